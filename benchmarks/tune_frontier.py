"""Searches the gains of the ``frontier`` explorer on train objects: where ``FrontierConfig``'s defaults come from.

    python benchmarks/tune_frontier.py --output tuning.jsonl

A random search: today's numbers, then changes of a few numbers of the best few. Every candidate plays the same episodes, and its
score is the mean number of touched voxels per pose. The best are then played again in other poses on other train objects. Lines
are written as soon as they are known; a stopped search goes on.
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
from recipe_search import spread
from report import print_table
from rollouts import Hands

from tslam_bench.baselines.frontier import FrontierBaseline, FrontierConfig
from tslam_bench.constants import HORIZON
from tslam_bench.engine.hand_batch import BatchSettings
from tslam_bench.engine.spaces import OBSERVATION_ARRAYS
from tslam_bench.objects.store import prepared_names

RANGES: Final[dict[str, tuple[float, float]]] = {
    "arm_noise": (0.1, 0.5),
    "turn_noise": (0.2, 1.2),
    "finger_noise": (0.3, 1.5),
    "near": (0.8, 3.0),
    "far": (2.0, 8.0),
    "close": (0.3, 2.0),
    "unknown": (0.0, 0.5),
    "wear": (0.0, 2.0),
    "arm_drift": (0.0, 2.0),
    "tether": (0.0, 0.2),
    "turn_pull": (0.0, 2.0),
    "finger_pull": (0.0, 2.0),
    "reach": (1.0, 6.0),
    "slide": (0.0, 2.0),
    "curl": (-0.5, 0.5),
}


@dataclass(frozen=True)
class Config:
    """Searches the explorer's gains."""

    output: Path
    """JSON lines: one candidate each."""
    candidates: int = 100
    """Budget."""
    objects: int = 12
    """Train objects of every candidate, spread evenly over the names of those that are prepared; as many others in the end."""
    poses: tuple[int, ...] = (0, 5)
    """Poses that they are explored in."""
    finalists: int = 3
    """Best candidates that are played again."""
    seed: int = 0
    """Seed of the search."""


def propose(known: Sequence[tuple[float, dict[str, float]]], generator: np.random.Generator) -> dict[str, float]:
    """Today's numbers first, then one of the best four with three numbers changed."""
    if not known:
        return {name: getattr(FrontierConfig(), name) for name in RANGES}
    ranked = [numbers for _, numbers in sorted(known, key=lambda entry: -entry[0])]
    child = dict(ranked[generator.integers(min(4, len(ranked)))])
    for name in generator.choice(list(RANGES), 3, replace=False):
        low, high = RANGES[name]
        child[name] = round(float(np.clip(child[name] + 0.25 * (high - low) * generator.normal(), low, high)), 3)
    return child


def touched(hands: Hands, config: FrontierConfig, objects: Sequence[str], poses: Sequence[int]) -> float:
    """Mean touched voxels per pose."""
    explorer = FrontierBaseline(config)
    seen = {name: hands.arrays[name] for name in OBSERVATION_ARRAYS}
    counts = []
    for pose in poses:
        explorer.reset(
            len(objects), [int(seed) for seed in np.random.SeedSequence([pose]).generate_state(len(objects))]
        )
        hands.reset(1000 * pose, objects, [pose] * len(objects))
        for _ in range(HORIZON):
            hands.step(explorer.act(seen))
        counts.append(hands.arrays["final_occupancy"][:, 0].sum(axis=(1, 2, 3), dtype=np.int64))
    return float(np.mean(counts))


def main(config: Config) -> None:
    """Searches, plays the finalists again, and prints them."""
    lines = config.output.read_text(encoding="utf-8").splitlines() if config.output.is_file() else []
    known: list[tuple[float, dict[str, Any]]] = [(e["touched"], e["numbers"]) for e in map(json.loads, lines)]
    chosen = spread(prepared_names("train"), 2 * config.objects)
    objects, others = chosen[::2], chosen[1::2]
    settings = BatchSettings(
        objects=chosen, split="train", control_mode=FrontierBaseline.control_mode, reward_mode="none"
    )
    hands = Hands(config.objects, settings)
    while len(known) < config.candidates:
        numbers = propose(known, np.random.default_rng([config.seed, len(known)]))
        known.append((touched(hands, FrontierConfig(**numbers), objects, config.poses), numbers))
        with config.output.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps({"touched": known[-1][0], "numbers": numbers}) + "\n")
        print(f"{len(known)}: {known[-1][0]:.1f}, best {max(score for score, _ in known):.1f}", flush=True)
    rows = []
    for score, numbers in [known[0], *sorted(known, key=lambda entry: -entry[0])[: config.finalists]]:
        again = touched(hands, dataclasses.replace(FrontierConfig(), **numbers), others, (2, 7))
        rows.append((f"{score:.1f}", f"{again:.1f}", json.dumps(numbers)))
    print_table(("in the search", "other objects and poses", "numbers; today's first"), rows)


if __name__ == "__main__":
    main(tyro.cli(Config))
