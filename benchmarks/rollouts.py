"""Rollouts that the benchmarks share: objects, actions, and a batch of hands in this process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import HORIZON, NUM_JOINTS
from tslam_bench.engine.hand_batch import BatchSettings, HandBatch

TEN_OBJECTS: Final = (
    *("mug", "stanfordbunny", "toruslarge", "wineglass", "hammer"),
    *("cubemedium", "apple", "camera", "scissors", "teapot"),
)
"""Test objects of different hull counts (1 to 128), the wine glass with the thinnest walls."""
THIN_OBJECTS: Final = ("wineglass", "bowl", "fryingpan", "cup")
"""Test objects with walls of 2 to 4 mm."""
HEIGHT: Final = 1
"""Index of ARTy, the joint that lifts the hand."""
HOLD: Final = 10
"""Control steps that a pressing hand keeps an action for."""
TARGET_HOLD: Final = 4
TARGET_SPREAD: Final = 0.6
"""Random absolute targets are kept for so many control steps, and have this standard deviation (1 is half a joint's range)."""


def exploring_actions(generator: np.random.Generator, num_envs: int, step: int) -> NDArray[np.float32]:
    """(num_envs, 28) random actions that send the hand down in the first quarter of an episode."""
    value = generator.uniform(-1, 1, (num_envs, NUM_JOINTS)).astype(np.float32)
    if step % HORIZON < HORIZON // 4:
        value[:, HEIGHT] = -1.0
    return value


class ExploringHands:
    """:func:`exploring_actions` of a generator of their own."""

    def __init__(self, num_envs: int, seed: int) -> None:
        self._generator = np.random.Generator(np.random.PCG64(seed))
        self._num_envs = num_envs

    def __call__(self, step: int, qpos: NDArray) -> NDArray[np.float32]:
        """(num_envs, 28) actions, whatever the joint positions."""
        return exploring_actions(self._generator, self._num_envs, step)


class TargetHands:
    """Absolute targets as learning uses them: normal, held for ``TARGET_HOLD`` steps."""

    def __init__(self, num_envs: int, seed: int) -> None:
        self._generator = np.random.Generator(np.random.PCG64(seed))
        self._held = np.zeros((num_envs, NUM_JOINTS), dtype=np.float32)

    def __call__(self, step: int, qpos: NDArray) -> NDArray[np.float32]:
        """(num_envs, 28) actions, whatever the joint positions."""
        if step % TARGET_HOLD == 0:
            self._held = self._generator.normal(0, TARGET_SPREAD, self._held.shape).astype(np.float32)
        return self._held


class PressingHands:
    """Actions of hands that press on what lies at the workspace centre: random, held for ``HOLD`` steps, mostly downwards.

    Args:
        num_envs: hands.
        seed: of their random numbers.
        absolute: whether the actions are those of ``pd_joint_pos``.
    """

    def __init__(self, num_envs: int, seed: int, absolute: bool = False) -> None:
        self._generator = np.random.Generator(np.random.PCG64(seed))
        self._held = np.zeros((num_envs, NUM_JOINTS))
        self._absolute = absolute

    def __call__(self, step: int, qpos: NDArray) -> NDArray[np.float32]:
        """(num_envs, 28) actions for joint positions (num_envs, 28)."""
        if step % HOLD == 0:
            self._held = self._generator.uniform(-1, 1, self._held.shape)
            self._held[:, HEIGHT] = self._generator.uniform(-1, 0.3, len(self._held))
        action = self._held.copy()
        sideways = [0, 2]
        if self._absolute:
            action[:, sideways] *= 0.2  # 5 cm
        else:
            action[:, sideways] = np.clip(-10 * qpos[:, sideways] + 0.5 * self._held[:, sideways], -1, 1)
        return action.astype(np.float32)


KINDS: Final = {
    "random": "pd_joint_delta_pos",
    "random targets": "pd_joint_pos",
    "pressing": "pd_joint_delta_pos",
    "pressing targets": "pd_joint_pos",
}
"""Kinds of hands, and the control mode that their actions are for."""


def make_actor(kind: str, num_envs: int, seed: int) -> Callable[[int, NDArray], NDArray[np.float32]]:
    """What chooses (num_envs, 28) actions of a kind of ``KINDS`` for a step and joint positions."""
    if kind == "random":
        return ExploringHands(num_envs, seed)
    if kind == "random targets":
        return TargetHands(num_envs, seed)
    return PressingHands(num_envs, seed, absolute=KINDS[kind] == "pd_joint_pos")


class Hands:
    """A :class:`HandBatch` in this process with its arrays.

    Args:
        num_envs: hands.
        settings: what they explore.
    """

    def __init__(self, num_envs: int, settings: BatchSettings) -> None:
        self.num_envs = num_envs
        self.batch = HandBatch(num_envs, settings)
        self.arrays = self.batch.arrays

    def reset(self, seed: int, objects: Sequence[str] | None = None, poses: Sequence[int] | None = None) -> None:
        """Starts an episode everywhere; environment i has seed ``seed + i``."""
        envs = list(range(self.num_envs))
        self.batch.reset([seed + env for env in envs], envs, objects, poses)

    def step(self, action: NDArray) -> None:
        """One control step."""
        self.arrays["action"][:] = action
        self.batch.step()

    @property
    def scenes(self) -> Sequence[Any]:
        """The physics scenes, one per hand."""
        return self.batch._scenes


def run_episode(
    hands: Hands,
    seed: int,
    act: Callable[[int, NDArray], NDArray],
    look: Callable[[int], None],
    objects: Sequence[str] | None = None,
    poses: Sequence[int] | None = None,
) -> None:
    """One episode of every hand but for its last step (which starts the next episode): ``look(step)`` after each step."""
    hands.reset(seed, objects, poses)
    for step in range(HORIZON - 1):
        hands.step(act(step, hands.arrays["qpos"]))
        look(step)
