"""Explorers that know nothing: ``random`` and ``random_targets`` (protocol section 11).

``random``: uniform actions in [-1, 1]^28 at each step. ``random_targets``: random absolute joint targets, each held for a few
steps: what learning has to beat.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import HORIZON, NUM_JOINTS
from tslam_bench.evaluation.policy import check_observation, episode_generators
from tslam_bench.hand_constants import CONTROL_MODES

DEVIATION: Final = 0.6
"""Standard deviation of the normal targets, in halves of the joint ranges; clipped to the ranges."""


class _DrawnBaseline(ABC):
    """Actions are drawn for one horizon at a time, so that a step costs one array read, and held for ``hold`` steps."""

    control_mode: str
    hold: ClassVar[int]

    def __init__(self) -> None:
        self._generators: list[np.random.Generator] = []
        self._actions = np.zeros((0, HORIZON // self.hold, NUM_JOINTS), dtype=np.float32)
        self._step = 0

    @abstractmethod
    def _drawn(self, generator: np.random.Generator, shape: tuple[int, int]) -> NDArray[np.float64]:
        """One horizon's actions in [-1, 1] of one episode."""

    def reset(self, num_envs: int, seed: int | Sequence[int]) -> None:
        """See :class:`tslam_bench.evaluation.policy.Policy`."""
        self._generators = episode_generators(num_envs, seed)
        self._draw()

    def act(self, observation: Mapping[str, NDArray]) -> NDArray[np.float32]:
        """See :class:`tslam_bench.evaluation.policy.Policy`."""
        check_observation(observation, len(self._generators))
        if self._step == HORIZON:
            self._draw()
        actions = self._actions[:, self._step // self.hold]
        self._step += 1
        return actions.copy()

    def _draw(self) -> None:
        blocks = [self._drawn(generator, (HORIZON // self.hold, NUM_JOINTS)) for generator in self._generators]
        self._actions = np.stack(blocks).astype(np.float32)
        self._step = 0


class RandomBaseline(_DrawnBaseline):
    """Uniform actions of ``pd_joint_delta_pos``, new at each step."""

    control_mode = CONTROL_MODES[0]
    hold = 1

    def _drawn(self, generator: np.random.Generator, shape: tuple[int, int]) -> NDArray[np.float64]:
        return generator.uniform(-1, 1, shape)


class RandomTargetsBaseline(_DrawnBaseline):
    """Normal targets of ``pd_joint_pos``, each held for four steps."""

    control_mode = CONTROL_MODES[1]
    hold = 4

    def _drawn(self, generator: np.random.Generator, shape: tuple[int, int]) -> NDArray[np.float64]:
        return np.clip(generator.normal(0.0, DEVIATION, shape), -1, 1)
