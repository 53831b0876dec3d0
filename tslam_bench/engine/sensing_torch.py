"""Touch and coverage on tensors, for GPU simulation: all probes and points at once, with no wait for the device.

Elementwise arithmetic, gathers and order-free scatters only, so that bits do not depend on how many environments are
batched. ``sensing_numba`` does the same sums in the same order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import torch
from typing_extensions import override

from tslam_bench.constants import GRID_SIZE, TOUCH_DISTANCE, VOXEL_EDGE, WORKSPACE_LOW
from tslam_bench.engine.arrays import TorchBackend
from tslam_bench.engine.field_atlas import Fields
from tslam_bench.engine.sensing import MAX_NEW_CONTACTS, VOXELS, Contacts, Sensing
from tslam_bench.engine.skin import PointSet, Skin

FARTHEST: Final = 100.0
"""No entry of a link's matrix (m) is larger while the simulation is sound."""
_GRID = (GRID_SIZE, GRID_SIZE, GRID_SIZE)


class TorchSensing(Sensing):
    """:class:`Sensing` on one torch device.

    Args:
        num_envs: E.
        skin: probes and volume points.
        device: torch's name of it.
    """

    def __init__(self, num_envs: int, skin: Skin, device: Any) -> None:
        backend = TorchBackend(device)
        super().__init__(num_envs, skin, backend, np.float16)
        self._fields: Fields | None = None
        self._probes = _PlacedPoints(skin.probes, backend)
        self._volume = _PlacedPoints(skin.volume, backend)
        self._reach = backend.array(skin.probes.radius + np.float32(TOUCH_DISTANCE))
        link_of_probe = np.zeros((len(skin.probes), int(skin.volume.link.max()) + 1), dtype=np.float32)
        link_of_probe[np.arange(len(skin.probes)), skin.probes.link] = 1
        self._link_of_probe = backend.array(link_of_probe)
        flat = (num_envs * VOXELS + 1,)  # the last element takes what lies outside W
        self._touched = backend.full(flat, False, bool)
        self._visited = backend.full(flat, False, bool)
        self._touched_step = backend.full(flat, -1, np.int16)
        self._touched_count = backend.full((num_envs,), 0, np.int64)
        self._visited_count = backend.full((num_envs,), 0, np.int64)
        self._first_voxel = backend.array(np.arange(num_envs, dtype=np.int64)[:, None] * VOXELS)
        self.lost = backend.full((num_envs,), False, bool)
        """(E,) bool, hands whose last pose was not finite or absurdly far away: they felt nothing."""
        nowhere = np.eye(3, 4, dtype=np.float32)
        nowhere[:, 3] = FARTHEST
        self._nowhere = backend.array(nowhere)
        self._slots = backend.array(np.arange(MAX_NEW_CONTACTS))

    def _rows(self, grid: torch.Tensor) -> torch.Tensor:
        """(E, VOXELS) view of a flat grid."""
        return grid[:-1].reshape(self.num_envs, VOXELS)

    @property
    @override
    def occupancy(self) -> torch.Tensor:
        """(E, 2, 32, 32, 32) uint8; a new tensor."""
        both = torch.stack([self._rows(self._touched), self._rows(self._visited)], dim=1)
        return both.reshape(self.num_envs, 2, *_GRID).to(torch.uint8)

    @property
    @override
    def touched_step(self) -> torch.Tensor:
        return self._rows(self._touched_step).reshape(self.num_envs, *_GRID)

    @override
    def begin(self, envs: Sequence[int]) -> None:
        self._fields = None  # the atlas may need its memory
        self._fields = self.atlas.bound()
        chosen = list(envs)
        self._on[chosen] = False
        for grid, value in ((self._touched, False), (self._visited, False), (self._touched_step, -1)):
            self._rows(grid)[chosen] = value
        self._touched_count[chosen] = 0
        self._visited_count[chosen] = 0

    @override
    def set_state(self, envs: Sequence[int], state: Mapping[str, Any]) -> None:
        chosen, array = list(envs), self.backend.array
        self._on[chosen] = array(state["on"])
        occupancy = array(state["occupancy"]).bool().reshape(-1, 2, VOXELS)
        for channel, grid, count in (
            (0, self._touched, self._touched_count),
            (1, self._visited, self._visited_count),
        ):
            self._rows(grid)[chosen] = occupancy[:, channel]
            count[chosen] = occupancy[:, channel].sum(1)
        self._rows(self._touched_step)[chosen] = array(state["touched_step"]).reshape(-1, VOXELS)

    @override
    def step(self, link_matrices: torch.Tensor, step: torch.Tensor) -> Contacts:
        # One NaN would become an index out of range, which ends a CUDA context with all environments in it.
        self.lost = ~(link_matrices.abs() < FARTHEST).flatten(1).all(1)
        link_matrices = torch.where(self.lost[:, None, None, None], self._nowhere, link_matrices)
        on, world = self._touch(link_matrices)
        new = on & ~self._on
        self._on = on
        new_touched = self._mark_touched(on, world, step)
        new_visited = self._mark(
            self._visited, self._visited_count, self._voxels(self._volume.place(_components(link_matrices)))
        )
        points, mask = self._new_points(world, new)
        return Contacts(on, new, points, mask, new_touched, new_visited)

    @override
    def link_touch(self) -> torch.Tensor:
        return ((self._on.to(torch.float32) @ self._link_of_probe) > 0).to(torch.uint8)  # sums of 0 and 1: exact

    def _touch(self, link_matrices: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(E, P) probes that are on, and (3, E, P) the nearest point of the surface to each, in the world."""
        fields = self._fields
        assert fields is not None, "begin comes before step"
        # Into the object's frame: exact, since a turn is a signed permutation and the other products are zero.
        turned = (fields.turn[:, None, :, :, None] * link_matrices[:, :, :, None, :]).sum(2)
        placed = self._probes.place(_components(turned))
        distance, gradient = _interpolate(fields, placed)
        x, y, z = placed - distance * gradient
        turn = fields.turn[..., None]
        world = torch.stack([turn[:, a, 0] * x + turn[:, a, 1] * y + turn[:, a, 2] * z for a in range(3)])
        return distance <= self._reach, world

    def _mark_touched(self, on: torch.Tensor, world: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        outside = self.num_envs * VOXELS
        key = torch.where(on, self._voxels(world), outside)
        fresh = torch.where(self._touched[key], outside, key)
        self._touched_step[fresh] = step.to(torch.int16)[:, None].expand_as(fresh)
        self._touched_step[-1] = -1
        return self._mark(self._touched, self._touched_count, key)

    def _mark(self, grid: torch.Tensor, count: torch.Tensor, key: torch.Tensor) -> torch.Tensor:
        """Sets voxels and returns how many that adds per environment, (E,) int64; keeps ``count`` up to date."""
        grid[key] = True
        grid[-1] = False
        now = self._rows(grid).sum(1)
        added = now - count
        count[:] = now
        return added

    def _voxels(self, points: torch.Tensor) -> torch.Tensor:
        """(E, P) flat voxel index of points (3, E, P), or the spare last element where they lie outside W."""
        scaled = (points - np.float32(WORKSPACE_LOW).item()) * np.float32(1 / VOXEL_EDGE).item()
        x, y, z = torch.floor(scaled).to(torch.int64)
        inside = ((x | y | z) & ~(GRID_SIZE - 1)) == 0  # all within 0..31: no bit above the fifth, no sign
        key = self._first_voxel + ((x * GRID_SIZE + y) * GRID_SIZE + z)
        return torch.where(inside, key, self.num_envs * VOXELS)

    def _new_points(self, world: torch.Tensor, new: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The first MAX_NEW_CONTACTS new contact points of each environment, in probe order, and which slots they fill."""
        rank = torch.cumsum(new.to(torch.int64), 1) - 1
        slot = torch.where(new & (rank < MAX_NEW_CONTACTS), rank, MAX_NEW_CONTACTS)  # the last slot is thrown away
        points = torch.zeros((self.num_envs, MAX_NEW_CONTACTS + 1, 3), device=world.device)
        points.scatter_(1, slot[:, :, None].expand(-1, -1, 3), world.permute(1, 2, 0))
        return points[:, :MAX_NEW_CONTACTS], self._slots < new.sum(1)[:, None]


class _PlacedPoints:
    """A point set on the device."""

    def __init__(self, points: PointSet, backend: TorchBackend) -> None:
        self._link = backend.array(points.link)
        self._local = backend.array(np.ascontiguousarray(points.position.T))

    def place(self, components: torch.Tensor) -> torch.Tensor:
        """(3, E, P) coordinates of all points for link poses (3, 4, E, L)."""
        poses = components[..., self._link]
        local = self._local
        return poses[:, 0] * local[0] + poses[:, 1] * local[1] + poses[:, 2] * local[2] + poses[:, 3]


def _components(link_matrices: torch.Tensor) -> torch.Tensor:
    """(E, L, 3, 4) -> (3, 4, E, L), contiguous."""
    return link_matrices.permute(2, 3, 0, 1).contiguous()


def _interpolate(fields: Fields, placed: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(E, P) signed distance (m) and (3, E, P) unit gradient of the trilinear fields at points (3, E, P)."""
    u = (placed - fields.origin.T[:, :, None]) * fields.inverse_spacing[:, None]
    low = torch.minimum(torch.clamp(torch.floor(u), min=0.0), fields.last_cell.T[:, :, None])
    fx, fy, fz = torch.clamp(u - low, 0.0, 1.0)
    cell = low.to(torch.int64) * fields.stride.T[:, :, None]
    index = fields.offset[:, None] + cell[0] + cell[1] + cell[2]
    along_x, along_y = fields.stride[:, 0, None], fields.stride[:, 1, None]
    c = {
        (i, j, k): fields.values[index + i * along_x + j * along_y + k].to(torch.float32)  # the stride of z is 1
        for i in (0, 1)
        for j in (0, 1)
        for k in (0, 1)
    }
    on_edge = {(j, k): c[0, j, k] + fx * (c[1, j, k] - c[0, j, k]) for j in (0, 1) for k in (0, 1)}
    on_face = {k: on_edge[0, k] + fy * (on_edge[1, k] - on_edge[0, k]) for k in (0, 1)}
    distance = on_face[0] + fz * (on_face[1] - on_face[0])
    gx = _bilinear(fy, fz, *(c[1, j, k] - c[0, j, k] for j in (0, 1) for k in (0, 1)))
    gy = _bilinear(fx, fz, *(c[i, 1, k] - c[i, 0, k] for i in (0, 1) for k in (0, 1)))
    gz = _bilinear(fx, fy, *(c[i, j, 1] - c[i, j, 0] for i in (0, 1) for j in (0, 1)))
    length = torch.sqrt(gx * gx + gy * gy + gz * gz) + 1e-12
    return distance, torch.stack([gx / length, gy / length, gz / length])


def _bilinear(
    a: torch.Tensor, b: torch.Tensor, v00: torch.Tensor, v01: torch.Tensor, v10: torch.Tensor, v11: torch.Tensor
) -> torch.Tensor:
    low = v00 + b * (v01 - v00)
    high = v10 + b * (v11 - v10)
    return low + a * (high - low)
