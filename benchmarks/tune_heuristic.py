"""Searches the numbers of the scripted heuristic on train objects: where ``GraspConfig``'s defaults come from.

    python benchmarks/tune_heuristic.py --output tuning.jsonl

An evolutionary search with a fixed budget. Each candidate explores every object in a few poses; its score is the mean
number of touched voxels per pose. A candidate's line is written as soon as it is known, and a stopped search goes on. In the
end the best few are played again with other seeds, on the same objects and on others, and the best of these is printed: the
luck of one evaluation then counts for little.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import tyro
from gymnasium.vector import VectorEnv
from report import print_table

import tslam_bench
from tslam_bench.baselines.heuristic import GraspConfig, HeuristicBaseline
from tslam_bench.constants import ENVIRONMENT_ID, QUICK_TRAIN_OBJECTS
from tslam_bench.evaluation.rollouts import roll_out_batch
from tslam_bench.objects.splits import prepared_names

SALT: Final = "0"
RANGES: Final[dict[str, tuple[float, float]]] = {
    "side": (0.02, 0.08),
    "forward": (0.02, 0.10),
    "forward_centre": (-0.05, 0.03),
    "roll": (0.2, 0.75),
    "spread": (0.0, 0.43),
    "wrist": (0.0, 0.4),
    "depth_low": (-0.14, -0.02),
    "depth_high": (-0.04, 0.06),
    "rise": (0.005, 0.06),
    "travel_steps": (4, 14),
    "sink_steps": (6, 25),
    "close_steps": (3, 12),
    "open_steps": (2, 8),
    "squeezes": (1, 6),
    "shift": (0.0, 0.08),
    "roll_shift": (0.0, 0.7),
    "press": (0.0, 0.04),
    "knuckle": (1.0, 1.57),
    "middle": (0.6, 1.57),
    "curl": (0.3, 1.0),
    "thumb": (0.0, 1.0),
    "opened": (0.0, 0.5),
    "stall": (1e-3, 8e-3),
}
"""Where each number may lie; ``depth`` is searched as its two ends."""
WHOLE: Final = ("travel_steps", "sink_steps", "close_steps", "open_steps", "squeezes")


@dataclass(frozen=True)
class Config:
    """Searches the heuristic's numbers."""

    output: Path
    """JSON lines: one candidate each."""
    candidates: int = 120
    """Budget."""
    objects: tuple[str, ...] = QUICK_TRAIN_OBJECTS
    """Train objects that every candidate explores."""
    poses: tuple[int, ...] = (0, 5)
    """Poses that it explores them in."""
    finalists: int = 5
    """Best candidates that are played again."""
    seed: int = 0
    """Seed of the search."""
    processes: int | None = None
    """Worker processes; default: the cores."""


def numbers_of(config: GraspConfig) -> dict[str, float]:
    """The searched numbers of a configuration."""
    values = dataclasses.asdict(config) | {"depth_low": config.depth[0], "depth_high": config.depth[1]}
    return {name: values[name] for name in RANGES}


def config_of(numbers: dict[str, float]) -> GraspConfig:
    """The configuration with these numbers."""
    values: dict[str, Any] = {name: int(value) if name in WHOLE else value for name, value in numbers.items()}
    depth = (values.pop("depth_low"), values.pop("depth_high"))
    return GraspConfig(**values, depth=(min(depth), max(depth)))


def propose(known: Sequence[tuple[float, dict[str, float]]], generator: np.random.Generator) -> dict[str, float]:
    """The next candidate: today's numbers first, then wide changes of them, then children of the best six."""
    if not known:
        return numbers_of(GraspConfig())
    ranked = [numbers for _, numbers in sorted(known, key=lambda entry: -entry[0])]
    wide = len(known) < 16
    first, second = (ranked[generator.integers(1 if wide else min(6, len(ranked)))] for _ in range(2))
    child = {name: first[name] if generator.random() < 0.6 else second[name] for name in RANGES}
    for name in generator.choice(list(RANGES), 7 if wide else 3, replace=False):
        low, high = RANGES[name]
        moved = generator.uniform(low, high) if wide else child[name] + 0.2 * (high - low) * generator.normal()
        child[name] = float(np.clip(round(moved) if name in WHOLE else moved, low, high))
    return child


def touched(
    envs: VectorEnv, numbers: dict[str, float], objects: Sequence[str], poses: Sequence[int], seed: int
) -> float:
    """Mean touched voxels per pose."""
    episodes = [(name, pose, seed) for name in objects for pose in poses]
    explorer = HeuristicBaseline(config_of(numbers))
    counts: list[int] = []
    for first in range(0, len(episodes), envs.num_envs):
        rollouts = roll_out_batch(envs, explorer, episodes[first : first + envs.num_envs], SALT)
        counts += [int(rollout.touched.sum()) for rollout in rollouts]
    return float(np.mean(counts))


def main(config: Config) -> None:
    """Searches, plays the finalists again, and prints the best."""
    lines = config.output.read_text(encoding="utf-8").splitlines() if config.output.is_file() else []
    known = [(entry["touched"], entry["numbers"]) for entry in map(json.loads, lines)]
    others = [name for name in prepared_names("train") if name not in config.objects][: len(config.objects)]
    envs = tslam_bench.make_vec(
        ENVIRONMENT_ID,
        len(config.objects),
        "cpu",
        objects=config.objects,
        split="train",
        reward_mode="none",
        processes=config.processes,
    )
    try:
        while len(known) < config.candidates:
            numbers = propose(known, np.random.default_rng([config.seed, len(known)]))
            known.append((touched(envs, numbers, config.objects, config.poses, 0), numbers))
            with config.output.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps({"touched": known[-1][0], "numbers": numbers}) + "\n")
            print(f"{len(known)}: {known[-1][0]:.1f}, best {max(score for score, _ in known):.1f}", flush=True)
        rows = []
        for score, numbers in sorted(known, key=lambda entry: -entry[0])[: config.finalists]:
            again = touched(envs, numbers, config.objects, (1, 2, 4, 7), 1)
            elsewhere = touched(envs, numbers, others, (0, 5), 1) if others else float("nan")
            rows.append((score, again, elsewhere, numbers))
    finally:
        envs.close()
    rows.sort(key=lambda row: -row[1] if np.isnan(row[2]) else -(row[1] + row[2]))
    header = ("in the search", "other poses and seed", "other objects", "numbers")
    print_table(header, [(*(f"{value:.1f}" for value in row[:3]), json.dumps(row[3])) for row in rows])
    print(config_of(rows[0][3]))


if __name__ == "__main__":
    main(tyro.cli(Config))
