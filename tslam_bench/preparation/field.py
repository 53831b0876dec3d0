"""Signed distance to the union of the collision hulls on a regular grid (protocol section 5).

The exact distance is that to the boundary of the boolean union, so that faces between hulls inside the solid do not read as
surface; its sign is exact too: a point is inside when it is inside any hull. Sampled as it is, such a field reads trilinearly up
to half a spacing wrong at sharp edges and thin walls. The samples next to the surface are therefore fitted (weighted linear least
squares) so that the *interpolated* field is right at the surface and outside it; the others stay exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import lsqr

from tslam_bench.constants import SIGNED_DISTANCE_TOLERANCE
from tslam_bench.errors import AssetError
from tslam_bench.geometry.distance import distance_to_mesh
from tslam_bench.geometry.interpolation import trilinear
from tslam_bench.geometry.meshes import TriangleMesh, from_manifold
from tslam_bench.geometry.sampling import sample_surface
from tslam_bench.objects.store import SignedDistanceField
from tslam_bench.preparation.decompose import hull_union

PADDING = 20e-3
"""The field reaches this far (m) beyond the object's bounding box."""
SPACINGS = (1.5e-3, 1.2e-3, 1.0e-3, 0.8e-3, 0.6e-3)
"""Sample distances (m), tried in this order until the error is in tolerance."""
ERROR_SAMPLES = 20_000
"""Surface samples at which the error is measured (not those of the fit)."""
BAND = 2e-3
"""The fit looks at points up to this far (m) from the surface."""
SURFACE_DENSITY = 4.0
"""Points of the fit per spacing^2 of surface ..."""
CELL_POINTS = 5
"""... and per cell of the band."""
WEIGHT_SURFACE, WEIGHT_INSIDE = 1.5, 0.1
"""Weights in the fit of points on the surface and of points inside; those outside have 1."""
DAMPING = 0.3
"""Pull of the fit towards the exact sample values."""
FIT_ROUNDS = 2
"""Rounds of the fit; after the first, points with large residuals weigh more."""
_SEED = 20211108


@dataclass(frozen=True)
class _Solid:
    """Convex hulls and the boundary of their union."""

    hulls: list[TriangleMesh]
    surface: TriangleMesh

    def signed_distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        return signed_distance(points, self.hulls, self.surface)


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


def build_field(hulls: list[TriangleMesh], tolerance: float = SIGNED_DISTANCE_TOLERANCE) -> SignedDistanceField:
    """Samples the signed distance to the hulls' union, finely enough for ``tolerance``.

    Returns:
        the field, its values rounded to half precision; ``surface_error`` is the largest absolute value (m) that it reads at
        20,000 area-uniform samples of the union's surface. The finest spacing is returned even if that is above ``tolerance``.

    Raises:
        AssetError: the hulls are not solid.
    """
    solid = _Solid(hulls, from_manifold(hull_union(hulls)))
    if len(solid.surface.faces) == 0:
        raise AssetError("the collision hulls enclose nothing")
    on_surface, _ = sample_surface(solid.surface, ERROR_SAMPLES, np.random.default_rng(_SEED))
    low, high = solid.surface.bounds
    for spacing in SPACINGS:
        size = np.ceil((high - low + 2 * PADDING) / spacing).astype(int) + 1
        shape = (int(size[0]), int(size[1]), int(size[2]))
        origin = (low + high) / 2 - (size - 1) * spacing / 2
        exact = solid.signed_distance(origin + np.indices(shape).reshape(3, -1).T * spacing).reshape(shape)
        values = _fit(exact, origin, spacing, solid)
        half = values.astype(np.float16).astype(np.float32)
        error = float(np.abs(trilinear(half, origin, spacing, on_surface)).max())
        field = SignedDistanceField(origin, spacing, half, error)
        if error <= tolerance:
            break
    return field


def _fit_points(
    exact: NDArray[np.float64], origin: NDArray[np.float64], spacing: float, solid: _Solid
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Points of the fit (M, 3), their exact signed distances (M,) and weights (M,)."""
    generator = np.random.default_rng(_SEED + 1)
    on_surface, _ = sample_surface(solid.surface, int(SURFACE_DENSITY * solid.surface.area() / spacing**2), generator)
    cells = np.argwhere(np.abs(exact[:-1, :-1, :-1]) < BAND + spacing)
    corner = np.repeat(cells, CELL_POINTS, axis=0)
    near = origin + spacing * (corner + generator.random(corner.shape))
    distance = solid.signed_distance(near)
    kept = np.abs(distance) < 1.25 * BAND
    points = np.concatenate([on_surface, near[kept]])
    distance = np.concatenate([np.zeros(len(on_surface)), distance[kept]])
    weight = np.where(distance < -0.2 * spacing, WEIGHT_INSIDE, 1.0)
    weight[: len(on_surface)] = WEIGHT_SURFACE
    return points, distance, weight


def _interpolation_matrix(
    points: NDArray[np.float64], origin: NDArray[np.float64], spacing: float, shape: tuple[int, int, int]
) -> tuple[sparse.csr_matrix, NDArray[np.int64]]:
    """Trilinear interpolation at ``points`` as a matrix over the samples that it uses, and those samples' flat indices."""
    scaled = (points - origin) / spacing
    lower = np.floor(scaled).astype(np.int64)
    fraction = scaled - lower
    corners = np.array(list(np.ndindex(2, 2, 2)))
    weights = np.where(corners[None] == 1, fraction[:, None], 1 - fraction[:, None]).prod(axis=2)
    flat = np.ravel_multi_index(tuple((lower[:, None] + corners[None]).transpose(2, 0, 1)), shape)
    column_of = np.zeros(np.prod(shape), dtype=np.int64)
    column_of[flat] = 1
    used = np.flatnonzero(column_of)
    column_of[used] = np.arange(len(used))
    column = column_of[flat]
    row = np.repeat(np.arange(len(points)), 8)
    matrix = sparse.csr_matrix((weights.ravel(), (row, column.ravel())), (len(points), len(used)))
    return matrix, used


def _fit(exact: NDArray[np.float64], origin: NDArray[np.float64], spacing: float, solid: _Solid) -> NDArray[np.float64]:
    """Samples (nx, ny, nz) whose interpolation is right near the surface; equal to ``exact`` away from it."""
    points, distance, weight = _fit_points(exact, origin, spacing, solid)
    matrix, used = _interpolation_matrix(points, origin, spacing, (exact.shape[0], exact.shape[1], exact.shape[2]))
    residual = distance - matrix @ exact.ravel()[used]
    damping = DAMPING * sparse.identity(len(used))
    correction = np.zeros(len(used))
    for _ in range(FIT_ROUNDS):
        system = sparse.vstack([sparse.diags(weight) @ matrix, damping]).tocsr()
        target = np.concatenate([weight * residual, np.zeros(len(used))])
        correction = lsqr(system, target, iter_lim=30)[0]
        left = np.abs(residual - matrix @ correction)
        typical = max(float(np.quantile(left, 0.9)), 1e-6)
        weight = weight * np.sqrt(np.clip(left / typical, 0.5, 4.0))
        weight /= weight.mean()
    fitted = exact.ravel().copy()
    fitted[used] += correction
    return fitted.reshape(exact.shape)
