"""Ground-truth occupancy of a solid: voxels, surface samples, any points (protocol sections 8 and 10)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import GRID_SIZE, SURFACE_SAMPLES, VOXEL_EDGE, WORKSPACE_LOW
from tslam_bench.geometry.distance import InsideTest, contains
from tslam_bench.geometry.meshes import TriangleMesh
from tslam_bench.geometry.sampling import sample_surface
from tslam_bench.grids import voxel_centres

SURFACE_SEED = 20211109
"""Seed of the surface samples: the same for every object."""


def solid_grid(mesh: TriangleMesh) -> NDArray[np.bool_]:
    """(32, 32, 32) bool: the voxel's centre is inside the watertight mesh."""
    centres = voxel_centres().reshape(-1, 3)
    low, high = mesh.bounds
    inside = ((centres >= low) & (centres <= high)).all(axis=1)
    inside[inside] = contains(centres[inside], mesh)
    return inside.reshape((GRID_SIZE,) * 3)


def surface_grid(mesh: TriangleMesh) -> NDArray[np.bool_]:
    """(32, 32, 32) bool: the closed voxel cube meets a triangle of the mesh (exact separating-axis test).

    Akenine-Moller, "Fast 3D triangle-box overlap testing", Journal of Graphics Tools 2001.
    """
    corners = (mesh.triangles() - WORKSPACE_LOW) / VOXEL_EDGE
    grid = np.zeros((GRID_SIZE,) * 3, dtype=bool)
    low = np.clip(np.ceil(corners.min(axis=1)).astype(np.int64) - 1, 0, GRID_SIZE - 1)
    high = np.clip(np.floor(corners.max(axis=1)).astype(np.int64), 0, GRID_SIZE - 1)
    outside = (corners.max(axis=1) < 0).any(axis=1) | (corners.min(axis=1) > GRID_SIZE).any(axis=1)
    size = high - low + 1
    count = np.where(outside, 0, size.prod(axis=1))
    triangle = np.repeat(np.arange(len(count)), count)
    rank = np.arange(len(triangle)) - np.repeat(np.cumsum(count) - count, count)
    _sx, sy, sz = size[triangle].T
    voxel = low[triangle] + np.stack([rank // (sy * sz), rank // sz % sy, rank % sz], axis=1)
    met = voxel[_triangle_meets_cube(corners[triangle] - (voxel + 0.5)[:, None])]
    grid[tuple(met.T)] = True
    return grid


def _triangle_meets_cube(triangles: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which triangles (M, 3, 3) meet the cube [-0.5, 0.5]^3 (its boundary included)."""
    half = 0.5
    meets = ((triangles.min(axis=1) <= half) & (triangles.max(axis=1) >= -half)).all(axis=1)
    edges = np.roll(triangles, -1, axis=1) - triangles
    normal = np.cross(edges[:, 0], edges[:, 1])
    meets &= np.abs(np.einsum("ij,ij->i", normal, triangles[:, 0])) <= half * np.abs(normal).sum(axis=1)
    for edge in edges.transpose(1, 0, 2):
        for unit in np.eye(3):
            axis = np.cross(unit, edge)
            projected = np.einsum("ijk,ik->ij", triangles, axis)
            reach = half * np.abs(axis).sum(axis=1)
            meets &= (projected.min(axis=1) <= reach) & (projected.max(axis=1) >= -reach)
    return meets


def surface_samples(mesh: TriangleMesh) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The seeded area-uniform samples of the true surface: points (100000, 3) m and the face of each (100000,)."""
    return sample_surface(mesh, SURFACE_SAMPLES, np.random.Generator(np.random.PCG64(SURFACE_SEED)))


def solid_at(points: NDArray[np.float64], mesh: TriangleMesh) -> NDArray[np.bool_]:
    """(N,) bool: which of ``points`` (N, 3) m are inside the watertight mesh."""
    low, high = mesh.bounds
    inside = ((points >= low) & (points <= high)).all(axis=1)
    inside[inside] = InsideTest(mesh)(points[inside])
    return inside
