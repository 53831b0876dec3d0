"""Episode sums of the reward terms under the random policy: where lambda and the mode scales come from (protocol section 7).

python benchmarks/reward_scales.py --episodes-per-object 8
"""

from __future__ import annotations

from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

import tslam_bench  # noqa: F401  (registers the environment)
from tslam_bench.constants import ENVIRONMENT_ID, HORIZON, NUM_JOINTS, NUM_POSES, QUICK_OBJECTS, REWARD_MODES
from tslam_bench.tasks.rewards import COVERAGE_WEIGHT, MODE_SCALE


@dataclass(frozen=True)
class Config:
    """Measures the terms of every reward mode."""

    objects: tuple[str, ...] = QUICK_OBJECTS
    """Test objects to explore."""
    episodes_per_object: int = NUM_POSES
    """Episodes per object; episode k uses pose k % 8 and seed k."""


def episode_sums(config: Config, mode: str) -> tuple[float, float]:
    """Mean episode sums of (the unscaled exploration term, newly visited voxels) in one reward mode."""
    environment = gym.make(ENVIRONMENT_ID, objects=config.objects, reward_mode=mode)
    exploration, visited = [], []
    for name in config.objects:
        for episode in range(config.episodes_per_object):
            generator = np.random.Generator(np.random.PCG64(episode))
            environment.reset(seed=episode, options={"object": name, "pose": episode % NUM_POSES})
            total, new = 0.0, 0
            for _ in range(HORIZON):
                action = generator.uniform(-1, 1, NUM_JOINTS).astype(np.float32)
                _, reward, _, _, info = environment.step(action)
                total += float(reward)
                new += int(info["new_visited"])
            coverage = 0.0 if mode == "no_coverage" else COVERAGE_WEIGHT * new
            exploration.append((total - coverage) / MODE_SCALE[mode])
            visited.append(new)
    environment.close()
    return float(np.mean(exploration)), float(np.mean(visited))


def main(config: Config) -> None:
    """Prints one row per mode."""
    torch.set_num_threads(1)
    table = Table(
        "reward mode",
        "exploration term",
        "x scale",
        "newly visited",
        "x lambda",
        title="mean episode sums, random policy",
    )
    for mode in tqdm(REWARD_MODES, desc="modes"):
        exploration, visited = episode_sums(config, mode)
        numbers = (exploration, exploration * MODE_SCALE[mode], visited, visited * COVERAGE_WEIGHT)
        table.add_row(mode, *(f"{number:.4g}" for number in numbers))
    Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Config))
