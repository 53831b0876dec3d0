"""``heuristic``: a power grasp closing from a randomly placed open hand, reopened and repeated (protocol section 11).

Blind: it reads joint positions and the palm's touch bits, nothing else. It goes from spot to spot. At each of them:

* travel: the open hand moves over a random spot at a safe height;
* sink: it comes down, palm first, until the palm feels something, the arm is stopped, or it is at the spot's depth;
* close: fingers and thumb flex, each by a random share of its range;
* open: they reopen and the hand rises a little.

Close and open are repeated a few times with the arm shifted a little, then the next spot follows. All episodes of a batch
advance together; phases are arrays, so there is no loop over episodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import NUM_JOINTS
from tslam_bench.evaluation.policy import check_observation, episode_generators
from tslam_bench.hand_constants import CONTROL_MODES, DELTA_STEP, JOINT_LIMITS, JOINT_NAMES, SKIN_LINKS

_TRAVEL, _SINK, _CLOSE, _OPEN = range(4)
_INDEX: Final = {name: index for index, name in enumerate(JOINT_NAMES)}
_SIDE, _HEIGHT, _FORWARD, _ROLL = (_INDEX[name] for name in ("ARTx", "ARTy", "ARTz", "ARRz"))
_WRIST: Final = (_INDEX["WRJ1"], _INDEX["WRJ0"])
_SPREAD: Final = tuple(_INDEX[f"{finger}J3"] for finger in ("FF", "MF", "RF", "LF"))
_FINGERS: Final = tuple(tuple(_INDEX[f"{finger}J{k}"] for k in (2, 1, 0)) for finger in ("FF", "MF", "RF", "LF"))
"""Knuckle, middle and end joint of each finger."""
_THUMB: Final = tuple(_INDEX[f"THJ{k}"] for k in (4, 3, 2, 1, 0))
_PALM: Final = tuple(SKIN_LINKS.index(link) for link in ("palm", "lfmetacarpal"))

_FAN: Final = np.array([-1, -1 / 3, 1 / 3, 1])
"""How the four fingers spread, from the first to the little one."""
_END_BY_MIDDLE: Final = 1.15
"""The tendon flexes a finger's end joint this much more than its middle joint."""
_OPPOSED: Final = np.array([1.0, 0.9, 0.2, 0.4, -1.0])
"""Thumb joints THJ4..0 of the closed hand (rad)."""
_THUMB_REST: Final = 0.3
"""Share of ``_OPPOSED`` that the open hand's thumb root keeps."""
_LITTLE_ROOT: Final = 0.3
"""LFJ4 of the closed hand (rad)."""


@dataclass(frozen=True)
class GraspConfig:
    """Numbers of the heuristic, found by ``benchmarks/tune_heuristic.py`` on train objects.

    Attributes:
        side, forward, forward_centre: half ranges of the spots, ARTx and ARTz, and the middle of the latter (m).
        roll, spread, wrist: half ranges of the roll, of the fan of the fingers and of the wrist's tilts at a spot (rad).
        depth: (lowest, highest) height to sink to, ARTy (m).
        rise: height gained over where the hand was stopped, before it travels on (m).
        travel_height: travelling is never higher than this, ARTy (m).
        travel_steps, sink_steps: longest duration of a phase (control steps).
        close_steps, open_steps: duration of a phase (control steps).
        squeezes: grasps at a spot.
        shift, roll_shift: half ranges of the arm's moves (m) and turns (rad) between them.
        press: depth below where it was stopped that the closing hand aims at (m).
        knuckle, middle: flexion of a closed finger's first and second joint (rad).
        curl: smallest share of it that a closing finger is given.
        thumb: the same of the thumb.
        opened: share of it that an open finger keeps.
        stall: an arm that sinks less than this in one step has met an obstacle (m).
        spots: drawn per episode; more than fit in it.
    """

    side: float = 0.047
    forward: float = 0.02
    forward_centre: float = -0.008
    roll: float = 0.22
    spread: float = 0.38
    wrist: float = 0.1
    depth: tuple[float, float] = (-0.08, 0.028)
    rise: float = 5e-3
    travel_height: float = 0.17
    travel_steps: int = 13
    sink_steps: int = 24
    close_steps: int = 7
    open_steps: int = 5
    squeezes: int = 2
    shift: float = 0.076
    roll_shift: float = 0.6
    press: float = 0.03
    knuckle: float = 1.57
    middle: float = 1.27
    curl: float = 1.0
    thumb: float = 0.45
    opened: float = 0.06
    stall: float = 1.6e-3
    spots: int = 40


