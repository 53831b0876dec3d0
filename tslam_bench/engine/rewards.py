"""Reward modes (protocol section 7), batched over environments.

``tslam`` is the paper's reward: novel part discovery plus coverage (equations 2 and 3). Every other mode replaces or
drops one of the two terms. Modes that remember contact points keep the most recent ``MAX_KNOWN_CONTACTS`` per
environment, so that a step's work is bounded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from tslam_bench import grids
from tslam_bench.constants import VOXEL_EDGE, WORKSPACE_EDGE
from tslam_bench.engine.arrays import Array, Backend
from tslam_bench.engine.sensing import MAX_NEW_CONTACTS, Contacts
from tslam_bench.errors import InvalidInputError
from tslam_bench.geometry.alpha_shape import alpha_shape_samples, chamfer_l2, thin_out
from tslam_bench.objects.store import PreparedObject

COVERAGE_WEIGHT: Final = 0.005
"""Lambda of ``r = r_d + lambda r_c``: makes the two terms' episode sums equal within a factor 2
under a random policy (docs/rewards.md)."""
MODE_SCALE: Final = {
    "tslam": 1.0,
    "no_coverage": 1.0,
    "no_discovery": 1.0,
    "points": 0.4,
    "contact": 0.7,
    "knn": 0.75,
    "disagreement": 2300.0,
    "chamfer": 80.0,
}
"""Factor on the term that replaces ``r_d``: brings its episode sum under a random policy to the order of ``r_d``'s."""
NEIGHBOURS: Final = 5
MAX_KNOWN_CONTACTS: Final = 2048
SURFACE_SUBSAMPLE: Final = 512
"""True-surface samples that the privileged ``chamfer`` mode compares with."""
UNKNOWN: Final = 1e3
"""Coordinate (m) of empty slots: further away than anything real."""


class Rewards:
    """Computes one reward mode for E environments.

    Args:
        mode: one of ``tslam_bench.constants.REWARD_MODES``, or ``none``, whose rewards are 0.
        num_envs: E.
        backend: numpy or torch.
    """

    def __init__(self, mode: str, num_envs: int, backend: Backend) -> None:
        self.mode = mode
        self.backend = backend
        self.num_envs = num_envs
        self._memory = ContactMemory(num_envs, backend) if mode in ("knn", "disagreement") else None
        self._surface = SurfaceDistance(num_envs, backend) if mode == "chamfer" else None
        self._shapes = AlphaShapes(num_envs) if mode == "disagreement" else None

    def set_object(self, env: int, prepared: PreparedObject, pose: int) -> None:
        """Tells the privileged mode what one environment explores; the others do not look."""
        if self._surface is not None:
            self.set_surface(env, prepared.surface_points[:SURFACE_SUBSAMPLE] @ grids.pose_rotation(pose).T)

    def set_surface(self, env: int, points: np.ndarray) -> None:
        """Gives one environment its true surface, (SURFACE_SUBSAMPLE, 3) in the world frame (m)."""
        if self._surface is not None:
            self._surface.set(env, points)

    def begin(self, envs: Sequence[int]) -> None:
        """Forgets the episodes of ``envs``."""
        for part in (self._memory, self._surface, self._shapes):
            if part is not None:
                part.begin(envs)

    def step(self, contacts: Contacts) -> Array:
        """(E,) float32 reward of one control step."""
        if self.mode == "none":
            return self.backend.full((self.num_envs,), 0, np.float32)
        coverage = COVERAGE_WEIGHT * self._float(contacts.new_visited)
        if self.mode == "no_discovery":
            return coverage
        exploration = MODE_SCALE[self.mode] * _EXPLORATION[self.mode](self, contacts)
        return exploration if self.mode == "no_coverage" else exploration + coverage

    def state(self) -> dict[str, Array]:
        """What the mode remembers of the running episodes, (E, ...) arrays: copies. Empty where it remembers nothing."""
        parts = (part for part in (self._memory, self._surface) if part is not None)
        return {name: self.backend.array(getattr(part, f"_{name}")) for part in parts for name in part.REMEMBERED}

    def set_state(self, envs: Sequence[int], state: Mapping[str, Array]) -> None:
        """Puts rows of :meth:`state`, one per entry of ``envs``, back.

        Raises:
            InvalidInputError: a state of another reward mode.
        """
        parts = [part for part in (self._memory, self._surface) if part is not None]
        if {name for part in parts for name in part.REMEMBERED} != set(state):
            raise InvalidInputError(
                f"state: of another reward mode than this environment's {self.mode!r}; make one with the same reward_mode"
            )
        for part in parts:
            for name in part.REMEMBERED:
                getattr(part, f"_{name}")[list(envs)] = self.backend.array(state[name])
        if self._shapes is not None and self._memory is not None:
            self._shapes.recall(envs, self._memory)

    def _float(self, value: Array) -> Array:
        return self.backend.cast(value, np.float32)

    def _discovery(self, contacts: Contacts) -> Array:
        return self._float(contacts.new_touched)

    def _points(self, contacts: Contacts) -> Array:
        return self._float(contacts.new.sum(1))

    def _contact(self, contacts: Contacts) -> Array:
        return self._float(contacts.on.any(1))

    def _knn(self, contacts: Contacts) -> Array:
        assert self._memory is not None
        mean = self._memory.mean_neighbour_distance(contacts.points, contacts.mask) / VOXEL_EDGE
        self._memory.add(contacts.points, contacts.mask)
        return self._float(mean)

    def _disagreement(self, contacts: Contacts) -> Array:
        assert self._memory is not None and self._shapes is not None
        self._memory.add(contacts.points, contacts.mask)
        return self.backend.array(self._shapes.step(self._memory, self.backend.host(contacts.mask.any(1))))

    def _chamfer(self, contacts: Contacts) -> Array:
        assert self._surface is not None
        return self._float(self._surface.step(contacts.points, contacts.mask))


