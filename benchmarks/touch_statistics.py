"""Do simulated touches look like real ones? Share of voxels touched and visited, by distance from the object.

    python benchmarks/touch_statistics.py --document docs/reconstruction.md

Explorers feel *train* objects in poses of the exploration order; simulated touches are drawn on the same objects with as
many approaches as poses. The ranges in ``TouchSimulation`` were set with this table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import tyro
from numpy.typing import NDArray
from report import machine, markdown_table, print_table, replace_section
from scipy.ndimage import distance_transform_edt
from tqdm import tqdm

import tslam_bench
from tslam_bench import grids
from tslam_bench.constants import ENVIRONMENT_ID, QUICK_TRAIN_OBJECTS
from tslam_bench.evaluation.policies import make_baseline
from tslam_bench.evaluation.rollouts import roll_out_batch
from tslam_bench.objects.store import PreparedObject, load_object
from tslam_bench.reconstruction.touch_simulation import TouchSimulation, simulate_touches
from tslam_bench.reconstruction.training_shapes import PlacedShape, training_shape
from tslam_bench.scoring.submission import RECONSTRUCTED_POSES

SALT: Final = "0"
BANDS: Final = ((1, 1), (2, 2), (3, 3), (4, 5), (6, 9), (10, 99))
"""Distances from the nearest voxel of the object, in voxels."""


@dataclass(frozen=True)
class Config:
    """Compares simulated touches with rollouts."""

    objects: tuple[str, ...] = QUICK_TRAIN_OBJECTS
    """Train objects."""
    explorers: tuple[str, ...] = ("random", "random_targets", "heuristic")
    """Explorers without training."""
    repetitions: int = 6
    """Simulated explorations per object and number of poses."""
    processes: int | None = None
    """Worker processes; default: the cores."""
    document: Path | None = None
    """Page whose section ``touches`` is replaced by the table."""


Row = NDArray[np.float64]


def statistics(touched: NDArray, visited: NDArray, item: PreparedObject) -> Row:
    """Touched voxels, touched by surface voxels, share of touched that are visited, then shares visited: on the surface,
    and outside by band of distance."""
    solid = item.solid | item.surface
    distance = np.round(distance_transform_edt(~solid))
    near = [visited[(distance >= low) & (distance <= high)].mean() for low, high in BANDS]
    both = (touched & visited).sum() / max(1, touched.sum())
    return np.array([touched.sum(), touched.sum() / item.surface.sum(), both, visited[item.surface].mean(), *near])


def explored(config: Config, explorer: str, items: dict[str, PreparedObject]) -> dict[int, list[Row]]:
    """Statistics after 1, 2, 4 and 8 poses, one row per object."""
    policy = make_baseline(explorer)
    envs = tslam_bench.make_vec(
        ENVIRONMENT_ID,
        len(items),
        "cpu",
        objects=tuple(items),
        split="train",
        reward_mode="none",
        control_mode=policy.control_mode,
        processes=config.processes,
    )
    felt: dict[str, list[tuple[NDArray, NDArray]]] = {name: [] for name in items}
    rows: dict[int, list[Row]] = {}
    try:
        for pose in tqdm(RECONSTRUCTED_POSES[8], desc=explorer):
            for rollout in roll_out_batch(envs, policy, [(name, pose, 0) for name in items], SALT):
                pair = (grids.world_to_object(rollout.touched, pose), grids.world_to_object(rollout.visited, pose))
                felt[rollout.object].append(pair)
            count = len(next(iter(felt.values())))
            if count in RECONSTRUCTED_POSES:
                rows[count] = [
                    statistics(*(grids.merge(pair[channel] for pair in felt[name]) for channel in (0, 1)), item)
                    for name, item in items.items()
                ]
    finally:
        envs.close()
    return rows


def simulated(config: Config, items: dict[str, PreparedObject], approaches: int) -> list[Row]:
    """Statistics of simulated touches, one row per object and repetition."""
    simulation = TouchSimulation(approaches=(approaches, approaches))
    rows = []
    for index, (name, item) in enumerate(items.items()):
        generator = np.random.default_rng([index, approaches])
        placed = PlacedShape(training_shape(name, item.vertices, item.faces, generator), np.eye(3), 1.0, np.zeros(3))
        for _ in range(config.repetitions):
            touches = simulate_touches(placed, generator, simulation)
            rows.append(statistics(touches.touched, touches.visited, item))
    return rows


def cells(title: str, rows: Sequence[Row]) -> tuple[str, ...]:
    """One line of the table."""
    values = np.array(rows)
    low, median, high = np.percentile(values[:, 0], [5, 50, 95])
    return (title, f"{median:.0f} ({low:.0f} to {high:.0f})", *(f"{value:.2f}" for value in values[:, 1:].mean(axis=0)))


def main(config: Config) -> None:
    """Prints the table."""
    items = {name: load_object(name, "train") for name in config.objects}
    header = (
        *(
            "",
            "touched voxels: median (5 to 95 %)",
            "touched / surface",
            "touched and visited / touched",
            "on the surface",
        ),
        *(str(low) if low == high else f"{low}-{high}" if high < 99 else "further" for low, high in BANDS),
    )
    table = []
    for explorer in config.explorers:
        table += [
            cells(f"{explorer}, {count} poses", rows) for count, rows in explored(config, explorer, items).items()
        ]
    for count in RECONSTRUCTED_POSES:
        table.append(cells(f"simulated, {count} approaches", simulated(config, items, count)))
    print_table(header, table)
    if config.document is not None:
        text = f"{machine()}; {len(items)} train objects.\n\n"
        replace_section(config.document, "touches", text + markdown_table(header, table))


if __name__ == "__main__":
    main(tyro.cli(Config))
