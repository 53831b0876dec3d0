"""A reconstruction as scoring sees it: where it is solid, samples of its surface, or why it counts as empty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import igl
import numpy as np
import trimesh
from numpy.typing import NDArray

from tslam_bench.constants import OCCUPANCY_THRESHOLD, SURFACE_SAMPLES, VOXEL_EDGE, WORKSPACE_EDGE
from tslam_bench.errors import InvalidInputError
from tslam_bench.leaderboard.metrics import sample_surface
from tslam_bench.reconstruction.volume import Volume

SURFACE_SAMPLES_SEED: Final = 20211112
"""Seed of the samples on every predicted surface; another one than that of the true surfaces' samples, so that a surface
compared with itself has the distance of two samplings."""
MESH_BOUND: Final = WORKSPACE_EDGE / 2 + VOXEL_EDGE
"""Largest absolute coordinate of a valid mesh prediction (m): W and one voxel more."""


@dataclass(frozen=True)
class Prediction:
    """A prediction prepared for the metrics.

    Attributes:
        reason: why the prediction counts as empty; None if it does not.
        solid: (M,) bool at the points asked for.
        probability: (M,) float32 at the points asked for; None if there is none: a mesh, or no reconstruction.
        points, normals: (N, 3) area-uniform surface samples (m, object frame) and unit normals; (0, 3) if empty.
    """

    reason: str | None
    solid: NDArray[np.bool_]
    probability: NDArray[np.float32] | None
    points: NDArray[np.float64]
    normals: NDArray[np.float64]


def invalid_mesh(mesh: trimesh.Trimesh) -> str | None:
    """Why ``mesh`` (metres, object frame) is no valid prediction, or None."""
    if len(mesh.faces) == 0:
        return "the mesh has no faces"
    if not np.isfinite(mesh.vertices).all():
        return "the mesh has vertices that are not finite"
    reach = float(np.abs(mesh.vertices[np.unique(mesh.faces)]).max())
    if reach > MESH_BOUND:
        return f"the mesh reaches {reach:.4g} m from the origin, outside the workspace (metres? object frame?)"
    if not mesh.is_watertight or not mesh.is_winding_consistent:
        return "the mesh is not watertight with consistent faces"
    if mesh.volume <= 0:
        return "the mesh encloses no volume or its faces point inwards"
    return None


def solid_in_mesh(mesh: trimesh.Trimesh, points: NDArray) -> NDArray[np.bool_]:
    """(M,) bool: ``points`` (M, 3) m inside the closed ``mesh``, by generalised winding number at least one half."""
    points = np.asarray(points, dtype=np.float64)
    solid = np.zeros(len(points), dtype=bool)
    near = ((points >= mesh.bounds[0]) & (points <= mesh.bounds[1])).all(axis=1)
    if near.any():
        vertices, faces = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
        solid[near] = igl.fast_winding_number(vertices, faces, points[near]) >= 0.5
    return solid


def prepare(
    reconstruction: Volume | trimesh.Trimesh | None, points: NDArray, samples: int = SURFACE_SAMPLES
) -> Prediction:
    """Evaluates a reconstruction at ``points`` (M, 3) m and samples its surface.

    A missing, empty or invalid reconstruction gives an empty prediction with its reason; nothing is dropped.
    """
    if reconstruction is None:
        return _empty("missing", len(points))
    probability = None
    if isinstance(reconstruction, Volume):
        probability = reconstruction.query(points)
        try:
            triangles = reconstruction.triangles()
        except InvalidInputError as error:
            return _empty(str(error), len(points), probability)
        solid = probability >= OCCUPANCY_THRESHOLD
    else:
        reason = invalid_mesh(reconstruction)
        if reason is not None:
            return _empty(reason, len(points))
        triangles = np.asarray(reconstruction.triangles, dtype=np.float64)
        solid = solid_in_mesh(reconstruction, points)
    generator = np.random.Generator(np.random.PCG64(SURFACE_SAMPLES_SEED))
    try:
        surface, normals = sample_surface(triangles, samples, generator)
    except ValueError:  # no triangles, or none with an area: a sample alone at the threshold
        return _empty("nothing is solid", len(points), probability)
    return Prediction(None, solid, probability, surface, normals)


def _empty(reason: str, count: int, probability: NDArray[np.float32] | None = None) -> Prediction:
    return Prediction(reason, np.zeros(count, dtype=bool), probability, np.zeros((0, 3)), np.zeros((0, 3)))
