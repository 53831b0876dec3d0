"""What each environment explores, as arrays that a gather or a compiled loop can read: fields, poses, grid coordinates."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from tslam_bench import grids
from tslam_bench.engine.arrays import Array, Backend
from tslam_bench.objects.store import SignedDistanceField


@dataclass(frozen=True)
class Fields:
    """The signed-distance field of every environment, on the backend's device.

    Attributes:
        values: (n,) float32, all fields one after the other (m).
        offset: (E,) int64, where an environment's field begins in ``values``.
        stride: (E, 3) int64, of its axes.
        last_cell: (E, 3) float32, index of its last cell.
        origin: (E, 3) float32, its first sample, object frame (m).
        inverse_spacing: (E,) float32 (1/m).
        cell_reach: (E,) float32, no point is further than this from its nearest sample (m).
        turn: (E, 3, 3) float32, the pose: world point = turn @ object point.
    """

    values: Array
    offset: Array
    stride: Array
    last_cell: Array
    origin: Array
    inverse_spacing: Array
    cell_reach: Array
    turn: Array


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
        self._values: Array = None
        self._objects: list[tuple[str, SignedDistanceField] | None] = [None] * num_envs
        self._turn = np.tile(np.eye(3, dtype=np.float32), (num_envs, 1, 1))
        self._bound: Fields | None = None

    def set_object(self, env: int, name: str, field: SignedDistanceField, pose: int) -> None:
        """Puts an object in a pose into one environment."""
        self._objects[env] = (name, field)
        self._turn[env] = grids.pose_rotation(pose)
        self._bound = None

    def bound(self) -> Fields:
        """The fields of all environments as arrays."""
        if self._bound is None:
            self._bound = self._bind()
        return self._bound

    def _bind(self) -> Fields:
        objects = [entry for entry in self._objects if entry is not None]
        if len(objects) < len(self._objects):
            raise ValueError("set_object has to be called for every environment before begin")
        in_use = {name for name, _ in objects}
        for name, field in objects:
            self._place(name, field, in_use)
        offsets = [self._names.index(name) * self._slot_size for name, _ in objects]  # read last: placing moves slots
        sizes = np.array([field.values.shape for _, field in objects], dtype=np.int64)
        spacings = np.array([float(field.spacing) for _, field in objects])
        origins = np.array([field.origin for _, field in objects], dtype=np.float64)
        strides = np.stack([sizes[:, 1] * sizes[:, 2], sizes[:, 2], np.ones_like(sizes[:, 2])], axis=1)
        array = self._backend.array
        return Fields(
            self._values,
            array(np.array(offsets, dtype=np.int64)),
            array(strides),
            array((sizes - 2).astype(np.float32)),
            array(origins.astype(np.float32)),
            array((1.0 / spacings).astype(np.float32)),
            array((np.sqrt(3.0) / 2 * 1.001 * spacings).astype(np.float32)),  # half a cell diagonal
            array(self._turn),
        )

    def _place(self, name: str, field: SignedDistanceField, in_use: Collection[str]) -> None:
        """Copies the field called ``name`` in if it is not there; the fields named by ``in_use`` stay."""
        self._clock += 1
        if name not in self._names:
            self._put(self._free_slot(in_use), name, field)
        self._last_use[self._names.index(name)] = self._clock

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
        if self._values is None or field.values.size > self._slot_size or needed * self._slot_size > len(self._values):
            self._slot_size = max(self._slot_size, field.values.size)
            slots = min(self._limit, max(4, 2 * needed))
            self._values = self._backend.full((slots * self._slot_size,), 0, np.float32)
            for other, kept in enumerate(self._fields):
                if kept is not None:
                    self._copy(other, kept)
        else:
            self._copy(slot, field)

    def _copy(self, slot: int, field: SignedDistanceField) -> None:
        start = slot * self._slot_size
        flat = np.ascontiguousarray(field.values, dtype=np.float32).reshape(-1)
        self._values[start : start + len(flat)] = self._backend.array(flat)
