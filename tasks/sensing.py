"""Touch and coverage, batched over environments: probes, signed distance, contact points, voxel sets (section 5).

The same code runs on numpy arrays (CPU simulation) and on torch tensors (GPU simulation, or CPU tensors in tests): it uses
only elementwise arithmetic, gathers and order-free scatters, whose bits do not depend on how many environments are
batched.

Arrays are ``(environments, ...)``; E environments, P probes, N = 32 voxels per axis. World frame, metres.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from tslam_bench import grids
from tslam_bench.assets.store import SignedDistanceField
from tslam_bench.constants import GRID_SIZE, TOUCH_DISTANCE, VOXEL_EDGE, WORKSPACE_LOW
from tslam_bench.tasks.arrays import Backend
from tslam_bench.tasks.skin import PointSet, Skin

Array = Any
"""numpy.ndarray or torch.Tensor, as the backend says."""

VOXELS = GRID_SIZE**3
MAX_NEW_CONTACTS = 64
"""New contact points kept per environment and step (the first in probe order); more than that is a whole palm landing."""


@dataclass(frozen=True)
class Contacts:
    """What one control step felt.

    Attributes:
        on: (E, P) bool, probes that are on.
        new: (E, P) bool, probes on now that were off one step before.
        points: (E, MAX_NEW_CONTACTS, 3) float32 contact points of new probes, zero where ``mask`` is False.
        mask: (E, MAX_NEW_CONTACTS) bool.
        new_touched: (E,) int64, |T_t minus T_(t-1)| (paper eq. 2).
        new_visited: (E,) int64, |V_t minus V_(t-1)| (paper eq. 3).
    """

    on: Array
    new: Array
    points: Array
    mask: Array
    new_touched: Array
    new_visited: Array


class FieldAtlas:
    """The signed-distance fields in use, in equal slots of one flat array, so that environments share a gather.

    A field stays in its slot while an environment uses it, and after that until the slot is needed: memory is bounded
    by the number of environments, not by the number of objects.

    Args:
        num_envs: environments.
        backend: numpy or torch.
    """

    SPARE_SLOTS = 16

    def __init__(self, num_envs: int, backend: Backend) -> None:
        self._backend = backend
        self._limit = num_envs + self.SPARE_SLOTS
        self._names: list[str | None] = []  # of the slots
        self._fields: list[SignedDistanceField | None] = []
        self._last_use: list[int] = []
        self._slot_size = 0
        self._clock = 0
        self.values: Array = None

    def place(self, name: str, field: SignedDistanceField, in_use: Collection[str]) -> int:
        """Offset into ``values`` of the field called ``name``, copying it in if it is not there.

        ``in_use`` names the fields that must stay.
        """
        self._clock += 1
        if name not in self._names:
            self._put(self._free_slot(in_use), name, field)
        slot = self._names.index(name)
        self._last_use[slot] = self._clock
        return slot * self._slot_size

    def offset(self, name: str) -> int:
        """Offset of a field that is in its slot."""
        return self._names.index(name) * self._slot_size

    def _free_slot(self, in_use: Collection[str]) -> int:
        if len(self._names) < self._limit:
            self._names.append(None)
            self._fields.append(None)
            self._last_use.append(0)
            return len(self._names) - 1
        idle = [slot for slot, name in enumerate(self._names) if name not in in_use]
        return min(idle, key=lambda slot: self._last_use[slot])

    def _put(self, slot: int, name: str, field: SignedDistanceField) -> None:
        self._names[slot], self._fields[slot] = name, field
        needed = len(self._names)
        if self.values is None or field.values.size > self._slot_size or needed * self._slot_size > len(self.values):
            self._slot_size = max(self._slot_size, field.values.size)
            slots = min(self._limit, max(4, 2 * needed))
            self.values = self._backend.zeros(slots * self._slot_size, np.float32)
            for other, kept in enumerate(self._fields):
                if kept is not None:
                    self._copy(other, kept)
        else:
            self._copy(slot, field)

    def _copy(self, slot: int, field: SignedDistanceField) -> None:
        start = slot * self._slot_size
        flat = np.ascontiguousarray(field.values, dtype=np.float32).reshape(-1)
        self.values[start : start + len(flat)] = self._backend.array(flat)


class TactileSensing:
    """Senses E environments at once and accumulates their touched and visited grids.

    Args:
        num_envs: E.
        skin: probes and volume points.
        backend: numpy or torch.
    """

    def __init__(self, num_envs: int, skin: Skin, backend: Backend) -> None:
        self.num_envs = num_envs
        self.backend = backend
        self._xp: ModuleType = backend.module
        self._probes = _BoundPoints(skin.probes, backend)
        self._volume = _BoundPoints(skin.volume, backend)
        self._num_links = int(skin.volume.link.max()) + 1
        self._probe_reach = backend.array(skin.probes.radius + np.float32(TOUCH_DISTANCE))
        link_of_probe = np.zeros((len(skin.probes), self._num_links), dtype=bool)
        link_of_probe[np.arange(len(skin.probes)), skin.probes.link] = True
        self._first_probe = np.searchsorted(skin.probes.link, np.arange(self._num_links))
        self._link_of_probe = backend.array(link_of_probe.astype(np.float32))
        self.atlas = FieldAtlas(num_envs, backend)

        zeros, flat = backend.zeros, num_envs * VOXELS + 1  # the last element takes what lies outside W
        self._touched = zeros(flat, bool)
        self._visited = zeros(flat, bool)
        self._touched_step = backend.full(flat, -1, np.int16)
        self._winner = zeros(flat, np.int64)
        self._on = zeros((num_envs, len(skin.probes)), bool)
        self._env_base = backend.array(np.arange(num_envs, dtype=np.int64)[:, None] * VOXELS)
        self._env_row = backend.array(np.arange(num_envs, dtype=np.int64)[:, None])

        # Per environment, of its object and pose; host copies, pushed to the device after a reset.
        self._objects: list[tuple[str, SignedDistanceField] | None] = [None] * num_envs
        self._turn_host = np.tile(np.eye(3, dtype=np.float32), (num_envs, 1, 1))
        self._bound = False

    # -- grids ------------------------------------------------------------------------------------------------
    @property
    def touched(self) -> Array:
        """(E, 32, 32, 32) bool, touched since the episode began; a view."""
        return self._touched[:-1].reshape(self.num_envs, GRID_SIZE, GRID_SIZE, GRID_SIZE)

    @property
    def visited(self) -> Array:
        """(E, 32, 32, 32) bool, visited since the episode began; a view."""
        return self._visited[:-1].reshape(self.num_envs, GRID_SIZE, GRID_SIZE, GRID_SIZE)

    @property
    def touched_step(self) -> Array:
        """(E, 32, 32, 32) int16, control step (0 = first) of the first touch, -1 where never touched; a view."""
        return self._touched_step[:-1].reshape(self.num_envs, GRID_SIZE, GRID_SIZE, GRID_SIZE)

    @property
    def on(self) -> Array:
        """(E, P) bool, probes that are on."""
        return self._on

    # -- episodes ---------------------------------------------------------------------------------------------
    def set_object(self, env: int, name: str, field: SignedDistanceField, pose: int) -> None:
        """Puts an object in a pose into one environment; call :meth:`begin` before the next step."""
        self._objects[env] = (name, field)
        self._turn_host[env] = grids.pose_rotation(pose)
        self._bound = False

    def begin(self, envs: Sequence[int]) -> None:
        """Clears the grids and probe memory of ``envs`` for a new episode."""
        if not self._bound:
            self._bind()
        for grid, value in ((self._touched, False), (self._visited, False), (self._touched_step, -1)):
            rows = grid[:-1].reshape(self.num_envs, VOXELS)
            rows[list(envs)] = value
        self._on[list(envs)] = False

    def _bind(self) -> None:
        objects = [entry for entry in self._objects if entry is not None]
        if len(objects) < self.num_envs:
            raise ValueError("set_object has to be called for every environment before begin")
        in_use = {name for name, _ in objects}
        for name, field in objects:
            self.atlas.place(name, field, in_use)
        array = self.backend.array
        offsets = [self.atlas.offset(name) for name, _ in objects]  # read last: placing can move the slots
        sizes = [field.values.shape for _, field in objects]
        origins = [np.asarray(field.origin, dtype=np.float64) for _, field in objects]
        spacings = [float(field.spacing) for _, field in objects]
        strides = [(ny * nz, nz, 1) for _, ny, nz in sizes]
        self._offset = array(np.array(offsets, dtype=np.int64)[:, None])
        self._stride = [array(np.array([s[a] for s in strides], dtype=np.int64)[:, None]) for a in range(3)]
        self._last_cell = [array(np.array([s[a] - 2 for s in sizes], dtype=np.float32)[:, None]) for a in range(3)]
        self._origin = [array(np.array([o[a] for o in origins], dtype=np.float32)[:, None]) for a in range(3)]
        self._inverse_spacing = array((1.0 / np.array(spacings)).astype(np.float32)[:, None])
        # A sample is at most half a cell diagonal away from a point, and distance is 1-Lipschitz.
        self._cull_margin = array((np.sqrt(3.0) / 2 * 1.001 * np.array(spacings)).astype(np.float32)[:, None])
        self._turn = array(self._turn_host)
        self._bound = True

    # -- one step ---------------------------------------------------------------------------------------------
    def step(self, link_matrices: Array, step: Array) -> Contacts:
        """Senses the hand where it is now and updates the grids.

        Args:
            link_matrices: (E, L, 3, 4) float32, pose of every skin link in the world.
            step: (E,) int, number of the control step in its episode (0 = first).

        Returns:
            The step's contacts.
        """
        on, felt = self._touch(link_matrices)
        new = on & ~self._on
        self._on = on
        new_touched, points, mask = self._touch_voxels(felt, new, step)
        new_visited = self._visit_voxels(link_matrices)
        return Contacts(on, new, points, mask, new_touched, new_visited)

    def touches(self, link_matrices: Array) -> Array:
        """(E, P) bool, probes that would be on for these link poses; changes nothing."""
        return self._touch(link_matrices)[0]

    def link_touch(self) -> Array:
        """(E, L) bool: a link's touch bit is on when any of its probes is."""
        if self.backend.is_numpy:
            return np.logical_or.reduceat(self._on, self._first_probe, axis=1)
        return (self._on.to(self._link_of_probe.dtype) @ self._link_of_probe) > 0  # 0/1 sums: exact

    def _touch(self, link_matrices: Array) -> tuple[Array, _Felt]:
        """(E, P) probes on, and the probes near the surface with what their contact points need."""
        xp, backend = self._xp, self.backend
        # Into the object's frame: exact, since a turn is a signed permutation and the other products are zero.
        turned = (self._turn[:, None, :, :, None] * link_matrices[:, :, :, None, :]).sum(2)
        placed = self._probes.place(turned)
        u = [(p - o) * self._inverse_spacing for p, o in zip(placed, self._origin, strict=True)]
        nearest = self._offset
        for axis in range(3):
            cell = backend.clip(xp.floor(u[axis] + 0.5), 0.0, self._last_cell[axis] + 1.0)
            nearest = nearest + backend.integer(cell) * self._stride[axis]
        near = backend.take(self.atlas.values, nearest) <= self._probe_reach + self._cull_margin
        rows, columns = backend.select(near)
        cells = _Cells(self, [c[rows, columns] for c in u], rows)
        flags = (cells.value <= self._probe_reach[columns]) & near[rows, columns]
        on = backend.zeros(near.shape, bool)
        on[rows, columns] = flags
        return on, _Felt(rows, columns, flags, [p[rows, columns] for p in placed], cells)

    def _touch_voxels(self, felt: _Felt, new: Array, step: Array) -> tuple[Array, Array, Array]:
        backend, xp, rows = self.backend, self._xp, felt.rows
        gradient = felt.cells.unit_gradient()
        on_surface = [p - felt.cells.value * g for p, g in zip(felt.placed, gradient, strict=True)]
        turn = self._turn[rows]
        world = [
            turn[:, a, 0] * on_surface[0] + turn[:, a, 1] * on_surface[1] + turn[:, a, 2] * on_surface[2]
            for a in range(3)
        ]
        key = xp.where(felt.flags, self._voxel_key(world, self._env_base[rows, 0]), self.num_envs * VOXELS)
        fresh = self._first_of_each(self._touched, key)
        backend.put(self._touched_step, xp.where(fresh, key, self.num_envs * VOXELS), backend.int16(step[rows]))
        self._touched_step[-1] = -1
        backend.put(self._touched, key, True)
        self._touched[-1] = False
        new_touched = backend.count_rows(fresh, rows, self.num_envs)
        points, mask = self._new_points(world, felt.flags & new[rows, felt.columns], rows)
        return new_touched, points, mask

    def _new_points(self, world: list[Array], flags: Array, rows: Array) -> tuple[Array, Array]:
        """The first MAX_NEW_CONTACTS flagged points of each environment, in probe order."""
        backend, xp = self.backend, self._xp
        points = backend.zeros((self.num_envs, MAX_NEW_CONTACTS + 1, 3), np.float32)
        mask = backend.zeros((self.num_envs, MAX_NEW_CONTACTS + 1), bool)
        total = xp.cumsum(backend.integer(flags), 0)  # rows are sorted, so ranks restart by subtraction
        before = backend.count_rows(flags, rows, self.num_envs)
        start = xp.cumsum(before, 0) - before
        rank = total - 1 - start[rows]
        slot = xp.where(flags & (rank < MAX_NEW_CONTACTS), rank, MAX_NEW_CONTACTS)  # the last slot is thrown away
        mask[rows, slot] = True
        for axis in range(3):
            points[rows, slot, axis] = world[axis]
        return points[:, :MAX_NEW_CONTACTS], mask[:, :MAX_NEW_CONTACTS]

    def _visit_voxels(self, link_matrices: Array) -> Array:
        key = self._voxel_key(self._volume.place(link_matrices), self._env_base)
        fresh = self._first_of_each(self._visited, key)
        self.backend.put(self._visited, key, True)
        self._visited[-1] = False
        return fresh.sum(1)

    def _voxel_key(self, points: list[Array], base: Array) -> Array:
        """Flat voxel index of points, or the spare last element where they lie outside W."""
        xp = self._xp
        inside, key = None, base
        for axis, stride in zip(range(3), (GRID_SIZE * GRID_SIZE, GRID_SIZE, 1), strict=True):
            cell = xp.floor((points[axis] - np.float32(WORKSPACE_LOW).item()) * np.float32(1 / VOXEL_EDGE).item())
            within = (cell >= 0) & (cell < GRID_SIZE)
            inside = within if inside is None else inside & within
            key = key + self.backend.integer(cell) * stride
        return xp.where(inside, key, self.num_envs * VOXELS)

    def _first_of_each(self, grid: Array, key: Array) -> Array:
        """True for exactly one entry per voxel that ``key`` names and ``grid`` does not hold yet.

        Which entry wins a voxel is not defined, how many win is: the count is deterministic on any device.
        """
        backend = self.backend
        flat = key.reshape(-1)
        order = backend.arange(flat.shape[0])
        backend.put(self._winner, flat, order)
        first = (backend.take(self._winner, flat) == order) & ~backend.take(grid, flat)
        return (first & (flat != self.num_envs * VOXELS)).reshape(key.shape)


