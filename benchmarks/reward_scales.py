"""Episode sums of the reward terms under random policies: where lambda and the mode scales come from (protocol section 7).

    python benchmarks/reward_scales.py --document docs/rewards.md

The policy that decides is ``random_targets``. Uniform actions (``random``) are shown beside it; they hardly reach the object.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from report import machine, markdown_table, print_table, replace_section, write_json
from tqdm import tqdm

import tslam_bench
from tslam_bench.constants import ENVIRONMENT_ID, NUM_POSES, QUICK_TRAIN_OBJECTS, REWARD_MODES
from tslam_bench.engine.rewards import COVERAGE_WEIGHT, MODE_SCALE
from tslam_bench.evaluation.policies import make_baseline
from tslam_bench.evaluation.rollouts import roll_out_batch

SALT = "0"
POLICIES = ("random_targets", "random")


@dataclass(frozen=True)
class Config:
    """Measures the terms of every reward mode."""

    objects: tuple[str, ...] = QUICK_TRAIN_OBJECTS
    """Train objects to explore."""
    poses: int = 2
    """Episodes per object; episode k is in pose (3 k) mod 8."""
    processes: int | None = None
    """Worker processes; default: the cores."""
    output: Path | None = None
    """JSON file for the figures."""
    document: Path | None = None
    """Page whose section ``scales`` is replaced by the table."""


def episode_sums(config: Config, mode: str, policy: str) -> tuple[float, float]:
    """Mean episode sums of (the unscaled exploration term, newly visited voxels) in one reward mode."""
    explorer = make_baseline(policy)
    environments = RecordEpisodeStatistics(
        tslam_bench.make_vec(
            ENVIRONMENT_ID,
            len(config.objects),
            "cpu",
            objects=config.objects,
            split="train",
            reward_mode=mode,
            control_mode=explorer.control_mode,
            processes=config.processes,
        )
    )
    exploration, visited = [], []
    try:
        for index in range(config.poses):
            episodes = [(name, 3 * index % NUM_POSES, 0) for name in config.objects]
            rollouts = roll_out_batch(environments, explorer, episodes, SALT)
            returns = list(environments.return_queue)[-len(episodes) :]
            for rollout, episode_return in zip(rollouts, returns, strict=True):
                new = int(rollout.visited.sum())
                coverage = 0.0 if mode == "no_coverage" else COVERAGE_WEIGHT * new
                exploration.append((episode_return - coverage) / MODE_SCALE[mode])
                visited.append(new)
    finally:
        environments.close()
    return float(np.mean(exploration)), float(np.mean(visited))


def main(config: Config) -> None:
    """Prints one row per policy and mode."""
    header = ("policy", "reward mode", "exploration term", "x scale", "newly visited voxels", "x lambda")
    rows: list[tuple[str, ...]] = []
    result: list[dict[str, Any]] = []
    for policy in POLICIES:
        for mode in tqdm(REWARD_MODES if policy == POLICIES[0] else ("tslam",), desc=policy):
            if mode == "no_discovery":  # it has no exploration term
                continue
            exploration, visited = episode_sums(config, mode, policy)
            result.append({"policy": policy, "mode": mode, "exploration": exploration, "visited": visited})
            numbers = (exploration, exploration * MODE_SCALE[mode], visited, visited * COVERAGE_WEIGHT)
            rows.append((f"`{policy}`", f"`{mode}`", *(f"{number:.4g}" for number in numbers)))
    print_table(header, rows)
    write_json(config.output, result)
    if config.document is not None:
        episodes = config.poses * len(config.objects)
        text = f"{machine()}; mean of {episodes} episodes on {len(config.objects)} train objects.\n\n"
        replace_section(config.document, "scales", text + markdown_table(header, rows))


if __name__ == "__main__":
    main(tyro.cli(Config))
