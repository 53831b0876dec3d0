"""Hands in worker processes: K scenes each, arrays in shared memory, and workers that die or hang are found.

Every request carries a number and every answer that of its request. Whatever comes between them, an exception of a signal
handler as well as another thread's call, stops the workers: no later call gets an earlier one's answer.
"""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import selectors
import signal
import traceback
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.engine.hand_batch import BatchSettings, HandBatch, batch_arrays
from tslam_bench.errors import AssetError, BenchmarkError, InvalidInputError

_BROKEN: Final = (OSError, EOFError, ValueError, KeyError, TypeError, AttributeError)
"""What pipes and selectors raise once they are closed."""
START_TIMEOUT: Final = 300.0
"""Seconds that the workers have for importing and building their scenes."""


class WorkerError(BenchmarkError, RuntimeError):
    """A worker process died, hung, raised something unforeseen, or was interrupted."""


class HandWorkers:
    """What :class:`HandBatch` is, spread over processes: the same calls, the same arrays, the same bits.

    Args:
        num_envs: environments in all.
        settings: what they are.
        processes: worker processes; None means the cores. Never more than there are environments.
        timeout: seconds after which a worker that does not answer a step counts as hung.

    Attributes:
        arrays: the arrays of :func:`batch_arrays`, each (num_envs, ...), in memory that the workers share.

    Raises:
        InvalidInputError, AssetError: what a worker's :class:`HandBatch` raises; this process may start no others.
        WorkerError: a worker died or hung, or the workers were stopped before. Whatever is raised, by a call or in one, all
            workers are then stopped.
    """

    def __init__(self, num_envs: int, settings: BatchSettings, processes: int | None, timeout: float) -> None:
        if multiprocessing.current_process().daemon:
            raise InvalidInputError(
                f"processes {processes!r}: this is a daemonic process, which may start no others; give processes=0"
            )
        self._timeout = timeout
        self._owner = os.getpid()
        self._number = 0  # of the last request
        count = min(processes or len(_available_cores()), num_envs)
        context = multiprocessing.get_context("spawn")
        # RawArrays are anonymous: nothing is left in the file system, even if the process is killed.
        raw = {
            name: context.RawArray("b", num_envs * _bytes(shape, dtype))
            for name, (shape, dtype) in batch_arrays().items()
        }
        self.arrays = _views(raw, num_envs)
        bounds = np.linspace(0, num_envs, count + 1).astype(int)
        self._slices = [slice(int(a), int(b)) for a, b in itertools.pairwise(bounds)]
        self._workers: list[tuple[Any, Any]] = []
        self._selector = selectors.DefaultSelector()
        try:
            for part, core in zip(self._slices, _cores(count), strict=True):
                ours, theirs = context.Pipe()
                process = context.Process(
                    target=_work, args=(theirs, ours, raw, num_envs, part, settings, core), daemon=True
                )
                try:
                    process.start()
                except OSError:
                    ours.close()
                    raise
                finally:
                    theirs.close()
                self._selector.register(ours, selectors.EVENT_READ, len(self._workers))
                self._workers.append((process, ours))
            self._collect(
                START_TIMEOUT, "a script has to make it below 'if __name__ == \"__main__\":' or with processes=0"
            )  # the answers to request 0
        except BaseException:
            self.stop()
            raise

    @property
    def processes(self) -> list[Any]:
        """The worker processes; none once they are stopped."""
        return [process for process, _ in self._workers]

    def reset(
        self,
        seeds: Sequence[int | None],
        envs: Sequence[int],
        objects: Sequence[str | None] | None = None,
        poses: Sequence[int | None] | None = None,
    ) -> None:
        """Starts new episodes in ``envs``, in increasing order; see :meth:`HandBatch.reset`."""
        requests: list[Any] = []
        for part in self._slices:
            own = [position for position, env in enumerate(envs) if part.start <= env < part.stop]
            request = (
                [seeds[position] for position in own],
                [envs[position] - part.start for position in own],
                [objects[position] for position in own] if objects else None,
                [poses[position] for position in own] if poses else None,
            )
            requests.append(request if own else None)
        self._ask("reset", requests, START_TIMEOUT)

    def step(self, repeat: int = 1) -> None:
        """``repeat`` control steps of all environments; see :meth:`HandBatch.step`."""
        self._ask("step", [repeat] * len(self._slices), self._timeout)

    def state(self) -> dict[str, Any]:
        """Objects, poses and touched steps; see :meth:`HandBatch.state`."""
        parts = self._ask("state", [None] * len(self._slices), self._timeout)
        return {
            "object_name": [name for part in parts for name in part["object_name"]],
            "pose": [pose for part in parts for pose in part["pose"]],
            "touched_step": np.concatenate([part["touched_step"] for part in parts]),
        }

    def stop(self) -> None:
        """Stops the workers, kills those that do not; safe to call twice, and in a forked process, which has none."""
        workers, self._workers = self._workers, []
        if os.getpid() != self._owner:
            return  # they and their pipes are the parent's
        try:
            for _, pipe in workers:
                self._send(pipe, (None, "stop", None))
                with contextlib.suppress(OSError):
                    pipe.close()
            for process, _ in workers:
                process.join(2)
        finally:  # an impatient second Ctrl-C, too
            for process, _ in workers:
                process.kill()
            self._selector.close()
        for process, _ in workers:
            process.join()

    def _ask(self, name: str, arguments: Sequence[Any], timeout: float) -> list[Any]:
        """One request to every worker, and their answers to it."""
        if os.getpid() != self._owner:
            raise WorkerError("the vector environment belongs to the process that made it; make one in this process")
        workers = self._workers
        if not workers:
            raise WorkerError("the workers were stopped; make a new environment")
        try:
            self._number += 1
            for (_, pipe), argument in zip(workers, arguments, strict=True):
                self._send(pipe, (self._number, name, argument))
            return self._collect(timeout)
        except BenchmarkError:
            self.stop()
            raise
        except _BROKEN as error:
            if self._workers is workers:
                self.stop()
                raise
            # A signal handler, or another thread, has closed them under our feet: pipes and selector are gone.
            raise WorkerError(f"the workers were stopped in the middle of a {name}; make a new environment") from error
        except BaseException:  # what was asked for may still come: nobody may take it for the answer to something else
            self.stop()
            raise

    def _send(self, pipe: Any, message: Any) -> None:
        # A dead worker's pipe breaks; _collect says so with its exit code.
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            pipe.send(message)

    def _collect(self, timeout: float, remedy: str = "make a new environment") -> list[Any]:
        """The answer of every worker to the last request, in order; stops all of them and raises if any fails."""
        number, workers = self._number, self._workers
        answers: dict[int, Any] = {}
        left = timeout
        while len(answers) < len(workers):
            # In slices, so that time during which all processes are stopped (Ctrl-Z, a batch system) does not count.
            waited = min(left, 1.0)
            ready = self._selector.select(waited)
            left -= 0.0 if ready else waited
            if left <= 0:
                silent = next(index for index in range(len(workers)) if index not in answers)
                self.stop()
                raise WorkerError(f"worker {silent}: no answer for {timeout:g} s; all workers were stopped")
            for key, _ in ready:
                process, pipe = workers[key.data]
                try:
                    answered, kind, answer = pipe.recv()
                except (
                    EOFError,
                    OSError,
                ):  # a worker that dies closes its end of the pipe, maybe in the middle of an answer
                    if self._workers is not workers:
                        raise
                    process.join(5)
                    self.stop()
                    raise WorkerError(
                        f"worker {key.data}: died (exit code {process.exitcode}); all workers were stopped, {remedy}; "
                        "tslam-bench doctor tells whether memory or a library is missing"
                    ) from None
                if kind == "error":
                    self.stop()
                    raise answer
                if answered != number:
                    self.stop()
                    raise WorkerError(f"worker {key.data}: its answer was to another request; use one thread only")
                answers[key.data] = answer
        return [answers[index] for index in range(len(workers))]