class _BoundPoints:
    """A point set on the backend's device."""

    def __init__(self, points: PointSet, backend: Backend) -> None:
        self._backend = backend
        self._link = backend.array(points.link)
        self._local = [backend.array(np.ascontiguousarray(points.position[:, a])) for a in range(3)]

    def place(self, link_matrices: Array) -> list[Array]:
        """Coordinates, three (E, P) arrays, for link poses (E, L, 3, 4)."""
        parts = self._backend.link_components(link_matrices)
        taken = self._backend.take_last(parts, self._link)
        x, y, z = self._local
        return [
            taken[4 * row] * x + taken[4 * row + 1] * y + taken[4 * row + 2] * z + taken[4 * row + 3]
            for row in range(3)
        ]


@dataclass(frozen=True)
class _Felt:
    """Probes near the surface: a list of them, in order of environment and probe.

    Attributes:
        rows, columns: environment and probe of each.
        flags: whether it is on.
        placed: three coordinate arrays in the object's frame (m).
        cells: the field around it.
    """

    rows: Array
    columns: Array
    flags: Array
    placed: list[Array]
    cells: _Cells


class _Cells:
    """Trilinear interpolation of the fields at a list of points: grid coordinates ``u``, environments ``rows``.

    ``value`` is the signed distance (m).
    """

    def __init__(self, sensing: TactileSensing, u: list[Array], rows: Array) -> None:
        xp, backend = sensing._xp, sensing.backend
        index, fraction = sensing._offset[rows, 0], []
        strides = []
        for axis in range(3):
            low = backend.clip(xp.floor(u[axis]), 0.0, sensing._last_cell[axis][rows, 0])
            fraction.append(backend.clip(u[axis] - low, 0.0, 1.0))
            strides.append(sensing._stride[axis][rows, 0])
            index = index + backend.integer(low) * strides[axis]
        self._xp, self._fraction = xp, fraction
        values = sensing.atlas.values
        corner = {}
        for i in (0, 1):
            for j in (0, 1):
                for k in (0, 1):
                    at = index + i * strides[0] + j * strides[1] + k * strides[2]
                    corner[i, j, k] = backend.take(values, at)
        self._corner = corner
        self.value = self._interpolate()

    def _interpolate(self) -> Array:
        c, (fx, fy, fz) = self._corner, self._fraction
        along_x = {(j, k): c[0, j, k] + fx * (c[1, j, k] - c[0, j, k]) for j in (0, 1) for k in (0, 1)}
        along_y = {k: along_x[0, k] + fy * (along_x[1, k] - along_x[0, k]) for k in (0, 1)}
        return along_y[0] + fz * (along_y[1] - along_y[0])

    def unit_gradient(self) -> list[Array]:
        """Gradient of the trilinear field, scaled to length 1."""
        c, (fx, fy, fz) = self._corner, self._fraction
        gx = _bilinear(fy, fz, *(c[1, j, k] - c[0, j, k] for j in (0, 1) for k in (0, 1)))
        gy = _bilinear(fx, fz, *(c[i, 1, k] - c[i, 0, k] for i in (0, 1) for k in (0, 1)))
        gz = _bilinear(fx, fy, *(c[i, j, 1] - c[i, j, 0] for i in (0, 1) for j in (0, 1)))
        length = self._xp.sqrt(gx * gx + gy * gy + gz * gz) + 1e-12
        return [gx / length, gy / length, gz / length]


def _bilinear(a: Array, b: Array, v00: Array, v01: Array, v10: Array, v11: Array) -> Array:
    low = v00 + b * (v01 - v00)
    high = v10 + b * (v11 - v10)
    return low + a * (high - low)
