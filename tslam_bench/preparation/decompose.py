"""Convex decomposition for the simulator: CoACD, then few-cornered hulls that keep their volume.

CoACD: Wei et al., "Approximate convex decomposition for 3D meshes with collision-aware concavity and tree search",
SIGGRAPH 2022. PhysX on GPU takes at most 64 vertices and 64 polygons per hull; a triangulated hull of V vertices has
2 V - 4 faces, hence at most 34 vertices.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import zipfile
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import manifold3d
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from tslam_bench.errors import AssetError
from tslam_bench.files import atomic_file
from tslam_bench.geometry.meshes import TriangleMesh, from_manifold, is_valid, simplify, to_manifold, union
from tslam_bench.geometry.moments import centroid, volume
from tslam_bench.objects.hulls import pack_hulls, unpack_hulls

MAX_HULL_VERTICES = 34
"""Vertices of one hull, so that its triangles number at most 64."""
MIN_HULL_VOLUME = 1e-11
"""Hulls below this volume (m^3; a hundredth of a cubic millimetre) are dropped: the simulator cannot cook them."""


@dataclass(frozen=True)
class DecompositionSettings:
    """CoACD's parameters, and how far its input is simplified.

    Attributes:
        threshold: concavity at which cutting stops.
        max_hulls: most hulls.
        iterations, nodes, depth: Monte-Carlo tree search.
        resolution: sampling resolution of the concavity.
        input_triangles: the mesh is simplified to this many triangles first.
        seed: CoACD's seed; equal seeds give equal bytes.
    """

    threshold: float = 0.03
    max_hulls: int = 64
    iterations: int = 60
    nodes: int = 10
    depth: int = 2
    resolution: int = 1000
    input_triangles: int = 3000
    seed: int = 0


STANDARD = DecompositionSettings()

_FINE = DecompositionSettings(threshold=0.02, max_hulls=128)
_FINEST = DecompositionSettings(threshold=0.01, max_hulls=128)
EXCEPTIONS: dict[str, DecompositionSettings] = {
    "test/bowl": _FINE,
    "test/cup": _FINE,  # a finer cut is merged back to 128 hulls, and ends up worse
    "test/eyeglasses": _FINEST,
    "test/fryingpan": _FINEST,
    "test/wineglass": _FINEST,
}
"""Thin-walled objects, whose walls the standard settings thicken: split/name -> settings."""


def settings_for(split: str, name: str) -> DecompositionSettings:
    """The settings of one object."""
    return EXCEPTIONS.get(f"{split}/{name}", STANDARD)


def cache_key(mesh: TriangleMesh, settings: DecompositionSettings) -> str:
    """Hash of everything that decides the hulls: mesh bytes, settings, hull limits and CoACD's version."""
    digest = hashlib.sha256()
    digest.update(mesh.vertices.tobytes())
    digest.update(mesh.faces.tobytes())
    parameters = dataclasses.asdict(settings) | {
        "coacd": version("coacd"),
        "max_hull_vertices": MAX_HULL_VERTICES,
        "min_hull_volume": MIN_HULL_VOLUME,
    }
    digest.update(json.dumps(parameters, sort_keys=True).encode())
    return digest.hexdigest()


def decompose(mesh: TriangleMesh, settings: DecompositionSettings = STANDARD) -> list[TriangleMesh]:
    """Splits a watertight mesh into convex hulls of at most 34 vertices and 64 faces.

    Raises:
        AssetError: CoACD fails or leaves nothing.
    """
    import coacd

    reduced = from_manifold(simplify(to_manifold(mesh), settings.input_triangles))
    coacd.set_log_level("off")
    try:
        parts = coacd.run_coacd(
            coacd.Mesh(reduced.vertices, reduced.faces),
            threshold=settings.threshold,
            max_convex_hull=settings.max_hulls,
            preprocess_mode="off",
            resolution=settings.resolution,
            mcts_nodes=settings.nodes,
            mcts_iterations=settings.iterations,
            mcts_max_depth=settings.depth,
            decimate=False,
            seed=settings.seed,
        )
    except RuntimeError as error:
        raise AssetError(f"convex decomposition failed ({error})") from error
    hulls = [hull for vertices, _ in parts if (hull := reduce_hull(np.asarray(vertices, dtype=np.float64))) is not None]
    if not hulls:
        raise AssetError("convex decomposition left no hull")
    return hulls


