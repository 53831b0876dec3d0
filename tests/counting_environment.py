"""A vector environment for tests of the adapter and the learner: ``from counting_environment import Counter``."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space


class Counter(VectorEnv):
    """Environment i counts its steps, ends after ``lengths[i]`` of them, and pays its step count.

    Its observation buffers are overwritten in place at each step and reset, as a simulator's may be; they are torch
    tensors or numpy arrays.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, lengths: tuple[int, ...], terminates: bool = False, tensors: bool = True) -> None:
        self.num_envs = len(lengths)
        self.lengths = torch.tensor(lengths)
        self.terminates, self.tensors = terminates, tensors
        self.set_spaces(
            {
                "qpos": spaces.Box(-np.inf, np.inf, (2,), np.float32),  # seed of the first reset, step
                "occupancy": spaces.Box(0, 1, (1, 2, 2, 2), np.uint8),
                "touch": spaces.Box(0, 1, (1,), bool),
            },
            3,
        )
        self.seeds = torch.zeros(self.num_envs)
        self.steps = torch.zeros(self.num_envs, dtype=torch.long)
        self.buffers = {
            "qpos": torch.zeros(self.num_envs, 2),
            "occupancy": torch.zeros(self.num_envs, 1, 2, 2, 2, dtype=torch.uint8),
            "touch": torch.zeros(self.num_envs, 1, dtype=torch.bool),
        }
        self.last_actions: torch.Tensor | None = None
        self.was_closed = False

    def set_spaces(self, observations: dict[str, spaces.Space], actions: int) -> None:
        self.single_observation_space = spaces.Dict(observations)
        self.single_action_space = spaces.Box(-1, 1, (actions,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def _observe(self):
        self.buffers["qpos"][:, 0] = self.seeds
        self.buffers["qpos"][:, 1] = self.steps.float()
        self.buffers["occupancy"][:] = (self.steps % 2).to(torch.uint8)[:, None, None, None, None]
        return self.buffers if self.tensors else {key: value.numpy() for key, value in self.buffers.items()}

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.seeds = torch.as_tensor(seed).float().reshape(-1).expand(self.num_envs).clone()
        self.steps[:] = 0
        return self._observe(), {}

    def pay(self) -> torch.Tensor:
        return self.steps.double()

    def step(self, action):
        self.last_actions = torch.as_tensor(action)
        assert self.last_actions.shape == self.action_space.shape
        self.steps += 1
        ended = self.steps >= self.lengths
        reward, never = self.pay(), torch.zeros_like(ended)
        info: dict[str, Any] = {"elapsed": self.steps.clone()}
        if ended.any():
            observation, final = self._observe(), np.full(self.num_envs, None, dtype=object)
            for env in ended.nonzero()[:, 0].tolist():  # as SyncVectorEnv gives them
                final[env] = {key: copy.deepcopy(value[env]) for key, value in observation.items()}
            info["final_obs"], info["final_info"] = final, {"elapsed": self.steps * ended, "_elapsed": ended}
            info["_final_obs"] = info["_final_info"] = ended
            info["elapsed"] = info["elapsed"] * ~ended
            self.steps[ended] = 0
        terminated, truncated = (ended, never) if self.terminates else (never, ended)
        if self.tensors:
            return self._observe(), reward, terminated, truncated, info
        return self._observe(), reward.numpy(), terminated.numpy(), truncated.numpy(), info

    def double(self, x):
        return 2 * x

    def close_extras(self, **kwargs):
        self.was_closed = True
