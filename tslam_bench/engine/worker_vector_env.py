"""The CPU vector environment: K scenes per worker process, observations through shared memory (Gymnasium 1.x semantics)."""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import selectors
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from tslam_bench.constants import HORIZON, NUM_JOINTS
from tslam_bench.engine.hand_batch import FINAL, BatchSettings, HandBatch, batch_arrays
from tslam_bench.engine.spaces import OBSERVATION_ARRAYS, action_space, observation_space
from tslam_bench.errors import AssetError, BenchmarkError, InvalidInputError
from tslam_bench.hand_constants import JOINT_NAMES

MAX_ENVIRONMENTS: Final = 4096
"""More environments than this on one machine are probably a mistake."""
STEP_TIMEOUT: Final = 60.0
"""Seconds after which a worker that has not answered counts as hung."""
START_TIMEOUT: Final = 300.0
"""Seconds that the workers have for importing and building their scenes."""


class WorkerError(BenchmarkError, RuntimeError):
    """A worker process died, hung, or raised something unforeseen."""


class TactileVectorEnv(VectorEnv):
    """Many hands on the CPU, bit for bit the ManiSkill task (one ``PhysxCpuSystem`` per hand).

    Autoreset is ``SAME_STEP``: where an episode ends, the returned observation is the next episode's first, and
    ``info["final_obs"]`` (a dict of (num_envs, ...) arrays, valid where ``info["_final_obs"]``) is the true last one, as
    ``info["final_info"]`` is for ``info``. Environment ``i`` of ``reset(seed=s)`` has seed ``s + i`` and gives the same
    episodes as ``gymnasium.make`` with that seed. Actions (num_envs, 28); rewards float32.

    Args:
        num_envs: environments in all.
        settings: objects, pose, reward mode, control mode.
        processes: worker processes; None means the cores, but no more than there are environments.
        timeout: seconds after which a worker that does not answer a step counts as hung.
        action_repeat: control steps that a step holds its action for; rewards and counts are added up. A divisor of the
            horizon. Bit for bit what that many steps with the same action give, with one request per worker.

    Raises:
        InvalidInputError: a bad number of environments, processes or repeats, unknown object, pose, reward or control mode.
        AssetError: objects or the hand are not prepared.
        WorkerError: a worker died or hung; all workers are then stopped.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int,
        settings: BatchSettings,
        processes: int | None = None,
        timeout: float = STEP_TIMEOUT,
        action_repeat: int = 1,
    ) -> None:
        for name, value, low, high in (
            ("num_envs", num_envs, 1, MAX_ENVIRONMENTS),
            ("processes", 1 if processes is None else processes, 1, 256),
        ):
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not low <= value <= high:
                raise InvalidInputError(f"{name} {value!r}: must be a whole number from {low} to {high}")
        if not isinstance(timeout, (int, float)) or not 0 < timeout < float("inf"):
            raise InvalidInputError(f"timeout {timeout!r}: must be a number of seconds above 0")
        self.action_repeat = check_action_repeat(action_repeat)
        self._timeout = float(timeout)
        self._starts = settings.sampler()  # fail here, in one line, rather than in a worker
        self._variant = self._starts.variant
        if settings.object is None:  # workers need not list the split again, nor repeat its warning
            settings = replace(settings, objects=self._starts.names)
        self.num_envs = int(num_envs)
        self.single_observation_space = observation_space()
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.closed = False
        count = min(int(processes or len(_available_cores())), self.num_envs)
        context = multiprocessing.get_context("spawn")
        # RawArrays are anonymous: nothing is left in the file system, even if the process is killed.
        self._raw = {
            name: context.RawArray("b", self.num_envs * _bytes(shape, dtype))
            for name, (shape, dtype) in batch_arrays().items()
        }
        self._arrays = _views(self._raw, self.num_envs)
        bounds = np.linspace(0, self.num_envs, count + 1).astype(int)
        self._slices = [slice(int(a), int(b)) for a, b in itertools.pairwise(bounds)]
        self._workers: list[tuple[Any, Any]] = []
        self._selector = selectors.DefaultSelector()
        try:
            for part, core in zip(self._slices, _cores(count), strict=True):
                ours, theirs = context.Pipe()
                process = context.Process(
                    target=_work, args=(theirs, ours, self._raw, self.num_envs, part, settings, core), daemon=True
                )
                process.start()
                theirs.close()
                self._selector.register(ours, selectors.EVENT_READ, len(self._workers))
                self._workers.append((process, ours))
            self._collect(START_TIMEOUT, "a script has to make it below 'if __name__ == \"__main__\":'")
        except BaseException:
            self._stop()
            raise

    # -- Gymnasium --------------------------------------------------------------------------------------------
    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Starts new episodes.

        Args:
            seed: of environment 0, counting up, or one per environment; None lets the generators go on.
            options: ``object`` and ``pose``, one value or one per environment; ``reset_mask``, (num_envs,) bool, which
                environments to reset.
        """
        self._check_open()
        options = options or {}
        if seed is None or isinstance(seed, (int, np.integer)):
            seeds = [None if seed is None else int(seed) + env for env in range(self.num_envs)]
        else:
            seeds = self._one_each("seed", list(seed))
        mask = np.asarray(options.get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise InvalidInputError(
                f"options['reset_mask']: shape {mask.shape} {mask.dtype}; give ({self.num_envs},) bool"
            )
        names = self._option(options, "object")
        poses = self._option(options, "pose")
        for pose in poses or ():
            self._variant.check_pose(pose)
        for name in names or ():
            if name is not None:
                self._starts.check_name(name)
        for part, (_, pipe) in zip(self._slices, self._workers, strict=True):
            envs = np.flatnonzero(mask[part]).tolist()
            chosen = [part.start + env for env in envs]
            request = (
                [seeds[env] for env in chosen],
                envs,
                [names[env] for env in chosen] if names else None,
                [poses[env] for env in chosen] if poses else None,
            )
            self._send(pipe, ("reset", request if envs else None))
        self._collect(START_TIMEOUT)
        return self._observation(), self._info()

    def step(self, actions: Any) -> tuple[dict[str, NDArray], NDArray, NDArray, NDArray, dict[str, Any]]:
        """One control step of every environment, or ``action_repeat`` of them.

        Raises:
            InvalidInputError: actions of the wrong shape or not finite.
            WorkerError: a worker died or hung.
        """
        self._check_open()
        self._arrays["action"][:] = self._checked(actions)
        for _, pipe in self._workers:
            self._send(pipe, ("step", self.action_repeat))
        self._collect(self._timeout)
        truncated = self._arrays["truncated"].copy()
        info = self._info()
        if truncated.any():
            info["final_obs"] = {name: self._arrays[FINAL + name].copy() for name in OBSERVATION_ARRAYS}
            info["_final_obs"] = truncated.copy()
            info["final_info"] = {name: info[name].copy() for name in ("new_touched", "new_visited")}
            info["final_info"]["elapsed_steps"] = np.where(truncated, HORIZON, 0).astype(np.int32)
            info["_final_info"] = truncated.copy()
        return self._observation(), self._arrays["reward"].copy(), np.zeros_like(truncated), truncated, info

    def state(self) -> dict[str, Any]:
        """Objects, poses and touched steps (num_envs, 32, 32, 32) of the running episodes: for evaluation only."""
        self._check_open()
        for _, pipe in self._workers:
            self._send(pipe, ("state", None))
        parts = self._collect(self._timeout)
        return {
            "object_name": [name for part in parts for name in part["object_name"]],
            "pose": [pose for part in parts for pose in part["pose"]],
            "touched_step": np.concatenate([part["touched_step"] for part in parts]),
        }

    def close_extras(self, **kwargs: Any) -> None:
        """Stops the workers."""
        self._stop()

    # -- checks -----------------------------------------------------------------------------------------------
    def _checked(self, actions: Any) -> NDArray[np.float32]:
        try:
            value = np.asarray(actions, dtype=np.float32)
        except (TypeError, ValueError) as error:
            raise InvalidInputError(f"actions: not an array of numbers ({error})") from error
        if value.shape != (self.num_envs, NUM_JOINTS):
            raise InvalidInputError(f"actions: shape {value.shape}, expected ({self.num_envs}, {NUM_JOINTS})")
        finite = np.isfinite(value)
        if not finite.all():
            env, joint = (int(i) for i in np.argwhere(~finite)[0])
            raise InvalidInputError(
                f"actions: not finite for joint {JOINT_NAMES[joint]} of environment {env}; give numbers in [-1, 1]"
            )
        return value

    def _one_each(self, name: str, values: list) -> list:
        if len(values) != self.num_envs:
            raise InvalidInputError(f"{name}: {len(values)} values for {self.num_envs} environments; give one each")
        return values

    def _option(self, options: Mapping[str, Any], name: str) -> list | None:
        if name not in options:
            return None
        value = options[name]
        values = list(value) if isinstance(value, (list, tuple, np.ndarray)) else [value] * self.num_envs
        return self._one_each(f"options[{name!r}]", values)

    def _check_open(self) -> None:
        if self.closed or not self._workers:
            raise WorkerError("the vector environment is closed; make a new one")

    # -- workers ----------------------------------------------------------------------------------------------
    def _send(self, pipe: Any, message: Any) -> None:
        # A dead worker's pipe breaks; _collect says so with its exit code.
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            pipe.send(message)

    def _collect(self, timeout: float, remedy: str = "make a new environment") -> list[Any]:
        """One answer from every worker, in order; stops all of them and raises if any fails."""
        answers: dict[int, Any] = {}
        left = timeout
        while len(answers) < len(self._workers):
            # In slices, so that time during which all processes are stopped (Ctrl-Z, a batch system) does not count.
            waited = min(left, 1.0)
            ready = self._selector.select(waited)
            left -= 0.0 if ready else waited
            if left <= 0:
                silent = next(index for index in range(len(self._workers)) if index not in answers)
                self._stop()
                raise WorkerError(f"worker {silent}: no answer for {timeout:g} s; all workers were stopped")
            for key, _ in ready:
                process, pipe = self._workers[key.data]
                try:
                    kind, answer = pipe.recv()
                except (EOFError, ConnectionResetError):  # a worker that dies closes its end of the pipe
                    process.join(5)
                    self._stop()
                    raise WorkerError(
                        f"worker {key.data}: died (exit code {process.exitcode}); all workers were stopped, {remedy}"
                    ) from None
                if kind == "error":
                    self._stop()
                    raise answer
                answers[key.data] = answer
        return [answers[index] for index in range(len(self._workers))]

    def _stop(self) -> None:
        for _, pipe in self._workers:
            self._send(pipe, ("stop", None))
            with contextlib.suppress(OSError):
                pipe.close()
        for process, _ in self._workers:
            process.join(2)
            if process.is_alive():
                process.kill()
                process.join()
        self._workers = []
        self._selector.close()

    def _observation(self) -> dict[str, NDArray]:
        return {name: self._arrays[name].copy() for name in OBSERVATION_ARRAYS}

    def _info(self) -> dict[str, Any]:
        return {name: self._arrays[name].copy() for name in ("elapsed_steps", "new_touched", "new_visited")}


def check_action_repeat(action_repeat: int) -> int:
    """Raises InvalidInputError unless episodes are whole numbers of ``action_repeat`` control steps."""
    whole = isinstance(action_repeat, (int, np.integer)) and not isinstance(action_repeat, bool)
    if not whole or action_repeat < 1 or HORIZON % action_repeat:
        raise InvalidInputError(f"action_repeat {action_repeat!r}: must divide the {HORIZON} steps of an episode")
    return int(action_repeat)


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
    try:
        arrays = {name: view[part] for name, view in _views(raw, num_envs).items()}
        batch = HandBatch(part.stop - part.start, settings, arrays)
        pipe.send(("ready", None))
        while True:
            request, argument = pipe.recv()
            if request == "stop":
                return
            answer = None
            if request == "step":
                batch.step(argument)
            elif request == "state":
                answer = batch.state()
            elif argument is not None:
                batch.reset(*argument)
            pipe.send(("done", answer))
    except (EOFError, BrokenPipeError, ConnectionResetError, KeyboardInterrupt):
        return
    except (InvalidInputError, AssetError) as error:
        pipe.send(("error", error))
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        message = f"worker raised {type(error).__name__}: {error} ({where.name}, line {where.lineno})"
        pipe.send(("error", WorkerError(message.replace("\n", " "))))