_EXPLORATION: Final[dict[str, Callable[[Rewards, Contacts], Array]]] = {
    "tslam": Rewards._discovery,
    "no_coverage": Rewards._discovery,
    "points": Rewards._points,
    "contact": Rewards._contact,
    "knn": Rewards._knn,
    "disagreement": Rewards._disagreement,
    "chamfer": Rewards._chamfer,
}


def _squared_distances(a: Array, b: Array) -> Array:
    """(E, m, n) squared distances between (E, m, 3) and (E, n, 3), summed axis by axis so that bits do not depend on E."""
    total: Array = None
    for axis in range(3):
        difference = a[:, :, None, axis] - b[:, None, :, axis]
        total = difference * difference if total is None else total + difference * difference
    return total


class ContactMemory:
    """The known contact points of each environment: a ring of the latest ``MAX_KNOWN_CONTACTS``."""

    REMEMBERED = ("points", "count")

    def __init__(self, num_envs: int, backend: Backend) -> None:
        self._backend = backend
        # One more slot than the ring holds: points that are not there are written to it and thrown away.
        self._points = backend.full((num_envs, MAX_KNOWN_CONTACTS + 1, 3), UNKNOWN, np.float32)
        self._count = backend.full((num_envs,), 0, np.int64)
        self._rows = backend.array(np.arange(num_envs)[:, None])

    def begin(self, envs: Sequence[int]) -> None:
        """Forgets the points of ``envs``."""
        self._points[list(envs)] = UNKNOWN
        self._count[list(envs)] = 0

    def known(self, env: int) -> np.ndarray:
        """(n, 3) float32 known points of one environment, on the host."""
        count = min(int(self._count[env]), MAX_KNOWN_CONTACTS)
        return self._backend.host(self._points[env, :count])

    def add(self, points: Array, mask: Array) -> None:
        """Adds (E, m, 3) points where (E, m) ``mask`` is set."""
        backend, xp = self._backend, self._backend.module
        rank = xp.cumsum(backend.cast(mask, np.int64), 1) - 1 + self._count[:, None]
        slot = xp.where(mask, rank % MAX_KNOWN_CONTACTS, MAX_KNOWN_CONTACTS)
        self._points[self._rows, slot] = points
        self._points[:, MAX_KNOWN_CONTACTS] = UNKNOWN
        self._count = self._count + mask.sum(1)

    def mean_neighbour_distance(self, points: Array, mask: Array) -> Array:
        """(E,) mean over masked points of the mean distance (m) to their nearest known points (up to five), 0 if none."""
        backend, xp = self._backend, self._backend.module
        filled = int(min(int(self._count.max()), MAX_KNOWN_CONTACTS)) if backend.is_numpy else MAX_KNOWN_CONTACTS
        used = int(mask.sum(1).max()) if backend.is_numpy else mask.shape[1]
        if filled == 0 or used == 0:
            return backend.full((mask.shape[0],), 0, np.float32)
        squared = _squared_distances(points[:, :used], self._points[:, : max(filled, NEIGHBOURS)])
        if backend.is_numpy:
            nearest = np.sort(np.partition(squared, NEIGHBOURS - 1, axis=2)[:, :, :NEIGHBOURS], axis=2)
        else:
            nearest = xp.topk(squared, NEIGHBOURS, dim=2, largest=False, sorted=True).values
        real = nearest < 1.0  # empty slots are UNKNOWN metres away
        count = real.sum(2)
        distance = xp.where(real, xp.sqrt(nearest), 0.0 * nearest)
        total = distance[:, :, 0]
        for k in range(1, NEIGHBOURS):
            total = total + distance[:, :, k]
        valid = mask[:, :used] & (count > 0)
        mean = xp.where(valid, total / backend.clip(count, 1, NEIGHBOURS), 0.0 * total)
        return mean.sum(1) / backend.clip(mask.sum(1), 1, MAX_NEW_CONTACTS)


