"""A reconstruction as scoring sees it: where it is solid, samples of its surface, or why it counts as empty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import label

from tslam_bench.compiled import njit
from tslam_bench.constants import OCCUPANCY_THRESHOLD, SURFACE_SAMPLES, VOXEL_EDGE, WORKSPACE_EDGE
from tslam_bench.errors import InvalidInputError
from tslam_bench.geometry.crossings import crossing_numbers
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring.metrics import sample_surface

SURFACE_SAMPLES_SEED: Final = 20211112
"""Seed of the samples on every predicted surface; another one than that of the true surfaces' samples, so that a surface
compared with itself has the distance of two samplings."""
_CELLS: Final = 64
"""Cells along the longest edge of a mesh's box."""
_MOST_WORK: Final = 50_000_000
"""Cells marked for all faces together, before marking is given up."""
_MOST_EVALUATIONS: Final = 100_000_000
"""Faces looked at for all points together, as estimated, before crossings are counted instead: 7 s on one core."""
_MOST_CROSSINGS: Final = 500_000_000
"""Comparisons of points and faces, before a mesh counts as empty: 5 s on one core."""
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
    """(M,) bool: ``points`` (M, 3) m inside the closed ``mesh``, by generalised winding number at least one half.

    The number is the same all over a region that no face crosses. So the mesh's box is cut into cells; in each set of cells
    that hang together and that no face comes near, one point decides for all, and only points in the other cells are looked
    at one by one.

    Raises:
        InvalidInputError: very many faces are very long, so that it would take too much work.
    """
    points = np.asarray(points, dtype=np.float64)
    solid = np.zeros(len(points), dtype=bool)
    near = np.flatnonzero(((points >= mesh.bounds[0]) & (points <= mesh.bounds[1])).all(axis=1))
    if len(near) == 0:
        return solid
    vertices, faces = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    edge = max(float(mesh.extents.max()) / _CELLS, 1e-9)
    x, y, z = (int(size) for size in mesh.extents // edge + 1)
    shape = (x, y, z)
    regions, count = label(~_cells_near_faces((vertices - mesh.bounds[0]) / edge, faces, shape, _MOST_WORK))
    cells = np.minimum(((points[near] - mesh.bounds[0]) / edge).astype(np.int64), np.array(shape) - 1)
    region = regions[cells[:, 0], cells[:, 1], cells[:, 2]]
    known, first = np.unique(region, return_index=True)
    alone = np.flatnonzero(region == 0)
    asked = np.concatenate([first, alone])
    inside = _winds_around(vertices, faces, points[near[asked]])
    of_region = np.zeros(count + 1, dtype=bool)
    of_region[known] = inside[: len(first)]
    decided = of_region[region]
    decided[alone] = inside[len(first) :]
    solid[near] = decided
    return solid


def _winds_around(vertices: NDArray, faces: NDArray, points: NDArray) -> NDArray[np.bool_]:
    """(M,) bool: the closed mesh winds at least half around ``points`` (M, 3)."""
    import igl  # only meshes need it

    # A tree over the faces has to look at those that are nearer to a point than twice their own size.
    corners = vertices[faces]
    size = np.sqrt(np.square(corners - np.roll(corners, 1, axis=1)).sum(axis=2).max(axis=1))
    extent = np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0))
    if len(points) * np.minimum(1, (2 * size / extent) ** 3).sum() <= _MOST_EVALUATIONS:
        return igl.fast_winding_number(vertices, faces, points) >= 0.5
    numbers = crossing_numbers(vertices, faces, points, _MOST_CROSSINGS)
    if numbers is None:
        raise InvalidInputError("the mesh has too many long faces to tell its inside from its outside")
    return numbers >= 1


@njit(cache=True)
def _cells_near_faces(vertices: NDArray, faces: NDArray, shape: tuple[int, int, int], most_work: int) -> NDArray:
    """Cells (bool) that the bounding box of some face meets, with a margin for rounding; ``vertices`` in cell edges."""
    crossed = np.zeros(shape, dtype=np.bool_)
    work = 0
    low, high = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)
    for face in faces:
        for axis in range(3):
            a, b, c = vertices[face[0], axis], vertices[face[1], axis], vertices[face[2], axis]
            low[axis] = max(int(np.floor(min(a, b, c) - 1e-6)), 0)
            high[axis] = min(int(np.floor(max(a, b, c) + 1e-6)), shape[axis] - 1)
        work += (high[0] - low[0] + 1) * (high[1] - low[1] + 1) * (high[2] - low[2] + 1)
        if work > most_work:  # very many large faces: better not to sort cells at all
            crossed[:] = True
            return crossed
        crossed[low[0] : high[0] + 1, low[1] : high[1] + 1, low[2] : high[2] + 1] = True
    return crossed


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
        try:
            solid = solid_in_mesh(reconstruction, points)
        except InvalidInputError as error:
            return _empty(str(error), len(points))
    generator = np.random.Generator(np.random.PCG64(SURFACE_SAMPLES_SEED))
    try:
        surface, normals = sample_surface(triangles, samples, generator)
    except ValueError:  # no triangles, or none with an area: a sample alone at the threshold
        return _empty("nothing is solid", len(points), probability)
    return Prediction(None, solid, probability, surface, normals)


def _empty(reason: str, count: int, probability: NDArray[np.float32] | None = None) -> Prediction:
    return Prediction(reason, np.zeros(count, dtype=bool), probability, np.zeros((0, 3)), np.zeros((0, 3)))
