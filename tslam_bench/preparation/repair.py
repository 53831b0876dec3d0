"""Makes any mesh one watertight solid: keep it if it is clean, else rebuild its surface.

The ladder: a mesh that manifold3d accepts is kept as it is; one whose winding numbers are unambiguous is rebuilt from its
exact distance with the winding sign; anything else is rebuilt by rolling a ball around it.

Both ways of rebuilding can lose the inside of a closed body through an opening: inside and outside become one, and a shell comes
out. Where much less is left than the surface encloses with its openings closed, they are closed (``openings``), or it is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import manifold3d
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage import measure

from tslam_bench.errors import AssetError
from tslam_bench.geometry.distance import distance_to_mesh, winding_numbers
from tslam_bench.geometry.meshes import TriangleMesh, from_manifold, is_valid, simplify, to_manifold, union
from tslam_bench.geometry.sampling import sample_surface
from tslam_bench.preparation import openings

MAX_TRIANGLES = 8_000
"""Triangles of a ground-truth mesh."""
REMESH_PITCH = 0.5e-3
"""Sample spacing (m) when a surface is rebuilt ..."""
REMESH_CELLS = 320
"""... but never more than this many along the longest edge."""
AMBIGUOUS_SHARE = 1e-3
"""Winding numbers decide the sign where at most this share of points is further than 0.1 from an integer."""
BALL_CELLS = 160
"""Samples along the longest edge when a ball is rolled around a broken mesh."""
BALL_SHARE = 0.02
"""Radius of that ball as a share of the longest edge."""
BALL_OFFSET = 0.9
"""Outward offset of the rolled surface in sample spacings: less perforates sheets without thickness."""
LOST_SHARE = 0.5
"""The inside counts as lost when rebuilding leaves less than the rest of what the surface encloses with its openings closed. The
walls that a ball leaves, two of 1.1 % of the longest edge, are themselves half of a body that is only 5 % thick."""
MENDED_ERROR = 0.1
"""Largest relative difference between that volume and the one of the mended solid."""
CRUMB_VOLUME = 1e-9
"""Closed surfaces around less than this volume (m^3; a cubic millimetre) are dropped."""
_SEED = 20211108

Method = Literal["kept", "winding", "ball", "closed"]


@dataclass(frozen=True)
class Repaired:
    """A clean solid and how it came about.

    Attributes:
        solid: one connected watertight solid, at most ``MAX_TRIANGLES`` triangles.
        method: the step of the ladder that made it.
        kept_share: volume of the kept part by that of all parts.
    """

    solid: manifold3d.Manifold
    method: Method
    kept_share: float


def repair(mesh: TriangleMesh) -> Repaired:
    """Runs the repair ladder on a mesh in metres.

    Raises:
        AssetError: nothing solid can be made of it.
    """
    if not mesh.area() > 0:
        raise AssetError("the mesh has no area")
    method: Method = "kept"
    solid = to_manifold(mesh, merge=True)
    if is_valid(solid) and solid.volume() < 0:
        solid = to_manifold(TriangleMesh(mesh.vertices, mesh.faces[:, ::-1]), merge=True)
    if not is_valid(solid):
        solid, method = _rebuilt(mesh)
        closed = without_lost_inside(mesh, solid)
        if closed is not None:
            solid, method = closed, "closed"
    if not is_valid(solid) or solid.volume() <= 0:
        status = solid.status()
        reason = "it encloses no volume" if status == manifold3d.Error.NoError else status.name
        raise AssetError(f"no solid can be made of the mesh (repair by {method}: {reason})")
    solid, kept_share = largest_part(solid)
    simplified = _without_crumbs(simplify(solid, MAX_TRIANGLES))
    if not is_valid(simplified):
        raise AssetError("flat: nothing is left of the mesh when it is simplified")
    return Repaired(simplified, method, kept_share)


def _rebuilt(mesh: TriangleMesh) -> tuple[manifold3d.Manifold, Method]:
    if winding_is_unambiguous(mesh):
        return to_manifold(remesh_by_winding(mesh)), "winding"
    return to_manifold(remesh_by_ball(mesh)), "ball"


def without_lost_inside(mesh: TriangleMesh, solid: manifold3d.Manifold) -> manifold3d.Manifold | None:
    """The solid of the mesh with its damage closed, if ``solid`` lost the inside; None if it did not.

    Args:
        mesh: the mesh (m).
        solid: what was rebuilt from it.

    Raises:
        AssetError: the inside is lost through an opening of which nobody can say whether it is damage.
    """
    found = [o for o in openings.find_openings(mesh) if o.kind(mesh.extents) != "mouth"]
    if not found:
        return None
    volume = solid.volume() if is_valid(solid) else 0.0
    enclosed = _enclosed_volume(openings.close(mesh, found))
    if enclosed is None or volume >= (1 - LOST_SHARE) * enclosed:
        return None
    closed = openings.close(mesh, [o for o in found if o.kind(mesh.extents) == "damage"])
    mended = to_manifold(closed, merge=True)
    if not is_valid(mended):
        mended, _ = _rebuilt(closed)
    kept = mended.volume() if is_valid(mended) else 0.0
    if abs(kept - enclosed) <= MENDED_ERROR * enclosed:
        return mended
    widest = max(o.width for o in found)
    raise AssetError(
        f"repair would lose the inside through an opening of {1e3 * widest:.0f} mm ({1e6 * max(volume, kept):.0f} of "
        f"{1e6 * enclosed:.0f} cm3 would be left); close it, or give the wall a thickness"
    )


def _without_crumbs(solid: manifold3d.Manifold) -> manifold3d.Manifold:
    """The solid without the tiny closed surfaces that simplification can pinch off."""
    parts = solid.decompose()
    kept = [part for part in parts if abs(part.volume()) >= CRUMB_VOLUME]
    return solid if len(kept) == len(parts) or not kept else manifold3d.Manifold.compose(kept)


def largest_part(solid: manifold3d.Manifold) -> tuple[manifold3d.Manifold, float]:
    """The largest connected part with its inner voids, and its share of the whole volume.

    Parts that overlap are united first.
    """
    parts = solid.decompose()
    shells = [part for part in parts if part.volume() > 0]
    voids = [part for part in parts if part.volume() < 0]
    if len(shells) > 1:
        shells = [part for part in union(shells).decompose() if part.volume() > 0]
    if not shells:
        raise AssetError("the mesh encloses no volume")
    total = sum(part.volume() for part in shells)
    best = max(shells, key=lambda part: part.volume())
    share = float(best.volume() / total)
    for void in voids:
        outward = from_manifold(void)
        best = best - to_manifold(TriangleMesh(outward.vertices, outward.faces[:, ::-1]))
    return best, share


def winding_is_unambiguous(mesh: TriangleMesh, count: int = 20_000) -> bool:
    """Whether winding numbers are integers, zero or one, nearly everywhere in the bounding box."""
    return _inside_share(mesh, count) > 0


def _inside_share(mesh: TriangleMesh, count: int = 20_000) -> float:
    """Share of the bounding box that winding numbers call inside; 0 where they are ambiguous."""
    low, high = mesh.bounds
    points = np.random.default_rng(_SEED).uniform(low, high, (count, 3))
    winding = winding_numbers(points, mesh)
    ambiguous = (np.abs(winding - np.round(winding)) > 0.1) | (winding < -0.5)
    return float((winding > 0.5).mean()) if ambiguous.mean() <= AMBIGUOUS_SHARE else 0.0


def _enclosed_volume(mesh: TriangleMesh) -> float | None:
    """Volume (m^3) inside the mesh by winding numbers, to a few percent; None where they are ambiguous."""
    return float(np.prod(mesh.extents)) * _inside_share(mesh) or None


def grid_around(mesh: TriangleMesh, spacing: float, padding: float) -> tuple[NDArray[np.float64], tuple[int, int, int]]:
    """Origin and shape of a grid that covers the mesh with padding on every side."""
    low, high = mesh.bounds
    size = np.ceil((high - low + 2 * padding) / spacing).astype(int) + 1
    origin = (low + high) / 2 - (size - 1) * spacing / 2
    return origin, (int(size[0]), int(size[1]), int(size[2]))


def near_surface(
    mesh: TriangleMesh, origin: NDArray[np.float64], spacing: float, shape: tuple[int, int, int]
) -> NDArray[np.bool_]:
    """Grid samples whose cell neighbourhood the surface passes (from samples four to a spacing)."""
    count = int(np.clip(16 * mesh.area() / spacing**2, 20_000, 8_000_000))
    points, _ = sample_surface(mesh, count, np.random.default_rng(_SEED))
    index = np.round((np.concatenate([points, mesh.vertices]) - origin) / spacing).astype(int)
    near = np.zeros(shape, dtype=bool)
    near[tuple(np.clip(index, 0, np.array(shape) - 1).T)] = True
    return near


def isosurface(
    values: NDArray[np.float64], origin: NDArray[np.float64], spacing: float, level: float = 0.0
) -> TriangleMesh:
    """Marching cubes (solid where values < level), with samples nudged off the level so that the result is manifold."""
    shifted = values - level
    small = 0.02 * spacing
    shifted = np.where(np.abs(shifted) < small, np.where(shifted < 0, -small, small), shifted)
    vertices, faces, _, _ = measure.marching_cubes(shifted.astype(np.float32), 0.0, gradient_direction="descent")
    return TriangleMesh(origin + vertices.astype(np.float64) * spacing, faces.astype(np.int64))


def remesh_by_winding(mesh: TriangleMesh) -> TriangleMesh:
    """Rebuilds the surface from exact distances with the sign of the winding number."""
    spacing = max(REMESH_PITCH, float(mesh.extents.max()) / REMESH_CELLS)
    origin, shape = grid_around(mesh, spacing, 4 * spacing)
    band = ndimage.binary_dilation(near_surface(mesh, origin, spacing, shape), iterations=3)
    values = np.full(shape, 3 * spacing)
    index = np.argwhere(band)
    points = origin + index * spacing
    inside = winding_numbers(points, mesh) > 0.5
    values[band] = np.where(inside, -1, 1) * distance_to_mesh(points, mesh)
    # Away from the surface the sign is constant on connected regions: one winding number decides each.
    regions, count = ndimage.label(~band)
    if count:
        labels, first = np.unique(regions.ravel(), return_index=True)
        seeds = np.stack(np.unravel_index(first[labels > 0], shape), axis=1)
        solid_region = np.concatenate([[False], winding_numbers(origin + seeds * spacing, mesh) > 0.5])
        values[solid_region[regions]] = -3 * spacing
    return isosurface(values, origin, spacing)


def remesh_by_ball(mesh: TriangleMesh) -> TriangleMesh:
    """Rebuilds the surface that a ball feels when it rolls around the mesh; works on any triangle soup.

    Fills what the ball cannot enter (slits below its diameter, the inside of closed shells) and gives sheets without
    thickness a thickness of twice the offset.
    """
    longest = float(mesh.extents.max())
    spacing, radius = longest / BALL_CELLS, longest * BALL_SHARE
    origin, shape = grid_around(mesh, spacing, 2 * radius + 3 * spacing)
    distance = ndimage.distance_transform_edt(~near_surface(mesh, origin, spacing, shape)) * spacing
    band = np.abs(distance - radius) < 2 * spacing
    distance[band] = distance_to_mesh(origin + np.argwhere(band) * spacing, mesh)
    regions, _ = ndimage.label(distance >= radius)
    centres = regions == regions[0, 0, 0]
    to_centres, nearest = ndimage.distance_transform_edt(~centres, return_indices=True)
    # The nearest sample with room for the ball has a little room to spare: the ball itself can come that much closer.
    spare = distance[tuple(nearest)] - radius
    return isosurface(radius - BALL_OFFSET * spacing - (to_centres * spacing - spare), origin, spacing)
