"""``heuristic``: a power grasp closing from a randomly placed open hand, reopened and repeated (protocol section 11).

Blind: it reads joint positions only, and takes an arm that no longer sinks for an obstacle. Each grasp has four phases:

* travel: the open hand moves to a random spot at a safe height;
* sink: it comes down, palm first, until something stops it or it is at the spot's depth;
* close: all fingers and the thumb flex;
* open: they reopen and the hand rises, then the next grasp begins.

All episodes of a batch advance together; phases are arrays, so there is no loop over episodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.baselines.interface import check_observation, episode_generators
from tslam_bench.constants import NUM_JOINTS
from tslam_bench.hand_constants import CONTROL_MODES, DELTA_STEP, JOINT_LIMITS, JOINT_NAMES

_TRAVEL, _SINK, _CLOSE, _OPEN = range(4)
_INDEX: Final = {name: index for index, name in enumerate(JOINT_NAMES)}
_SIDE, _HEIGHT, _FORWARD, _ROLL = (_INDEX[name] for name in ("ARTx", "ARTy", "ARTz", "ARRz"))
_SPREAD_JOINTS: Final = tuple(_INDEX[name] for name in ("FFJ3", "MFJ3", "RFJ3", "LFJ3"))

_OPEN_HAND: Final = {"THJ4": 0.0}
"""Joint values of the open hand where they are not 0 (rad)."""
_CLOSED_HAND: Final = {
    **{f"{finger}J2": 1.4 for finger in ("FF", "MF", "RF", "LF")},
    **{f"{finger}J1": 1.2 for finger in ("FF", "MF", "RF", "LF")},
    **{f"{finger}J0": 1.4 for finger in ("FF", "MF", "RF", "LF")},
    **{"LFJ4": 0.3, "THJ4": 1.0, "THJ3": 0.9, "THJ2": 0.2, "THJ1": 0.4, "THJ0": -0.8},
}
"""Joint values of the fist where they are not 0 (rad)."""


@dataclass(frozen=True)
class GraspConfig:
    """Numbers of the heuristic, chosen by touched voxels on eight training objects.

    Attributes:
        side, forward: half range of the spots, ARTx and ARTz (m).
        roll: half range of the roll, ARRz (rad).
        spread: half range of the finger spread (rad).
        depth: (lowest, highest) height to sink to, ARTy (m).
        rise: height gained before travelling to the next spot (m).
        travel_height: travelling is never higher than this, ARTy (m).
        travel_steps, sink_steps: longest duration of a phase (control steps).
        close_steps, open_steps: duration of a phase (control steps).
        stall: an arm that sinks less than this in one step has met an obstacle (m).
        grasps: spots drawn per episode; more than fit in it.
    """

    side: float = 0.06
    forward: float = 0.07
    roll: float = 0.6
    spread: float = 0.3
    depth: tuple[float, float] = (-0.08, 0.0)
    rise: float = 0.05
    travel_height: float = 0.15
    travel_steps: int = 12
    sink_steps: int = 30
    close_steps: int = 14
    open_steps: int = 6
    stall: float = 3e-3
    grasps: int = 32


class HeuristicBaseline:
    """See the module's docstring."""

    control_mode = CONTROL_MODES[0]

    def __init__(self, config: GraspConfig | None = None) -> None:
        self.config = config or GraspConfig()
        self._open = _hand(_OPEN_HAND)
        self._closed = _hand(_CLOSED_HAND)
        self.reset(1, 0)

    def reset(self, num_envs: int, seed: int | Sequence[int]) -> None:
        """See :class:`tslam_bench.baselines.interface.Baseline`."""
        c = self.config
        generators = episode_generators(num_envs, seed)
        unit = np.stack([generator.uniform(-1, 1, (c.grasps, 5)) for generator in generators])
        middle, half = np.mean(c.depth), (c.depth[1] - c.depth[0]) / 2
        # (num_envs, grasps, 5): ARTx, ARTz, ARRz, finger spread, depth
        self._spots = unit * np.array([c.side, c.forward, c.roll, c.spread, half]) + np.array([0, 0, 0, 0, middle])
        self._grasp = np.zeros(num_envs, dtype=np.int64)
        self._phase = np.full(num_envs, _TRAVEL)
        self._phase_step = np.zeros(num_envs, dtype=np.int64)
        self._safe_height = np.full(num_envs, c.travel_height)
        self._last_height = np.full(num_envs, np.inf)

    def act(self, observation: Mapping[str, NDArray]) -> NDArray[np.float32]:
        """See :class:`tslam_bench.baselines.interface.Baseline`."""
        qpos = np.asarray(check_observation(observation, len(self._phase)), dtype=np.float64)
        self._advance(qpos)
        rows = np.arange(len(qpos))
        side, forward, roll, spread, depth = self._spots[rows, self._grasp % self.config.grasps].T
        closing = (self._phase == _CLOSE)[:, None]
        goal = np.where(closing, self._closed, self._open)
        goal[:, _SIDE], goal[:, _FORWARD], goal[:, _ROLL] = side, forward, roll
        goal[:, _SPREAD_JOINTS] += spread[:, None] * np.array([-1, -1 / 3, 1 / 3, 1])
        high = (self._phase == _TRAVEL) | (self._phase == _OPEN)
        goal[:, _HEIGHT] = np.where(high, self._safe_height, depth)
        goal = np.clip(goal, JOINT_LIMITS[:, 0], JOINT_LIMITS[:, 1])
        return np.clip((goal - qpos) / DELTA_STEP, -1, 1).astype(np.float32)

    def _advance(self, qpos: NDArray[np.float64]) -> None:
        """Moves episodes whose phase is over to the next one."""
        c = self.config
        rows = np.arange(len(qpos))
        side, forward, _, _, depth = self._spots[rows, self._grasp % c.grasps].T
        height = qpos[:, _HEIGHT]
        there = np.hypot(qpos[:, _SIDE] - side, qpos[:, _FORWARD] - forward) < 0.01
        stopped = (self._last_height - height < c.stall) & (self._phase_step >= 4)
        over = np.select(
            [self._phase == _TRAVEL, self._phase == _SINK, self._phase == _CLOSE],
            [
                there | (self._phase_step >= c.travel_steps),
                stopped | (height <= depth + 0.005) | (self._phase_step >= c.sink_steps),
                self._phase_step >= c.close_steps,
            ],
            self._phase_step >= c.open_steps,
        )
        landed = over & (self._phase == _SINK)
        self._safe_height = np.where(landed, np.minimum(height + c.rise, c.travel_height), self._safe_height)
        self._grasp += over & (self._phase == _OPEN)
        self._phase = np.where(over, (self._phase + 1) % 4, self._phase)
        self._phase_step = np.where(over, 0, self._phase_step + 1)
        self._last_height = height.copy()


def _hand(values: Mapping[str, float]) -> NDArray[np.float64]:
    """(28,) joint values, 0 where none is given."""
    hand = np.zeros(NUM_JOINTS)
    for name, value in values.items():
        hand[_INDEX[name]] = value
    return hand
