"""Shapes to learn from: surface samples, labelled query points, and a similarity that puts them anew into W.

A network must not learn the canonical orientation of its training objects, so each example turns, scales and centres
its shape again. Points and labels are computed once per shape, in its own frame, and carried along.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import WORKSPACE_EDGE, WORKSPACE_LOW
from tslam_bench.errors import InvalidInputError
from tslam_bench.geometry.triangles import areas, face_normals

NEAR_SURFACE_SIGMAS: Final = (0.02, 0.005)
"""Standard deviations of the near-surface query points about the surface (m): 2.6 and 0.6 voxels."""
SURFACE_POINTS: Final = 20_000
BOX_POINTS: Final = 20_000
NEAR_POINTS: Final = 10_000
"""Pool sizes per shape; near-surface points are per sigma."""
LOOKUP_SPACING: Final = 0.004
"""Spacing of the lookup that keeps the simulated hand out of the solid (m)."""
_LABEL_SHARES = (0.5, 0.5)  # near the surface, uniform in W; see `query_points`


@dataclass(frozen=True, eq=False)
class TrainingShape:
    """One watertight solid, in its own frame (bounding box centred on the origin), in metres.

    Attributes:
        name: for messages and the checkpoint's record.
        half_extents: (3,) of the bounding box.
        vertices: (V, 3) vertices of the convex hull: they bound the shape in every orientation.
        surface_points, surface_normals: (20000, 3) area-uniform samples and their outward face normals.
        box_points, box_inside: (20000, 3) uniform in the bounding box, and whether each is in the solid.
        near_points, near_inside: (2, 10000, 3) and (2, 10000): surface points with normal noise, one row per sigma.
        lookup: (nx, ny, nz) bool, solid at samples ``LOOKUP_SPACING`` apart; sample [1, 1, 1] is at ``-half_extents``, and
            the outermost samples are empty.
    """

    name: str
    half_extents: NDArray[np.float64]
    vertices: NDArray[np.float64]
    surface_points: NDArray[np.float64]
    surface_normals: NDArray[np.float64]
    box_points: NDArray[np.float64]
    box_inside: NDArray[np.bool_]
    near_points: NDArray[np.float64]
    near_inside: NDArray[np.bool_]
    lookup: NDArray[np.bool_]

    def inside(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether ``points`` (..., 3) in the shape's frame are in the solid, to the nearest sample of the lookup."""
        index = np.rint((points + self.half_extents) / LOOKUP_SPACING).astype(np.int64) + 1
        index = np.clip(index, 0, np.array(self.lookup.shape) - 1)  # the rim of the lookup is empty
        return np.asarray(self.lookup[index[..., 0], index[..., 1], index[..., 2]])


