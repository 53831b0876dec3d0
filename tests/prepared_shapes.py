"""Prepared objects made from primitives, by real computation that shares no code with the asset pipeline.

``from prepared_shapes import prepared_box, prepared_sphere, prepared_torus``
"""

from __future__ import annotations

import itertools

import igl
import numpy as np
import trimesh

from tslam_bench.constants import GRID_SIZE, SURFACE_SAMPLES, VOXEL_EDGE
from tslam_bench.geometry.sampling import iou_cells, iou_points
from tslam_bench.grids import points_to_grid, voxel_centres
from tslam_bench.objects.store import PreparedObject, SignedDistanceField


def inside(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """(M,) bool: exact winding number above one half."""
    return igl.winding_number(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64), points) > 0.5


def crossed_voxels(mesh: trimesh.Trimesh) -> np.ndarray:
    """(32, 32, 32) bool: voxels that hold a point of the surface, on a net finer than a tenth of a voxel."""
    vertices, _ = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, max_edge=VOXEL_EDGE / 10, max_iter=20)
    return points_to_grid(vertices)


def prepare_primitive(
    mesh: trimesh.Trimesh, hulls: list[trimesh.Trimesh], name: str = "primitive", spacing: float = 2e-3
) -> PreparedObject:
    """PreparedObject of a watertight ``mesh``, the union of convex ``hulls`` (m, centred on its bounding box)."""
    vertices, faces = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    generator = np.random.default_rng(0)
    points, face = trimesh.sample.sample_surface(mesh, SURFACE_SAMPLES, seed=generator)
    hull_arrays = tuple((np.array(h.vertices, dtype=np.float64), np.array(h.faces, dtype=np.int64)) for h in hulls)

    padding = 0.02
    origin = mesh.bounds[0] - padding
    counts = np.ceil((mesh.extents + 2 * padding) / spacing).astype(int) + 1
    grid = origin + spacing * np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1)
    distances = [igl.signed_distance(grid.reshape(-1, 3), v, f)[0] for v, f in hull_arrays]
    centres = voxel_centres().reshape(-1, 3)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    cells = iou_cells(low, high, mesh.volume)
    solid_at_iou_points = inside(mesh, iou_points(low, high, cells).points)
    return PreparedObject(
        name=name,
        split="test",
        category="primitive",
        vertices=vertices,
        faces=faces,
        hulls=hull_arrays,
        field=SignedDistanceField(
            origin=np.array(origin),
            spacing=spacing,
            values=np.min(distances, axis=0).reshape(counts).astype(np.float32),
            surface_error=spacing,  # a bound: trilinear interpolation of a 1-Lipschitz function errs less than this
        ),
        solid=inside(mesh, centres).reshape((GRID_SIZE,) * 3),
        surface=crossed_voxels(mesh),
        surface_points=points.astype(np.float32),
        surface_normals=mesh.face_normals[face].astype(np.float32),
        iou_cells=cells,
        solid_at_iou_points=solid_at_iou_points,
        raw_solid_at_iou_points=solid_at_iou_points.copy(),
        record={"name": name, "split": "test", "source": "primitive", "extents": mesh.extents.tolist()},
    )


def prepared_box(extents: tuple[float, float, float] = (0.12, 0.08, 0.06), name: str = "box") -> PreparedObject:
    """A box with edges ``extents`` (m)."""
    mesh = trimesh.creation.box(extents=extents)
    return prepare_primitive(mesh, [mesh], name)


def prepared_sphere(radius: float = 0.05, name: str = "sphere") -> PreparedObject:
    """An icosphere of 1,280 faces inscribed in the sphere of ``radius`` (m)."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return prepare_primitive(mesh, [mesh], name)


def prepared_torus(
    major: float = 0.045, minor: float = 0.018, name: str = "torus", sectors: int = 32
) -> PreparedObject:
    """A torus about z: circle of radius ``minor`` (m) swept on a circle of radius ``major`` (m).

    Its hulls are its sectors, which are convex: the prisms between neighbouring sections.
    """
    mesh = trimesh.creation.torus(major, minor, major_sections=sectors, minor_sections=24)
    turns = 2 * np.pi * np.arange(sectors + 1) / sectors
    section = 2 * np.pi * np.arange(24) / 24
    ring = np.stack([major + minor * np.cos(section), np.zeros(24), minor * np.sin(section)], axis=1)
    rings = [trimesh.transform_points(ring, trimesh.transformations.rotation_matrix(t, [0, 0, 1])) for t in turns]
    hulls = [trimesh.convex.convex_hull(np.concatenate(pair)) for pair in itertools.pairwise(rings)]
    return prepare_primitive(mesh, hulls, name, spacing=3e-3)


def surface_grid(prepared: PreparedObject) -> np.ndarray:
    """Voxels of an ideal explorer, (32, 32, 32) bool: all that hold a surface sample."""
    return points_to_grid(prepared.surface_points)
