"""Our adapter from batched torch environments to stable-baselines3.

The adapter that ManiSkill ships fails with gymnasium 1.x, hands out reset observations as terminal ones, and reports
episode returns as arrays.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvStepReturn

from tslam_bench.errors import InvalidInputError

Observation = dict[str, NDArray]


def to_numpy(value: Any) -> NDArray:
    """A tensor on any device, or an array, as a numpy array that shares no memory with the environment."""
    return value.detach().cpu().numpy().copy() if isinstance(value, torch.Tensor) else np.array(value)


def observation_to_numpy(observation: Mapping[str, Any]) -> Observation:
    """A flat dict observation (n, ...) as numpy copies; bytes and booleans become uint8, all else float32."""
    arrays = {}
    for key, value in observation.items():
        array = to_numpy(value)
        arrays[key] = array.astype(np.uint8 if array.dtype in (np.uint8, np.bool_) else np.float32, copy=False)
    return arrays


class TactileVecEnv(VecEnv):
    """Environments as one stable-baselines3 ``VecEnv``, the environments' sub-environments in order.

    * The terminal observation in ``infos[i]["terminal_observation"]`` is a copy of the true last one.
    * ``infos[i]["TimeLimit.truncated"]`` is set, so that the learner bootstraps at the horizon.
    * Observations are numpy copies (bytes stay bytes); rewards are float32.
    * Finished sub-environments are reset at once; a batched environment is reset by ``options={"env_idx": ...}``.

    Args:
        environments: environments whose spaces agree, each with ``num_envs`` sub-environments (one on CPU) and dict
            observations of shape (num_envs, ...).
        seed: seeds the first reset; sub-environment ``i`` starts from ``seed + i`` and goes on from there.

    Raises:
        InvalidInputError: no environment, or spaces that differ or are not a flat dict of boxes.
    """

    def __init__(self, environments: Sequence[gym.Env], seed: int | None = None) -> None:
        if not environments:
            raise InvalidInputError("environments: none given; pass at least one")
        self.environments = tuple(environments)
        self._sizes = [int(getattr(env.unwrapped, "num_envs", 1)) for env in self.environments]
        starts = np.cumsum([0, *self._sizes])
        self._slices = [slice(int(a), int(b)) for a, b in itertools.pairwise(starts)]
        self._owner = [k for k, size in enumerate(self._sizes) for _ in range(size)]
        observation_spaces = [_single_space(env, "observation") for env in self.environments]
        action_spaces = [_single_space(env, "action") for env in self.environments]
        if any(space != action_spaces[0] for space in action_spaces):
            raise InvalidInputError("environments: action spaces differ; build all with the same control mode")
        converted = [_byte_or_float_space(space) for space in observation_spaces]
        if any(space != converted[0] for space in converted):
            raise InvalidInputError("environments: observation spaces differ; build all with the same observation mode")
        super().__init__(int(starts[-1]), converted[0], action_spaces[0])
        self._actions: NDArray | None = None
        if seed is not None:
            self.seed(seed)

    def reset(self) -> Observation:
        """Resets every sub-environment; seeds set before are used once. Entries are (num_envs, ...)."""
        parts = []
        for env, part in zip(self.environments, self._slices, strict=True):
            seeds = self._seeds[part]
            options = next((o for o in self._options[part] if o), None)
            seed: Any = None if seeds[0] is None else (seeds[0] if len(seeds) == 1 else list(seeds))
            observation, info = env.reset(seed=seed, options=options)
            parts.append(observation_to_numpy(observation))
            self.reset_infos[part] = [_info_of(info, i) for i in range(len(seeds))]
        self._reset_seeds()
        self._reset_options()
        return _concatenate(parts)

    def step_async(self, actions: NDArray) -> None:
        """Keeps ``actions`` (num_envs, 28) for :meth:`step_wait`."""
        self._actions = np.asarray(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Steps every environment: observation, reward (num_envs,) float32, done (num_envs,) bool, one info each."""
        if self._actions is None:
            raise InvalidInputError("step_wait: no actions; call step_async first")
        actions, self._actions = self._actions, None
        parts: list[Observation] = []
        rewards = np.zeros(self.num_envs, dtype=np.float32)
        dones = np.zeros(self.num_envs, dtype=bool)
        infos: list[dict[str, Any]] = []
        for env, size, part in zip(self.environments, self._sizes, self._slices, strict=True):
            raw, reward, terminated, truncated, info = env.step(actions[part])
            observation = observation_to_numpy(raw)
            terminated_array = np.broadcast_to(to_numpy(terminated), (size,))
            truncated_array = np.broadcast_to(to_numpy(truncated), (size,))
            done = terminated_array | truncated_array
            rewards[part] = to_numpy(reward)
            dones[part] = done
            own: list[dict[str, Any]] = [
                {"TimeLimit.truncated": bool(t and not e)}
                for t, e in zip(truncated_array, terminated_array, strict=True)
            ]
            if done.any():
                for i in np.flatnonzero(done).tolist():
                    own[i].update(_info_of(info, i))
                    own[i]["terminal_observation"] = {key: value[i].copy() for key, value in observation.items()}
                observation = self._reset_finished(env, part, done, observation)
            infos.extend(own)
            parts.append(observation)
        return _concatenate(parts), rewards, dones, infos

    def _reset_finished(self, env: gym.Env, part: slice, done: NDArray[np.bool_], last: Observation) -> Observation:
        """``last`` with the entries of finished sub-environments replaced by those of their next episode."""
        if done.all():
            observation, info = env.reset()
        else:
            observation, info = env.reset(options={"env_idx": torch.from_numpy(np.flatnonzero(done))})
        first = observation_to_numpy(observation)
        for i in np.flatnonzero(done).tolist():
            self.reset_infos[part.start + i] = _info_of(info, i)
        for key, value in last.items():
            value[done] = first[key][done]
        return last

    def close(self) -> None:
        """Closes every environment."""
        for env in self.environments:
            env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The attribute of the environment that each sub-environment belongs to."""
        return [self.environments[self._owner[i]].get_wrapper_attr(attr_name) for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Sets an attribute on the environments that the sub-environments belong to."""
        for k in sorted({self._owner[i] for i in self._get_indices(indices)}):
            self.environments[k].set_wrapper_attr(attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Calls a method once per environment that is concerned; returns one result per sub-environment."""
        owners = [self._owner[i] for i in self._get_indices(indices)]
        results = {
            k: self.environments[k].get_wrapper_attr(method_name)(*method_args, **method_kwargs)
            for k in sorted(set(owners))
        }
        return [results[k] for k in owners]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Whether the environment of each sub-environment is wrapped in ``wrapper_class``."""
        return [_is_wrapped(self.environments[self._owner[i]], wrapper_class) for i in self._get_indices(indices)]


def _single_space(env: gym.Env, kind: str) -> spaces.Space:
    """The space of one sub-environment."""
    name = f"single_{kind}_space"
    base = env.unwrapped
    return getattr(base, name) if hasattr(base, name) else getattr(env, f"{kind}_space")


def _byte_or_float_space(space: spaces.Space) -> spaces.Dict:
    """The space of :func:`observation_to_numpy`'s result."""
    if not isinstance(space, spaces.Dict) or not all(isinstance(entry, spaces.Box) for entry in space.spaces.values()):
        raise InvalidInputError("environments: observations are not a flat dict of boxes; use obs_mode='state_dict'")
    converted: dict[str, spaces.Space] = {}
    for key, entry in space.spaces.items():
        assert isinstance(entry, spaces.Box)
        if entry.dtype in (np.uint8, np.bool_):
            converted[key] = spaces.Box(0, 1, entry.shape, np.uint8)
        else:
            converted[key] = spaces.Box(entry.low.astype(np.float32), entry.high.astype(np.float32), dtype=np.float32)
    return spaces.Dict(converted)


def _concatenate(parts: list[Observation]) -> Observation:
    if len(parts) == 1:
        return parts[0]
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def _info_of(info: Mapping[str, Any], index: int) -> dict[str, Any]:
    """Sub-environment ``index``'s share of a batched info: entries of shape (n,) as Python numbers."""
    own: dict[str, Any] = {}
    for key, value in info.items():
        if isinstance(value, torch.Tensor | np.ndarray) and value.ndim == 1 and len(value) > index:
            own[key] = value[index].item()
    return own


def _is_wrapped(env: gym.Env, wrapper_class: type[gym.Wrapper]) -> bool:
    while isinstance(env, gym.Wrapper):
        if isinstance(env, wrapper_class):
            return True
        env = env.env
    return False
