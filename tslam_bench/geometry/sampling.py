"""Seeded points on a surface, and those at which solids are compared (protocol section 10).

Most objects fill one to three per cent of the workspace, so uniform points hardly meet them: of 100,000, 62 lie in the
eyeglasses. Solids are compared at stratified points instead, one in each cell of two lattices: a fine one over the object's
box, a coarse one over the rest of the workspace. Each point stands for the volume of its cell, so weighted sums are unbiased.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import (
    IOU_BOX_MARGIN,
    IOU_BOX_POINTS,
    IOU_INSIDE_POINTS,
    IOU_MOST_BOX_POINTS,
    IOU_OUTER_CELLS,
    WORKSPACE_EDGE,
    WORKSPACE_LOW,
)
from tslam_bench.geometry import triangles

if TYPE_CHECKING:
    from tslam_bench.geometry.meshes import TriangleMesh

IOU_POINTS_SEED: Final = 20211108
"""Seed of the IoU points (the first day of CoRL 2021)."""


@dataclass(frozen=True, eq=False)
class IouPoints:
    """Where an object's IoU is measured.

    Attributes:
        points: (N, 3) metres, object frame.
        weights: (N,) m^3, the volume that each point stands for.
    """

    points: NDArray[np.float64]
    weights: NDArray[np.float64]


def iou_cells(low: NDArray, high: NDArray, volume: float) -> tuple[int, int, int]:
    """Cells per axis of the fine lattice over the box of a solid.

    So many that about ``IOU_INSIDE_POINTS`` of its points lie in the solid, but ``IOU_BOX_POINTS`` to
    ``IOU_MOST_BOX_POINTS`` in all (a little more, as the numbers per axis are rounded up).

    Args:
        low, high: (3,) corners of the solid's bounding box (m).
        volume: of the solid (m^3), above 0.
    """
    low, high = _grown(low, high)
    extents = high - low
    wanted = IOU_INSIDE_POINTS * float(extents.prod()) / volume
    edge = (float(extents.prod()) / min(max(wanted, IOU_BOX_POINTS), IOU_MOST_BOX_POINTS)) ** (1 / 3)
    x, y, z = (max(1, int(np.ceil(extent / edge))) for extent in extents)
    return x, y, z


def iou_points(low: NDArray, high: NDArray, cells: tuple[int, int, int], seed: int = IOU_POINTS_SEED) -> IouPoints:
    """The points of an object: the same for every submission.

    Args:
        low, high: (3,) corners of the object's bounding box (m, object frame).
        cells: per axis of the fine lattice, which covers the box grown by ``IOU_BOX_MARGIN`` and cut at W.
        seed: another one gives another set, for measuring how much the choice matters.
    """
    low, high = _grown(low, high)
    generator = np.random.Generator(np.random.PCG64(seed))
    near, near_cell = _one_per_cell(low, high, cells, generator)
    corner = np.full(3, WORKSPACE_LOW)
    far, far_cell = _one_per_cell(corner, corner + WORKSPACE_EDGE, (IOU_OUTER_CELLS,) * 3, generator)
    # A cell on the border of the box gives its point or none, in proportion to its outer part: unbiased all the same.
    far = far[~((far >= low) & (far < high)).all(axis=1)]
    weights = np.concatenate([np.full(len(near), near_cell), np.full(len(far), far_cell)])
    return IouPoints(np.concatenate([near, far]), weights)


def _grown(low: NDArray, high: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The box grown by the margin and cut at W."""
    grown_low = np.maximum(np.asarray(low, dtype=np.float64) - IOU_BOX_MARGIN, WORKSPACE_LOW)
    grown_high = np.minimum(np.asarray(high, dtype=np.float64) + IOU_BOX_MARGIN, WORKSPACE_LOW + WORKSPACE_EDGE)
    return grown_low, grown_high


def _one_per_cell(
    low: NDArray, high: NDArray, cells: tuple[int, int, int], generator: np.random.Generator
) -> tuple[NDArray[np.float64], float]:
    """One uniform point in each cell of a lattice over a box: (cells, 3) in C order, and a cell's volume (m^3)."""
    size = (high - low) / np.array(cells)
    corner = np.indices(cells).reshape(3, -1).T
    return low + (corner + generator.random(corner.shape)) * size, float(size.prod())


def sample_surface(
    mesh: TriangleMesh, count: int, generator: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Area-uniform samples: points (count, 3) and the face each lies on (count,).

    The routine behind prepared objects. Scoring draws in the order of the faces, which is quicker, and training shapes by a
    weighted choice: other numbers from the same seed, so each keeps its own.
    """
    corners = mesh.triangles()
    cumulative = np.cumsum(triangles.areas(corners))
    face = np.searchsorted(cumulative, generator.random(count) * cumulative[-1], side="right")
    face = np.minimum(face, len(corners) - 1)
    u, v = generator.random((2, count, 1))
    return triangles.points_on(corners[face], u, v), face
