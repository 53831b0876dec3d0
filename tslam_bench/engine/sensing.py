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
from numpy.typing import NDArray

from tslam_bench import grids
from tslam_bench.constants import GRID_SIZE, TOUCH_DISTANCE, VOXEL_EDGE, WORKSPACE_LOW
from tslam_bench.engine.arrays import Backend
from tslam_bench.engine.skin import PointSet, Skin
from tslam_bench.objects.store import SignedDistanceField

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
        self._num_links = int(skin.volume.link.max()) + 1
        blocks, block_of_probe = _blocks(skin.probes)
        self._blocks = _BoundPoints(blocks, backend)
        self._block_of_probe = backend.array(block_of_probe)
        self._probes = _BoundPoints(skin.probes, backend)
        self._volume = _BoundPoints(skin.volume, backend)
        self._probe_reach = backend.array(skin.probes.radius + np.float32(TOUCH_DISTANCE))
        link_of_probe = np.zeros((len(skin.probes), self._num_links), dtype=bool)
        link_of_probe[np.arange(len(skin.probes)), skin.probes.link] = True
        self._first_probe = np.searchsorted(skin.probes.link, np.arange(self._num_links))
        self._link_of_probe = backend.array(link_of_probe.astype(np.float32))
        self.atlas = FieldAtlas(num_envs, backend)

        self._on = backend.zeros((num_envs, len(skin.probes)), bool)
        self._make_grids()

        # Per environment, of its object and pose; host copies, pushed to the device after a reset.
        self._objects: list[tuple[str, SignedDistanceField] | None] = [None] * num_envs
        self._turn_host = np.tile(np.eye(3, dtype=np.float32), (num_envs, 1, 1))
        self._bound = False

    # -- grids ------------------------------------------------------------------------------------------------
    def _make_grids(self) -> None:
        zeros, flat = self.backend.zeros, self.num_envs * VOXELS + 1  # the last element takes what lies outside W
        self._touched = zeros(flat, bool)
        self._visited = zeros(flat, bool)
        self._touched_step = self.backend.full(flat, -1, np.int16)
        self._touched_count = zeros(self.num_envs, np.int64)
        self._visited_count = zeros(self.num_envs, np.int64)
        self._env_base = self.backend.array(np.arange(self.num_envs, dtype=np.int64)[:, None] * VOXELS)

    def _clear_grids(self, envs: Sequence[int]) -> None:
        for grid, value in ((self._touched, False), (self._visited, False), (self._touched_step, -1)):
            rows = grid[:-1].reshape(self.num_envs, VOXELS)
            rows[list(envs)] = value
        for count in (self._touched_count, self._visited_count):
            count[list(envs)] = 0

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
        self._clear_grids(envs)
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
        self._stride = array(np.array(strides, dtype=np.int64).T[:, :, None].copy())
        self._last_cell = array((np.array(sizes, dtype=np.float32) - 2).T[:, :, None].copy())
        self._origin = array(np.array(origins, dtype=np.float32).T[:, :, None].copy())
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
        """(E, P) probes on, and the probes that may be, with what their contact points need."""
        backend = self.backend
        # Into the object's frame: exact, since a turn is a signed permutation and the other products are zero.
        turned = backend.link_components((self._turn[:, None, :, :, None] * link_matrices[:, :, :, None, :]).sum(2))
        rows, columns = backend.select(self._near_blocks(turned)[:, self._block_of_probe])
        placed = self._probes.place_some(turned, rows, columns)
        cells = _Cells(self, (placed - self._origin[:, rows, 0]) * self._inverse_spacing[rows, 0], rows)
        flags = cells.value <= self._probe_reach[columns]
        on = backend.zeros((self.num_envs, len(self._probe_reach)), bool)
        on[rows, columns] = flags
        return on, _Felt(rows, columns, flags, placed, cells)

    def _near_blocks(self, turned: Array) -> Array:
        """(E, B) bool: blocks of probes that are not certainly clear of the object."""
        xp, backend = self._xp, self.backend
        u = (self._blocks.place(turned) - self._origin) * self._inverse_spacing
        # Outside the field's box the nearest sample's value is less than the true distance: no block is lost.
        cell = backend.integer(backend.clip(xp.floor(u + 0.5), 0.0, self._last_cell + 1.0)) * self._stride
        nearest = backend.take(self.atlas.values, self._offset + cell[0] + cell[1] + cell[2])
        return nearest <= self._blocks.radius + self._cull_margin

    def _touch_voxels(self, felt: _Felt, new: Array, step: Array) -> tuple[Array, Array, Array]:
        backend, xp, rows = self.backend, self._xp, felt.rows
        on_surface = felt.placed - felt.cells.value * felt.cells.unit_gradient()
        turn = self._turn[rows]
        world = xp.stack(
            [
                turn[:, a, 0] * on_surface[0] + turn[:, a, 1] * on_surface[1] + turn[:, a, 2] * on_surface[2]
                for a in range(3)
            ]
        )
        outside = self.num_envs * VOXELS
        key = xp.where(felt.flags, self._voxel_key(world, self._env_base[rows, 0]), outside)
        fresh = xp.where(backend.take(self._touched, key), outside, key)
        backend.put(self._touched_step, fresh, backend.int16(step[rows]))
        self._touched_step[-1] = -1
        new_touched = self._mark(self._touched, self._touched_count, key)
        points, mask = self._new_points(world, felt.flags & new[rows, felt.columns], rows)
        return new_touched, points, mask

    def _new_points(self, world: Array, flags: Array, rows: Array) -> tuple[Array, Array]:
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
        placed = self._volume.place(self.backend.link_components(link_matrices))
        return self._mark(self._visited, self._visited_count, self._voxel_key(placed, self._env_base))

    def _mark(self, grid: Array, count: Array, key: Array) -> Array:
        """Sets voxels and returns how many that adds per environment, (E,) int64; keeps ``count`` up to date."""
        self.backend.put(grid, key, True)
        grid[-1] = False
        now = self.backend.count_set(grid[:-1].reshape(self.num_envs, VOXELS))
        added = now - count
        count[:] = now
        return added

    def _voxel_key(self, points: Array, base: Array) -> Array:
        """Flat voxel index of points (3, ...), or the spare last element where they lie outside W."""
        scaled = (points - np.float32(WORKSPACE_LOW).item()) * np.float32(1 / VOXEL_EDGE).item()
        x, y, z = self.backend.integer(self._xp.floor(scaled))
        inside = ((x | y | z) & ~(GRID_SIZE - 1)) == 0  # all within 0..31: no bit above the fifth, no sign
        key = base + ((x * GRID_SIZE + y) * GRID_SIZE + z)
        return self._xp.where(inside, key, self.num_envs * VOXELS)


