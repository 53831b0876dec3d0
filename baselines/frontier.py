"""``frontier``: goes where its own map says that surface is likely and unfelt (protocol section 11). Scripted, closed loop.

Blind: it reads joint positions, touch bits and the two grids, nothing else. What it does, over and over:

* the map: voxels that were neither felt nor visited are worth something, most of all those beside felt ones with visited ones
  around; where the skin has been for long, that wears off;
* the potential: the worth, spread by the heat equation, so that it is felt from afar;
* the agents: points of the skin, each drawn up the potential; those of a touching link slide along the surface instead of
  pushing through it;
* the joints: the damped transpose of the agents' Jacobian makes one step of all these wishes. The arm's goes into the
  place that it works around;
* the noise, for a hand that is still feels nothing new: of several draws the one on whose way the skin would come by most worth.

Exploring by heat is known from ergodic control (Ivic et al. 2017, HEDAC; Bilaloglu et al. 2023 for all of a robot's body),
tactile potential fields from Bierbaum et al. 2008. This is neither of them, but takes up both ideas.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import GRID_SIZE, NUM_JOINTS, VOXEL_EDGE, WORKSPACE_EDGE, WORKSPACE_LOW
from tslam_bench.engine.skin import PointSet, build_skin
from tslam_bench.evaluation.policy import check_observation, episode_generators
from tslam_bench.grids import voxel_centres
from tslam_bench.hand_constants import CONTROL_MODES, DELTA_STEP, JOINT_LIMITS, SKIN_LINKS
from tslam_bench.objects.hand import load_hand

from .hand_kinematics import HandKinematics

Grids = NDArray[np.float32]
"""(n, 32, 32, 32)."""
Uncertainty = Callable[[NDArray[np.uint8]], NDArray]
"""Grids (n, 2, 32, 32, 32) of touched and visited voxels -> (n, 32, 32, 32) weights from 0, how little is known there."""

_ARM: Final = slice(0, 3)
_TURNS: Final = slice(3, 6)
_FINGERS: Final = slice(6, NUM_JOINTS)
_MIDDLE: Final = JOINT_LIMITS.mean(axis=1)
_HALF: Final = (JOINT_LIMITS[:, 1] - JOINT_LIMITS[:, 0]) / 2
_AGENTS_PER_LINK: Final = {"palm": 16, "lfmetacarpal": 6, "wrist": 2}
_SPEED: Final = 0.6
"""How far a joint gets in a control step, in step limits."""
_AGENTS: Final = 4
"""Agents of a link that the table above does not name."""


@dataclass(frozen=True)
class FrontierConfig:
    """Numbers of the explorer, set by hand and compared on train objects; ``benchmarks/tune_frontier.py`` would search them.

    Lengths are in voxel edges, noise and places in halves of joint ranges, as actions are.

    Attributes:
        aim: place of the arm at first: sideways, up, forward.
        hold: control steps between two looks at the map, and that noise is held for.
        arm_noise, turn_noise, finger_noise: standard deviations.
        near: how far felt voxels make their neighbours likely surface.
        far: how far worth is felt.
        unknown: worth of what nobody has been near, at the workspace's centre; that beside felt voxels is 1.
        wear: how fast worth is lost by the skin's presence.
        arm_drift: how fast the arm's place follows the agents.
        tether: share of the way back to ``aim`` that it goes in each look.
        turn_pull, finger_pull: how far roll and wrist, and the fingers, follow the agents.
        reach: an agent's largest wish.
        slide: share of its wish into the surface that a touching agent gives up; above 1 it backs away.
        curl: middle of the fingers' noise, in halves of their ranges.
        tries: so many noises are drawn, and the best is taken.
        close: how near the skin has to come to what is worth being felt, for a noise to promise it.
    """

    aim: tuple[float, float, float] = (0.0, -0.4, 0.2)
    hold: int = 4
    arm_noise: float = 0.3
    turn_noise: float = 0.6
    finger_noise: float = 0.8
    near: float = 1.5
    far: float = 4.0
    unknown: float = 0.1
    wear: float = 0.3
    arm_drift: float = 0.5
    tether: float = 0.02
    turn_pull: float = 0.5
    finger_pull: float = 0.5
    reach: float = 3.0
    slide: float = 1.0
    curl: float = 0.0
    tries: int = 8
    close: float = 1.0


class FrontierBaseline:
    """See the module's docstring.

    Args:
        config: its numbers.
        uncertainty: weighs what is worth feeling, as a reconstructor's uncertainty does; None weighs all alike.
    """

    control_mode = CONTROL_MODES[1]

    def __init__(self, config: FrontierConfig | None = None, uncertainty: Uncertainty | None = None) -> None:
        self.config = c = config or FrontierConfig()
        self._uncertainty = uncertainty
        self._kinematics, self._agent_link = _body()
        self._near, self._far, self._close = heat_kernel(c.near), heat_kernel(c.far), heat_kernel(c.close)
        self._noise_scale = np.zeros(NUM_JOINTS)
        self._noise_scale[_ARM], self._noise_scale[_TURNS] = c.arm_noise, c.turn_noise
        self._noise_scale[_FINGERS] = c.finger_noise
        self._pull = np.zeros(NUM_JOINTS)
        self._pull[_TURNS], self._pull[_FINGERS] = c.turn_pull, c.finger_pull
        self._aim = np.zeros(NUM_JOINTS)
        self._aim[_ARM], self._aim[_FINGERS] = c.aim, c.curl
        distance = np.linalg.norm(voxel_centres(), axis=-1)
        self._prior = np.exp(-0.5 * (distance / (WORKSPACE_EDGE / 5)) ** 2).astype(np.float32)
        self.reset(1, 0)

    def reset(self, num_envs: int, seed: int | Sequence[int]) -> None:
        """See :class:`tslam_bench.evaluation.policy.Policy`."""
        self._generators = episode_generators(num_envs, seed)
        self._step = 0
        self._worn = np.zeros((num_envs, *(GRID_SIZE,) * 3), dtype=np.float32)
        self._place = np.tile(self._aim, (num_envs, 1))

    def act(self, observation: Mapping[str, NDArray]) -> NDArray[np.float32]:
        """See :class:`tslam_bench.evaluation.policy.Policy`."""
        qpos = np.asarray(check_observation(observation, len(self._generators)), dtype=np.float64)
        if self._step % self.config.hold == 0:
            self._held = self._decide(qpos, np.asarray(observation["touch"]), np.asarray(observation["occupancy"]))
        self._step += 1
        return self._held.copy()

    def _decide(self, qpos: NDArray, touch: NDArray, occupancy: NDArray) -> NDArray[np.float32]:
        """(n, 28) new actions."""
        c, kinematics = self.config, self._kinematics
        links = kinematics.links(qpos)
        agents = kinematics.points(links)
        worth, potential, free = self._map(agents, occupancy)
        wish = self._wishes(agents, potential, free, touch[:, self._agent_link] > 0)
        change = joint_steps(kinematics.jacobian(links, agents), wish, kinematics.moves) / _HALF
        self._place[:, _ARM] += c.arm_drift * change[:, _ARM] + c.tether * (self._aim[_ARM] - self._place[:, _ARM])
        self._place = np.clip(self._place, -1, 1)
        noise = np.stack([generator.standard_normal((c.tries, NUM_JOINTS)) for generator in self._generators])
        goals = (self._place + self._pull * change)[:, None] + self._noise_scale * noise
        goals = np.clip(goals, -1, 1)
        best = self._promise(qpos, goals, worth).argmax(axis=1)
        return goals[np.arange(len(qpos)), best].astype(np.float32)

    def _promise(self, qpos: NDArray, goals: NDArray, worth: Grids) -> NDArray[np.float64]:
        """(n, K) what the skin would come by on the way to goals (n, K, 28), were nothing in its way."""
        n, tries = goals.shape[:2]
        start = qpos[:, None]
        most = _SPEED * self.config.hold * DELTA_STEP
        end = start + np.clip(_MIDDLE + goals * _HALF - start, -most, most)
        promise = np.zeros((n, tries))
        for share in (0.5, 1.0):
            on_the_way = (start + share * (end - start)).reshape(n * tries, NUM_JOINTS)
            agents = self._kinematics.points(self._kinematics.links(on_the_way))
            inside = (np.abs(agents) < WORKSPACE_EDGE / 2).all(axis=-1).reshape(n, -1)
            index = voxel_of(agents).reshape(n, -1, 3)
            found = worth[np.arange(n)[:, None], index[..., 0], index[..., 1], index[..., 2]]
            promise += (found * inside).reshape(n, tries, -1).sum(axis=-1)
        return promise

    def _map(self, agents: NDArray, occupancy: NDArray) -> tuple[Grids, Grids, Grids]:
        """What is worth being felt, the potential, and how much free space is around each voxel."""
        c = self.config
        touched, visited = occupancy[:, 0].astype(np.float32), occupancy[:, 1].astype(np.float32)
        rows = np.arange(len(agents))[:, None]
        np.add.at(self._worn, (rows, *np.moveaxis(voxel_of(agents), -1, 0)), np.float32(c.wear))
        beside, free = spread(touched, self._near), spread(visited, self._near)
        beside *= free
        peak = beside.max(axis=(1, 2, 3), keepdims=True)
        worth = beside / np.maximum(peak, np.float32(1e-6)) + np.float32(c.unknown) * self._prior
        if self._uncertainty is not None:
            worth = worth * np.asarray(self._uncertainty(occupancy), dtype=np.float32)
        worth *= (1 - touched) * (1 - visited) * np.exp(-spread(self._worn, self._near))
        return spread(worth, self._close), spread(worth, self._far), free

    def _wishes(self, agents: NDArray, potential: Grids, free: Grids, touching: NDArray[np.bool_]) -> NDArray:
        """(n, A, 3) how far each agent wants to go (m)."""
        c = self.config
        index = voxel_of(agents)
        value, slope = slopes(potential, index)
        direction = slope / np.maximum(value, 1e-12)[..., None] * c.far  # of the order of 1: how many spreads away
        outside = np.clip(agents, WORKSPACE_LOW, -WORKSPACE_LOW) - agents
        direction += outside / VOXEL_EDGE
        wish = direction / np.sqrt(1 + (direction**2).sum(axis=-1, keepdims=True))
        _, normal = slopes(free, index)  # out of the object, where it touches
        normal /= np.maximum(np.sqrt((normal**2).sum(axis=-1, keepdims=True)), 1e-12)
        into = np.minimum((wish * normal).sum(axis=-1, keepdims=True), 0)
        wish -= c.slide * np.where(touching[..., None], into, 0) * normal
        return c.reach * VOXEL_EDGE * wish


def joint_steps(jacobian: NDArray, wish: NDArray, moves: NDArray[np.bool_], damping: float = 2e-2) -> NDArray:
    """(n, 28) steps of the joints (m or rad): each as if it alone served the agents that it moves, damped.

    Args:
        jacobian: (n, 28, A, 3).
        wish: (n, A, 3) of the agents (m).
        moves: (28, A) which joint moves which agent.
        damping: agents nearer than this to a joint's axis hardly turn it (m).
    """
    served = (jacobian * wish[:, None]).sum(axis=(2, 3))
    square = (jacobian**2).sum(axis=(2, 3)) + damping**2 * moves.sum(axis=1)
    return served / square


def heat_kernel(length: float) -> NDArray[np.float32]:
    """(32, 32) matrix that spreads along one axis, by a standard deviation of ``length`` voxels; nothing leaves the grid."""
    laplacian = -2.0 * np.eye(GRID_SIZE) + np.eye(GRID_SIZE, k=1) + np.eye(GRID_SIZE, k=-1)
    laplacian[0, 0] = laplacian[-1, -1] = -1
    values, vectors = np.linalg.eigh(laplacian)
    return ((vectors * np.exp(values * length**2 / 2)) @ vectors.T).astype(np.float32)


def spread(grids: Grids, kernel: NDArray[np.float32]) -> Grids:
    """The heat equation's solution: ``kernel`` along each axis.

    Products of 32 x 32 matrices: small enough that no library shares them out among threads, and the same in every batch.
    """
    first = (kernel @ grids.swapaxes(1, 2)).swapaxes(1, 2)
    return (kernel @ first) @ kernel


def voxel_of(points: NDArray) -> NDArray[np.int64]:
    """Voxels (n, P, 3) that hold points (n, P, 3) in metres; the nearest one of those outside."""
    index = np.floor((points - WORKSPACE_LOW) / VOXEL_EDGE).astype(np.int64)
    return np.clip(index, 0, GRID_SIZE - 1)


def slopes(grids: Grids, index: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Values (n, P) and slopes (n, P, 3), per voxel edge, at voxels (n, P, 3)."""
    rows = np.arange(len(index))[:, None]
    slope = np.empty(index.shape)
    for axis in range(3):
        ends = []
        for side in (-1, 1):
            moved = index.copy()
            moved[..., axis] = np.clip(moved[..., axis] + side, 0, GRID_SIZE - 1)
            ends.append(grids[rows, moved[..., 0], moved[..., 1], moved[..., 2]])
        slope[..., axis] = (ends[1].astype(np.float64) - ends[0]) / 2
    return grids[rows, index[..., 0], index[..., 1], index[..., 2]].astype(np.float64), slope


@lru_cache(maxsize=1)
def _body() -> tuple[HandKinematics, NDArray[np.int64]]:
    """Kinematics of the agents, evenly taken from each link's probes, and the link (in ``SKIN_LINKS``) of each agent."""
    hand = load_hand()
    probes = build_skin(hand.shapes).probes
    chosen = []
    for index, name in enumerate(SKIN_LINKS):
        own = np.flatnonzero(probes.link == index)
        count = min(_AGENTS_PER_LINK.get(name, _AGENTS), len(own))
        chosen.append(own[np.linspace(0, len(own) - 1, count).round().astype(int)])
    kept = np.concatenate(chosen)
    agents = PointSet(probes.link[kept], probes.position[kept], probes.radius[kept])
    return HandKinematics(hand, agents), agents.link
