"""A batched ManiSkill task as a Gymnasium vector environment (1.x semantics), with what ``make_vec`` promises.

ManiSkill's own wrapper names and seeds things its own way, and asks the device at every step whether an episode ended.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from tslam_bench.constants import HORIZON
from tslam_bench.engine.requests import check_action_repeat, check_mask
from tslam_bench.engine.same_step import info_at_the_end, with_masks
from tslam_bench.engine.worker_vector_env import INFO

_SUMMED = ("new_touched", "new_visited")


class BatchedVectorEnv(VectorEnv):
    """A ``TactileSLAM`` task with ``num_envs`` sub-scenes as a vector environment with autoreset ``SAME_STEP``.

    Observations, rewards, flags and ``info`` are torch tensors on the simulation's device, else as in
    :class:`tslam_bench.engine.worker_vector_env.TactileVectorEnv`. ``info["final_obs"]`` is a numpy array of objects there
    too, with tensors in its observations. Gymnasium's vector wrappers compute with numpy, so they do not take this environment.
    Episodes end at the horizon alone, so the steps are counted on the host and no step waits for the device.

    On a GPU an object belongs to its sub-scene until ``reset(options={"reconfigure": True})`` draws anew; poses and starts
    change with every episode.

    Args:
        environment: what ``gymnasium.make`` returned.
        action_repeat: see :class:`tslam_bench.engine.worker_vector_env.TactileVectorEnv`.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012

    def __init__(self, environment: gym.Env, action_repeat: int = 1) -> None:
        self.action_repeat = check_action_repeat(action_repeat)
        base: Any = environment.unwrapped
        self.environment: Any = environment
        self.num_envs = int(base.num_envs)
        self.device = base.device
        self.single_observation_space = base.single_observation_space
        self.single_action_space = base.single_action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.closed = False
        self._steps = np.zeros(self.num_envs, dtype=np.int64)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Starts new episodes.

        Args:
            seed: of environment 0, counting up, or one per environment; None lets the generators go on.
            options: ``object`` and ``pose``, one value or one per environment; ``reset_mask``, (num_envs,) bool, which
                environments to reset; ``reconfigure``, whether a GPU scene is rebuilt with other objects.
        """
        given = dict(options or {})
        mask = check_mask(given, self.num_envs)
        given["env_idx"] = np.flatnonzero(mask)
        given.pop("reset_mask", None)
        observation, info = self.environment.reset(seed=seed, options=given)
        self._steps[mask] = 0
        return observation, with_masks(_counts(info), torch.tensor(mask, device=self.device))

    def step(self, actions: Any) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor, torch.Tensor, dict]:
        """One control step of every environment, or ``action_repeat`` of them.

        Raises:
            InvalidInputError: actions of the wrong shape.
        """
        observation, total, terminated, truncated, info = self.environment.step(actions)
        counts = _counts(info)
        for _ in range(self.action_repeat - 1):
            total, before = total.clone(), {name: counts[name].clone() for name in _SUMMED}
            observation, reward, terminated, truncated, info = self.environment.step(actions)
            total = total + reward
            counts = _counts(info)
            for name, value in before.items():
                counts[name] = counts[name] + value
        self._steps += self.action_repeat
        ended = self._steps >= HORIZON
        if not ended.any():
            return observation, total, terminated, truncated, with_masks(counts, torch.ones_like(truncated))
        envs = torch.as_tensor(np.flatnonzero(ended), device=self.device)
        flags = torch.as_tensor(ended, device=self.device)
        last = {name: value[envs] for name, value in observation.items()}
        info = info_at_the_end(counts, flags, np.flatnonzero(ended).tolist(), last)
        total, terminated, truncated = total.clone(), terminated.clone(), truncated.clone()  # a reset writes there
        observation, _ = self.environment.reset(options={} if ended.all() else {"env_idx": envs})
        self._steps[ended] = 0
        return observation, total, terminated, truncated, info

    @property
    def faults(self) -> torch.Tensor:
        """(num_envs,) int64 control steps so far with an action or a hand that was not finite; see the task."""
        return self.environment.unwrapped.faults

    def close_extras(self, **kwargs: Any) -> None:
        """Closes the task."""
        self.environment.close()


def _counts(info: Mapping[str, Any]) -> dict[str, Any]:
    return {name: info[name] for name in INFO}
