"""Do fingers pass through thin walls? Looks at the axes of the finger capsules after every physics step.

A finger that is where physics allows it to be keeps its axis a radius (7 to 16 mm) away from the object. Two things are counted:

- *axis inside*: physics steps after which a part of an axis lies inside one of the object's hulls (the finger has sunk in by more
  than its radius);
- *jump*: physics steps in which a point of an axis moved along a line that crosses a hull, from outside to outside: through
  the wall between two looks.

A wall cannot be passed without one of the two. Lines are clipped against the hulls' half-spaces, exactly, after
the signed-distance field has sorted out those that cannot meet the object.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rollouts import Hands, PressingHands, exploring_actions
from scipy.spatial import ConvexHull

from tslam_bench import grids
from tslam_bench.assets.hand import load_hand
from tslam_bench.assets.store import PreparedObject, load_object
from tslam_bench.constants import HORIZON, NUM_JOINTS, SUBSTEPS
from tslam_bench.hand_constants import SKIN_LINKS
from tslam_bench.tasks.batch import BatchSettings
from tslam_bench.tasks.link_poses import POSE_SIZE, link_matrices
from tslam_bench.tasks.skin import build_skin

QUIET_STEPS = 20
"""Physics steps without anything to count that part two incidents of one hand."""


@dataclass
class WallCounts:
    """What was seen on one object.

    Attributes:
        control_steps: control steps of all hands.
        contact_steps: control steps with touch.
        inside: physics steps with a part of a finger's axis inside a hull.
        jumps: physics steps in which a point of an axis crossed a hull unseen.
        incidents: runs of such steps of one hand.
    """

    control_steps: int = 0
    contact_steps: int = 0
    inside: int = 0
    jumps: int = 0
    incidents: int = 0


class HullUnion:
    """Exact clipping of line segments against an object's hulls, in the object's frame (m)."""

    def __init__(self, prepared: PreparedObject) -> None:
        planes = [ConvexHull(vertices).equations for vertices, _ in prepared.hulls]
        most = max(len(equations) for equations in planes)
        # Hulls with fewer planes repeat their last one.
        padded = np.stack([equations[np.minimum(np.arange(most), len(equations) - 1)] for equations in planes])
        self._normal, self._offset = padded[..., :3], padded[..., 3]
        field = prepared.field
        self._values, self._origin, self._spacing = field.values, np.asarray(field.origin), field.spacing
        self._last_cell = np.array(field.values.shape) - 1

    def at_least(self, points: NDArray) -> NDArray[np.float64]:
        """(n,) a lower bound of the distance (m) of points (n, 3) from the hulls."""
        cell = ((points - self._origin) * (1.0 / self._spacing) + 0.5).astype(int)
        x, y, z = np.minimum(np.maximum(cell, 0), self._last_cell).T
        # The nearest sample is at most half a cell's diagonal away; beyond the field's box it is nearer to the object.
        return self._values[x, y, z] - 0.87 * self._spacing

    def crossed(self, start: NDArray, end: NDArray) -> NDArray[np.bool_]:
        """(n,) bool: whether segments (n, 3) to (n, 3) have a point inside a hull."""
        before = np.einsum("hpk,nk->nhp", self._normal, start) + self._offset
        rise = np.einsum("hpk,nk->nhp", self._normal, end - start)
        with np.errstate(divide="ignore", invalid="ignore"):
            at = -before / rise
        enter = np.where(rise < 0, at, np.where((rise == 0) & (before > 0), np.inf, -np.inf)).max(axis=2)
        leave = np.where(rise > 0, at, np.inf).min(axis=2)
        return (np.maximum(enter, 0.0) < np.minimum(leave, 1.0)).any(axis=1)

    def contains(self, points: NDArray) -> NDArray[np.bool_]:
        """(n,) bool: whether points (n, 3) lie inside a hull."""
        distance = np.einsum("hpk,nk->nhp", self._normal, points) + self._offset
        return (distance < 0).all(axis=2).any(axis=1)


class AxisWatch:
    """Watches one hand on one object: call :meth:`count` after every physics step."""

    def __init__(self, union: HullUnion, pose: int) -> None:
        probes = build_skin(load_hand().shapes).probes
        on_axis = probes.radius > 0  # boxes have their probes on their faces
        self._link, self._local = probes.link[on_axis], probes.position[on_axis].astype(np.float64)
        self._joined = np.flatnonzero(self._link[1:] == self._link[:-1])  # each with the next one
        between = self._local[self._joined + 1] - self._local[self._joined]
        self._gap = np.linalg.norm(between, axis=1) + 1e-5  # rigid links: the distance never changes, but for rounding
        self._union, self._turn = union, grids.pose_rotation(pose).astype(np.float64)
        self._last: NDArray | None = None
        self._quiet = QUIET_STEPS

    def count(self, link_matrices: NDArray, counts: WallCounts) -> None:
        """Adds what is seen after a physics step, for skin link poses (L, 3, 4) in the world."""
        inside, jumped = self.look(link_matrices)
        counts.inside += inside
        counts.jumps += jumped
        if inside or jumped:
            counts.incidents += self._quiet >= QUIET_STEPS
            self._quiet = 0
        else:
            self._quiet += 1

    def look(self, link_matrices: NDArray) -> tuple[bool, bool]:
        """(an axis is inside, an axis jumped) for skin link poses (L, 3, 4) in the world."""
        poses = link_matrices[self._link].astype(np.float64)
        world = np.einsum("pij,pj->pi", poses[:, :, :3], self._local) + poses[:, :, 3]
        points = world @ self._turn  # into the object's frame: the turn's inverse
        inside = jumped = False
        clear = self._union.at_least(points)
        joined = self._joined[clear[self._joined] < self._gap]
        if len(joined):
            inside = bool(self._union.crossed(points[joined], points[joined + 1]).any())
        if self._last is not None:
            moved = points - self._last
            near = clear * np.abs(clear) < np.einsum("pk,pk->p", moved, moved)
            if near.any():
                start, end = self._last[near], points[near]
                outside = ~self._union.contains(start) & ~self._union.contains(end)
                jumped = bool((self._union.crossed(start, end) & outside).any())
        self._last = points
        return inside, jumped


def count_crossings(name: str, pressing: bool, control_steps: int, num_envs: int = 16) -> WallCounts:
    """Hands on one object for at least ``control_steps``: random ones, or ones that press on it."""
    union = HullUnion(load_object(name))
    hands = Hands(num_envs, BatchSettings(object=name, reward_mode="none"))
    counts, generator = WallCounts(), np.random.Generator(np.random.PCG64(0))
    rows, links = hands.scenes[0].skin_rows(), np.zeros((1, len(SKIN_LINKS), 3, 4), dtype=np.float32)
    joints = np.zeros((2, NUM_JOINTS), dtype=np.float32)
    poses = np.zeros((1, hands.scenes[0].num_bodies, POSE_SIZE), dtype=np.float32)
    watches: list[AxisWatch] = []

    def watched(env: int) -> Callable[[], None]:
        scene = hands.scenes[env]

        def step() -> None:
            for _ in range(SUBSTEPS):
                scene._system.step()
                scene.read(*joints, poses[0])
                link_matrices(poses, rows, links)
                watches[env].count(links[0], counts)

        return step

    for env in range(num_envs):
        hands.scenes[env].step = watched(env)
    episode = 0
    while counts.control_steps < control_steps:
        hands.reset(episode * num_envs)
        watches[:] = [AxisWatch(union, pose) for pose in hands.batch.pose]
        press = PressingHands(num_envs, episode)
        for index in range(HORIZON - 1):  # the last step would start the next episode
            explore = exploring_actions(generator, num_envs, index)
            hands.step(press(index, hands.arrays["qpos"]) if pressing else explore)
            counts.control_steps += num_envs
            counts.contact_steps += int(hands.arrays["touch"].any(axis=1).sum())
        episode += 1
    return counts


def crossings(objects: Sequence[str], pressing: bool, control_steps: int) -> dict[str, WallCounts]:
    """Counts per object, ``control_steps`` in all."""
    share = -(-control_steps // len(objects))
    return {name: count_crossings(name, pressing, share) for name in objects}
