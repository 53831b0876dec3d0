"""What an environment shows and takes (protocol sections 2 and 6): one table, from which every face makes its spaces and arrays.

No torch, no simulator: documentation and command lines read it too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from tslam_bench.constants import GRID_SIZE, NUM_JOINTS
from tslam_bench.hand_constants import SKIN_LINKS

ArraySpec = tuple[tuple[int, ...], type]
"""Shape and type of one environment's array."""


@dataclass(frozen=True)
class Entry:
    """One entry of the observation of one environment.

    Attributes:
        name: its key.
        shape: without the batch axis.
        dtype: numpy's.
        low: smallest value.
        high: largest value.
        unit: of its numbers.
        description: one line.
    """

    name: str
    shape: tuple[int, ...]
    dtype: type
    low: float
    high: float
    unit: str
    description: str

    def space(self) -> spaces.Box:
        """The entry's Gymnasium space."""
        dtype: Any = self.dtype
        return spaces.Box(self.low, self.high, self.shape, dtype)


OBSERVATION: Final = (
    Entry("qpos", (NUM_JOINTS,), np.float32, -np.inf, np.inf, "m, rad", "joint positions"),
    Entry("qvel", (NUM_JOINTS,), np.float32, -np.inf, np.inf, "m/s, rad/s", "joint velocities"),
    Entry("touch", (len(SKIN_LINKS),), np.uint8, 0, 1, "0 or 1", "whether each skin link touches the object"),
    Entry(
        "occupancy",
        (2, GRID_SIZE, GRID_SIZE, GRID_SIZE),
        np.uint8,
        0,
        1,
        "0 or 1",
        "voxels touched (channel 0) and visited (channel 1) since the episode began, world frame",
    ),
    Entry("time", (1,), np.float32, 0.0, 1.0, "share of the horizon", "elapsed time"),
)
"""The observation, entry by entry, in the order in which ``obs_mode="state"`` flattens it."""
OBSERVATION_ARRAYS: Final[dict[str, ArraySpec]] = {entry.name: (entry.shape, entry.dtype) for entry in OBSERVATION}
"""Shape and type of each entry of one environment's observation."""


def observation_space() -> spaces.Dict:
    """Observation space of one environment."""
    return spaces.Dict({entry.name: entry.space() for entry in OBSERVATION})


def action_space() -> spaces.Box:
    """Action space of one environment: one number per joint, in the order of ``JOINT_NAMES``."""
    return spaces.Box(-1.0, 1.0, (NUM_JOINTS,), np.float32)


def observation_rows() -> list[dict[str, Any]]:
    """One record per entry, for tables in documentation and on the command line."""
    return [
        {
            "key": entry.name,
            "shape": list(entry.shape),
            "dtype": np.dtype(entry.dtype).name,
            "low": float(entry.low),
            "high": float(entry.high),
            "unit": entry.unit,
            "meaning": entry.description,
        }
        for entry in OBSERVATION
    ]
