"""The few array operations that numpy and torch spell differently, behind one small interface."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

Array = Any


class Backend:
    """Array operations on one device. Use :class:`NumpyBackend` or :class:`TorchBackend`."""

    is_numpy: bool
    module: ModuleType


class NumpyBackend(Backend):
    """numpy on the host."""

    is_numpy = True
    module = np

    def array(self, value: np.ndarray) -> np.ndarray:
        """A copy of ``value`` on the device, same dtype."""
        return np.array(value)

    def zeros(self, shape: Any, dtype: Any) -> np.ndarray:
        """Zeros of a numpy dtype."""
        return np.zeros(shape, dtype)

    def full(self, shape: Any, value: Any, dtype: Any) -> np.ndarray:
        """``value`` everywhere."""
        return np.full(shape, value, dtype)

    def arange(self, count: int) -> np.ndarray:
        """0 .. count - 1, int64."""
        return np.arange(count)

    def integer(self, value: np.ndarray) -> np.ndarray:
        """As int64."""
        return value.astype(np.int64)

    def int16(self, value: np.ndarray) -> np.ndarray:
        """As int16."""
        return value.astype(np.int16)

    def clip(self, value: np.ndarray, low: float, high: Any) -> np.ndarray:
        """Elementwise clip; ``high`` may be an array."""
        return np.minimum(np.maximum(value, low), high)

    def take(self, flat: np.ndarray, index: np.ndarray) -> np.ndarray:
        """``flat[index]`` for a one-dimensional array."""
        return flat.take(index)

    def take_last(self, value: np.ndarray, index: np.ndarray) -> np.ndarray:
        """``value[..., index]``."""
        return value.take(index, axis=-1)

    def put(self, flat: np.ndarray, index: np.ndarray, value: Any) -> None:
        """``flat[index] = value``; which of several values for one element stays is not defined."""
        flat[index] = value

    def select(self, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns that a computation has to cover for ``mask`` (E, P), in order: on the host, the True ones."""
        rows, columns = np.nonzero(mask)
        return rows, columns

    def count_rows(self, flags: np.ndarray, rows: np.ndarray, num_rows: int) -> np.ndarray:
        """(num_rows,) int64, how many of ``flags`` are set per row."""
        return np.bincount(rows[flags], minlength=num_rows)


class TorchBackend(Backend):
    """torch tensors on one device."""

    is_numpy = False

    def __init__(self, device: Any) -> None:
        import torch

        self.module = torch
        self.device = torch.device(device)
        self._dtypes = {bool: torch.bool, np.int64: torch.int64, np.int16: torch.int16, np.float32: torch.float32}

    def array(self, value: np.ndarray) -> Array:
        """A copy of ``value`` on the device, same dtype."""
        return self.module.tensor(value, device=self.device)

    def zeros(self, shape: Any, dtype: Any) -> Array:
        """Zeros of a numpy dtype."""
        return self.module.zeros(shape, dtype=self._dtypes[dtype], device=self.device)

    def full(self, shape: Any, value: Any, dtype: Any) -> Array:
        """``value`` everywhere."""
        size = (shape,) if isinstance(shape, int) else shape
        return self.module.full(size, value, dtype=self._dtypes[dtype], device=self.device)

    def arange(self, count: int) -> Array:
        """0 .. count - 1, int64."""
        return self.module.arange(count, device=self.device)

    def integer(self, value: Array) -> Array:
        """As int64."""
        return value.to(self.module.int64)

    def int16(self, value: Array) -> Array:
        """As int16."""
        return value.to(self.module.int16)

    def clip(self, value: Array, low: float, high: Any) -> Array:
        """Elementwise clip; ``high`` may be a tensor."""
        return self.module.clamp(self.module.clamp(value, min=low), max=high)

    def take(self, flat: Array, index: Array) -> Array:
        """``flat[index]`` for a one-dimensional tensor."""
        return flat[index]

    def take_last(self, value: Array, index: Array) -> Array:
        """``value[..., index]``."""
        return value[..., index]

    def put(self, flat: Array, index: Array, value: Any) -> None:
        """``flat[index] = value``; which of several values for one element stays is not defined."""
        flat[index] = value

    def select(self, mask: Array) -> tuple[Array, Array]:
        """Rows and columns that a computation has to cover for ``mask`` (E, P), in order.

        On a GPU that is every element: finding the True ones would copy their number to the host and stall the device.
        """
        if self.device.type == "cpu":
            rows, columns = self.module.nonzero(mask, as_tuple=True)
            return rows, columns
        count, width = mask.shape
        flat = self.module.arange(count * width, device=self.device)
        return flat // width, flat % width

    def count_rows(self, flags: Array, rows: Array, num_rows: int) -> Array:
        """(num_rows,) int64, how many of ``flags`` are set per row."""
        counts = self.module.zeros(num_rows, dtype=self.module.int64, device=self.device)
        return counts.index_add_(0, rows, self.integer(flags))