class HeuristicBaseline:
    """See the module's docstring.

    Args:
        config: numbers of the grasps.
        step_limit: (28,) what an action of 1 adds to a joint's position (m or rad).
    """

    control_mode = CONTROL_MODES[0]

    def __init__(self, config: GraspConfig | None = None, step_limit: NDArray[np.float64] = DELTA_STEP) -> None:
        self.config = config or GraspConfig()
        self._step_limit = step_limit
        self.reset(1, 0)

    def reset(self, num_envs: int, seed: int | Sequence[int]) -> None:
        """See :class:`tslam_bench.evaluation.policy.Policy`."""
        c = self.config
        generators = episode_generators(num_envs, seed)
        unit = np.stack([generator.uniform(-1, 1, (c.spots, 7)) for generator in generators])
        middle, half = np.mean(c.depth), (c.depth[1] - c.depth[0]) / 2
        scale = np.array([c.side, c.forward, c.roll, c.spread, half, c.wrist, c.wrist])
        # (num_envs, spots, 7): ARTx, ARTz, ARRz, fan, depth, WRJ1, WRJ0
        self._spots = unit * scale + np.array([0, c.forward_centre, 0, 0, middle, 0, 0])
        # (num_envs, spots * squeezes, 9): curl of four fingers and the thumb in [0, 1]; moves ARTx, ARTz, ARRz, fan in [-1, 1]
        grips = np.stack([generator.uniform(0, 1, (c.spots * c.squeezes, 9)) for generator in generators])
        self._curls = grips[..., :5] * (1 - np.array([c.curl] * 4 + [c.thumb])) + np.array([c.curl] * 4 + [c.thumb])
        self._shifts = (2 * grips[..., 5:] - 1) * np.array([c.shift, c.shift, c.roll_shift, c.spread / 2])
        self._spot = np.zeros(num_envs, dtype=np.int64)
        self._squeeze = np.zeros(num_envs, dtype=np.int64)
        self._phase = np.full(num_envs, _TRAVEL)
        self._phase_step = np.zeros(num_envs, dtype=np.int64)
        self._stopped_at = np.full(num_envs, c.travel_height)
        self._last_height = np.full(num_envs, np.inf)

    def act(self, observation: Mapping[str, NDArray]) -> NDArray[np.float32]:
        """See :class:`tslam_bench.evaluation.policy.Policy`."""
        c = self.config
        qpos = np.asarray(check_observation(observation, len(self._phase)), dtype=np.float64)
        self._advance(qpos, np.any(np.asarray(observation["touch"])[:, _PALM], axis=1))
        rows = np.arange(len(qpos))
        side, forward, roll, fan, depth, *wrist = self._spots[rows, self._spot % c.spots].T
        grip = (self._spot * c.squeezes + self._squeeze) % (c.spots * c.squeezes)
        gripping = self._phase >= _CLOSE
        shift = np.where(gripping[:, None], self._shifts[rows, grip], 0.0)
        goal = self._hand(self._phase == _CLOSE, self._curls[rows, grip])
        goal[:, _SIDE], goal[:, _FORWARD] = side + shift[:, 0], forward + shift[:, 1]
        goal[:, _ROLL] = roll + shift[:, 2]
        goal[:, _WRIST] = np.stack(wrist, axis=1)
        goal[:, _SPREAD] += (fan + shift[:, 3])[:, None] * _FAN
        safe = np.minimum(self._stopped_at + c.rise, c.travel_height)
        heights = [safe, depth, self._stopped_at - c.press, self._stopped_at + c.rise / 2]
        goal[:, _HEIGHT] = np.select([self._phase == phase for phase in (_TRAVEL, _SINK, _CLOSE, _OPEN)], heights)
        goal = np.clip(goal, JOINT_LIMITS[:, 0], JOINT_LIMITS[:, 1])
        return np.clip((goal - qpos) / self._step_limit, -1, 1).astype(np.float32)

    def _hand(self, closing: NDArray[np.bool_], curls: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 28) goals of fingers and thumb: closed by ``curls`` (n, 5), or open."""
        c = self.config
        goal = np.zeros((len(closing), NUM_JOINTS))
        flexed = np.where(closing[:, None], curls, [c.opened] * 4 + [0.0])
        for finger, (knuckle, middle, end) in enumerate(_FINGERS):
            goal[:, knuckle] = c.knuckle * flexed[:, finger]
            goal[:, middle] = c.middle * flexed[:, finger]
            goal[:, end] = _END_BY_MIDDLE * c.middle * flexed[:, finger]
        goal[:, _THUMB] = flexed[:, 4:] * _OPPOSED
        goal[:, _THUMB[:2]] = np.maximum(goal[:, _THUMB[:2]], _THUMB_REST * _OPPOSED[:2])
        goal[:, _INDEX["LFJ4"]] = _LITTLE_ROOT * flexed[:, 4]
        return goal

    def _advance(self, qpos: NDArray[np.float64], felt: NDArray[np.bool_]) -> None:
        """Moves episodes whose phase is over to the next one; ``felt`` (n,) says whose palm touches."""
        c = self.config
        side, forward, _, _, depth, *_ = self._spots[np.arange(len(qpos)), self._spot % c.spots].T
        height = qpos[:, _HEIGHT]
        there = np.hypot(qpos[:, _SIDE] - side, qpos[:, _FORWARD] - forward) < 0.015
        stalled = (self._last_height - height < c.stall) & (self._phase_step >= 3)
        over = np.select(
            [self._phase == _TRAVEL, self._phase == _SINK, self._phase == _CLOSE],
            [
                there | (self._phase_step >= c.travel_steps),
                felt | stalled | (height <= depth + 0.005) | (self._phase_step >= c.sink_steps),
                self._phase_step >= c.close_steps,
            ],
            self._phase_step >= c.open_steps,
        )
        self._stopped_at = np.where(over & (self._phase == _SINK), height, self._stopped_at)
        opened = over & (self._phase == _OPEN)
        self._squeeze += opened
        leaving = opened & (self._squeeze >= c.squeezes)
        self._spot += leaving
        self._squeeze[leaving] = 0
        following = np.select([leaving, opened], [_TRAVEL, _CLOSE], self._phase + 1)
        self._phase = np.where(over, following, self._phase)
        self._phase_step = np.where(over, 0, self._phase_step + 1)
        self._last_height = height.copy()
