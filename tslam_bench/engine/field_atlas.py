"""What each environment explores, as arrays that a gather or a compiled loop can read: fields, poses, grid coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tslam_bench import grids
from tslam_bench.engine.arrays import Array, Backend
from tslam_bench.objects.store import SignedDistanceField


@dataclass(frozen=True)
class Fields:
    """The signed-distance field of every environment, on the backend's device.

    Attributes:
        values: (n,) float32 or float16, all fields one after the other (m).
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
        dtype: of the array. Prepared fields are stored as float16, which therefore holds the same values as float32.
    """

    SPARE_SLOTS = 16

    def __init__(self, num_envs: int, backend: Backend, dtype: Any = np.float32) -> None:
        self._backend = backend
        self._dtype = dtype
        self._limit = num_envs + self.SPARE_SLOTS
        self._slots: dict[str, int] = {}
        self._fields: list[SignedDistanceField] = []  # of the slots
        self._last_use: list[int] = []
        self._slot_size = 0
        self._clock = 0
        self._values: Array = None
        self._names: list[str | None] = [None] * num_envs  # of the environments
        self._waiting: dict[str, SignedDistanceField] = {}  # set, not bound yet
        # What environments have, on the host; a row changes when its environment gets another object.
        self._sizes = np.ones((num_envs, 3), dtype=np.int64)
        self._spacings = np.ones(num_envs)
        self._origins = np.zeros((num_envs, 3))
        self._turn = np.tile(np.eye(3, dtype=np.float32), (num_envs, 1, 1))
        self._bound: Fields | None = None

    def set_object(self, env: int, name: str, field: SignedDistanceField, pose: int) -> None:
        """Puts an object in a pose into one environment."""
        if self._names[env] != name:
            self._names[env] = name
            self._sizes[env], self._spacings[env], self._origins[env] = field.values.shape, field.spacing, field.origin
        if name not in self._slots:
            self._waiting[name] = field
        self._turn[env] = grids.pose_rotation(pose)
        self._bound = None

    def bound(self) -> Fields:
        """The fields of all environments as arrays. Let go of those of an earlier call first: they hold its memory."""
        if self._bound is None:
            self._bound = self._bind()
        return self._bound

    def _bind(self) -> Fields:
        if None in self._names:
            raise ValueError("set_object has to be called for every environment before begin")
        names = [name for name in self._names if name is not None]
        self._place(dict.fromkeys(names))
        slots = np.array([self._slots[name] for name in names], dtype=np.int64)
        sizes, array = self._sizes, self._backend.array
        strides = np.stack([sizes[:, 1] * sizes[:, 2], sizes[:, 2], np.ones_like(sizes[:, 2])], axis=1)
        return Fields(
            self._values,
            array(slots * self._slot_size),
            array(strides),
            array((sizes - 2).astype(np.float32)),
            array(self._origins.astype(np.float32)),
            array((1.0 / self._spacings).astype(np.float32)),
            array((np.sqrt(3.0) / 2 * 1.001 * self._spacings).astype(np.float32)),  # half a cell diagonal
            array(self._turn),
        )

    def _place(self, in_use: Mapping[str, None]) -> None:
        """Copies in what is not there yet; the fields named by ``in_use`` stay."""
        self._clock += 1
        fresh = [name for name in in_use if name not in self._slots]
        changed = [self._take_slot(name, in_use) for name in fresh]
        self._waiting.clear()
        for name in in_use:
            self._last_use[self._slots[name]] = self._clock
        size = max((self._fields[slot].values.size for slot in changed), default=0)
        needed = len(self._fields)
        if self._values is None or size > self._slot_size or needed * self._slot_size > len(self._values):
            self._slot_size = max(self._slot_size, size)
            # At first as many as there are: the objects of a GPU scene stay. Later twice as many, for episodes to come.
            slots = needed if self._values is None else min(self._limit, max(4, 2 * needed))
            self._values = None  # frees the old array before the new one is made
            self._values = self._backend.full((slots * self._slot_size,), 0, self._dtype)
            changed = list(range(needed))
        for slot in changed:
            self._copy(slot, self._fields[slot])

    def _take_slot(self, name: str, in_use: Mapping[str, None]) -> int:
        field = self._waiting[name]
        if len(self._fields) < self._limit:
            slot = len(self._fields)
            self._fields.append(field)
            self._last_use.append(0)
        else:
            idle = [other for other in self._slots if other not in in_use]
            oldest = min(idle, key=lambda other: self._last_use[self._slots[other]])
            slot = self._slots.pop(oldest)
            self._fields[slot] = field
        self._slots[name] = slot
        return slot

    def _copy(self, slot: int, field: SignedDistanceField) -> None:
        start = slot * self._slot_size
        flat = np.ascontiguousarray(field.values, dtype=self._dtype).reshape(-1)
        self._values[start : start + len(flat)] = self._backend.array(flat)
