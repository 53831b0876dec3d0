"""Touch and coverage on the CPU, as compiled loops.

Every probe and volume point is carried through in registers, in float32 and in a fixed order that the compiler is not
allowed to change, so that bits depend neither on the batch nor on the machine's vector width.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from tslam_bench.compiled import njit
from tslam_bench.constants import GRID_SIZE, TOUCH_DISTANCE, VOXEL_EDGE, WORKSPACE_LOW
from tslam_bench.engine.arrays import NumpyBackend
from tslam_bench.engine.field_atlas import Fields
from tslam_bench.engine.sensing import MAX_NEW_CONTACTS, VOXELS, Contacts, Sensing
from tslam_bench.engine.skin import PointSet, Skin
from tslam_bench.hand_constants import SKIN_LINKS

BLOCK_EDGE: Final = 25e-3
"""Probes of a link are tested for nearness in blocks of this edge (m)."""
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_TINY = np.float32(1e-12)
_SIZE, _NOT_IN_GRID, _OUTSIDE = np.int32(GRID_SIZE), np.int32(~(GRID_SIZE - 1)), np.int32(-1)
_LOW, _PER_EDGE = np.float32(WORKSPACE_LOW), np.float32(1 / VOXEL_EDGE)


class CompiledSensing(Sensing):
    """:class:`Sensing` on numpy arrays.

    Args:
        num_envs: E.
        skin: probes and volume points.
        occupancy: (E, 2, 32, 32, 32) uint8 array to keep the grids in, for whoever wants to read them where they are; None
            makes one.
    """

    def __init__(self, num_envs: int, skin: Skin, occupancy: NDArray[np.uint8] | None = None) -> None:
        shape = (num_envs, 2, GRID_SIZE, GRID_SIZE, GRID_SIZE)
        self._occupancy = np.zeros(shape, dtype=np.uint8) if occupancy is None else occupancy
        if self._occupancy.shape != shape or self._occupancy.dtype != np.uint8:
            raise ValueError(f"occupancy: {self._occupancy.shape} {self._occupancy.dtype}, expected {shape} uint8")
        super().__init__(num_envs, skin, NumpyBackend())
        blocks, block_of_probe = _blocks(skin.probes)
        self._blocks = (blocks.link, _columns(blocks), blocks.radius, block_of_probe)
        self._probes = (skin.probes.link, _columns(skin.probes), skin.probes.radius + np.float32(TOUCH_DISTANCE))
        self._volume = (np.searchsorted(skin.volume.link, np.arange(len(SKIN_LINKS) + 1)), _columns(skin.volume))
        self._first_probe = np.searchsorted(skin.probes.link, np.arange(len(SKIN_LINKS)))
        self._grids = self._occupancy.reshape(num_envs, 2, VOXELS)
        self._steps = np.full((num_envs, VOXELS), -1, dtype=np.int16)

    @property
    @override
    def occupancy(self) -> NDArray[np.uint8]:
        """(E, 2, 32, 32, 32) uint8; the array itself, which the next step changes."""
        return self._occupancy

    @property
    @override
    def touched_step(self) -> NDArray[np.int16]:
        return self._steps.reshape(self.num_envs, GRID_SIZE, GRID_SIZE, GRID_SIZE)

    @override
    def begin(self, envs: Sequence[int]) -> None:
        self._fields: Fields = self.atlas.bound()
        chosen = list(envs)
        self._on[chosen] = False
        self._grids[chosen] = 0
        self._steps[chosen] = -1

    @override
    def set_state(self, envs: Sequence[int], state: Mapping[str, Any]) -> None:
        chosen = list(envs)
        self._on[chosen] = state["on"]
        self._occupancy[chosen] = state["occupancy"]
        self.touched_step[chosen] = state["touched_step"]

    @override
    def step(self, link_matrices: NDArray[np.float32], step: NDArray) -> Contacts:
        on, new, points, mask, new_touched = self._feel(link_matrices, step, mark=True)
        new_visited = np.zeros(self.num_envs, dtype=np.int64)
        _visit(link_matrices, *self._volume, self._grids, new_visited)
        self._on = on
        return Contacts(on, new, points, mask, new_touched, new_visited)

    def touches(self, link_matrices: NDArray[np.float32]) -> NDArray[np.bool_]:
        """(E, P) bool, probes that would be on for these link poses; changes nothing."""
        return self._feel(link_matrices, np.zeros(self.num_envs, dtype=np.int64), mark=False)[0]

    @override
    def link_touch(self) -> NDArray[np.uint8]:
        return np.logical_or.reduceat(self._on, self._first_probe, axis=1).view(np.uint8)

    def _feel(self, link_matrices: NDArray[np.float32], step: NDArray, mark: bool) -> tuple[Any, ...]:
        """(on, new, points, mask, new_touched) of a step; with ``mark`` touched voxels and their step are kept."""
        on, new = np.zeros_like(self._on), np.zeros_like(self._on)
        points = np.zeros((self.num_envs, MAX_NEW_CONTACTS, 3), dtype=np.float32)
        mask = np.zeros((self.num_envs, MAX_NEW_CONTACTS), dtype=np.bool_)
        new_touched = np.zeros(self.num_envs, dtype=np.int64)
        fields = self._fields
        _touch(
            link_matrices,
            fields.turn,
            self._blocks,
            self._probes,
            (fields.values, fields.offset, fields.stride, fields.last_cell),
            (fields.origin, fields.inverse_spacing, fields.cell_reach),
            step,
            (self._on, on, new),
            (points, mask),
            (mark, self._grids, self._steps, new_touched),
        )
        return on, new, points, mask, new_touched


def _columns(points: PointSet) -> NDArray[np.float32]:
    """(3, P) positions, contiguous per axis."""
    return np.ascontiguousarray(points.position.T)


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


@njit(cache=True)
def _voxel(x: Any, y: Any, z: Any) -> Any:
    """Flat index of the voxel around a point (m, world frame), or -1 outside W."""
    i = int(np.floor((x - _LOW) * _PER_EDGE))
    j = int(np.floor((y - _LOW) * _PER_EDGE))
    k = int(np.floor((z - _LOW) * _PER_EDGE))
    if i < 0 or j < 0 or k < 0 or i >= GRID_SIZE or j >= GRID_SIZE or k >= GRID_SIZE:
        return -1
    return (i * GRID_SIZE + j) * GRID_SIZE + k


@njit(cache=True)
def _visit(links: Any, starts: Any, local: Any, grids: Any, added: Any) -> None:
    """Marks the voxels (channel 1) that hold a volume point, and counts the new ones.

    The points of link ``l`` are ``starts[l]`` to ``starts[l + 1]``: a loop without branches, which the compiler turns into
    vector instructions.
    """
    keys = np.empty(local.shape[1], dtype=np.int32)
    x, y, z = local[0], local[1], local[2]
    for env in range(links.shape[0]):
        for link in range(links.shape[1]):
            pose = links[env, link]
            xx, xy, xz, x0 = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
            yx, yy, yz, y0 = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
            zx, zy, zz, z0 = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
            for point in range(starts[link], starts[link + 1]):
                a, b, c = x[point], y[point], z[point]
                i = np.int32(np.floor((xx * a + xy * b + xz * c + x0 - _LOW) * _PER_EDGE))
                j = np.int32(np.floor((yx * a + yy * b + yz * c + y0 - _LOW) * _PER_EDGE))
                k = np.int32(np.floor((zx * a + zy * b + zz * c + z0 - _LOW) * _PER_EDGE))
                inside = ((i | j | k) & _NOT_IN_GRID) == 0  # no bit above the fifth, no sign: all within 0..31
                keys[point] = (i * _SIZE + j) * _SIZE + k if inside else _OUTSIDE
        for point in range(len(keys)):
            voxel = keys[point]
            if voxel >= 0 and grids[env, 1, voxel] == 0:
                grids[env, 1, voxel] = 1
                added[env] += 1


@njit(cache=True)
def _clip(value: Any, low: Any, high: Any) -> Any:
    return min(max(value, low), high)


@njit(cache=True)
def _bilinear(a: Any, b: Any, v00: Any, v01: Any, v10: Any, v11: Any) -> Any:
    low = v00 + b * (v01 - v00)
    high = v10 + b * (v11 - v10)
    return low + a * (high - low)


@njit(cache=True)
def _touch(
    links: Any,
    turns: Any,
    block_points: Any,
    probe_points: Any,
    fields: Any,
    frames: Any,
    step: Any,
    states: Any,
    contacts: Any,
    marks: Any,
) -> None:
    """Probes that are on, their contact points and touched voxels (channel 0), environment by environment."""
    block_link, block_local, block_radius, block_of_probe = block_points
    probe_link, probe_local, reach = probe_points
    values, offsets, strides, last_cells = fields
    origins, inverse_spacings, cull_margins = frames
    on_before, on, new = states
    points, mask = contacts
    mark, grids, steps, added = marks
    num_links = links.shape[1]
    turned = np.zeros((num_links, 3, 4), dtype=np.float32)
    near = np.zeros(len(block_link), dtype=np.bool_)
    for env in range(links.shape[0]):
        turn = turns[env]
        for row in range(num_links):  # into the object's frame: exact, a turn is a signed permutation
            for i in range(3):
                for j in range(4):
                    turned[row, i, j] = (
                        turn[0, i] * links[env, row, 0, j]
                        + turn[1, i] * links[env, row, 1, j]
                        + turn[2, i] * links[env, row, 2, j]
                    )
        offset, inverse = offsets[env], inverse_spacings[env]
        stride_x, stride_y, stride_z = strides[env, 0], strides[env, 1], strides[env, 2]
        last_x, last_y, last_z = last_cells[env, 0], last_cells[env, 1], last_cells[env, 2]
        origin_x, origin_y, origin_z = origins[env, 0], origins[env, 1], origins[env, 2]
        for block in range(len(block_link)):
            pose = turned[block_link[block]]
            a, b, c = block_local[0, block], block_local[1, block], block_local[2, block]
            x = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c + pose[0, 3]
            y = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c + pose[1, 3]
            z = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * c + pose[2, 3]
            i = int(_clip(np.floor((x - origin_x) * inverse + _HALF), _ZERO, last_x + _ONE))
            j = int(_clip(np.floor((y - origin_y) * inverse + _HALF), _ZERO, last_y + _ONE))
            k = int(_clip(np.floor((z - origin_z) * inverse + _HALF), _ZERO, last_z + _ONE))
            nearest = values[offset + i * stride_x + j * stride_y + k * stride_z]
            near[block] = nearest <= block_radius[block] + cull_margins[env]
        found = 0
        for probe in range(len(probe_link)):
            if not near[block_of_probe[probe]]:
                continue
            pose = turned[probe_link[probe]]
            a, b, c = probe_local[0, probe], probe_local[1, probe], probe_local[2, probe]
            x = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c + pose[0, 3]
            y = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c + pose[1, 3]
            z = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * c + pose[2, 3]
            u, v, w = (x - origin_x) * inverse, (y - origin_y) * inverse, (z - origin_z) * inverse
            low_x = _clip(np.floor(u), _ZERO, last_x)
            low_y = _clip(np.floor(v), _ZERO, last_y)
            low_z = _clip(np.floor(w), _ZERO, last_z)
            fx, fy, fz = _clip(u - low_x, _ZERO, _ONE), _clip(v - low_y, _ZERO, _ONE), _clip(w - low_z, _ZERO, _ONE)
            cell = offset + int(low_x) * stride_x + int(low_y) * stride_y + int(low_z) * stride_z
            v000, v001 = values[cell], values[cell + 1]
            v010, v011 = values[cell + stride_y], values[cell + stride_y + 1]
            cell += stride_x
            v100, v101 = values[cell], values[cell + 1]
            v110, v111 = values[cell + stride_y], values[cell + stride_y + 1]
            x00, x01 = v000 + fx * (v100 - v000), v001 + fx * (v101 - v001)
            x10, x11 = v010 + fx * (v110 - v010), v011 + fx * (v111 - v011)
            y0, y1 = x00 + fy * (x10 - x00), x01 + fy * (x11 - x01)
            distance = y0 + fz * (y1 - y0)
            if not distance <= reach[probe]:
                continue
            on[env, probe] = True
            gx = _bilinear(fy, fz, v100 - v000, v101 - v001, v110 - v010, v111 - v011)
            gy = _bilinear(fx, fz, v010 - v000, v011 - v001, v110 - v100, v111 - v101)
            gz = _bilinear(fx, fy, v001 - v000, v011 - v010, v101 - v100, v111 - v110)
            length = np.sqrt(gx * gx + gy * gy + gz * gz) + _TINY
            x -= distance * (gx / length)
            y -= distance * (gy / length)
            z -= distance * (gz / length)
            world_x = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z
            world_y = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z
            world_z = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z
            voxel = _voxel(world_x, world_y, world_z)
            if mark and voxel >= 0 and grids[env, 0, voxel] == 0:
                grids[env, 0, voxel] = 1
                steps[env, voxel] = step[env]
                added[env] += 1
            if not on_before[env, probe]:
                new[env, probe] = True
                if found < MAX_NEW_CONTACTS:
                    points[env, found, 0], points[env, found, 1], points[env, found, 2] = world_x, world_y, world_z
                    mask[env, found] = True
                    found += 1
