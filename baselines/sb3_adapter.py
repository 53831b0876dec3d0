"""Our adapter from Gymnasium vector environments to stable-baselines3.

The adapter that ManiSkill ships fails with gymnasium 1.x, hands out reset observations as terminal ones, and reports
episode returns as arrays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvStepReturn

from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.observations import Observation, observation_to_numpy, to_numpy


class TactileVecEnv(VecEnv):
    """A Gymnasium vector environment (``tslam_bench.make_vec``) as a stable-baselines3 ``VecEnv``.

    * The terminal observation in ``infos[i]["terminal_observation"]`` is a copy of the true last one.
    * ``infos[i]["TimeLimit.truncated"]`` is set, so that the learner bootstraps at the horizon.
    * Observations are numpy copies (bytes stay bytes); rewards are float32. stable-baselines3 wants numpy, so what a GPU
      simulates is copied to the host once a step.
    * Finished environments start anew at once: the vector environment's own ``SAME_STEP`` autoreset.

    Args:
        environments: a vector environment with autoreset ``SAME_STEP`` and dict observations of shape (num_envs, ...).
        seed: seeds the first reset; environment ``i`` starts from ``seed + i`` and goes on from there.

    Raises:
        InvalidInputError: another autoreset mode, or observations that are not a flat dict of boxes.
    """

    def __init__(self, environments: VectorEnv, seed: int | None = None) -> None:
        mode = environments.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise InvalidInputError(
                f"environments: autoreset mode {mode}, expected SAME_STEP; see tslam_bench.make_vec"
            )
        self.environments = environments
        space = _byte_or_float_space(environments.single_observation_space)
        super().__init__(environments.num_envs, space, environments.single_action_space)
        self._actions: NDArray | None = None
        if seed is not None:
            self.seed(seed)

    def reset(self) -> Observation:
        """Resets every environment; seeds and options set before are used once. Entries are (num_envs, ...)."""
        seeds: Any = None if all(seed is None for seed in self._seeds) else list(self._seeds)
        options = next((o for o in self._options if o), None)
        observation, info = self.environments.reset(seed=seeds, options=options)
        self.reset_infos = _infos_of(info, range(self.num_envs))
        self._reset_seeds()
        self._reset_options()
        return observation_to_numpy(observation)

    def step_async(self, actions: NDArray) -> None:
        """Keeps ``actions`` (num_envs, 28) for :meth:`step_wait`."""
        self._actions = np.asarray(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Steps every environment: observation, reward (num_envs,) float32, done (num_envs,) bool, one info each."""
        if self._actions is None:
            raise InvalidInputError("step_wait: no actions; call step_async first")
        actions, self._actions = self._actions, None
        observation, reward, terminated, truncated, info = self.environments.step(actions)
        terminated, truncated = to_numpy(terminated), to_numpy(truncated)
        done = (terminated | truncated).astype(bool)
        infos: list[dict[str, Any]] = [
            {"TimeLimit.truncated": bool(t and not e)} for t, e in zip(truncated, terminated, strict=True)
        ]
        if done.any():
            ended = np.flatnonzero(done).tolist()
            terminal = _terminal_observations([info["final_obs"][i] for i in ended])
            others = _infos_of(info["final_info"], ended), terminal, _infos_of(info, ended)
            for i, own, last, begun in zip(ended, *others, strict=True):
                infos[i].update(own)
                infos[i]["terminal_observation"] = last
                self.reset_infos[i] = begun
        return observation_to_numpy(observation), to_numpy(reward).astype(np.float32), done, infos

    def close(self) -> None:
        """Closes the vector environment."""
        self.environments.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The vector environment's attribute, once per environment asked for."""
        value = getattr(self.environments, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Sets an attribute of the vector environment."""
        setattr(self.environments, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Calls a method of the vector environment once; its result, once per environment asked for."""
        result = getattr(self.environments, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """False: the vector environment's members are not Gymnasium environments of their own."""
        return [False for _ in self._get_indices(indices)]


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


def _infos_of(info: Mapping[str, Any], envs: Sequence[int]) -> list[dict[str, Any]]:
    """Each of these environments' share of a batched info: numbers (n,) as Python numbers, brought to the host as a whole."""
    columns = {
        key: to_numpy(value).tolist()
        for key, value in info.items()
        if not key.startswith("_")
        and isinstance(value, torch.Tensor | np.ndarray)
        and value.ndim == 1
        and value.dtype != object
    }
    return [{key: column[env] for key, column in columns.items()} for env in envs]


def _terminal_observations(last: Sequence[Mapping[str, Any]]) -> list[Observation]:
    """Observations of single environments as numpy copies, brought to the host as a whole."""
    entries = {key: [one[key] for one in last] for key in last[0]}
    batch = observation_to_numpy(
        {
            key: torch.stack(values) if isinstance(values[0], torch.Tensor) else np.stack(values)
            for key, values in entries.items()
        }
    )
    return [{key: value[row] for key, value in batch.items()} for row in range(len(last))]
