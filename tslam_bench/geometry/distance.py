"""Exact distances to triangle meshes and robust inside tests, through libigl."""

from __future__ import annotations

import igl
import numpy as np
from numpy.typing import NDArray

from tslam_bench.geometry.meshes import TriangleMesh
from tslam_bench.geometry.scanline import inside_grid

_CELLS = 32


def distance_to_mesh(points: NDArray[np.float64], mesh: TriangleMesh) -> NDArray[np.float64]:
    """Exact unsigned distance (M,) in metres from ``points`` (M, 3) to the surface."""
    squared, *_ = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points, dtype=np.float64),
        np.ascontiguousarray(mesh.vertices),
        np.ascontiguousarray(mesh.faces),
    )
    return np.sqrt(np.maximum(squared, 0.0))


def winding_numbers(points: NDArray[np.float64], mesh: TriangleMesh) -> NDArray[np.float64]:
    """Fast generalised winding number (M,) of ``points`` (M, 3): about 1 inside, 0 outside.

    Barill et al., "Fast winding numbers for soups and clouds", SIGGRAPH 2018.
    """
    return igl.fast_winding_number(
        np.ascontiguousarray(mesh.vertices),
        np.ascontiguousarray(mesh.faces),
        np.ascontiguousarray(points, dtype=np.float64),
    )


def contains(points: NDArray[np.float64], mesh: TriangleMesh) -> NDArray[np.bool_]:
    """Which of ``points`` (M, 3) are inside (M,): the benchmark's definition of ground-truth occupancy."""
    return winding_numbers(points, mesh) > 0.5


class InsideTest:
    """:func:`contains` for many points in the box of one watertight mesh: the same answers, sooner.

    The box is cut into cells. In a cell that is nowhere near the surface all points are on the side of its centre, by
    counted crossings; only points in the other cells need a winding number.
    """

    def __init__(self, mesh: TriangleMesh) -> None:
        self._mesh = mesh
        low, high = mesh.bounds
        self._edge = float((high - low).max()) / _CELLS
        size = np.maximum(np.ceil((high - low) / self._edge).astype(int), 1)
        self._shape = (int(size[0]), int(size[1]), int(size[2]))
        self._low = low
        centre = low + self._edge / 2
        centres = centre + np.indices(self._shape).reshape(3, -1).T * self._edge
        half_diagonal = self._edge * np.sqrt(3) / 2
        self._clear = (distance_to_mesh(centres, mesh) > 1.01 * half_diagonal).reshape(self._shape)
        self._inside = inside_grid(mesh, centre, self._edge, self._shape)

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of ``points`` (M, 3), all within the mesh's bounding box, are inside (M,)."""
        index = np.floor((points - self._low) / self._edge).astype(np.int64)
        cell = tuple(np.clip(index, 0, np.array(self._shape) - 1).T)
        inside = self._inside[cell]
        near = ~self._clear[cell]
        inside[near] = contains(points[near], self._mesh)
        return inside
