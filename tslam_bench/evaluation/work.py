"""One command of a run, and how it is run on whatever machine an engine has chosen for it.

The machines share the run's folder, the asset cache and the Python environment, under the same paths.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Final

from tslam_bench.errors import BenchmarkError, InvalidInputError
from tslam_bench.version import __version__

_THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "IGL_NUM_THREADS")
_CARRIED: Final = ("TSLAM_BENCH_CACHE", "XDG_CACHE_HOME", "PYTHONPATH")
"""Variables that decide what a command finds: those of the machine where the run was started count everywhere."""
_DIES_WITH_ITS_PARENT: Final = (
    "import ctypes, os, signal, sys\n"
    "ctypes.CDLL(None).prctl(1, signal.SIGKILL)\n"  # PR_SET_PDEATHSIG
    "signal.signal(signal.SIGINT, signal.SIG_DFL)\n"  # ignored in what a shell runs behind itself; it is how a job is stopped
    "signal.signal(signal.SIGUSR2, signal.SIG_IGN)\n"  # SLURM tells every process of a job that its time is up
    "os.getppid() == int(sys.argv[1]) or sys.exit('the process that started this has gone')\n"
    "os.execv(sys.argv[2], sys.argv[2:])\n"
)
"""Run by a Python of its own before the command takes its place: an engine that kills its worker knows nothing of the command."""


class LostError(BenchmarkError, RuntimeError):
    """A command did not end by itself: it was killed, or its machine was lost."""


@dataclass(frozen=True)
class Work:
    """One command, with all that another machine has to know.

    Attributes:
        name: of the job.
        command: program and arguments; ``tslam-bench`` is the installation of the machine that runs it.
        log: file that the output is appended to.
        slots: cores that it keeps busy.
        retries: times that it is started again where it is lost.
        folder: current folder of the command.
        environment: variables that it gets, besides those of the machine that runs it.
        version: tslam-bench's that planned it.
    """

    name: str
    command: tuple[str, ...]
    log: Path
    slots: int = 1
    retries: int = 0
    folder: Path = field(default_factory=Path.cwd)
    environment: Mapping[str, str] = field(default_factory=lambda: carried_variables())
    version: str = __version__

    def program(self) -> list[str]:
        """Program and arguments on this machine."""
        first, *others = self.command
        return [*([sys.executable, "-m", "tslam_bench.cli"] if first == "tslam-bench" else [first]), *others]


def carried_variables() -> dict[str, str]:
    """Variables of this process that a command gets wherever it runs: one thread each, unless the user says otherwise."""
    return {name: os.environ.get(name, "1") for name in _THREADS} | {
        name: os.environ[name] for name in _CARRIED if name in os.environ
    }


def describe(work: Work) -> str:
    """The command as one would type it."""
    return shlex.join(work.command)


def run_work(work: Work, place: str = "") -> int:
    """Runs the command on this machine; what an engine calls there. The command ends with this process.

    Args:
        work: the command.
        place: the engine's name of this machine or start, for the log.

    Returns:
        its exit status.

    Raises:
        InvalidInputError: another version of tslam-bench is installed here, or the run's folder is not there.
        LostError: it was killed.
    """
    host = socket.gethostname()
    if work.version != __version__:
        raise InvalidInputError(
            f"{host}: has tslam-bench {__version__}, and the run was started with {work.version}; install the same"
        )
    if not (work.log.parent.is_dir() and work.folder.is_dir()):
        raise InvalidInputError(
            f"{host}: there is no {work.log.parent}; the run's folder has to be shared by all machines"
        )
    with work.log.open("a", encoding="utf-8") as log, _alone(work.log.with_suffix(".lock"), log) as lock:
        print(f"\n# on {host} {place}".rstrip(), file=log, flush=True)  # what was cut off before has no end of line
        process = subprocess.Popen(
            [sys.executable, "-c", _DIES_WITH_ITS_PARENT, str(os.getpid()), *work.program()],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            cwd=work.folder,
            env={**os.environ, **work.environment},
            pass_fds=() if lock is None else (lock,),  # the lock is held until the command is gone
        )
        try:
            while process.poll() is None:
                time.sleep(0.1)  # not a wait: an engine's request to stop arrives between two instructions
        finally:
            stop_process(process)
    if process.returncode < 0:
        raise LostError(f"{work.name}: killed on {host} by signal {-process.returncode}")
    return process.returncode


def stop_process(process: subprocess.Popen, patience: float = 10.0) -> None:
    """Interrupts a process if it is still there, and kills it after ``patience`` seconds."""
    if process.poll() is not None:
        return
    process.send_signal(signal.SIGINT)
    try:
        process.wait(timeout=patience)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@contextlib.contextmanager
def _alone(path: Path, log: IO[str]) -> Iterator[int | None]:
    """Waits until no machine runs the same job: one that was given up as lost may still be at it. Yields the lock's descriptor.

    Where the file system has no locks it goes without.
    """
    try:
        import fcntl
    except ImportError:
        yield None
        return
    with path.open("w") as stream:
        waited = False
        while True:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if not waited:
                    print("\n# waits for an earlier start of the same job", file=log, flush=True)
                waited = True
                time.sleep(0.5)
            except OSError:
                yield None
                return
        yield stream.fileno()