BLOCK_EDGE = 25e-3
"""Probes of a link are tested for nearness in blocks of this edge (m)."""


def _blocks(probes: PointSet) -> tuple[PointSet, NDArray[np.int64]]:
    """Blocks of neighbouring probes (centre, radius within which any of its probes can touch), and each probe's block."""
    cell = np.floor(probes.position / BLOCK_EDGE).astype(np.int64)
    _, block = np.unique(np.column_stack([probes.link, cell]), axis=0, return_inverse=True)
    block = block.reshape(-1)
    links, centres, radii = [], [], []
    for index in range(int(block.max()) + 1):
        position = probes.position[block == index].astype(np.float64)
        centre = (position.min(axis=0) + position.max(axis=0)) / 2
        reach = np.linalg.norm(position - centre, axis=1) + probes.radius[block == index] + TOUCH_DISTANCE
        links.append(probes.link[block == index][0])
        centres.append(centre)
        radii.append(reach.max() + 1e-5)  # for rounding
    return PointSet(np.array(links), np.array(centres, dtype=np.float32), np.array(radii, dtype=np.float32)), block


class _BoundPoints:
    """A point set on the backend's device."""

    def __init__(self, points: PointSet, backend: Backend) -> None:
        self._backend = backend
        self.link = backend.array(points.link)
        self._num_points = len(points)
        self.local = backend.array(np.ascontiguousarray(points.position.T))
        self.radius = backend.array(points.radius)

    def place(self, components: Array) -> Array:
        """(3, E, P) coordinates of all points for link poses (12, E, L)."""
        taken = self._backend.take_last(components, self.link).reshape(3, 4, -1, self._num_points)
        return _apply(taken, self.local)

    def place_some(self, components: Array, rows: Array, columns: Array) -> Array:
        """(3, n) coordinates of the listed points for link poses (12, E, L)."""
        flat = components.reshape(12, -1)
        index = rows * components.shape[2] + self.link[columns]
        return _apply(self._backend.take_last(flat, index).reshape(3, 4, -1), self.local[:, columns])


