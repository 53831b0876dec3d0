"""``random_targets``: random absolute joint targets, held for a few steps: what learning has to beat (protocol section 11)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.baselines.interface import check_observation, episode_generators
from tslam_bench.constants import HORIZON, NUM_JOINTS
from tslam_bench.hand_constants import CONTROL_MODES

DEVIATION: Final = 0.6
"""Standard deviation of the normal targets, in halves of the joint ranges; clipped to the ranges."""
HOLD: Final = 4
"""Control steps for which a target is held."""


class RandomTargetsBaseline:
    """Normal targets of ``pd_joint_pos``, drawn for one horizon at a time."""

    control_mode = CONTROL_MODES[1]

    def __init__(self) -> None:
        self._generators: list[np.random.Generator] = []
        self._targets = np.zeros((0, HORIZON // HOLD, NUM_JOINTS), dtype=np.float32)
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
        actions = self._targets[:, self._step // HOLD]
        self._step += 1
        return actions.copy()

    def _draw(self) -> None:
        shape = (HORIZON // HOLD, NUM_JOINTS)
        blocks = [generator.normal(0.0, DEVIATION, shape) for generator in self._generators]
        self._targets = np.clip(np.stack(blocks), -1, 1).astype(np.float32)
        self._step = 0
