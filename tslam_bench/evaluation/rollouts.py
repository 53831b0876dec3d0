"""Evaluation episodes: a baseline explores objects in poses (protocol sections 4 to 6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from tslam_bench.constants import GRID_SIZE, HORIZON, NUM_JOINTS
from tslam_bench.episodes import Episode, episode_seed, policy_seed
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.observations import last_observation, observation_to_numpy, to_numpy
from tslam_bench.evaluation.policy import Policy
from tslam_bench.files import atomic_file
from tslam_bench.grids import check_pose, pack, unpack

_GRID_SHAPE = (GRID_SIZE,) * 3


@dataclass(frozen=True, eq=False)
class Rollout:
    """What one episode left.

    Attributes:
        object, pose, seed: what was explored; the episode's seed is ``episode_seed(pose, seed)``.
        actions: (200, 28) float32.
        touched, visited: (32, 32, 32) bool, world frame, at the end.
        touched_step: (32, 32, 32) int16, control step (0 = first) of a voxel's first touch, -1 never; world frame.
        episode_return: sum of the environment's reward.
    """

    object: str
    pose: int
    seed: int
    actions: NDArray[np.float32]
    touched: NDArray[np.bool_]
    visited: NDArray[np.bool_]
    touched_step: NDArray[np.int16]
    episode_return: float

    def save(self, path: Path) -> None:
        """Writes the episode as a compressed npz, atomically."""
        with atomic_file(path) as temporary:
            np.savez_compressed(
                temporary,
                object=self.object,
                pose=self.pose,
                seed=self.seed,
                actions=self.actions,
                touched=pack(self.touched),
                visited=pack(self.visited),
                touched_step=self.touched_step,
                episode_return=self.episode_return,
            )

    @classmethod
    def load(cls, path: Path) -> Rollout:
        """Reads :meth:`save`'s file.

        Raises:
            InvalidInputError: the file is missing, damaged, or not an episode.
        """
        try:
            with np.load(path, allow_pickle=False) as data:
                rollout = cls(
                    str(data["object"]),
                    int(data["pose"]),
                    int(data["seed"]),
                    data["actions"],
                    unpack(data["touched"]),
                    unpack(data["visited"]),
                    data["touched_step"],
                    float(data["episode_return"]),
                )
        except Exception as error:  # damaged archives fail in zipfile, zlib or numpy
            raise InvalidInputError(
                f"{path}: is not a stored episode ({type(error).__name__}); delete it and run again"
            ) from error
        if rollout.actions.shape != (HORIZON, NUM_JOINTS) or rollout.touched_step.shape != _GRID_SHAPE:
            raise InvalidInputError(f"{path}: arrays of the wrong shape; delete it and run again")
        return rollout


def roll_out(env: gym.Env, baseline: Policy, object_name: str, pose: int, seed: int, salt: str) -> Rollout:
    """Lets ``baseline`` explore ``object_name`` in ``pose`` for one episode.

    The environment starts from ``episode_seed(pose, seed)``, the baseline from ``policy_seed(salt, ...)``: equal arguments
    give equal episodes, bit for bit on one machine.

    Args:
        env: a ``TactileSLAM`` environment with one sub-environment and flat dict observations.
        baseline: the policy; it is reset here.
        object_name: a prepared object of the environment's split.
        pose: 0..7.
        seed: repetition.
        salt: hexadecimal digits that the baseline's random numbers come from.

    Raises:
        InvalidInputError: unknown object or pose, not a salt, an environment of several sub-environments, or an episode that does
            not end after 200 steps.
    """
    pose = check_pose(pose)
    if getattr(env.unwrapped, "num_envs", 1) != 1:
        raise InvalidInputError(f"environment: has {env.unwrapped.num_envs} sub-environments, expected 1")  # type: ignore[attr-defined]
    baseline.reset(1, [policy_seed(salt, (object_name, pose, seed))])
    raw, _ = env.reset(seed=episode_seed(pose, seed), options={"object": object_name, "pose": pose})
    actions = np.zeros((HORIZON, NUM_JOINTS), dtype=np.float32)
    episode_return = 0.0
    for step in range(HORIZON):
        actions[step] = baseline.act(observation_to_numpy(raw))[0]
        raw, reward, terminated, truncated, _ = env.step(actions[step])
        episode_return += float(reward)
        if bool(terminated) or bool(truncated) != (step == HORIZON - 1):
            raise InvalidInputError(f"environment: the episode ended after {step + 1} steps, expected {HORIZON}")
    base = env.unwrapped
    return Rollout(
        object_name,
        pose,
        int(seed),
        actions,
        to_numpy(base.touched)[0].astype(bool),  # type: ignore[attr-defined]
        to_numpy(base.visited)[0].astype(bool),  # type: ignore[attr-defined]
        to_numpy(base.touched_step)[0].astype(np.int16),  # type: ignore[attr-defined]
        episode_return,
    )


def roll_out_batch(envs: VectorEnv, baseline: Policy, episodes: Sequence[Episode], salt: str) -> list[Rollout]:
    """Lets ``baseline`` explore several (object, pose, seed) side by side.

    Bit for bit what :func:`roll_out` gives for each of them.

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
    episode_return = [0.0] * envs.num_envs
    touched_step = np.full((envs.num_envs, *_GRID_SHAPE), -1, dtype=np.int16)
    for step in range(HORIZON):
        actions[step] = baseline.act(observation_to_numpy(raw))
        raw, reward, terminated, truncated, info = envs.step(actions[step])
        ended = to_numpy(terminated) | to_numpy(truncated)
        if ended.any() != (step == HORIZON - 1) or ended.any() != ended.all():
            raise InvalidInputError(f"environment: an episode ended after {step + 1} steps, expected {HORIZON}")
        occupancy = to_numpy(last_observation(raw, info)["occupancy"]).astype(bool)
        touched_step[occupancy[:, 0] & (touched_step < 0)] = step
        for env, value in enumerate(to_numpy(reward).tolist()):
            episode_return[env] += value
    rollouts = []
    for env, (name, pose, seed) in enumerate(episodes):
        touched, visited = occupancy[env]
        taken = actions[:, env].copy()
        rollouts.append(
            Rollout(name, check_pose(pose), int(seed), taken, touched, visited, touched_step[env], episode_return[env])
        )
    return rollouts
