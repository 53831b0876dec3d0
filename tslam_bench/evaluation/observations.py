"""Batched observations as numpy arrays on the host."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Observation = dict[str, NDArray]


def to_numpy(value: Any) -> NDArray:
    """A tensor on any device, or an array, as a numpy array that shares no memory with the environment."""
    return value.detach().cpu().numpy().copy() if hasattr(value, "detach") else np.array(value)


def observation_to_numpy(observation: Mapping[str, Any]) -> Observation:
    """A flat dict observation (n, ...) as numpy copies; bytes and booleans become uint8, all else float32."""
    arrays = {}
    for key, value in observation.items():
        array = to_numpy(value)
        arrays[key] = array.astype(np.uint8 if array.dtype in (np.uint8, np.bool_) else np.float32, copy=False)
    return arrays
