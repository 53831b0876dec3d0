"""Fills inner voids that touch can never feel (protocol section 8).

A void is *enclosed* when some ball of radius 4 mm or less fits into it but cannot get out. A closed shell's inside is one;
so is the inside of a pot whose openings are narrower than that. Open slits, grooves and holes are not, however narrow they
are: a ball small enough to be in one can leave it. The outside surface stays as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import manifold3d
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from tslam_bench.constants import REACHABLE_BALL_RADIUS
from tslam_bench.geometry.meshes import from_manifold, is_valid, simplify, to_manifold, union
from tslam_bench.geometry.scanline import inside_grid
from tslam_bench.preparation.repair import MAX_TRIANGLES, grid_around, isosurface, near_surface

RADII = (1.0e-3, 1.5e-3, 2.0e-3, 3.0e-3, REACHABLE_BALL_RADIUS)
"""Ball radii (m) that are tried, smallest first: the smallest that cannot leave a void seals it at its narrowest opening."""
MIN_ROOM = 100e-9
"""Voids are left alone unless a ball's centre has this much room (m^3) in them: less is a dimple."""
MIN_VOID_VOLUME = 100e-9
"""A filling below this volume (m^3) is not worth a change: a voxel has five times as much."""
OVERLAP = 1.5e-3
"""How far (m) a filling reaches into the wall around its void."""
FINEST_PITCH, COARSEST_PITCH, CELLS = 0.5e-3, 1.0e-3, 160
"""Sample spacing (m): the longest edge over ``CELLS``, within these limits."""


@dataclass(frozen=True)
class Filled:
    """A solid without unreachable voids.

    Attributes:
        solid: the filled solid.
        volume: volume (m^3) that was added; 0 when nothing was.
    """

    solid: manifold3d.Manifold
    volume: float


def fill_voids(solid: manifold3d.Manifold) -> Filled:
    """Fills every void of a watertight solid (in metres) that a ball of ``REACHABLE_BALL_RADIUS`` cannot enter from outside.

    Radii are judged on a grid, to within its spacing.
    """
    filled = without_closed_voids(solid)
    fillings = _fillings(filled)
    if fillings:
        filled = simplify(without_closed_voids(union([filled, *fillings])), MAX_TRIANGLES)
        filled = max(filled.decompose(), key=lambda part: part.volume())
    added = filled.volume() - solid.volume()
    return Filled(filled, added) if added > MIN_VOID_VOLUME else Filled(solid, 0.0)


def without_closed_voids(solid: manifold3d.Manifold) -> manifold3d.Manifold:
    """The solid without its inward-facing closed surfaces; exact."""
    parts = solid.decompose()
    shells = [part for part in parts if part.volume() > 0]
    return solid if len(shells) == len(parts) else union(shells)


def _fillings(solid: manifold3d.Manifold) -> list[manifold3d.Manifold]:
    """Solids that fill the enclosed voids of a solid and overlap the walls around them."""
    mesh = from_manifold(solid)
    pitch = float(np.clip(mesh.extents.max() / CELLS, FINEST_PITCH, COARSEST_PITCH))
    origin, shape = grid_around(mesh, pitch, 2 * REACHABLE_BALL_RADIUS + 3 * pitch)
    inside = inside_grid(mesh, origin, pitch, shape)
    blocked = inside | near_surface(mesh, origin, pitch, shape)
    clearance = ndimage.distance_transform_edt(~blocked) * pitch
    depth = np.full(shape, np.inf)  # below zero where something is filled in
    covered = np.zeros(shape, dtype=bool)
    for radius in RADII:
        regions, _ = ndimage.label(clearance >= radius)
        outside = regions == regions[0, 0, 0]
        enclosed = _large_parts((regions > 0) & ~outside & ~covered, MIN_ROOM / pitch**3)
        if not enclosed.any():
            continue
        void = _swept(enclosed, radius, pitch)
        covered |= void
        to_outside = ndimage.distance_transform_edt(~_swept(outside, radius, pitch)) * pitch
        depth = np.minimum(depth, _around(void, np.maximum(1.5 * pitch - to_outside, -OVERLAP), pitch))
    if not covered.any():
        return []
    # Slits beside a filling that have no way out any more are filled with it.
    empty, _ = ndimage.label(~inside & (depth > 0))
    pockets = (empty > 0) & (empty != empty[0, 0, 0])
    if pockets.any():
        depth = np.minimum(depth, ndimage.distance_transform_edt(~pockets) * pitch - 0.9 * pitch)
    filling = to_manifold(isosurface(np.minimum(depth, 2 * pitch), origin, pitch))
    return [part for part in filling.decompose() if part.volume() > MIN_VOID_VOLUME] if is_valid(filling) else []


def _around(void: NDArray[np.bool_], limit: NDArray[np.float64], pitch: float) -> NDArray[np.float64]:
    """A function below zero up to ``OVERLAP`` around ``void``, but nowhere where ``limit`` is not."""
    return np.maximum(ndimage.distance_transform_edt(~void) * pitch - OVERLAP, limit)


def _swept(centres: NDArray[np.bool_], radius: float, pitch: float) -> NDArray[np.bool_]:
    """Samples that balls of ``radius`` cover when their centres are at ``centres``."""
    return ndimage.distance_transform_edt(~centres) * pitch <= radius


def _large_parts(region: NDArray[np.bool_], min_count: float) -> NDArray[np.bool_]:
    """The connected parts of ``region`` that have at least ``min_count`` samples."""
    labels, _ = ndimage.label(region)
    size = np.bincount(labels.ravel())
    size[0] = 0
    return (size >= min_count)[labels]