def _apply(poses: Array, local: Array) -> Array:
    """Rigid transforms (3, 4, ...) of points (3, ...), as elementwise multiply-adds."""
    return poses[:, 0] * local[0] + poses[:, 1] * local[1] + poses[:, 2] * local[2] + poses[:, 3]


@dataclass(frozen=True)
class _Felt:
    """Probes that may be on: a list of them, in order of environment and probe.

    Attributes:
        rows, columns: environment and probe of each.
        flags: whether it is on.
        placed: (3, n) coordinates in the object's frame (m).
        cells: the field around it.
    """

    rows: Array
    columns: Array
    flags: Array
    placed: Array
    cells: _Cells


class _Cells:
    """Trilinear interpolation of the fields at a list of points: grid coordinates ``u`` (3, n), environments ``rows``.

    ``value`` is the signed distance (m).
    """

    def __init__(self, sensing: TactileSensing, u: Array, rows: Array) -> None:
        xp, backend = sensing._xp, sensing.backend
        low = backend.clip(xp.floor(u), 0.0, sensing._last_cell[:, rows, 0])
        self._xp, self._fraction = xp, backend.clip(u - low, 0.0, 1.0)
        strides = sensing._stride[:, rows, 0]
        cell = backend.integer(low) * strides
        index = sensing._offset[rows, 0] + cell[0] + cell[1] + cell[2]
        values = sensing.atlas.values
        corner = {}
        for i in (0, 1):
            for j in (0, 1):
                edge = index + i * strides[0] + j * strides[1]  # the stride of z is 1
                for k in (0, 1):
                    corner[i, j, k] = backend.take(values, edge + k)
        self._corner = corner
        self.value = self._interpolate()

    def _interpolate(self) -> Array:
        c, (fx, fy, fz) = self._corner, self._fraction
        along_x = {(j, k): c[0, j, k] + fx * (c[1, j, k] - c[0, j, k]) for j in (0, 1) for k in (0, 1)}
        along_y = {k: along_x[0, k] + fy * (along_x[1, k] - along_x[0, k]) for k in (0, 1)}
        return along_y[0] + fz * (along_y[1] - along_y[0])

    def unit_gradient(self) -> Array:
        """(3, n) gradient of the trilinear field, scaled to length 1."""
        c, (fx, fy, fz) = self._corner, self._fraction
        gx = _bilinear(fy, fz, *(c[1, j, k] - c[0, j, k] for j in (0, 1) for k in (0, 1)))
        gy = _bilinear(fx, fz, *(c[i, 1, k] - c[i, 0, k] for i in (0, 1) for k in (0, 1)))
        gz = _bilinear(fx, fy, *(c[i, j, 1] - c[i, j, 0] for i in (0, 1) for j in (0, 1)))
        length = self._xp.sqrt(gx * gx + gy * gy + gz * gz) + 1e-12
        return self._xp.stack([gx / length, gy / length, gz / length])


def _bilinear(a: Array, b: Array, v00: Array, v01: Array, v10: Array, v11: Array) -> Array:
    low = v00 + b * (v01 - v00)
    high = v10 + b * (v11 - v10)
    return low + a * (high - low)
