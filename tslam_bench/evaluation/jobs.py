"""Runs the commands of a run: in parallel where they do not depend on each other, each once, with a log.

A job that ended well leaves a stamp of its command and of the jobs before it. While the stamp fits and its outputs are there,
the job is not run again; so a run that was killed goes on, and a changed setting runs again what follows from it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final

from tslam_bench.errors import BenchmarkError, InvalidInputError
from tslam_bench.files import ensure_writable_directory, write_json
from tslam_bench.version import __version__

_PERCENT: Final = re.compile(r"(\d{1,3})%\|")
_THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "IGL_NUM_THREADS")


class JobError(BenchmarkError, RuntimeError):
    """A job of the run failed."""


@dataclass(frozen=True)
class Job:
    """One command.

    Attributes:
        name: also names its log and stamp.
        command: program and arguments; ``tslam-bench`` is this installation's.
        after: names of the jobs that have to end well before.
        outputs: paths that it leaves; if one is gone it is run again.
        slots: processes that it keeps busy.
        always: run it even if it was done before.
        fingerprint: called after the job; what it returns must be the same whenever the folder is used again.
    """

    name: str
    command: tuple[str, ...]
    after: tuple[str, ...] = ()
    outputs: tuple[Path, ...] = ()
    slots: int = 1
    always: bool = False
    fingerprint: Callable[[], str] | None = None


@dataclass
class _Running:
    job: Job
    process: subprocess.Popen
    log: Path
    stream: IO[str]
    started: float = field(default_factory=time.monotonic)


class JobRunner:
    """Runs jobs below one folder.

    Args:
        folder: gets ``logs/<job>.log``, ``logs/<job>.json`` (stamps) and a lock.
        workers: processes at a time.
        say: prints one line.
        show: called about once a second with (jobs done, all jobs, what is running).

    Raises:
        AssetError: the folder cannot be written.
    """

    def __init__(
        self, folder: Path, workers: int, say: Callable[[str], None], show: Callable[[int, int, str], None]
    ) -> None:
        if workers < 1:
            raise InvalidInputError(f"workers {workers}: must be at least 1")
        self.logs = ensure_writable_directory(folder / "logs")
        self.workers = workers
        self._say, self._show = say, show
        self._stamps: dict[str, str] = {}

    def run(self, jobs: Sequence[Job]) -> None:
        """Runs every job; returns when all have ended well.

        Raises:
            JobError: a job failed (its log's last line is in the message); the others are stopped.
            InvalidInputError: another run uses the same folder.
        """
        with _locked(self.logs / "run.lock") as lock:
            self._run(list(jobs), lock)

    def _run(self, jobs: list[Job], lock: int | None) -> None:
        waiting, finished = list(jobs), set[str]()
        running: list[_Running] = []
        for job in jobs:
            self._stamps[job.name] = self._stamp(job)
        try:
            while waiting or running:
                for job in list(waiting):
                    if not set(job.after) <= finished:
                        continue
                    if self._is_done(job):
                        self._say(f"[{len(finished) + 1}/{len(jobs)}] {job.name}: done before")
                        finished.add(job.name)
                        waiting.remove(job)
                    elif not running or sum(r.job.slots for r in running) + job.slots <= self.workers:
                        running.append(self._start(job, lock))
                        waiting.remove(job)
                for current in list(running):
                    if current.process.poll() is None:
                        continue
                    running.remove(current)
                    self._end(current)
                    finished.add(current.job.name)
                    seconds = time.monotonic() - current.started
                    self._say(f"[{len(finished)}/{len(jobs)}] {current.job.name}: done in {seconds:.0f} s")
                self._show(len(finished), len(jobs), ", ".join(_described(r) for r in running))
                if running:
                    time.sleep(0.2)
        finally:
            for current in running:
                _stop(current)

    def _stamp(self, job: Job) -> str:
        before = [self._stamps[name] for name in job.after]
        return hashlib.sha256(json.dumps([__version__, job.command, before]).encode()).hexdigest()

    def _is_done(self, job: Job) -> bool:
        if job.always:
            return False
        stored = self._stored(job).get("stamp")
        return stored == self._stamps[job.name] and all(output.exists() for output in job.outputs)

    def _stored(self, job: Job) -> dict[str, Any]:
        """The stamp of an earlier run; empty if there is none."""
        try:
            stamp = json.loads((self.logs / f"{job.name}.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return stamp if isinstance(stamp, dict) else {}

    def _start(self, job: Job, lock: int | None) -> _Running:
        self._say(f"$ {shlex.join(job.command)}")
        log = self.logs / f"{job.name}.log"
        stream = log.open("w", encoding="utf-8")
        stream.write(f"$ {shlex.join(job.command)}\n")
        stream.flush()
        program = [sys.executable, "-m", "tslam_bench.cli"] if job.command[0] == "tslam-bench" else [job.command[0]]
        process = subprocess.Popen(
            [*program, *job.command[1:]],
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            env={**dict.fromkeys(_THREADS, "1"), **os.environ},
            pass_fds=() if lock is None else (lock,),  # the lock is held until the last job is gone
        )
        return _Running(job, process, log, stream)

    def _end(self, current: _Running) -> None:
        current.stream.close()
        code = current.process.returncode
        missing = [output for output in current.job.outputs if not output.exists()]
        if code == 0 and not missing:
            fingerprint = current.job.fingerprint() if current.job.fingerprint else None
            command = shlex.join(current.job.command)
            stored = self._stored(current.job)
            if stored.get("command") == command and stored.get("fingerprint") != fingerprint:
                raise InvalidInputError(
                    f"{self.logs.parent}: was made with other products of {current.job.name}; "
                    "delete it or choose another folder"
                )
            stamp = {
                "stamp": self._stamps[current.job.name],
                "command": command,
                "fingerprint": fingerprint,
                "seconds": round(time.monotonic() - current.started, 1),
            }
            write_json(self.logs / f"{current.job.name}.json", stamp)
            return
        reason = f"wrote no {missing[0]}" if code == 0 else _last_line(current.log)
        raise JobError(f"{current.job.name} failed with status {code}: {reason} (log: {current.log})")


def _described(current: _Running) -> str:
    """Name of a running job and how far its progress bar is."""
    with current.log.open("rb") as stream:
        stream.seek(max(current.log.stat().st_size - 400, 0))
        found = _PERCENT.findall(stream.read().decode("utf-8", errors="replace"))
    return current.job.name + (f" {found[-1]}%" if found else "")


def _last_line(log: Path) -> str:
    lines = [line.strip() for line in re.split(r"[\r\n]", log.read_text(encoding="utf-8", errors="replace"))]
    return next((line for line in reversed(lines) if line), "no output")


def _stop(current: _Running) -> None:
    """Interrupts a job, then ends it."""
    if current.process.poll() is None:
        current.process.send_signal(signal.SIGINT)
        try:
            current.process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            current.process.kill()
            current.process.wait()
    current.stream.close()


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[int | None]:
    """Holds a lock that jobs inherit. Systems without ``fcntl``, and file systems without locks, go without.

    Raises:
        InvalidInputError: another run holds it.
    """
    try:
        import fcntl
    except ImportError:
        yield None
        return
    with path.open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            folder = path.parent.parent
            raise InvalidInputError(f"{folder}: another run uses this folder; wait for it or choose another") from None
        except OSError as error:  # many network file systems
            reason = f"cannot be locked ({error.strerror})"
            warnings.warn(f"{path.parent.parent}: {reason}; start no second run in this folder", stacklevel=1)
            yield None
            return
        yield stream.fileno()
