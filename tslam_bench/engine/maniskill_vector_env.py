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
from tslam_bench.engine.worker_vector_env import check_action_repeat
from tslam_bench.errors import InvalidInputError

_COUNTS = ("new_touched", "new_visited")


class BatchedVectorEnv(VectorEnv):
    """A ``TactileSLAM`` task with ``num_envs`` sub-scenes as a vector environment with autoreset ``SAME_STEP``.

    Observations, rewards, flags and ``info`` are torch tensors on the simulation's device, else as in
    :class:`tslam_bench.engine.worker_vector_env.TactileVectorEnv`. Episodes end at the horizon alone, so the steps are counted on
    the host and no step waits for the device.

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
                environments to reset (unseeded); ``reconfigure``, whether a GPU scene is rebuilt with other objects.
        """
        given = dict(options or {})
        mask = given.pop("reset_mask", None)
        if seed is not None:
            numbers = range(int(seed), int(seed) + self.num_envs) if isinstance(seed, (int, np.integer)) else seed
            seed = None if all(number is None for number in numbers) else [int(number or 0) for number in numbers]
        if mask is not None:
            mask = np.asarray(mask)
            if mask.shape != (self.num_envs,) or mask.dtype != bool:
                raise InvalidInputError(
                    f"options['reset_mask']: shape {mask.shape} {mask.dtype}; give ({self.num_envs},) bool"
                )
            if seed is not None:
                raise InvalidInputError("options['reset_mask']: a partial reset takes no seed; leave one of them out")
            given["env_idx"] = torch.as_tensor(np.flatnonzero(mask), device=self.device)
            self._steps[mask] = 0
        else:
            self._steps[:] = 0
        observation, info = self.environment.reset(seed=seed, options=given)
        return observation, _without_reconfigure(info)

    def step(self, actions: Any) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor, torch.Tensor, dict]:
        """One control step of every environment, or ``action_repeat`` of them.

        Raises:
            InvalidInputError: actions of the wrong shape.
        """
        observation, total, terminated, truncated, info = self._control_step(actions)
        for _ in range(self.action_repeat - 1):
            before, total = {name: info[name].clone() for name in _COUNTS}, total.clone()
            observation, reward, terminated, truncated, info = self._control_step(actions)
            total = total + reward
            for name, value in before.items():
                info[name] = info[name] + value
                if "final_info" in info:
                    info["final_info"][name] = info["final_info"][name] + value
        return observation, total, terminated, truncated, info

    def _control_step(
        self, actions: Any
    ) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor, torch.Tensor, dict]:
        observation, reward, terminated, truncated, info = self.environment.step(actions)
        info = _without_reconfigure(info)
        self._steps += 1
        ended = self._steps >= HORIZON
        if ended.any():
            final_obs = {key: value.clone() for key, value in observation.items()}
            final_info = {key: value.clone() for key, value in info.items()}
            options: dict[str, Any] = {}
            if not ended.all():
                options["env_idx"] = torch.as_tensor(np.flatnonzero(ended), device=self.device)
            reward, truncated = reward.clone(), truncated.clone()
            observation, after = self.environment.reset(options=options)
            self._steps[ended] = 0
            flags = torch.as_tensor(ended, device=self.device)
            info["elapsed_steps"] = after["elapsed_steps"]  # the counts stay those of the step
            info.update(final_obs=final_obs, _final_obs=flags, final_info=final_info, _final_info=flags.clone())
        return observation, reward, terminated, truncated, info

    def close_extras(self, **kwargs: Any) -> None:
        """Closes the task."""
        self.environment.close()


def _without_reconfigure(info: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in info.items() if key != "reconfigure"}
