"""Alpha shapes of contact points, for the ``disagreement`` reward (protocol section 7)."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError
from scipy.spatial.distance import cdist

from tslam_bench.geometry import triangles

ALPHA_RADIUS: Final = 0.03
"""Tetrahedra with a circumradius above this (m) are left out of the shape."""
MAX_POINTS: Final = 192
"""Points that enter a triangulation: the first in each cell of a coarsening lattice, so that a step's work is bounded."""
SAMPLES: Final = 256
"""Points sampled on a shape's surface."""
_FIRST_LATTICE: Final = 4e-3  # m

_SOBOL_LIKE = np.stack([(np.arange(SAMPLES) * a + 0.5) % 1.0 for a in (0.7548776662466927, 0.5698402909980532)], axis=1)


def thin_out(points: NDArray) -> NDArray[np.float64]:
    """The first point in each cell of the finest lattice that leaves at most ``MAX_POINTS``: (m, 3)."""
    points = np.asarray(points, dtype=np.float64)
    lattice = _FIRST_LATTICE
    while True:
        _, first = np.unique(np.floor(points / lattice).astype(np.int64), axis=0, return_index=True)
        if len(first) <= MAX_POINTS:
            return points[np.sort(first)]
        lattice *= 1.3


def alpha_shape_triangles(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Boundary triangles of the alpha shape: (t, 3, 3) corners; none for fewer than four or coplanar points."""
    if len(points) < 4:
        return np.zeros((0, 3, 3))
    try:
        simplices = Delaunay(points).simplices
    except QhullError:
        return np.zeros((0, 3, 3))
    corner = points[simplices]
    edges = corner[:, 1:] - corner[:, :1]
    determinant = np.linalg.det(edges)
    solid = np.abs(determinant) > 1e-15
    simplices, edges = simplices[solid], edges[solid]
    if len(simplices) == 0:
        return np.zeros((0, 3, 3))
    centre = np.linalg.solve(2 * edges, (edges**2).sum(axis=2, keepdims=True))[:, :, 0]
    kept = simplices[np.linalg.norm(centre, axis=1) <= ALPHA_RADIUS]
    faces = np.sort(kept[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    unique, count = np.unique(faces, axis=0, return_counts=True)
    return points[unique[count == 1]]


def alpha_shape_samples(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(SAMPLES, 3) low-discrepancy samples on the alpha shape of (m, 3) thinned points; the points while it is empty."""
    corners = alpha_shape_triangles(points)
    area = triangles.areas(corners)
    if area.sum() <= 0:
        return points
    share = (np.arange(SAMPLES) + 0.5) / SAMPLES * area.sum()
    chosen = np.minimum(np.searchsorted(np.cumsum(area), share), len(area) - 1)
    return triangles.points_on(corners[chosen], _SOBOL_LIKE[:, :1], _SOBOL_LIKE[:, 1:])


def chamfer_l2(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """``0.5 * (mean_a d^2 + mean_b d^2)`` between two small point sets, in the square of their unit."""
    squared = cdist(a, b, "sqeuclidean")
    return float(0.5 * (np.mean(squared.min(axis=1)) + np.mean(squared.min(axis=0))))