class SurfaceDistance:
    """Chamfer-L2 (metric units) between accumulated contact points and the true surface, kept up to date step by step."""

    REMEMBERED = ("nearest", "sum", "total", "last", "first")

    def __init__(self, num_envs: int, backend: Backend) -> None:
        self._backend = backend
        self._surface = backend.full((num_envs, SURFACE_SUBSAMPLE, 3), 0, np.float32)
        self._nearest = backend.full((num_envs, SURFACE_SUBSAMPLE), np.inf, np.float32)  # squared, surface to contacts
        self._sum = backend.full((num_envs,), 0, np.float32)  # of squared distances, contacts to surface
        self._total = backend.full((num_envs,), 0, np.int64)
        self._last = backend.full((num_envs,), 0, np.float32)
        self._first = backend.full((num_envs,), 0, np.float32)

    def set(self, env: int, points: np.ndarray) -> None:
        """The true surface of one environment, (SURFACE_SUBSAMPLE, 3) world frame, metres."""
        self._surface[env] = self._backend.array(np.asarray(points / WORKSPACE_EDGE, dtype=np.float32))

    def begin(self, envs: Sequence[int]) -> None:
        """Forgets the contacts of ``envs``."""
        chosen = list(envs)
        self._nearest[chosen] = np.inf
        for value in (self._sum, self._total, self._last, self._first):
            value[chosen] = 0

    def step(self, points: Array, mask: Array) -> Array:
        """(E,) decrease of the Chamfer distance by these points, as a share of its first value."""
        backend, xp = self._backend, self._backend.module
        used = max(1, int(mask.sum(1).max())) if backend.is_numpy else mask.shape[1]
        mask = mask[:, :used]
        squared = _squared_distances(points[:, :used] * (1.0 / WORKSPACE_EDGE), self._surface)
        squared = xp.where(mask[:, :, None], squared, backend.full((1, 1, 1), np.inf, np.float32))
        self._nearest = xp.minimum(self._nearest, squared.min(1) if backend.is_numpy else squared.min(1).values)
        to_surface = squared.min(2) if backend.is_numpy else squared.min(2).values
        self._sum = self._sum + xp.where(mask, to_surface, 0.0 * self._sum[:, None]).sum(1)
        self._total = self._total + mask.sum(1)
        known = self._total > 0
        nearest = xp.where(known[:, None], self._nearest, 0.0 * self._sum[:, None])
        now = 0.5 * (nearest.sum(1) / SURFACE_SUBSAMPLE + self._sum / backend.clip(self._total, 1, 1 << 30))
        now = backend.cast(now, np.float32)
        started = self._first > 0
        gain = xp.where(started, (self._last - now) / xp.where(started, self._first, self._first + 1.0), 0.0 * now)
        self._first = xp.where(started | ~known, self._first, now)
        self._last = now
        return gain


class AlphaShapes:
    """Chamfer-L2 between the alpha shapes of the known contact points before and after a step.

    The triangulation is qhull's, on the host and one environment at a time. What bounds its work: the points are thinned out
    to ``alpha_shape.MAX_POINTS``, and only an environment whose thinned points change pays; for all others it is zero.
    """

    def __init__(self, num_envs: int) -> None:
        self._shapes: list[tuple[np.ndarray, np.ndarray] | None] = [None] * num_envs  # thinned points, samples

    def begin(self, envs: Sequence[int]) -> None:
        """Forgets the shapes of ``envs``."""
        for env in envs:
            self._shapes[env] = None

    def recall(self, envs: Sequence[int], memory: ContactMemory) -> None:
        """Makes the shapes of ``envs`` anew from the known points: they follow from them."""
        for env in envs:
            points = thin_out(memory.known(env))
            self._shapes[env] = (points, alpha_shape_samples(points)) if len(points) else None

    def step(self, memory: ContactMemory, fresh: np.ndarray) -> np.ndarray:
        """(E,) float32 disagreement in metric units, for environments that have new points where ``fresh`` (E,) is set."""
        reward = np.zeros(len(self._shapes), dtype=np.float32)
        for env in np.flatnonzero(fresh):
            points, before = thin_out(memory.known(int(env))), self._shapes[env]
            if before is not None and np.array_equal(points, before[0]):
                continue
            samples = alpha_shape_samples(points)
            if before is not None:
                reward[env] = chamfer_l2(before[1], samples) / WORKSPACE_EDGE**2
            self._shapes[env] = points, samples
        return reward
