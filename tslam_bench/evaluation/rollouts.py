"""Evaluation episodes: a baseline explores objects in poses (protocol sections 4 to 6)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv

from tslam_bench.constants import GRID_SIZE, HORIZON, NUM_JOINTS
from tslam_bench.episodes import Episode, episode_seed, policy_seed
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.observations import last_observation, observation_to_numpy, to_numpy
from tslam_bench.evaluation.policy import Policy
from tslam_bench.scoring.rollout import CHECKPOINT_SPACING, CHECKPOINTS, Rollout


def roll_out_batch(envs: VectorEnv, baseline: Policy, episodes: Sequence[Episode], salt: str) -> list[Rollout]:
    """Lets ``baseline`` explore several (object, pose, seed) side by side.

    An environment starts from ``episode_seed(pose, seed)``, the baseline from ``policy_seed(salt, ...)``. Equal arguments
    give equal episodes, bit for bit on one machine, whatever is explored beside them.

    Args:
        envs: what ``tslam_bench.make_vec`` returned.
        baseline: the policy; it is reset here.
        episodes: at most ``envs.num_envs`` of them.
        salt: hexadecimal digits that the baseline's random numbers come from.

    Raises:
        InvalidInputError: too many episodes or none, unknown object or pose, or episodes that do not end after 200 steps.
    """
    count = len(episodes)
    if not 0 < count <= envs.num_envs:
        raise InvalidInputError(f"episodes: {count} given for {envs.num_envs} environments; give 1 to {envs.num_envs}")
    filled = [*episodes, *[episodes[-1]] * (envs.num_envs - count)]  # idle environments repeat the last one
    starts: Any = [episode_seed(pose, seed) for _, pose, seed in filled]  # Gymnasium's type is one number
    baseline.reset(envs.num_envs, [policy_seed(salt, episode) for episode in filled])
    options = {"object": [name for name, _, _ in filled], "pose": [pose for _, pose, _ in filled]}
    raw, _ = envs.reset(seed=starts, options=options)
    actions = np.zeros((HORIZON, envs.num_envs, NUM_JOINTS), dtype=np.float32)
    joints = np.zeros((envs.num_envs, CHECKPOINTS, NUM_JOINTS), dtype=np.float32)
    joints[:, 0] = to_numpy(raw["qpos"])
    touched_step = np.full((envs.num_envs, *(GRID_SIZE,) * 3), -1, dtype=np.int16)
    for step in range(HORIZON):
        actions[step] = baseline.act(observation_to_numpy(raw))
        raw, _, terminated, truncated, info = envs.step(actions[step])
        ended = to_numpy(terminated) | to_numpy(truncated)
        if ended.any() != (step == HORIZON - 1) or ended.any() != ended.all():
            raise InvalidInputError(f"environment: an episode ended after {step + 1} steps, expected {HORIZON}")
        now = last_observation(raw, info)
        occupancy = to_numpy(now["occupancy"]).astype(bool)
        touched_step[occupancy[:, 0] & (touched_step < 0)] = step
        if (step + 1) % CHECKPOINT_SPACING == 0:
            joints[:, (step + 1) // CHECKPOINT_SPACING] = to_numpy(now["qpos"])
    rollouts = []
    for env, (name, pose, seed) in enumerate(episodes):
        touched, visited = occupancy[env]
        taken = actions[:, env].copy()
        rollouts.append(Rollout(name, pose, int(seed), taken, touched, visited, touched_step[env], joints[env]))
    return rollouts
