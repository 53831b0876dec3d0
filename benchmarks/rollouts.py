"""Rollouts that the benchmarks share: objects, actions, and a batch of hands in this process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import HORIZON, NUM_JOINTS
from tslam_bench.tasks.batch import BatchSettings, HandBatch, batch_arrays

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


def exploring_actions(generator: np.random.Generator, num_envs: int, step: int) -> NDArray[np.float32]:
    """(num_envs, 28) random actions that send the hand down in the first quarter of an episode."""
    value = generator.uniform(-1, 1, (num_envs, NUM_JOINTS)).astype(np.float32)
    if step % HORIZON < HORIZON // 4:
        value[:, HEIGHT] = -1.0
    return value


class PressingHands:
    """Actions of hands that press on what lies at the workspace centre: random, held for ``HOLD`` steps, mostly downwards."""

    def __init__(self, num_envs: int, seed: int) -> None:
        self._generator = np.random.Generator(np.random.PCG64(seed))
        self._held = np.zeros((num_envs, NUM_JOINTS))

    def __call__(self, step: int, qpos: NDArray) -> NDArray[np.float32]:
        """(num_envs, 28) actions for joint positions (num_envs, 28)."""
        if step % HOLD == 0:
            self._held = self._generator.uniform(-1, 1, self._held.shape)
            self._held[:, HEIGHT] = self._generator.uniform(-1, 0.3, len(self._held))
        action = self._held.copy()
        sideways = [0, 2]
        action[:, sideways] = np.clip(-10 * qpos[:, sideways] + 0.5 * self._held[:, sideways], -1, 1)
        return action.astype(np.float32)


class Hands:
    """A :class:`HandBatch` in this process with its arrays.

    Args:
        num_envs: hands.
        settings: what they explore.
    """

    def __init__(self, num_envs: int, settings: BatchSettings) -> None:
        self.num_envs = num_envs
        self.arrays: dict[str, NDArray] = {
            name: np.zeros((num_envs, *shape), dtype) for name, (shape, dtype) in batch_arrays().items()
        }
        self.batch = HandBatch(num_envs, settings, self.arrays)

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
