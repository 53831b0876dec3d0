"""The CPU vector environment: many hands, in worker processes or in the caller's own (Gymnasium 1.x semantics)."""

from __future__ import annotations

import multiprocessing
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from tslam_bench.constants import HORIZON
from tslam_bench.engine.hand_batch import FINAL, BatchSettings, HandBatch, batch_arrays
from tslam_bench.engine.hand_workers import HandWorkers, WorkerError
from tslam_bench.engine.requests import ResetRequest, check_action_repeat, check_actions, check_reset, check_whole
from tslam_bench.engine.same_step import info_at_the_end, with_masks
from tslam_bench.engine.spaces import OBSERVATION_ARRAYS, action_space, observation_space
from tslam_bench.errors import InvalidInputError

MAX_ENVIRONMENTS: Final = 4096
"""More environments than this on one machine are probably a mistake."""
STEP_TIMEOUT: Final = 60.0
"""Seconds after which a worker that has not answered counts as hung."""
INFO: Final = ("elapsed_steps", "new_touched", "new_visited")
"""Step arrays that ``info`` carries."""


class TactileVectorEnv(VectorEnv):
    """Many hands on the CPU, bit for bit the ManiSkill task (one ``PhysxCpuSystem`` per hand).

    Autoreset is ``SAME_STEP``, in the form of ``gymnasium.vector.SyncVectorEnv``: where an episode ends, observation and
    ``info`` are the next episode's first; ``info["final_obs"]``, a (num_envs,) array of objects, holds the true last
    observation (None where no episode ended), and ``info["final_info"]`` the last step's ``info``. Each entry of an info has
    a mask ``_name`` (num_envs,) bool. Environment ``i`` of ``reset(seed=s)`` has seed ``s + i`` and gives the same episodes
    as ``gymnasium.make`` with that seed. Actions (num_envs, 28); rewards float32.

    Args:
        num_envs: environments in all.
        settings: objects, pose, reward mode, control mode.
        processes: worker processes; None means the cores, but no more than there are environments, or none where the system
            refuses them (a warning says so). 0 steps in the caller's own
            process, without workers and shared memory, for notebooks, daemonic pools and debuggers: the same bits.
        timeout: seconds after which a worker that does not answer a step counts as hung.
        action_repeat: control steps that a step holds its action for; rewards and counts are added up. A divisor of the
            horizon. Bit for bit what that many steps with the same action give, with one request per worker.

    Raises:
        InvalidInputError: a bad number of environments, processes or repeats, unknown object, pose, reward or control mode;
            workers asked for in a daemonic process.
        AssetError: objects or the hand are not prepared.
        WorkerError: a worker died or hung. Whatever fails in a step or a reset after the checks, the environment is then closed.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012
    _hands: HandBatch | HandWorkers | None = None
    _broken: str = "is closed"

    def __init__(
        self,
        num_envs: int,
        settings: BatchSettings,
        processes: int | None = None,
        timeout: float = STEP_TIMEOUT,
        action_repeat: int = 1,
    ) -> None:
        self.num_envs = check_whole("num_envs", num_envs, 1, MAX_ENVIRONMENTS)
        workers = None if processes is None else check_whole("processes", processes, 0, 256)
        if not isinstance(timeout, (int, float)) or not 0 < timeout < float("inf"):
            raise InvalidInputError(f"timeout {timeout!r}: must be a number of seconds above 0")
        self.action_repeat = check_action_repeat(action_repeat)
        self._starts = settings.sampler()  # fail here, in one line, rather than in a worker
        if settings.object is None:  # workers need not list the split again, nor repeat its warning
            settings = replace(settings, objects=self._starts.names)
        self.single_observation_space = observation_space()
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._begun = False
        self._hands = None if workers == 0 else self._workers(settings, workers, float(timeout))
        if self._hands is None:
            self._arrays: dict[str, NDArray] = {
                name: np.zeros((self.num_envs, *shape), dtype) for name, (shape, dtype) in batch_arrays().items()
            }
            self._hands = HandBatch(self.num_envs, settings, self._arrays)
        else:
            self._arrays = self._hands.arrays

    def _workers(self, settings: BatchSettings, workers: int | None, timeout: float) -> HandWorkers | None:
        """The worker processes; None where the system refuses processes and nobody asked for a number of them."""
        reason = "this is a daemonic process, which may start no others"
        if workers is not None or not multiprocessing.current_process().daemon:
            try:
                return HandWorkers(self.num_envs, settings, workers, timeout)
            except OSError as error:  # no more processes, files or shared memory
                reason = f"the system refuses worker processes ({error})"
                if workers is not None:
                    raise WorkerError(f"{reason}; give processes=0") from error
        warnings.warn(f"{reason}; the hands are stepped in this one, with the same bits (processes=0)", stacklevel=4)
        return None

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Starts new episodes.

        Args:
            seed: of environment 0, counting up, or one per environment; None lets the generators go on.
            options: ``object`` and ``pose``, one value or one per environment; ``reset_mask``, (num_envs,) bool, which
                environments to reset.

        Raises:
            InvalidInputError: seeds or options of the wrong number, an unknown object or pose, a first reset of some alone.
        """
        hands = self._open()
        asked = check_reset(seed, options, self.num_envs, self._starts)
        if not (self._begun or asked.mask.all()):
            raise InvalidInputError("options['reset_mask']: the first reset is of all environments; leave it out")
        return self._whole("reset", self._reset, hands, asked)

    def step(self, actions: Any) -> tuple[dict[str, NDArray], NDArray, NDArray, NDArray, dict[str, Any]]:
        """One control step of every environment, or ``action_repeat`` of them.

        Raises:
            InvalidInputError: actions of the wrong shape or not finite, or no reset before.
            WorkerError: a worker died or hung.
        """
        hands = self._open()
        checked = check_actions(actions, self.num_envs)
        if not self._begun:
            raise InvalidInputError("step: no episode has begun; call reset first")
        return self._whole("step", self._step, hands, checked)

    def state(self) -> dict[str, Any]:
        """Objects, poses and touched steps (num_envs, 32, 32, 32) of the running episodes: for evaluation only."""
        return self._whole("state", self._open().state)

    def close_extras(self, **kwargs: Any) -> None:
        """Stops the workers."""
        hands, self._hands = self._hands, None
        if isinstance(hands, HandWorkers):
            hands.stop()

    def _reset(self, hands: HandBatch | HandWorkers, asked: ResetRequest) -> tuple[Any, ...]:
        envs = np.flatnonzero(asked.mask).tolist()
        if envs:
            objects = [asked.objects[env] for env in envs] if asked.objects else None
            poses = [asked.poses[env] for env in envs] if asked.poses else None
            hands.reset([asked.seeds[env] for env in envs], envs, objects, poses)
        self._begun = True
        return self._read(OBSERVATION_ARRAYS), with_masks(self._read(INFO), asked.mask.copy())

    def _step(self, hands: HandBatch | HandWorkers, actions: NDArray[np.float32]) -> tuple[Any, ...]:
        self._arrays["action"][:] = actions
        hands.step(self.action_repeat)
        truncated = self._arrays["truncated"].copy()
        counts = self._read(INFO)
        if truncated.any():
            envs = np.flatnonzero(truncated)
            counts["elapsed_steps"][envs] = HORIZON  # a new episode has begun there
            last = {name: self._arrays[FINAL + name][envs] for name in OBSERVATION_ARRAYS}
            info = info_at_the_end(counts, truncated.copy(), envs.tolist(), last)
        else:
            info = with_masks(counts, np.ones_like(truncated))
        reward = self._arrays["reward"].copy()
        return self._read(OBSERVATION_ARRAYS), reward, np.zeros_like(truncated), truncated, info

    def _open(self) -> HandBatch | HandWorkers:
        if self._hands is None:
            raise WorkerError(f"the vector environment {self._broken}; make a new one")
        return self._hands

    def _whole(self, name: str, call: Callable[..., Any], *arguments: Any) -> Any:
        """``call``, from its first effect to its answer; what fails or is interrupted in between closes the environment.

        Some hands may be a step ahead of others then, or all may be a step ahead of what the caller knows.
        """
        try:
            return call(*arguments)
        except BaseException as error:
            self._broken = f"is closed since {name} ended with {type(error).__name__}"
            self.close_extras()
            raise

    def _read(self, names: Any) -> dict[str, NDArray]:
        return {name: self._arrays[name].copy() for name in names}
