"""Runs the commands of a run: in parallel where they do not depend on each other, each once, with a log.

A job that ended well leaves a stamp of its command and of the jobs before it. While the stamp fits and its outputs are there,
the job is not run again; so a run that was killed goes on, and a changed setting runs again what follows from it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import shlex
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from tslam_bench.errors import BenchmarkError, InvalidInputError
from tslam_bench.evaluation.launchers import Launched, Launcher
from tslam_bench.evaluation.work import LostError, Work
from tslam_bench.files import ensure_writable_directory, write_json
from tslam_bench.version import __version__

_PERCENT: Final = re.compile(r"(\d{1,3})%\|")


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
        slots: cores that it keeps busy.
        retries: times that an engine starts it again where it is killed or its machine is lost. What a command has done it
            does not do again.
        always: run it even if it was done before.
        fingerprint: called after the job; what it returns must be the same whenever the folder is used again.
    """

    name: str
    command: tuple[str, ...]
    after: tuple[str, ...] = ()
    outputs: tuple[Path, ...] = ()
    slots: int = 1
    retries: int = 2
    always: bool = False
    fingerprint: Callable[[], str] | None = None


@dataclass
class _Running:
    job: Job
    launched: Launched
    log: Path
    started: float = field(default_factory=time.monotonic)


class JobRunner:
    """Runs jobs below one folder.

    Args:
        folder: gets ``logs/<job>.log``, ``logs/<job>.json`` (stamps) and a lock.
        launcher: runs their commands.
        say: prints one line.
        show: called about once a second with (jobs done, all jobs, what is running).

    Raises:
        AssetError: the folder cannot be written.
    """

    def __init__(
        self, folder: Path, launcher: Launcher, say: Callable[[str], None], show: Callable[[int, int, str], None]
    ) -> None:
        self.logs = ensure_writable_directory(folder / "logs").absolute()
        self._launcher = launcher
        self._say, self._show = say, show
        self._stamps: dict[str, str] = {}

    def run(self, jobs: Sequence[Job]) -> None:
        """Runs every job; returns when all have ended well.

        Raises:
            JobError: a job failed (its log's last line is in the message); the others are stopped.
            InvalidInputError: another run uses the same folder, or no machine has the cores that a job wants.
        """
        self._launcher.check(max((job.slots for job in jobs), default=1))
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
                    elif self._has_room(running, job):
                        running.append(self._start(job, lock))
                        waiting.remove(job)
                for current in list(running):
                    code = self._status(current)
                    if code is None:
                        continue
                    running.remove(current)
                    self._end(current, code)
                    finished.add(current.job.name)
                    seconds = time.monotonic() - current.started
                    self._say(f"[{len(finished)}/{len(jobs)}] {current.job.name}: done in {seconds:.0f} s")
                self._show(len(finished), len(jobs), ", ".join(_described(r) for r in running))
                if running:
                    time.sleep(0.2)
        finally:
            for current in running:
                current.launched.stop()

    def _has_room(self, running: Sequence[_Running], job: Job) -> bool:
        cores = self._launcher.cores
        return not running or cores is None or sum(r.job.slots for r in running) + job.slots <= cores

    def _status(self, current: _Running) -> int | None:
        try:
            return current.launched.poll()
        except LostError as error:
            raise JobError(f"{error} (log: {current.log})") from error

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
        log.write_text(f"$ {shlex.join(job.command)}\n", encoding="utf-8")
        work = Work(job.name, job.command, log, job.slots, job.retries)
        return _Running(job, self._launcher.start(work, lock), log)

    def _end(self, current: _Running, code: int) -> None:
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
