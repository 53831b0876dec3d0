"""How much do explorers feel? Touched voxels per pose, and the surface touched after 1, 2, 4 and 8 poses, on val objects.

    python benchmarks/surface_by_pose.py --explorers random_targets heuristic frontier tslam=runs/models/tslam-0 \\
        --output surface.jsonl --document docs/baselines.md

The episodes are those of ``benchmarks/recipe_search.py``, in all eight poses. No test object is used. The line of an explorer is
written as soon as it is known; those that have theirs are not played again.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
import tyro
from recipe_search import coverage, spread
from report import machine, markdown_table, print_table, replace_section
from rollouts import Hands

from tslam_bench.constants import HORIZON, NUM_POSES
from tslam_bench.engine.hand_batch import BatchSettings
from tslam_bench.engine.spaces import OBSERVATION_ARRAYS
from tslam_bench.evaluation.policies import make_baseline
from tslam_bench.evaluation.policy import Policy
from tslam_bench.grids import merge, world_to_object
from tslam_bench.objects.store import prepared_names
from tslam_bench.scoring.submission import RECONSTRUCTED_POSES

SEEDED: Final = 1000
"""Environments of pose k have the seeds from this times k on."""


@dataclass(frozen=True)
class Config:
    """Lets explorers feel val objects."""

    output: Path
    """JSON lines: one explorer each."""
    explorers: tuple[str, ...] = ()
    """Ids, or ID=MODEL."""
    objects: int = 24
    """Val objects, spread evenly over the names of those that are prepared."""
    document: Path | None = None
    """Page whose section ``explorers`` is replaced by the table."""


def measure(explorer: Policy, objects: Sequence[str]) -> dict[str, Any]:
    """Touched voxels per pose with their standard error over objects, and shares of the surface by number of poses."""
    settings = BatchSettings(
        objects=tuple(objects), split="val", control_mode=explorer.control_mode, reward_mode="none"
    )
    hands = Hands(len(objects), settings)
    seen = {name: hands.arrays[name] for name in OBSERVATION_ARRAYS}
    grids, acting = [], 0.0
    for pose in range(NUM_POSES):
        seeds = [int(seed) for seed in np.random.SeedSequence([pose]).generate_state(len(objects))]
        explorer.reset(len(objects), seeds)
        hands.reset(SEEDED * pose, objects, [pose] * len(objects))
        for _ in range(HORIZON):
            begun = time.thread_time()
            action = explorer.act(seen)
            acting += time.thread_time() - begun
            hands.step(action)
        grids.append([world_to_object(grid, pose) for grid in hands.arrays["final_occupancy"][:, 0].astype(bool)])
    counts = np.array([[grid.sum() for grid in of_pose] for of_pose in grids])
    means = counts.mean(axis=0)
    recall = {
        str(number): round(
            float(np.mean([coverage(n).recall(merge(grids[p][i] for p in poses)) for i, n in enumerate(objects)])), 4
        )
        for number, poses in RECONSTRUCTED_POSES.items()
    }
    return {
        "touched": round(float(means.mean()), 1),
        "error": round(float(means.std(ddof=1) / np.sqrt(len(means))), 1),
        "by_object": dict(zip(objects, means.round(1).tolist(), strict=True)),
        "recall": recall,
        "milliseconds": round(1e3 * acting / (NUM_POSES * HORIZON * len(objects)), 3),
    }


def main(config: Config) -> None:
    """Plays what is missing and prints one row per explorer."""
    torch.set_num_threads(1)
    about = machine()
    objects = spread(prepared_names("val"), config.objects)
    lines = config.output.read_text(encoding="utf-8").splitlines() if config.output.is_file() else []
    known = {line["explorer"]: line for line in map(json.loads, lines)}
    for explorer in config.explorers:
        if explorer in known:
            continue
        name, _, model = explorer.partition("=")
        known[explorer] = {
            "explorer": explorer,
            **measure(make_baseline(name, Path(model) if model else None), objects),
        }
        with config.output.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(known[explorer]) + "\n")
        print({key: value for key, value in known[explorer].items() if key != "by_object"}, flush=True)
    header = ("explorer", "touched voxels per pose", "surface after 1 / 2 / 4 / 8 poses", "ms per step and hand")
    rows = [
        (
            f"`{line['explorer'].partition('=')[0]}`" + ("" if "=" not in line["explorer"] else f" {line['explorer']}"),
            f"{line['touched']:.0f} +- {line['error']:.0f}",
            " / ".join(f"{value:.3f}"[1:] if value < 1 else "1" for value in line["recall"].values()),
            f"{line['milliseconds']:.2f}",
        )
        for line in known.values()
    ]
    print_table(header, rows)
    if config.document is not None:
        text = f"{about}; {len(objects)} val objects in {NUM_POSES} poses.\n\n"
        replace_section(config.document, "explorers", text + markdown_table(header, rows))


if __name__ == "__main__":
    main(tyro.cli(Config))
