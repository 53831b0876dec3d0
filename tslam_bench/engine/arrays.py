"""The few array operations that numpy and torch spell differently, for code that runs on both: control and rewards."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import ModuleType
from typing import Any

import numpy as np
from typing_extensions import override

Array = Any
"""numpy.ndarray or torch.Tensor, as the backend says."""


class Backend(ABC):
    """Array operations on one device: :class:`NumpyBackend` or :class:`TorchBackend`."""

    is_numpy: bool
    module: ModuleType
    """numpy or torch itself, for what both spell alike."""

    @abstractmethod
    def array(self, value: Any) -> Array:
        """A copy of a numpy array or tensor on the device, same dtype."""

    @abstractmethod
    def full(self, shape: tuple[int, ...], value: Any, dtype: Any) -> Array:
        """``value`` everywhere, of a numpy dtype."""

    @abstractmethod
    def cast(self, value: Array, dtype: Any) -> Array:
        """As a numpy dtype."""

    @abstractmethod
    def clip(self, value: Array, low: float, high: float) -> Array:
        """Elementwise clip."""

    @abstractmethod
    def host(self, value: Array) -> np.ndarray:
        """As a numpy array; shares memory where it can."""


class NumpyBackend(Backend):
    """numpy on the host."""

    is_numpy = True
    module = np

    @override
    def array(self, value: Any) -> np.ndarray:
        return np.asarray(value).copy()

    @override
    def full(self, shape: tuple[int, ...], value: Any, dtype: Any) -> np.ndarray:
        return np.full(shape, value, dtype)

    @override
    def cast(self, value: np.ndarray, dtype: Any) -> np.ndarray:
        return value.astype(dtype)

    @override
    def clip(self, value: np.ndarray, low: float, high: float) -> np.ndarray:
        return np.minimum(np.maximum(value, low), high)

    @override
    def host(self, value: np.ndarray) -> np.ndarray:
        return value


class TorchBackend(Backend):
    """torch tensors on one device."""

    is_numpy = False

    def __init__(self, device: Any) -> None:
        import torch

        self.module = torch
        self.device = torch.device(device)

    @override
    def array(self, value: Any) -> Array:
        return self.module.as_tensor(value).to(self.device, copy=True)

    @override
    def full(self, shape: tuple[int, ...], value: Any, dtype: Any) -> Array:
        return self.module.full(shape, value, dtype=self._dtype(dtype), device=self.device)

    @override
    def cast(self, value: Array, dtype: Any) -> Array:
        return value.to(self._dtype(dtype))

    @override
    def clip(self, value: Array, low: float, high: float) -> Array:
        return self.module.clamp(value, low, high)

    @override
    def host(self, value: Array) -> np.ndarray:
        return value.cpu().numpy()

    def _dtype(self, dtype: Any) -> Any:
        return getattr(self.module, np.dtype(dtype).name)