def _available_cores() -> list[int]:
    """The cores that this process may use."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [*range(os.cpu_count() or 1)]


def _cores(count: int) -> list[int | None]:
    """The core that each of ``count`` workers keeps to, or None: one each, if they take all that this process may use.

    Left alone, the scheduler often wakes two workers on one core while the other idles, for a good part of a step.
    """
    available = _available_cores()
    return [*available] if len(available) == count > 1 and hasattr(os, "sched_setaffinity") else [None] * count


def _settle(core: int | None) -> None:
    """Keeps this process to a core, and makes it wait for the parent to have told every worker to start."""
    if core is not None:
        os.sched_setaffinity(0, {core})
    if hasattr(os, "SCHED_BATCH"):  # such a process does not preempt the one that wakes it
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def _bytes(shape: tuple[int, ...], dtype: type) -> int:
    return int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize


def _views(raw: Mapping[str, Any], num_envs: int) -> dict[str, NDArray]:
    return {
        name: np.frombuffer(raw[name], dtype=dtype).reshape(num_envs, *shape)
        for name, (shape, dtype) in batch_arrays().items()
    }


def _work(
    pipe: Any, parent: Any, raw: Any, num_envs: int, part: slice, settings: BatchSettings, core: int | None
) -> None:
    """A worker: builds its scenes, then answers requests until the parent stops it or goes away."""
    _settle(core)
    parent.close()  # or the pipe would not break when the parent dies
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; what it means is the parent's to say
    number: int | None = 0
    try:
        arrays = {name: view[part] for name, view in _views(raw, num_envs).items()}
        batch = HandBatch(part.stop - part.start, settings, arrays)
        pipe.send((number, "ready", None))
        while True:
            number, request, argument = pipe.recv()
            if request == "stop":
                return
            answer = None
            if request == "step":
                batch.step(argument)
            elif request == "state":
                answer = batch.state()
            elif argument is not None:
                batch.reset(*argument)
            pipe.send((number, "done", answer))
    except (EOFError, BrokenPipeError, ConnectionResetError, KeyboardInterrupt):
        return
    except (InvalidInputError, AssetError) as error:
        pipe.send((number, "error", error))
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        message = f"worker raised {type(error).__name__}: {error} ({where.name}, line {where.lineno})"
        pipe.send((number, "error", WorkerError(message.replace("\n", " "))))
