"""What a caller may ask of an environment: one set of checks, in one line each, for every face (task, CPU engine, GPU adapter).

All raise InvalidInputError. No torch, no simulator.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import HORIZON, NUM_JOINTS, REWARD_MODES
from tslam_bench.errors import InvalidInputError
from tslam_bench.hand_constants import CONTROL_MODES, JOINT_NAMES
from tslam_bench.variants import Variant

ENVIRONMENT_REWARD_MODES = (*REWARD_MODES, "none")
"""Reward modes of an environment; with ``none`` every reward is 0."""


_LARGEST_SEED = 2**32 - 1  # of numpy's RandomState


class Objects(Protocol):
    """What a reset asks about objects and poses; a ``StartSampler``."""

    variant: Variant

    def check_name(self, name: str) -> None:
        """Raises InvalidInputError for an unknown object."""


# -- making -------------------------------------------------------------------------------------------------------
def check_reward_mode(reward_mode: str) -> str:
    """Returns a known reward mode."""
    return _one_of("reward_mode", reward_mode, ENVIRONMENT_REWARD_MODES)


def check_control_mode(control_mode: str) -> str:
    """Returns a known control mode."""
    return _one_of("control_mode", control_mode, CONTROL_MODES)


def check_names(objects: Any) -> tuple[str, ...]:
    """Returns the names of a list of objects; which of them there are is for others to say."""
    names = _plain(objects)
    if isinstance(names, (str, bytes, set, frozenset)) or not isinstance(names, Iterable):  # sets: in no order
        raise InvalidInputError(f"objects {objects!r}: must be a list of names; object={objects!r} is one")
    return tuple(check_name(name) for name in names)


def check_name(name: Any) -> str:
    """Returns a text as it is."""
    if not isinstance(name, str):
        raise InvalidInputError(f"object {name!r}: must be a name, a text")
    return name


def check_whole(name: str, value: Any, low: int, high: int) -> int:
    """Returns a whole number from ``low`` to ``high``; True and 2.0 are none."""
    if not _is_whole(value) or not low <= value <= high:
        raise InvalidInputError(f"{name} {value!r}: must be a whole number from {low} to {high}")
    return int(value)


def check_action_repeat(action_repeat: Any) -> int:
    """Returns a number of control steps of which an episode is a whole multiple."""
    if not _is_whole(action_repeat) or action_repeat < 1 or HORIZON % action_repeat:
        raise InvalidInputError(f"action_repeat {action_repeat!r}: must divide the {HORIZON} steps of an episode")
    return int(action_repeat)


# -- reset --------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class ResetRequest:
    """A checked call of ``reset`` of E environments.

    Attributes:
        seeds: (E,) one per environment; None lets a generator go on.
        objects: (E,) names, None where one is drawn; None draws all.
        poses: (E,) poses, None where one is drawn; None draws all.
        mask: (E,) bool, environments to reset.
    """

    seeds: list[int | None]
    objects: list[str | None] | None
    poses: list[int | None] | None
    mask: NDArray[np.bool_]


def check_reset(seed: Any, options: Mapping[str, Any] | None, num_envs: int, known: Objects) -> ResetRequest:
    """Checks the arguments of ``reset``.

    Args:
        seed: of environment 0, counting up, or one per environment, or None.
        options: ``object`` and ``pose``, one value or one per environment; ``reset_mask``, (E,) bool, or ``env_idx``, numbers of
            environments in any order. None is as good as leaving an entry out. Others are not looked at.
        num_envs: E.
        known: which objects and poses there are.
    """
    if options is not None and not isinstance(options, Mapping):
        raise InvalidInputError(f"options {options!r}: must be a dictionary; for example options={{'pose': 3}}")
    options = options or {}
    objects = _option(options, "object", num_envs)
    poses = _option(options, "pose", num_envs)
    for name in objects or ():
        if name is not None:
            known.check_name(name)
    checked = None
    if poses is not None:
        checked = [None if pose is None else known.variant.check_pose(pose) for pose in poses]
    return ResetRequest(check_seeds(seed, num_envs), objects, checked, check_mask(options, num_envs))


def check_seeds(seed: Any, num_envs: int) -> list[int | None]:
    """One seed per environment: environment ``i`` of a single seed ``s`` has ``s + i``."""
    seed = _plain(seed)
    if isinstance(seed, list):
        return [
            None if value is None else check_whole("seed", value, 0, _LARGEST_SEED) for value in _each(seed, num_envs)
        ]
    if seed is None:
        return [None] * num_envs
    first = check_whole("seed", seed, 0, _LARGEST_SEED + 1 - num_envs)
    return [first + env for env in range(num_envs)]


def check_mask(options: Mapping[str, Any], num_envs: int) -> NDArray[np.bool_]:
    """(E,) bool, which environments ``options`` ask to reset; all without ``reset_mask`` and ``env_idx``."""
    asked, numbers = options.get("reset_mask"), options.get("env_idx")
    if asked is not None and numbers is not None:
        raise InvalidInputError("options['reset_mask'], options['env_idx']: give one of them")
    if numbers is not None:
        mask = np.zeros(num_envs, dtype=bool)
        numbers = _plain(numbers)
        for env in numbers if isinstance(numbers, list) else [numbers]:
            mask[check_whole("options['env_idx']", env, 0, num_envs - 1)] = True
        return mask
    try:
        mask = np.ones(num_envs, dtype=bool) if asked is None else np.asarray(_plain(asked))
    except ValueError as error:
        raise InvalidInputError(f"options['reset_mask'] {asked!r}: give ({num_envs},) bool") from error
    if mask.shape != (num_envs,) or (mask.dtype != bool and mask.size):
        raise InvalidInputError(f"options['reset_mask']: shape {mask.shape} {mask.dtype}; give ({num_envs},) bool")
    return mask


# -- step ---------------------------------------------------------------------------------------------------------
def check_actions(actions: Any, num_envs: int) -> NDArray[np.float32]:
    """Returns (E, 28) float32 finite actions; a single environment may be given (28,)."""
    try:
        value = np.asarray(actions, dtype=np.float32)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InvalidInputError(f"actions: not an array of numbers ({error}); give floats ({NUM_JOINTS},)") from error
    value = value.reshape(check_action_shape(value.shape, num_envs))
    finite = np.isfinite(value)
    if not finite.all():
        env, joint = (int(i) for i in np.argwhere(~finite)[0])
        raise InvalidInputError(
            f"actions: not finite for joint {JOINT_NAMES[joint]} of environment {env}; give numbers in [-1, 1]"
        )
    return value


def check_action_shape(shape: tuple[int, ...], num_envs: int) -> tuple[int, int]:
    """Returns the shape (E, 28) that actions of this shape are to have."""
    expected = (num_envs, NUM_JOINTS)
    if shape != expected and not (num_envs == 1 and shape == (NUM_JOINTS,)):
        raise InvalidInputError(f"actions: shape {shape}, expected {expected}; one number per joint")
    return expected


# -- helpers ------------------------------------------------------------------------------------------------------
def _one_of(name: str, value: Any, known: tuple[str, ...]) -> str:
    if value not in known:
        raise InvalidInputError(f"{name} {value!r}: unknown; choose one of {', '.join(known)}")
    return value


def _is_whole(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _each(values: list, num_envs: int, name: str = "seed") -> list:
    if len(values) != num_envs:
        raise InvalidInputError(f"{name}: {len(values)} values for {num_envs} environments; give one each")
    return values


def _plain(value: Any) -> Any:
    """Sequences, arrays and tensors on any device as a list; all else as it is."""
    if hasattr(value, "tolist"):
        return value.tolist()
    return [_plain(entry) for entry in value] if isinstance(value, (list, tuple, range)) else value


def _option(options: Mapping[str, Any], name: str, num_envs: int) -> list | None:
    value = _plain(options.get(name))
    if value is None:
        return None
    return _each(value, num_envs, f"options[{name!r}]") if isinstance(value, list) else [value] * num_envs