def training_shape(name: str, vertices: NDArray, faces: NDArray, generator: np.random.Generator) -> TrainingShape:
    """Samples a watertight mesh, (V, 3) in metres and (F, 3).

    Raises:
        InvalidInputError: the mesh has no area, is not finite, or does not fit into W.
    """
    from scipy.spatial import ConvexHull, QhullError

    from tslam_bench.geometry.distance import contains
    from tslam_bench.geometry.meshes import TriangleMesh

    vertices = np.asarray(vertices, dtype=np.float64)
    faces = np.asarray(faces, dtype=np.int64)
    if vertices.ndim != 2 or len(faces) == 0 or not np.isfinite(vertices).all():
        raise InvalidInputError(f"{name}: not a mesh with finite vertices (V, 3) and at least one face (F, 3)")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    vertices = vertices - (low + high) / 2
    half_extents = (high - low) / 2
    if (2 * half_extents > WORKSPACE_EDGE).any():
        raise InvalidInputError(f"{name}: {2 * half_extents.max():.3f} m long; scale it to fit into {WORKSPACE_EDGE} m")
    try:
        corners = vertices[ConvexHull(vertices).vertices]
    except QhullError as error:
        raise InvalidInputError(f"{name}: encloses no volume; training shapes must be watertight solids") from error

    triangles = vertices[faces]
    area = areas(triangles)
    chosen = generator.choice(len(faces), SURFACE_POINTS, p=area / area.sum())
    u, v = generator.random((2, SURFACE_POINTS, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    corner, first, second = triangles[chosen].transpose(1, 0, 2)
    surface_points = corner + u * (first - corner) + v * (second - corner)

    near_points = np.stack(
        [
            surface_points[generator.choice(SURFACE_POINTS, NEAR_POINTS)]
            + sigma * generator.standard_normal((NEAR_POINTS, 3))
            for sigma in NEAR_SURFACE_SIGMAS
        ]
    )
    box_points = half_extents * generator.uniform(-1, 1, (BOX_POINTS, 3))
    axes = [np.arange(-h, h + LOOKUP_SPACING, LOOKUP_SPACING) for h in half_extents]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    mesh = TriangleMesh(vertices, faces)
    lookup = contains(lattice.reshape(-1, 3), mesh).reshape(lattice.shape[:3])
    return TrainingShape(
        name=name,
        half_extents=half_extents,
        vertices=corners,
        surface_points=surface_points,
        surface_normals=face_normals(triangles[chosen]),
        box_points=box_points,
        box_inside=contains(box_points, mesh),
        near_points=near_points,
        near_inside=contains(near_points.reshape(-1, 3), mesh).reshape(near_points.shape[:2]),
        lookup=np.pad(lookup, 1),
    )


def axis_rotations() -> NDArray[np.int64]:
    """The 24 rotations that map the axes to axes: (24, 3, 3) signed permutations of determinant 1."""
    import itertools

    matrices = []
    for permutation in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            matrix = np.zeros((3, 3), dtype=np.int64)
            matrix[range(3), permutation] = signs
            if round(np.linalg.det(matrix)) == 1:
                matrices.append(matrix)
    return np.array(matrices)


@dataclass(frozen=True, eq=False)
class PlacedShape:
    """A training shape after a similarity, its bounding box again centred on the origin of W.

    Attributes:
        shape: the shape in its own frame.
        rotation, scale, translation: point in W = scale * rotation @ point + translation.
    """

    shape: TrainingShape
    rotation: NDArray[np.float64]
    scale: float
    translation: NDArray[np.float64]

    def to_workspace(self, points: NDArray) -> NDArray[np.float64]:
        """Points (..., 3) of the shape's frame in W."""
        return self.scale * (points @ self.rotation.T) + self.translation

    def inside(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether ``points`` (..., 3) of W are in the solid, to the nearest sample of the lookup."""
        return self.shape.inside((points - self.translation) @ self.rotation / self.scale)

    def surface(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Surface samples (20000, 3) in W and their outward normals."""
        return self.to_workspace(self.shape.surface_points), self.shape.surface_normals @ self.rotation.T

    def query_points(self, count: int, generator: np.random.Generator) -> tuple[NDArray, NDArray]:
        """Labelled training points: a half near the surface (equal parts per sigma), a half uniform in W.

        Returns:
            (count, 3) float32 in metres and (count,) float32, 1 inside the solid. Every point is in W.
        """
        near_count = round(count * _LABEL_SHARES[0])
        near = self.shape.near_points.reshape(-1, 3)
        near_inside = self.shape.near_inside.reshape(-1)
        near, near_inside = _draw_in_workspace(self.to_workspace, near, near_inside, near_count, generator)

        # Uniform in W: a point that falls into the shape's (turned) bounding box is replaced by one of the pool, which
        # is uniform in that box and has an exact label; everything outside the box is outside the solid.
        uniform = WORKSPACE_LOW + WORKSPACE_EDGE * generator.random((count - near_count, 3))
        local = (uniform - self.translation) @ self.rotation / self.scale
        in_box = (np.abs(local) <= self.shape.half_extents).all(axis=1)
        uniform_inside = np.zeros(len(uniform), dtype=bool)
        uniform[in_box], uniform_inside[in_box] = _draw_in_workspace(
            self.to_workspace, self.shape.box_points, self.shape.box_inside, int(in_box.sum()), generator
        )
        points = np.concatenate([near, uniform]).astype(np.float32)
        return points, np.concatenate([near_inside, uniform_inside]).astype(np.float32)


def _draw_in_workspace(to_workspace, pool, labels, count, generator):
    """``count`` points of the pool with their labels, uniformly among those that land in W."""
    chosen = np.zeros(0, dtype=np.int64)
    while len(chosen) < count:
        candidates = generator.choice(len(pool), 2 * count + 16)
        within = (np.abs(to_workspace(pool[candidates])) < WORKSPACE_EDGE / 2).all(axis=1)
        chosen = np.concatenate([chosen, candidates[within]])
    chosen = chosen[:count]
    return to_workspace(pool[chosen]), labels[chosen]


def place(
    shape: TrainingShape,
    generator: np.random.Generator,
    scale_range: tuple[float, float] = (0.8, 1.2),
    continuous_rotation: bool = False,
) -> PlacedShape:
    """Draws a rotation (one of 24, or uniform over all) and a scale, and centres the bounding box in W.

    The scale is uniform in ``scale_range``, reduced where the turned shape would not fit into W.
    """
    if continuous_rotation:
        from scipy.spatial.transform import Rotation

        rotation = Rotation.random(random_state=np.random.RandomState(int(generator.integers(2**31)))).as_matrix()
    else:
        rotation = axis_rotations()[generator.integers(24)].astype(np.float64)
    scale = float(generator.uniform(*scale_range))
    turned = shape.vertices @ rotation.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    scale = min(scale, 0.98 * WORKSPACE_EDGE / float((high - low).max()))
    return PlacedShape(shape, rotation, scale, -scale * (low + high) / 2)
