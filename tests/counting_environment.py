"""A batched environment for tests of the adapter and the learner: ``from counting_environment import Counter``."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces


class Counter(gym.Env):
    """Batched like ManiSkill. Row i counts its steps, ends after ``lengths[i]`` of them, and pays its step count.

    Its observation buffers are overwritten in place at each step and reset, as a simulator's may be.
    """

    def __init__(self, lengths: tuple[int, ...], terminates: bool = False) -> None:
        self.num_envs = len(lengths)
        self.lengths = torch.tensor(lengths)
        self.terminates = terminates
        self.single_observation_space = spaces.Dict(
            {
                "qpos": spaces.Box(-np.inf, np.inf, (2,), np.float32),  # seed of the first reset, step
                "occupancy": spaces.Box(0, 1, (1, 2, 2, 2), np.uint8),
                "touch": spaces.Box(0, 1, (1,), bool),
            }
        )
        self.single_action_space = spaces.Box(-1, 1, (3,), np.float32)
        self.observation_space, self.action_space = self.single_observation_space, self.single_action_space
        self.seeds = torch.zeros(self.num_envs)
        self.steps = torch.zeros(self.num_envs, dtype=torch.long)
        self.buffers = {
            "qpos": torch.zeros(self.num_envs, 2),
            "occupancy": torch.zeros(self.num_envs, 1, 2, 2, 2, dtype=torch.uint8),
            "touch": torch.zeros(self.num_envs, 1, dtype=torch.bool),
        }
        self.last_actions: torch.Tensor | None = None
        self.closed = False

    def _observe(self):
        self.buffers["qpos"][:, 0] = self.seeds
        self.buffers["qpos"][:, 1] = self.steps.float()
        self.buffers["occupancy"][:] = (self.steps % 2).to(torch.uint8)[:, None, None, None, None]
        return self.buffers

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.seeds = torch.as_tensor(seed).float().reshape(-1).expand(self.num_envs).clone()
        index = (options or {}).get("env_idx", torch.arange(self.num_envs))
        self.steps[index] = 0
        return self._observe(), {}

    def step(self, action):
        self.last_actions = torch.as_tensor(action)
        assert self.last_actions.shape == (self.num_envs, 3)
        self.steps += 1
        ended = self.steps >= self.lengths
        never = torch.zeros_like(ended)
        info = {"elapsed": self.steps.clone()}
        terminated, truncated = (ended, never) if self.terminates else (never, ended)
        return self._observe(), self.steps.double(), terminated, truncated, info

    def double(self, x):
        return 2 * x

    def close(self):
        self.closed = True
