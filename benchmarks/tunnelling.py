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
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rollouts import KINDS, Hands, make_actor
from scipy.spatial import ConvexHull

from tslam_bench import grids
from tslam_bench.compiled import njit
from tslam_bench.constants import HORIZON, NUM_JOINTS
from tslam_bench.engine.hand_batch import BatchSettings
from tslam_bench.engine.link_poses import POSE_SIZE, link_matrices
from tslam_bench.engine.skin import build_skin
from tslam_bench.hand_constants import SKIN_LINKS
from tslam_bench.objects.hand import load_hand
from tslam_bench.objects.store import PreparedObject, load_object

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

    def __add__(self, other: WallCounts) -> WallCounts:
        """Both together."""
        mine, theirs = asdict(self), asdict(other)
        return WallCounts(**{key: mine[key] + theirs[key] for key in mine})


class HullUnion:
    """Exact clipping of line segments against an object's hulls, in the object's frame (m)."""

    def __init__(self, prepared: PreparedObject) -> None:
        planes = [ConvexHull(vertices).equations for vertices, _ in prepared.hulls]
        self._planes = np.concatenate(planes)
        self._first = np.concatenate([[0], np.cumsum([len(equations) for equations in planes])])
        field = prepared.field
        self.field = np.ascontiguousarray(field.values, dtype=np.float64), np.asarray(field.origin), field.spacing

    def crossed(self, start: NDArray, end: NDArray) -> NDArray[np.bool_]:
        """(n,) bool: whether segments (n, 3) to (n, 3) have a point inside a hull."""
        return _crossed(self._planes, self._first, start, end)

    def contains(self, points: NDArray) -> NDArray[np.bool_]:
        """(n,) bool: whether points (n, 3) lie inside a hull."""
        return _contains(self._planes, self._first, points)


@njit(cache=True)
def _crossed(planes: Any, first: Any, start: Any, end: Any) -> Any:
    found = np.zeros(len(start), dtype=np.bool_)
    for segment in range(len(start)):
        a, b = start[segment], end[segment]
        for hull in range(len(first) - 1):
            enter, leave = 0.0, 1.0
            for index in range(first[hull], first[hull + 1]):
                n = planes[index]
                before = n[0] * a[0] + n[1] * a[1] + n[2] * a[2] + n[3]
                rise = n[0] * (b[0] - a[0]) + n[1] * (b[1] - a[1]) + n[2] * (b[2] - a[2])
                if rise < 0:
                    enter = max(enter, -before / rise)
                elif rise > 0:
                    leave = min(leave, -before / rise)
                elif before > 0:
                    leave = -1.0
                if enter >= leave:
                    break
            if enter < leave:
                found[segment] = True
                break
    return found


@njit(cache=True)
def _contains(planes: Any, first: Any, points: Any) -> Any:
    found = np.zeros(len(points), dtype=np.bool_)
    for point in range(len(points)):
        p = points[point]
        for hull in range(len(first) - 1):
            inside = True
            for index in range(first[hull], first[hull + 1]):
                n = planes[index]
                if n[0] * p[0] + n[1] * p[1] + n[2] * p[2] + n[3] >= 0:
                    inside = False
                    break
            if inside:
                found[point] = True
                break
    return found


class AxisWatch:
    """Watches hands on one object: call :meth:`count` with where the links were after each physics step.

    Args:
        union: the object.
        poses: of the object, one per hand.
    """

    def __init__(self, union: HullUnion, poses: Sequence[int]) -> None:
        probes = build_skin(load_hand().shapes).probes
        on_axis = probes.radius > 0  # boxes have their probes on their faces
        self._link, self._local = probes.link[on_axis], probes.position[on_axis].astype(np.float64)
        self._joined = np.flatnonzero(self._link[1:] == self._link[:-1])  # each with the next one
        between = self._local[self._joined + 1] - self._local[self._joined]
        self._gap = np.linalg.norm(between, axis=1) + 1e-5  # rigid links: the distance never changes, but for rounding
        self._union = union
        self._turn = np.stack([grids.pose_rotation(pose) for pose in poses]).astype(np.float64)
        self._last: NDArray | None = None
        self._quiet = np.full(len(poses), QUIET_STEPS)

    def count(self, link_matrices: NDArray, counts: WallCounts) -> None:
        """Adds what is seen after S physics steps, for skin link poses (E, S, L, 3, 4) in the world."""
        inside, jumped = self.look(link_matrices)
        counts.inside += int(inside.sum())
        counts.jumps += int(jumped.sum())
        for seen in (inside | jumped).T:
            counts.incidents += int((seen & (self._quiet >= QUIET_STEPS)).sum())
            self._quiet = np.where(seen, 0, self._quiet + 1)

    def look(self, link_matrices: NDArray) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(E, S) an axis is inside, (E, S) an axis jumped, for skin link poses (E, S, L, 3, 4) in the world."""
        shape = (*link_matrices.shape[:2], len(self._link))
        points, clear = np.empty((*shape, 3)), np.empty(shape)
        _place(link_matrices, self._link, self._local, self._turn, *self._union.field, points, clear)
        inside, jumped = np.zeros(shape[:2], dtype=bool), np.zeros(shape[:2], dtype=bool)

        near = clear[..., self._joined] < self._gap
        if near.any():
            env, step, which = np.nonzero(near)
            first = self._joined[which]
            crossed = self._union.crossed(points[env, step, first], points[env, step, first + 1])
            inside[env[crossed], step[crossed]] = True

        before = points[:, :1] if self._last is None else self._last[:, None]
        before = np.concatenate([before, points[:, :-1]], axis=1)
        moved = np.square(points - before).sum(axis=-1)
        near = clear * np.abs(clear) < moved
        if near.any():
            start, end = before[near], points[near]
            outside = ~self._union.contains(start) & ~self._union.contains(end)
            crossed = self._union.crossed(start, end) & outside
            env, step, _ = np.nonzero(near)
            jumped[env[crossed], step[crossed]] = True
        self._last = points[:, -1]
        return inside, jumped


@njit(cache=True)
def _place(
    matrices: Any, link: Any, local: Any, turn: Any, values: Any, origin: Any, spacing: Any, points: Any, clear: Any
) -> None:
    """Writes (E, S, P, 3) ``points`` in the object's frame and (E, S, P) ``clear``, at most their distance from the hulls (m)."""
    world = np.zeros(3)
    for env in range(matrices.shape[0]):
        for step in range(matrices.shape[1]):
            for probe in range(len(link)):
                pose = matrices[env, step, link[probe]]
                for row in range(3):
                    world[row] = pose[row, 3]
                    for column in range(3):
                        world[row] += pose[row, column] * local[probe, column]
                for axis in range(3):
                    value = 0.0
                    for row in range(3):  # into the object's frame: the turn's inverse
                        value += world[row] * turn[env, row, axis]
                    points[env, step, probe, axis] = value
                clear[env, step, probe] = _at_least(points[env, step, probe], values, origin, spacing)


