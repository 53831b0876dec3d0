"""How much an IoU depends on which points it is measured at.

Every object is compared with itself shifted by 4 mm, along each axis, at many sets of points: 100,000 uniform in the workspace,
and the stratified points of the protocol (section 10) with other seeds. Printed: the standard deviation over the sets, along
the worst axis, and the number of points inside the object, as the table of docs/metrics.md.

    python benchmarks/iou_precision.py
    python benchmarks/iou_precision.py --objects mug eyeglasses --sets 50
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import tyro
from numpy.typing import NDArray

from tslam_bench.cli.ending import one_line_errors
from tslam_bench.constants import WORKSPACE_EDGE
from tslam_bench.geometry.distance import InsideTest
from tslam_bench.geometry.meshes import TriangleMesh
from tslam_bench.geometry.sampling import iou_points
from tslam_bench.objects.splits import known_names
from tslam_bench.objects.store import PreparedObject, load_object
from tslam_bench.scoring.metrics import iou

SHIFT = 4e-3
"""How far the copy is shifted (m)."""
UNIFORM_POINTS = 100_000
"""Points of a uniform set."""
LIMIT = 5e-3
"""Largest standard deviation that the protocol allows."""


@dataclass(frozen=True)
class Arguments:
    """Standard deviation of the IoU over sets of points."""

    split: str = "test"
    """Split of the objects."""
    objects: tuple[str, ...] = ()
    """Objects; empty: all of the split."""
    sets: int = 24
    """Sets of points of each kind."""


def solid(inside: InsideTest, low: NDArray, high: NDArray, points: NDArray) -> NDArray[np.bool_]:
    """Which of ``points`` (M, 3), anywhere, are in the object whose box is ``low`` to ``high``."""
    result = np.zeros(len(points), dtype=bool)
    near = ((points >= low) & (points <= high)).all(axis=1)
    result[near] = inside(points[near])
    return result


def deviations(item: PreparedObject, sets: int) -> tuple[NDArray, NDArray]:
    """Uniform and stratified points: (2, 3) standard deviations per axis, and (2,) mean numbers of points inside."""
    inside = InsideTest(TriangleMesh(item.vertices, item.faces))
    low, high = item.vertices.min(axis=0), item.vertices.max(axis=0)
    values = np.empty((2, sets, 3))
    counts = np.empty((2, sets))
    for number in range(sets):
        generator = np.random.default_rng(number)
        stratified = iou_points(low, high, item.iou_cells, seed=number)
        uniform = WORKSPACE_EDGE * (generator.random((UNIFORM_POINTS, 3)) - 0.5)
        for kind, (points, weights) in enumerate(
            ((uniform, np.ones(UNIFORM_POINTS)), (stratified.points, stratified.weights))
        ):
            true = solid(inside, low, high, points)
            counts[kind, number] = true.sum()
            for axis in range(3):
                copy = solid(inside, low, high, points - SHIFT * np.eye(3)[axis])
                values[kind, number, axis] = iou(copy, true, weights)
    return values.std(axis=1, ddof=1), counts.mean(axis=1)


def main() -> None:
    """Command line."""
    arguments = tyro.cli(Arguments, description=__doc__)
    with one_line_errors("iou_precision"):
        names = arguments.objects or known_names(arguments.split)
        worst = []
        print("| object | inside, before | sd, before | inside, after | sd, after |\n|---|---|---|---|---|")
        for name in names:
            deviation, inside = deviations(load_object(name, arguments.split), arguments.sets)
            before, after = deviation.max(axis=1)
            worst.append((before, after))
            print(f"| {name} | {inside[0]:,.0f} | {before:.4f} | {inside[1]:,.0f} | {after:.4f} |", flush=True)
    figures = np.array(worst)
    for kind, column in zip(("before", "after"), figures.T, strict=True):
        print(f"{kind}: {column.min():.4f} to {column.max():.4f}, median {np.median(column):.4f}")
    above = [name for name, after in zip(names, figures[:, 1], strict=True) if after > LIMIT]
    print(f"above {LIMIT}: {', '.join(above) or 'none'}")


if __name__ == "__main__":
    main()
