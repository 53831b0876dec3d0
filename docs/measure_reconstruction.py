"""Prints the tables of docs/reconstruction.md.

python docs/measure_reconstruction.py hull
python docs/measure_reconstruction.py simulated --split val --models ifnet=runs/quick/models/ifnet.pt
python docs/measure_reconstruction.py rollouts --folder runs/quick/rollouts --split test --models ifnet=FILE
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray

from tslam_bench import grids
from tslam_bench.cli.ending import one_line_errors
from tslam_bench.constants import (
    GRID_SIZE,
    OCCUPANCY_THRESHOLD,
    PROTOCOL_POSES,
    QUICK_OBJECTS,
    VOXEL_EDGE,
    WORKSPACE_LOW,
)
from tslam_bench.geometry.sampling import iou_points
from tslam_bench.objects.splits import prepared_names
from tslam_bench.objects.store import PreparedObject, load_object
from tslam_bench.reconstruction.hull import HullReconstructor
from tslam_bench.reconstruction.inputs import read_grids
from tslam_bench.reconstruction.registry import make_reconstructor
from tslam_bench.reconstruction.touch_simulation import TouchSimulation, simulate_touches
from tslam_bench.reconstruction.training_shapes import PlacedShape, training_shape
from tslam_bench.reconstruction.volume import Reconstructor
from tslam_bench.scoring.metrics import iou


@dataclass(frozen=True)
class Hull:
    """Hull of all surface voxels of analytic solids, against the solids."""


@dataclass(frozen=True)
class Simulated:
    """Reconstructors on simulated touches of prepared objects."""

    split: str = "val"
    """Split of the objects."""
    models: tuple[str, ...] = ()
    """Trained reconstructors, as ID=FILE."""
    repetitions: int = 3
    """Simulated explorations per object."""


@dataclass(frozen=True)
class Rollouts:
    """Reconstructors on rollouts: FOLDER/EXPLORER/OBJECT/pose<k>_seed0.npz."""

    folder: Path
    """Folder of the explorers."""
    split: str = "test"
    """Split of the objects."""
    explorers: tuple[str, ...] = ("random", "heuristic")
    """Explorers."""
    models: tuple[str, ...] = field(default=())
    """Trained reconstructors, as ID=FILE."""


Command = (
    Annotated[Hull, tyro.conf.subcommand("hull")]
    | Annotated[Simulated, tyro.conf.subcommand("simulated")]
    | Annotated[Rollouts, tyro.conf.subcommand("rollouts")]
)


def reconstructors(models: tuple[str, ...]) -> dict[str, Reconstructor]:
    """The ones that need no model, and the given models."""
    made = {name: make_reconstructor(name) for name in ("grid", "hull", "carve", "mean_shape", "retrieval")}
    for text in models:
        name, _, path = text.partition("=")
        made[f"{name} ({Path(path).stem})"] = make_reconstructor(name, Path(path))
    return made


def report(title: str, scores: dict[str, list[float]]) -> None:
    """One row of figures."""
    print(f"{title:28}" + "  ".join(f"{name} {np.mean(values):.3f}" for name, values in scores.items()), flush=True)


def score(made: dict[str, Reconstructor], touched: NDArray, visited: NDArray, item: PreparedObject) -> dict[str, float]:
    """IoU of every reconstructor."""
    sample = item.iou_points()
    return {
        name: iou(
            reconstructor.reconstruct(touched, visited).query(sample.points) >= OCCUPANCY_THRESHOLD,
            item.solid_at_iou_points,
            sample.weights,
        )
        for name, reconstructor in made.items()
    }


def hull() -> None:
    """Analytic sphere, cube and cylinder (as high as wide)."""
    solids = {
        "sphere": lambda p: np.linalg.norm(p, axis=-1),
        "cube": lambda p: np.abs(p).max(axis=-1),
        "cylinder": lambda p: np.maximum(np.hypot(p[..., 0], p[..., 1]), np.abs(p[..., 2])),
    }
    low = WORKSPACE_LOW + VOXEL_EDGE * np.arange(GRID_SIZE)
    near = np.maximum(np.maximum(low, -(low + VOXEL_EDGE)), 0)
    far = np.maximum(np.abs(low), np.abs(low + VOXEL_EDGE))
    corners = [np.stack(np.meshgrid(a, a, a, indexing="ij"), axis=-1) for a in (near, far)]
    for (name, gauge), diameter in itertools.product(solids.items(), (0.04, 0.08, 0.12)):
        surface = (gauge(corners[0]) <= diameter / 2) & (gauge(corners[1]) >= diameter / 2)
        volume = HullReconstructor().reconstruct(surface, np.zeros_like(surface))
        sample = iou_points(np.full(3, -diameter / 2), np.full(3, diameter / 2), (50, 50, 50))
        true = gauge(sample.points) <= diameter / 2
        predicted = volume.query(sample.points) >= OCCUPANCY_THRESHOLD
        found = iou(predicted, true, sample.weights)
        print(f"{name:9} {100 * diameter:3.0f} cm: {surface.sum():5} touched voxels, IoU {found:.3f}")


def simulated(command: Simulated) -> None:
    """Prepared objects as they stand, explored from 1, 4 and 8 sides."""
    made = reconstructors(command.models)
    for approaches in (1, 4, 8):
        simulation = TouchSimulation(approaches=(approaches, approaches))
        scores: dict[str, list[float]] = {name: [] for name in made}
        for index, name in enumerate(prepared_names(command.split)):
            item = load_object(name, command.split)
            generator = np.random.default_rng([index, approaches])
            shape = training_shape(name, item.vertices, item.faces, generator)
            placed = PlacedShape(shape, np.eye(3), 1.0, np.zeros(3))
            for _ in range(command.repetitions):
                touches = simulate_touches(placed, generator, simulation)
                for key, value in score(made, touches.touched, touches.visited, item).items():
                    scores[key].append(value)
        report(f"{approaches} approaches", scores)


def rollouts(command: Rollouts) -> None:
    """Merged rollouts of 1, 4 and 8 poses, and every surface voxel touched."""
    made = reconstructors(command.models)
    names = QUICK_OBJECTS if command.split == "test" else tuple(prepared_names(command.split))
    items = {name: load_object(name, command.split) for name in names}
    for explorer, poses in itertools.product(command.explorers, ((0,), PROTOCOL_POSES[4], PROTOCOL_POSES[8])):
        scores: dict[str, list[float]] = {name: [] for name in made}
        for name, item in items.items():
            pairs = []
            for pose in poses:
                pair = read_grids(command.folder / explorer / name / f"pose{pose}_seed0.npz")
                pairs.append([grids.world_to_object(grid, pose) for grid in pair])
            touched, visited = (grids.merge(pair[channel] for pair in pairs) for channel in (0, 1))
            for key, value in score(made, touched, visited, item).items():
                scores[key].append(value)
        report(f"{explorer}, {len(poses)} poses", scores)
    every = [score(made, item.surface, ~item.solid, item) for item in items.values()]
    report("every surface voxel touched", {name: [values[name] for values in every] for name in made})


def main() -> None:
    """Command line."""
    command = tyro.cli(Command, description=__doc__)
    with one_line_errors("measure_reconstruction"):
        run(command)


def run(command: Hull | Simulated | Rollouts) -> None:
    """Runs one subcommand."""
    if isinstance(command, Simulated):
        simulated(command)
    elif isinstance(command, Rollouts):
        rollouts(command)
    else:
        hull()


if __name__ == "__main__":
    main()