def decompose_cached(mesh: TriangleMesh, settings: DecompositionSettings, directory: Path) -> list[TriangleMesh]:
    """:func:`decompose` with its result kept in ``directory`` under :func:`cache_key`."""
    path = directory / f"{cache_key(mesh, settings)}.npz"
    if path.exists():
        try:
            with np.load(path) as data:
                packed = data["vertices"], data["faces"], data["offsets"]
                return [TriangleMesh(*hull) for hull in unpack_hulls(*packed)]
        except (OSError, ValueError, KeyError, IndexError, EOFError, zipfile.BadZipFile):
            path.unlink(missing_ok=True)  # a damaged entry is computed again
    hulls = decompose(mesh, settings)
    vertices, faces, offsets = pack_hulls(hulls)
    with atomic_file(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, vertices=vertices, faces=faces, offsets=offsets)
    return hulls


def convex_hull(points: NDArray[np.float64]) -> TriangleMesh | None:
    """Convex hull (M, 3) -> mesh with outward faces and only the hull's vertices; None if it is flat."""
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return None
    faces = hull.simplices.astype(np.int64)
    a, b, c = points[faces].transpose(1, 0, 2)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    used, inverse = np.unique(faces, return_inverse=True)
    return TriangleMesh(points[used], inverse.reshape(-1, 3).astype(np.int64))


def reduce_hull(points: NDArray[np.float64], max_vertices: int = MAX_HULL_VERTICES) -> TriangleMesh | None:
    """Convex hull of at most ``max_vertices`` vertices with the volume of the full hull.

    Vertices are inserted one by one, always the one furthest outside the hull so far; the result is then scaled about its
    centroid so that cutting corners costs no volume.

    Args:
        points: (M, 3) metres.
        max_vertices: most vertices.

    Returns:
        the hull, or None if the points are flat or the hull is too small to simulate.
    """
    full = convex_hull(points)
    if full is None or volume(full) < MIN_HULL_VOLUME:
        return None
    if len(full.vertices) <= max_vertices:
        return full
    corners = full.vertices
    chosen = _extreme_simplex(corners)
    while len(chosen) < max_vertices:
        try:
            planes = ConvexHull(corners[chosen]).equations
        except QhullError:
            return None
        outside = (corners @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        outside[chosen] = -np.inf
        furthest = int(outside.argmax())
        if outside[furthest] <= 1e-9:
            break
        chosen.append(furthest)
    reduced = convex_hull(corners[chosen])
    if reduced is None:
        return None
    factor = (volume(full) / volume(reduced)) ** (1 / 3)
    centre = centroid(reduced)
    return TriangleMesh(centre + factor * (reduced.vertices - centre), reduced.faces)


def _extreme_simplex(points: NDArray[np.float64]) -> list[int]:
    """Indices of four points that span a large tetrahedron."""
    first = int(points[:, 0].argmin())
    chosen = [first, int(np.linalg.norm(points - points[first], axis=1).argmax())]
    axis = points[chosen[1]] - points[first]
    chosen.append(int(np.linalg.norm(np.cross(points - points[first], axis), axis=1).argmax()))
    normal = np.cross(axis, points[chosen[2]] - points[first])
    chosen.append(int(np.abs((points - points[first]) @ normal).argmax()))
    return chosen


def hull_union(hulls: list[TriangleMesh]) -> manifold3d.Manifold:
    """The solid that the hulls cover together."""
    solids = [solid for solid in (to_manifold(hull) for hull in hulls) if is_valid(solid)]
    if len(solids) != len(hulls):
        raise AssetError(f"{len(hulls) - len(solids)} of {len(hulls)} collision hulls are not solid")
    return union(solids)


def intersection_over_union(first: manifold3d.Manifold, second: manifold3d.Manifold) -> float:
    """Exact volumetric IoU of two solids."""
    common = (first ^ second).volume()
    return float(common / (first.volume() + second.volume() - common))
