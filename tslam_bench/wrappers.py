"""Wrappers of the environments that ``gymnasium.make`` returns. No torch, no simulator."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from tslam_bench.errors import InvalidInputError


class NumpyEnv(gym.Wrapper, RecordConstructorArgs):
    """One environment without batch axis and tensors: plain Gymnasium, which its ``check_env`` accepts.

    ``gymnasium.make`` returns a ManiSkill task, whose values are tensors with a leading axis of one. This wrapper hands out
    numpy arrays without it, a float reward, and bools.

    Args:
        env: what ``gymnasium.make`` returned.

    Raises:
        InvalidInputError: more than one environment, or one on a GPU.
    """

    def __init__(self, env: gym.Env) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        base: Any = env.unwrapped
        if base.num_envs != 1 or base.gpu_sim_enabled:
            raise InvalidInputError("NumpyEnv: wraps one environment on the CPU; use make_vec for several, or a GPU")
        self.observation_space, self.action_space = base.single_observation_space, base.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode; see the environment."""
        observation, info = self.env.reset(seed=seed, options=options)
        return _first(observation), _first(info)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One control step with an action (28,)."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return _first(observation), float(reward), bool(terminated), bool(truncated), _first(info)

    def render(self) -> Any:
        """A picture (H, W, 3) uint8."""
        return _first(self.env.render())


def _first(value: Any) -> Any:
    """The first row of what is batched, as numpy."""
    if isinstance(value, dict):
        return {key: _first(entry) for key, entry in value.items()}
    array = np.asarray(value)
    return array[0] if array.ndim else value
