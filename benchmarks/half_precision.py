"""What does half precision change? Trained policies on val objects, with their weights as trained and as shipped.

    python benchmarks/half_precision.py --models runs/models/tslam-0 runs/models/tslam-1 --document docs/baselines.md

In every decision of the policy as trained, the shipped one decides about the same observation with the same noise: how far
the two actions differ. Then it plays the same episodes by itself: after the first contact the smallest difference grows, so what
counts is whether it touches as much.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from report import machine, markdown_table, print_table, replace_section
from rollouts import Hands

from tslam_bench.baselines.export import export
from tslam_bench.constants import HORIZON
from tslam_bench.engine.hand_batch import BatchSettings
from tslam_bench.engine.spaces import OBSERVATION_ARRAYS
from tslam_bench.evaluation.policies import make_baseline
from tslam_bench.evaluation.policy import Policy
from tslam_bench.objects.store import prepared_names


@dataclass(frozen=True)
class Config:
    """Compares weights in full and in half precision."""

    models: tuple[Path, ...]
    """Folders that ``tslam-bench baselines train`` wrote."""
    objects: int = 12
    """Val objects, spread evenly over the names of those that are prepared."""
    poses: tuple[int, ...] = (0, 2, 5, 7)
    """Poses in which each is explored."""
    document: Path | None = None
    """Page whose section ``half precision`` is replaced by the table."""


def play(
    hands: Hands, objects: Sequence[str], pose: int, policy: Policy, beside: Policy | None = None
) -> tuple[NDArray[np.int64], float]:
    """Touched voxels of each episode, and the largest difference of the actions of a policy that looks on."""
    seen = {name: hands.arrays[name] for name in OBSERVATION_ARRAYS}
    seeds = [int(seed) for seed in np.random.SeedSequence([pose]).generate_state(len(objects))]
    largest = 0.0
    for each in (policy, *([beside] if beside else [])):
        each.reset(len(objects), seeds)
    hands.reset(1000 * pose, objects, [pose] * len(objects))
    for _ in range(HORIZON):
        action = policy.act(seen)
        if beside is not None:
            largest = max(largest, float(np.abs(action - beside.act(seen)).max()))
        hands.step(action)
    return hands.arrays["final_occupancy"][:, 0].sum(axis=(1, 2, 3), dtype=np.int64), largest


def measure(model: Path, config: Config, objects: Sequence[str], folder: Path) -> tuple[str, ...]:
    """One row."""
    weights = export(model, folder)
    whole, half = (make_baseline("tslam", path) for path in (model, weights))
    settings = BatchSettings(objects=tuple(objects), split="val", control_mode=whole.control_mode, reward_mode="none")
    hands = Hands(len(objects), settings)
    pairs, largest = [], 0.0
    for pose in config.poses:
        touched, difference = play(hands, objects, pose, whole, half)
        pairs.append((touched, play(hands, objects, pose, half)[0]))
        largest = max(largest, difference)
    first, second = np.concatenate(pairs, axis=1)
    change = second - first
    error = change.std(ddof=1) / np.sqrt(len(change))
    row = (model.name, f"{weights.stat().st_size:,}", f"{largest:.4f}", f"{first.mean():.1f}", f"{second.mean():.1f}")
    return (*row, f"{change.mean():+.1f} +- {error:.1f}", f"{np.abs(change).mean():.0f}")


def main(config: Config) -> None:
    """Prints one row per model."""
    torch.set_num_threads(1)
    names = prepared_names("val")
    objects = [names[index] for index in np.linspace(0, len(names) - 1, config.objects).round().astype(int)]
    header = (
        *("policy", "bytes", "largest difference of an action", "touched voxels as trained", "as shipped"),
        *("difference", "per episode, either way"),
    )
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for model in config.models:
            rows.append(measure(model, config, objects, Path(folder)))
            print(*rows[-1], sep=" | ", flush=True)
    print_table(header, rows)
    if config.document is not None:
        text = f"{machine()}; {len(objects)} val objects in poses {', '.join(map(str, config.poses))}.\n\n"
        replace_section(config.document, "half precision", text + markdown_table(header, rows))


if __name__ == "__main__":
    main(tyro.cli(Config))
