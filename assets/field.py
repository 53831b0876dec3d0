"""Signed distance to the union of the collision hulls on a regular grid (protocol section 5).

The magnitude is the exact distance to the boundary of the boolean union, so that faces between hulls inside the solid do not
read as surface; the sign is exact too: a sample is inside when it is inside any hull.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from tslam_bench.assets.decompose import hull_union
from tslam_bench.assets.distance import distance_to_mesh, sample_surface
from tslam_bench.assets.meshes import TriangleMesh, from_manifold
from tslam_bench.assets.store import SignedDistanceField
from tslam_bench.constants import SIGNED_DISTANCE_TOLERANCE

PADDING = 20e-3
"""The field reaches this far (m) beyond the object's bounding box."""
SPACINGS = (0.8e-3, 0.65e-3, 0.5e-3)
"""Sample distances (m), tried in this order until the error is in tolerance."""
ERROR_SAMPLES = 20_000
"""Surface samples at which the error is measured (and again at the same number of points near the surface)."""
NEAR = 2e-3
"""Points up to this far (m) off the surface count as near it."""
_SEED = 20211108


def hull_planes(hull: TriangleMesh) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Outward unit normals (F, 3) and offsets (F,): a point p is inside where ``normals @ p <= offsets``."""
    normals = hull.face_normals()
    return normals, np.einsum("ij,ij->i", normals, hull.triangles()[:, 0])


def inside_any(points: NDArray[np.float64], hulls: list[TriangleMesh]) -> NDArray[np.bool_]:
    """Which of ``points`` (M, 3) are inside at least one convex hull (M,)."""
    inside = np.zeros(len(points), dtype=bool)
    for hull in hulls:
        low, high = hull.bounds
        near = np.flatnonzero(~inside & ((points >= low) & (points <= high)).all(axis=1))
        normals, offsets = hull_planes(hull)
        inside[near] = (points[near] @ normals.T <= offsets).all(axis=1)
    return inside


def signed_distance(
    points: NDArray[np.float64], hulls: list[TriangleMesh], surface: TriangleMesh
) -> NDArray[np.float64]:
    """Exact signed distance (M,) in metres of ``points`` (M, 3) to the solid that the hulls cover, negative inside.

    Args:
        points: query points.
        hulls: the convex hulls.
        surface: boundary of their boolean union.
    """
    distance = distance_to_mesh(points, surface)
    return np.where(inside_any(points, hulls), -distance, distance)


def trilinear(field: SignedDistanceField, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Trilinear value (M,) of the field at ``points`` (M, 3); beyond the grid the nearest border value."""
    index = (np.asarray(points, dtype=np.float64) - field.origin) / field.spacing
    return map_coordinates(field.values, index.T, output=np.float64, order=1, mode="nearest")


def build_field(hulls: list[TriangleMesh], tolerance: float = SIGNED_DISTANCE_TOLERANCE) -> SignedDistanceField:
    """Samples the signed distance to the hulls' union, finely enough for ``tolerance``.

    Returns:
        the field, its values rounded to what half precision holds; ``surface_error`` is the largest difference to the exact
        signed distance over samples on the surface and up to 2 mm off it.
    """
    surface = from_manifold(hull_union(hulls))
    generator = np.random.default_rng(_SEED)
    on_surface, face = sample_surface(surface, ERROR_SAMPLES, generator)
    offset = generator.uniform(-NEAR, NEAR, (ERROR_SAMPLES, 1)) * surface.face_normals()[face]
    probes = np.concatenate([on_surface, on_surface + offset])
    exact = signed_distance(probes, hulls, surface)
    low, high = surface.bounds
    field = None
    for spacing in SPACINGS:
        size = np.ceil((high - low + 2 * PADDING) / spacing).astype(int) + 1
        origin = (low + high) / 2 - (size - 1) * spacing / 2
        index = np.indices(tuple(size)).reshape(3, -1).T
        values = signed_distance(origin + index * spacing, hulls, surface)
        half = values.astype(np.float16).astype(np.float32).reshape(tuple(size))
        field = SignedDistanceField(origin, spacing, half, 0.0)
        error = float(np.abs(trilinear(field, probes) - exact).max())
        field = SignedDistanceField(origin, spacing, half, error)
        if error <= tolerance:
            break
    assert field is not None
    return field
