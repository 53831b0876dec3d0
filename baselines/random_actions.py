"""``random``: uniform actions in [-1, 1]^28 at each step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from tslam_bench.baselines.interface import check_observation, episode_generators
from tslam_bench.constants import HORIZON, NUM_JOINTS
from tslam_bench.hand_constants import CONTROL_MODES


class RandomBaseline:
    """Uniform actions of ``pd_joint_delta_pos``, drawn for one horizon at a time so that a step costs one array read."""

    control_mode = CONTROL_MODES[0]

    def __init__(self) -> None:
        self._generators: list[np.random.Generator] = []
        self._actions = np.zeros((0, HORIZON, NUM_JOINTS), dtype=np.float32)
        self._step = 0

    def reset(self, num_envs: int, seed: int | Sequence[int]) -> None:
        """See :class:`tslam_bench.baselines.interface.Baseline`."""
        self._generators = episode_generators(num_envs, seed)
        self._draw()

    def act(self, observation: Mapping[str, NDArray]) -> NDArray[np.float32]:
        """See :class:`tslam_bench.baselines.interface.Baseline`."""
        check_observation(observation, len(self._generators))
        if self._step == HORIZON:
            self._draw()
        actions = self._actions[:, self._step]
        self._step += 1
        return actions.copy()

    def _draw(self) -> None:
        blocks = [generator.uniform(-1, 1, (HORIZON, NUM_JOINTS)) for generator in self._generators]
        self._actions = np.stack(blocks).astype(np.float32)
        self._step = 0
