"""Triangle meshes as plain arrays, and their passage through manifold3d.

A mesh here is a pair ``vertices`` (V, 3) float64 in metres and ``faces`` (F, 3) int64, counter-clockwise from outside.
"""

from __future__ import annotations

import io
from typing import NamedTuple

import manifold3d
import numpy as np
import trimesh
from numpy.typing import NDArray

from tslam_bench.errors import AssetError
from tslam_bench.geometry import triangles


class TriangleMesh(NamedTuple):
    """vertices (V, 3) float64 in metres, faces (F, 3) int64."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]

    @property
    def bounds(self) -> NDArray[np.float64]:
        """(2, 3) lower and upper corner of the bounding box (m)."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @property
    def extents(self) -> NDArray[np.float64]:
        """(3,) edges of the bounding box (m)."""
        low, high = self.bounds
        return high - low

    def translated(self, offset: NDArray[np.float64]) -> TriangleMesh:
        """The mesh moved by ``offset`` (3,)."""
        return TriangleMesh(self.vertices + offset, self.faces)

    def triangles(self) -> NDArray[np.float64]:
        """(F, 3, 3) corners of every face."""
        return self.vertices[self.faces]

    def face_normals(self) -> NDArray[np.float64]:
        """(F, 3) unit normals, zero for degenerate faces."""
        return triangles.face_normals(self.triangles())

    def area(self) -> float:
        """Area of the surface."""
        return float(triangles.areas(self.triangles()).sum())


def parse_stl(data: bytes) -> TriangleMesh:
    """Reads an STL file, merging equal vertices. Raises AssetError when the bytes hold no finite triangle."""
    try:
        loaded = trimesh.load_mesh(io.BytesIO(data), file_type="stl")
    except Exception as error:  # trimesh raises many kinds for a file that is not what it says
        raise AssetError(f"not a readable STL file ({type(error).__name__}: {error})") from error
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0 or not np.isfinite(loaded.vertices).all():
        raise AssetError("not a mesh: no triangles, or vertices that are not finite")
    return TriangleMesh(np.array(loaded.vertices, dtype=np.float64), np.array(loaded.faces, dtype=np.int64))


def to_manifold(mesh: TriangleMesh, merge: bool = False) -> manifold3d.Manifold:
    """The mesh as a manifold3d solid; its ``status()`` tells whether it is a clean manifold.

    Args:
        mesh: the mesh.
        merge: also close cracks between vertices that coincide within manifold3d's tolerance (for files; single precision).
    """
    if merge:
        single = manifold3d.Mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
        single.merge()
        return manifold3d.Manifold(single)
    return manifold3d.Manifold(manifold3d.Mesh64(mesh.vertices, mesh.faces.astype(np.uint64)))


def from_manifold(solid: manifold3d.Manifold) -> TriangleMesh:
    """The surface of a manifold3d solid."""
    mesh = solid.to_mesh64()
    vertices = np.array(mesh.vert_properties, dtype=np.float64)[:, :3]
    faces = np.array(mesh.tri_verts, dtype=np.int64)
    if len(mesh.merge_from_vert):  # vertices that are one corner but carry different properties
        target = np.arange(len(vertices))
        target[np.asarray(mesh.merge_from_vert, dtype=np.int64)] = np.asarray(mesh.merge_to_vert, dtype=np.int64)
        used, inverse = np.unique(target[faces], return_inverse=True)
        return TriangleMesh(vertices[used], inverse.reshape(-1, 3).astype(np.int64))
    return TriangleMesh(vertices, faces)


def is_valid(solid: manifold3d.Manifold) -> bool:
    """True for a manifold solid with something in it."""
    return solid.status() == manifold3d.Error.NoError and not solid.is_empty()


def union(solids: list[manifold3d.Manifold]) -> manifold3d.Manifold:
    """Boolean union of solids that may overlap."""
    return manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)


def simplify(solid: manifold3d.Manifold, max_triangles: int) -> manifold3d.Manifold:
    """The solid with at most ``max_triangles`` triangles, at a tolerance (m) that grows until this is reached.

    The tolerance has to grow in small steps: one large step leaves manifold3d stuck at many triangles and large errors.
    Even a mesh that is small enough loses its exactly coplanar triangles.
    """
    longest = float(np.ptp(np.reshape(solid.bounding_box(), (2, 3)), axis=0).max())
    tolerance = 1e-6 * longest
    solid = solid.simplify(tolerance)
    while solid.num_tri() > max_triangles and tolerance < 0.1 * longest:
        tolerance = max(1.25 * tolerance, 2e-5 * longest)
        solid = solid.simplify(tolerance)
    return solid
