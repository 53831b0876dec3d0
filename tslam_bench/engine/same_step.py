"""Infos in the form of Gymnasium's own vector environments with autoreset ``SAME_STEP``, for numpy arrays and torch tensors.

What ``gymnasium.vector.SyncVectorEnv`` builds environment by environment, built at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def with_masks(values: Mapping[str, Any], mask: Any) -> dict[str, Any]:
    """Entries (n,), each beside ``_name``, a mask (n,) bool of the environments that it is news of.

    The masks of one info are one array.
    """
    return {**values, **{f"_{name}": mask for name in values}}


def info_at_the_end(
    counts: Mapping[str, Any], ended: Any, envs: Sequence[int], last: Mapping[str, Any]
) -> dict[str, Any]:
    """The info of a step after which episodes ended, and others began at once.

    Args:
        counts: (n,) numbers, those of the step in every environment.
        ended: (n,) bool, in the library and on the device of ``counts``.
        envs: the k environments whose episode ended, in order: where ``ended`` is True, known without asking a device.
        last: entries (k, ...), their last observations; not copied.

    Returns:
        ``counts`` with a new episode's zeros where one ended, ``final_info`` with what they were, and ``final_obs``, an (n,)
        numpy array of objects: an environment's last observation, or None. Each with its mask.
    """
    final_obs = np.full(len(ended), None, dtype=object)
    for row, env in enumerate(envs):
        final_obs[env] = {name: value[row] for name, value in last.items()}
    return {
        **with_masks({name: value * ~ended for name, value in counts.items()}, ended | ~ended),
        "final_obs": final_obs,
        "_final_obs": ended,
        "final_info": with_masks({name: value * ended for name, value in counts.items()}, ended),
        "_final_info": ended,
    }
