"""Worker processes that survive what native geometry code can do to them: a crash or a hang costs one object, not the run."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar

from tslam_bench.errors import AssetError

Item = TypeVar("Item")
Result = TypeVar("Result")

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "IGL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# glibc gives large arrays back as soon as they are freed; clearing fresh pages for the next ones took a twelfth of all time.
_ALLOCATOR_VARIABLES = {"MALLOC_MMAP_THRESHOLD_": str(2**32), "MALLOC_TRIM_THRESHOLD_": str(2**32)}
MEMORY_LIMIT = 8 * 2**30
"""Address space (bytes) of a worker: a job that asks for more fails alone, instead of bringing the machine down."""


def _limit_memory(limit: int) -> None:
    """Limits this process's address space, where the operating system can."""
    try:
        import resource
    except ImportError:  # Windows
        return
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    if hard == resource.RLIM_INFINITY or limit < hard:
        with contextlib.suppress(ValueError, OSError):  # macOS refuses
            resource.setrlimit(resource.RLIMIT_AS, (limit, hard))


def _serve(connection: Connection, function: Callable[..., Any], memory_limit: int = MEMORY_LIMIT) -> None:
    """Worker loop: one job after the other, each on one thread so that workers do not fight for the cores."""
    _limit_memory(memory_limit)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with contextlib.suppress(EOFError, KeyboardInterrupt, BrokenPipeError):
        while True:
            connection.send(function(*connection.recv()))


def _end_with_parent() -> None:
    """Ends this process once its parent is gone, however that ended: a job can go on for minutes."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _refused(error: OSError) -> AssetError:
    reason = error.strerror or str(error)
    return AssetError(f"preparation works in processes, and the system refuses one ({reason}); give it fewer --workers")


@dataclass
class _Worker(Generic[Item]):
    """One process and what it works on."""

    process: Any
    connection: Connection
    item: Item | None = None
    started: float = 0.0


@dataclass
class WorkerPool(Generic[Item, Result]):
    """A few processes that run ``function(*arguments)``.

    Attributes:
        function: importable function; its result must be picklable and it should not raise.
        size: processes.
        time_limit: seconds after which a job is given up and its process killed.
        memory_limit: bytes of address space of each process.
    """

    function: Callable[..., Result]
    size: int
    time_limit: float
    memory_limit: int = MEMORY_LIMIT
    _workers: list[_Worker[Item]] = field(default_factory=list)

    @property
    def busy(self) -> int:
        """Jobs that are running."""
        return sum(worker.item is not None for worker in self._workers)

    @property
    def has_room(self) -> bool:
        """Whether another job can start now."""
        return self.busy < self.size

    def submit(self, item: Item, arguments: tuple[Any, ...]) -> None:
        """Starts ``function(*arguments)`` on behalf of ``item``. There must be room."""
        worker = next((w for w in self._workers if w.item is None), None) or self._start()
        worker.item, worker.started = item, time.monotonic()
        worker.connection.send(arguments)

    def results(self) -> Iterator[tuple[Item, Result | None, str]]:
        """Waits until at least one job has ended; yields (item, result, "") or (item, None, reason) for each."""
        while self.busy:
            busy = [worker for worker in self._workers if worker.item is not None]
            patience = self.time_limit - (time.monotonic() - min(worker.started for worker in busy))
            ready = wait([w.connection for w in busy], timeout=max(patience, 0.0))
            ended = [w for w in busy if w.connection in ready]
            ended += [w for w in busy if w not in ended and time.monotonic() - w.started >= self.time_limit]
            for worker in ended:
                item = worker.item
                assert item is not None
                if worker.connection in ready:
                    try:
                        result: Result = worker.connection.recv()
                        worker.item = None
                        yield item, result, ""
                        continue
                    except (EOFError, OSError):
                        worker.process.join()
                        reason = f"the worker process crashed (exit status {worker.process.exitcode})"
                else:
                    reason = f"given up after {self.time_limit:.0f} s"
                self._stop(worker)
                yield item, None, reason
            if ended:
                return

    def close(self) -> None:
        """Stops all processes at once; running jobs are lost."""
        for worker in list(self._workers):
            self._stop(worker)

    def _start(self) -> _Worker[Item]:
        """Another process: without one there is nothing that a crash could be kept to.

        Raises:
            AssetError: the system refuses it.
        """
        if multiprocessing.current_process().daemon:
            raise AssetError("preparation works in processes, and a daemonic one may start none; start it elsewhere")
        context = multiprocessing.get_context("spawn")
        try:
            ours, theirs = context.Pipe()
        except OSError as error:
            raise _refused(error) from error
        process = context.Process(target=_serve, args=(theirs, self.function, self.memory_limit), daemon=True)
        variables = dict.fromkeys(_THREAD_VARIABLES, "1") | _ALLOCATOR_VARIABLES
        before = {variable: os.environ.get(variable) for variable in variables}
        os.environ.update(variables)  # read when the libraries load, in the new process
        try:
            process.start()
        except OSError as error:
            ours.close()
            raise _refused(error) from error
        finally:
            theirs.close()
            for variable, value in before.items():
                if value is None:
                    os.environ.pop(variable, None)
                else:
                    os.environ[variable] = value
        worker: _Worker[Item] = _Worker(process, ours)
        self._workers.append(worker)
        return worker

    def _stop(self, worker: _Worker[Item]) -> None:
        self._workers.remove(worker)
        worker.process.kill()
        worker.process.join()
        worker.connection.close()