@njit(cache=True)
def _at_least(point: Any, values: Any, origin: Any, spacing: Any) -> float:
    """A lower bound of a point's distance from the hulls (m): distances change no faster than places."""
    corner, offset = np.empty(3, dtype=np.int64), np.empty(3)
    for axis in range(3):
        last = values.shape[axis] - 1
        # Beyond the field's box a point is no nearer to the object than its nearest point of the box.
        at = min(max((point[axis] - origin[axis]) / spacing, 0.0), float(last))
        corner[axis] = min(int(at), last - 1)
        offset[axis] = at - corner[axis]
    bound = -np.inf
    for x in range(2):
        for y in range(2):
            for z in range(2):
                away = np.sqrt((offset[0] - x) ** 2 + (offset[1] - y) ** 2 + (offset[2] - z) ** 2)
                bound = max(bound, values[corner[0] + x, corner[1] + y, corner[2] + z] - away * spacing)
    return bound


def count_crossings(
    name: str, kind: str, control_steps: int, settings: BatchSettings, num_envs: int = 16, seed: int = 0
) -> WallCounts:
    """Hands on one object for at least ``control_steps``.

    Args:
        name: the object.
        kind: how the hands act, one of ``rollouts.KINDS``; it decides the control mode.
        control_steps: of all hands together.
        settings: split and physics.
        num_envs: hands.
        seed: of the first episode and its actions.
    """
    union = HullUnion(load_object(name, settings.split))
    hands = Hands(num_envs, replace(settings, object=name, objects=None, reward_mode="none", control_mode=KINDS[kind]))
    counts, substeps = WallCounts(), settings.physics.substeps
    rows = hands.scenes[0].skin_rows()
    joints = np.zeros((2, NUM_JOINTS), dtype=np.float32)
    bodies = np.zeros((num_envs, substeps, hands.scenes[0].num_bodies, POSE_SIZE), dtype=np.float32)
    links = np.zeros((num_envs, substeps, len(SKIN_LINKS), 3, 4), dtype=np.float32)

    def recorded(env: int) -> Callable[[], None]:
        scene = hands.scenes[env]

        def step() -> None:
            for index in range(substeps):
                scene.substep()
                scene.read(*joints, bodies[env, index])

        return step

    for env in range(num_envs):
        hands.scenes[env].step = recorded(env)
    while counts.control_steps < control_steps:
        hands.reset(seed * num_envs)
        watch, actor = AxisWatch(union, hands.batch.pose), make_actor(kind, num_envs, seed)
        for index in range(HORIZON - 1):  # the last step would start the next episode
            hands.step(actor(index, hands.arrays["qpos"]))
            link_matrices(bodies.reshape(-1, *bodies.shape[2:]), rows, links.reshape(-1, *links.shape[2:]))
            watch.count(links, counts)
            counts.control_steps += num_envs
            counts.contact_steps += int(hands.arrays["touch"].any(axis=1).sum())
        seed += 1
    return counts


def crossings(
    objects: Sequence[str], kind: str, control_steps: int, settings: BatchSettings | None = None, seed: int = 0
) -> dict[str, WallCounts]:
    """Counts per object, ``control_steps`` in all."""
    share = -(-control_steps // len(objects))
    settings = settings or BatchSettings(split="test")
    return {name: count_crossings(name, kind, share, settings, seed=seed) for name in objects}
