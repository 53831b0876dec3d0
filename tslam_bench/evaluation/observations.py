"""Batched observations as numpy arrays on the host."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Observation = dict[str, NDArray]


def to_numpy(value: Any) -> NDArray:
    """A tensor on any device, or an array, as a numpy array that shares no memory with the environment."""
    if not hasattr(value, "detach"):
        return np.array(value)
    array = value.detach().cpu().numpy()
    return array.copy() if value.device.type == "cpu" else array  # from a device it is a copy already


def observation_to_numpy(observation: Mapping[str, Any]) -> Observation:
    """A flat dict observation (n, ...) as numpy copies; bytes and booleans become uint8, all else float32."""
    arrays = {}
    for key, value in observation.items():
        array = to_numpy(value)
        arrays[key] = array.astype(np.uint8 if array.dtype in (np.uint8, np.bool_) else np.float32, copy=False)
    return arrays


def last_observation(observation: Mapping[str, Any], info: Mapping[str, Any]) -> dict[str, Any]:
    """What a step with autoreset ``SAME_STEP`` led to: where an episode ended, its last observation, not the next one's first.

    Args:
        observation: entries (n, ...), as the step returned them; arrays or tensors.
        info: as the step returned it.
    """
    final = info.get("final_obs")
    if final is None:
        return dict(observation)
    last = {name: copy.deepcopy(value) for name, value in observation.items()}
    for env in np.flatnonzero([entry is not None for entry in final]).tolist():
        for name, value in final[env].items():
            last[name][env] = value
    return last
