"""The few array operations that numpy and torch spell differently, behind one small interface."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import ModuleType
from typing import Any

import numpy as np
from typing_extensions import override

Array = Any


class Backend(ABC):
    """Array operations on one device: :class:`NumpyBackend` or :class:`TorchBackend`."""

    is_numpy: bool
    module: ModuleType
    """numpy or torch itself, for what both spell alike."""

    @abstractmethod
    def array(self, value: np.ndarray) -> Array:
        """A copy of ``value`` on the device, same dtype."""

    @abstractmethod
    def zeros(self, shape: Any, dtype: Any) -> Array:
        """Zeros of a numpy dtype."""

    @abstractmethod
    def full(self, shape: Any, value: Any, dtype: Any) -> Array:
        """``value`` everywhere."""

    @abstractmethod
    def arange(self, count: int) -> Array:
        """0 .. count - 1, int64."""

    @abstractmethod
    def integer(self, value: Array) -> Array:
        """As int64."""

    @abstractmethod
    def int16(self, value: Array) -> Array:
        """As int16."""

    @abstractmethod
    def clip(self, value: Array, low: float, high: Any) -> Array:
        """Elementwise clip; ``high`` may be an array."""

    @abstractmethod
    def take(self, flat: Array, index: Array) -> Array:
        """``flat[index]`` for a one-dimensional array."""

    @abstractmethod
    def take_last(self, value: Array, index: Array) -> Array:
        """``value[..., index]``."""

    @abstractmethod
    def link_components(self, link_matrices: Array) -> Array:
        """(E, L, 3, 4) -> (12, E, L), contiguous."""

    @abstractmethod
    def put(self, flat: Array, index: Array, value: Any) -> None:
        """``flat[index] = value``; which of several values for one element stays is not defined."""

    @abstractmethod
    def select(self, mask: Array) -> tuple[Array, Array]:
        """Rows and columns that a computation has to cover for ``mask`` (E, P), in order: on the host, the True ones."""

    @abstractmethod
    def count_set(self, rows: Array) -> Array:
        """(E,) int64, how many elements of boolean rows (E, n) are set; n is a multiple of 8."""

    @abstractmethod
    def count_rows(self, flags: Array, rows: Array, num_rows: int) -> Array:
        """(num_rows,) int64, how many of ``flags`` are set per row."""


class NumpyBackend(Backend):
    """numpy on the host."""

    is_numpy = True
    module = np

    @override
    def array(self, value: np.ndarray) -> np.ndarray:
        return np.array(value)

    @override
    def zeros(self, shape: Any, dtype: Any) -> np.ndarray:
        return np.zeros(shape, dtype)

    @override
    def full(self, shape: Any, value: Any, dtype: Any) -> np.ndarray:
        return np.full(shape, value, dtype)

    @override
    def arange(self, count: int) -> np.ndarray:
        return np.arange(count)

    @override
    def integer(self, value: np.ndarray) -> np.ndarray:
        return value.astype(np.int64)

    @override
    def int16(self, value: np.ndarray) -> np.ndarray:
        return value.astype(np.int16)

    @override
    def clip(self, value: np.ndarray, low: float, high: Any) -> np.ndarray:
        return np.minimum(np.maximum(value, low), high)

    @override
    def take(self, flat: np.ndarray, index: np.ndarray) -> np.ndarray:
        return flat.take(index)

    @override
    def take_last(self, value: np.ndarray, index: np.ndarray) -> np.ndarray:
        return value.take(index, axis=-1)

    @override
    def link_components(self, link_matrices: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(link_matrices.reshape(*link_matrices.shape[:2], 12).transpose(2, 0, 1))

    @override
    def put(self, flat: np.ndarray, index: np.ndarray, value: Any) -> None:
        flat[index] = value

    @override
    def select(self, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows, columns = np.nonzero(mask)
        return rows, columns

    @override
    def count_set(self, rows: np.ndarray) -> np.ndarray:
        # A True is one byte with one bit: counting bits of whole words is several times faster than adding bytes.
        return np.bitwise_count(rows.view(np.uint64)).sum(axis=1, dtype=np.int64)

    @override
    def count_rows(self, flags: np.ndarray, rows: np.ndarray, num_rows: int) -> np.ndarray:
        return np.bincount(rows[flags], minlength=num_rows)


class TorchBackend(Backend):
    """torch tensors on one device."""

    is_numpy = False

    def __init__(self, device: Any) -> None:
        import torch

        self.module = torch
        self.device = torch.device(device)
        self._dtypes = {bool: torch.bool, np.int64: torch.int64, np.int16: torch.int16, np.float32: torch.float32}

    @override
    def array(self, value: np.ndarray) -> Array:
        return self.module.tensor(value, device=self.device)

    @override
    def zeros(self, shape: Any, dtype: Any) -> Array:
        return self.module.zeros(shape, dtype=self._dtypes[dtype], device=self.device)

    @override
    def full(self, shape: Any, value: Any, dtype: Any) -> Array:
        size = (shape,) if isinstance(shape, int) else shape
        return self.module.full(size, value, dtype=self._dtypes[dtype], device=self.device)

    @override
    def arange(self, count: int) -> Array:
        return self.module.arange(count, device=self.device)

    @override
    def integer(self, value: Array) -> Array:
        return value.to(self.module.int64)

    @override
    def int16(self, value: Array) -> Array:
        return value.to(self.module.int16)

    @override
    def clip(self, value: Array, low: float, high: Any) -> Array:
        return self.module.clamp(self.module.clamp(value, min=low), max=high)

    @override
    def take(self, flat: Array, index: Array) -> Array:
        return flat[index]

    @override
    def take_last(self, value: Array, index: Array) -> Array:
        return value[..., index]

    @override
    def link_components(self, link_matrices: Array) -> Array:
        return link_matrices.reshape(*link_matrices.shape[:2], 12).permute(2, 0, 1).contiguous()

    @override
    def put(self, flat: Array, index: Array, value: Any) -> None:
        flat[index] = value

    @override
    def select(self, mask: Array) -> tuple[Array, Array]:
        # On a GPU every element: finding the True ones would copy their number to the host and stall the device.
        if self.device.type == "cpu":
            rows, columns = self.module.nonzero(mask, as_tuple=True)
            return rows, columns
        count, width = mask.shape
        flat = self.module.arange(count * width, device=self.device)
        return flat // width, flat % width

    @override
    def count_set(self, rows: Array) -> Array:
        return rows.sum(1)

    @override
    def count_rows(self, flags: Array, rows: Array, num_rows: int) -> Array:
        counts = self.module.zeros(num_rows, dtype=self.module.int64, device=self.device)
        return counts.index_add_(0, rows, self.integer(flags))
