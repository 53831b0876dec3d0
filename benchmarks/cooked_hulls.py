"""Compares the collision hulls that PhysX cooked with the hulls that were handed to it: does cooking keep their volume?

python benchmarks/cooked_hulls.py
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.spatial import ConvexHull

from tslam_bench.engine.physics import collision_shapes
from tslam_bench.objects.splits import check_split, prepared_names
from tslam_bench.objects.store import PreparedObject, load_object


@dataclass(frozen=True)
class Config:
    """Cooks hulls and compares."""

    split: str = "test"
    """Split; all of its prepared objects, unless --objects names some."""
    objects: tuple[str, ...] = ()
    """Objects."""


@dataclass(frozen=True)
class Cooked:
    """Hulls of one object before and after cooking.

    Attributes:
        before: (H,) volumes (m^3) of the hulls.
        after: (H,) volumes inside the cooked triangles.
        corners: (H,) volumes of the convex hulls of the cooked corners.
        vertices, triangles: (H,) counts after cooking.
    """

    before: NDArray[np.float64]
    after: NDArray[np.float64]
    corners: NDArray[np.float64]
    vertices: NDArray[np.int64]
    triangles: NDArray[np.int64]

    @property
    def change(self) -> float:
        """Relative change of the hulls' summed volume."""
        return float(self.after.sum() / self.before.sum() - 1)

    @property
    def corner_change(self) -> float:
        """The same for the hulls of the corners."""
        return float(self.corners.sum() / self.before.sum() - 1)

    @property
    def worst(self) -> float:
        """Largest relative change of one hull's volume, without its sign."""
        return float(np.abs(self.after / self.before - 1).max())


def enclosed_volume(vertices: NDArray[np.float64], triangles: NDArray[np.int64]) -> float:
    """Volume (m^3) inside outward triangles (F, 3) of vertices (V, 3), summed from tetrahedra about the mean vertex."""
    a, b, c = (vertices[triangles] - vertices.mean(axis=0)).transpose(1, 0, 2)
    return float(np.linalg.det(np.stack([a, b, c], axis=1)).sum() / 6)


def cook(prepared: PreparedObject) -> Cooked:
    """Cooks an object's hulls as the tasks do, and reads back what PhysX keeps."""
    rows = []
    for (vertices, faces), shape in zip(prepared.hulls, collision_shapes(prepared), strict=True):
        kept = np.asarray(shape.vertices, dtype=np.float64) * np.asarray(shape.scale, dtype=np.float64)
        triangles = np.asarray(shape.triangles, dtype=np.int64)
        after = abs(enclosed_volume(kept, triangles))
        rows.append((enclosed_volume(vertices, faces), after, ConvexHull(kept).volume, len(kept), len(triangles)))
    return Cooked(*(np.array(column) for column in zip(*rows, strict=True)))


def main(config: Config) -> None:
    """Prints one row per object and the extremes."""
    split = check_split(config.split)
    results = {name: cook(load_object(name, split)) for name in config.objects or prepared_names(split)}
    table = Table(
        "object", "hulls", "volume change (%)", "of corners (%)", "worst hull (%)", "most vertices", "most triangles"
    )
    for name, cooked in results.items():
        table.add_row(
            name,
            str(len(cooked.before)),
            f"{100 * cooked.change:+.3f}",
            f"{100 * cooked.corner_change:+.3f}",
            f"{100 * cooked.worst:.3f}",
            str(cooked.vertices.max()),
            str(cooked.triangles.max()),
        )
    console = Console(width=100)
    console.print(table)
    changes = np.array([cooked.change for cooked in results.values()])
    print(
        f"{len(results)} objects, {sum(len(cooked.before) for cooked in results.values())} hulls: change per object "
        f"{100 * changes.min():+.3f} to {100 * changes.max():+.3f} %, "
        f"worst hull {100 * max(cooked.worst for cooked in results.values()):.3f} %, "
        f"at most {max(cooked.vertices.max() for cooked in results.values())} vertices "
        f"and {max(cooked.triangles.max() for cooked in results.values())} triangles"
    )


if __name__ == "__main__":
    main(tyro.cli(Config))
