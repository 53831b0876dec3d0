"""Building blocks of the shape generator: turned, swept, extruded and rounded solids, on manifold3d.

Units are free (the generator scales its result); z is up. Every function returns a watertight solid.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator

from tslam_bench.geometry.meshes import TriangleMesh, to_manifold, union

SEGMENTS = 48
"""Segments of a full turn."""


def smooth_profile(knots: ArrayLike, count: int = 40) -> NDArray[np.float64]:
    """A profile (count, 2) of (radius, z) through ``knots`` (K, 2) with increasing z, without overshoot."""
    points = np.asarray(knots, dtype=float)
    z = np.linspace(points[0, 1], points[-1, 1], count)
    return np.column_stack([np.maximum(PchipInterpolator(points[:, 1], points[:, 0])(z), 1e-3), z])


def lathe(profile: ArrayLike, segments: int = SEGMENTS) -> Manifold:
    """Solid of revolution about z: ``profile`` (N, 2) of (radius, z) from bottom to top, closed along the axis."""
    points = np.asarray(profile, dtype=float)
    closed = np.vstack([[0.0, points[0, 1]], points, [0.0, points[-1, 1]]])
    return _turn(closed, segments)


def ring(section: ArrayLike, segments: int = SEGMENTS) -> Manifold:
    """Solid of revolution about z of a closed polygon (N, 2) of (radius, z) that stays off the axis."""
    return _turn(np.asarray(section, dtype=float), segments)


def _turn(polygon: NDArray[np.float64], segments: int) -> Manifold:
    return CrossSection([_counterclockwise(polygon)]).revolve(segments)


def _counterclockwise(polygon: NDArray[np.float64]) -> NDArray[np.float64]:
    """The polygon (N, 2) in the order that encloses it from the left: the other one counts as empty."""
    x, y = polygon.T
    return polygon[::-1] if np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) < 0 else polygon


def vessel(profile: ArrayLike, wall: float, floor: float | None = None) -> Manifold:
    """An open vessel: the turned ``profile`` (radius, z) minus the same profile moved in by ``wall``, above a ``floor``."""
    outer = np.asarray(profile, dtype=float)
    floor = wall if floor is None else floor
    bottom, top = outer[0, 1], outer[-1, 1]
    tangent = np.gradient(outer, axis=0)
    normal = np.column_stack([tangent[:, 1], -tangent[:, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    z = np.linspace(bottom + floor, top, len(outer))
    slant = np.clip(np.abs(normal[:, 0]), 0.35, 1.0)  # horizontal thickness of a slanting wall
    inner_radius = np.interp(z, outer[:, 1], outer[:, 0] - wall / slant)
    if inner_radius.max() <= 0.05 * outer[:, 0].max():
        return lathe(outer)
    inner = np.column_stack([np.maximum(inner_radius, 1e-3), z])
    inner = np.vstack([inner, [inner[-1, 0], top + wall]])
    return lathe(outer) - lathe(inner)


def circle(radius: float, segments: int = 24) -> NDArray[np.float64]:
    """Corners (segments, 2) of a regular polygon."""
    angle = np.arange(segments) * (2 * np.pi / segments)
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def superellipse(a: float, b: float, power: float, segments: int = 48) -> NDArray[np.float64]:
    """Corners (segments, 2) of |x/a|^power + |y/b|^power = 1."""
    angle = np.arange(segments) * (2 * np.pi / segments)
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([a * np.sign(c) * np.abs(c) ** (2 / power), b * np.sign(s) * np.abs(s) ** (2 / power)])


def spline(knots: ArrayLike, count: int = 32) -> NDArray[np.float64]:
    """Smooth curve (count, D) through ``knots`` (K, D)."""
    points = np.asarray(knots, dtype=float)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return CubicSpline(length, points, bc_type="natural")(np.linspace(0, length[-1], count))


def sweep(
    path: ArrayLike,
    section: ArrayLike | float,
    scale: ArrayLike | None = None,
    side: Sequence[float] = (0.0, 0.0, 1.0),
) -> Manifold:
    """A section carried along a path.

    Args:
        path: (N, 3) points; must not turn more sharply than the section is wide.
        section: corners (S, 2) of a convex polygon in the plane across the path, or the radius of a round one.
        scale: (N,) factors along the path (default: ones).
        side: direction that the section's second axis leans to.
    """
    points = np.asarray(path, dtype=float)
    corners = circle(section, 20) if isinstance(section, float | int) else np.asarray(section, dtype=float)
    factors = np.ones(len(points)) if scale is None else np.asarray(scale, dtype=float)
    tangent = np.gradient(points, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    up = np.asarray(side, dtype=float)
    if np.abs(tangent @ up).max() > 0.99:  # the path runs along that direction somewhere: carry a frame along it
        across, up_axis = _transported_frames(tangent)
    else:
        across = np.cross(up, tangent)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        up_axis = np.cross(tangent, across)
    rings = points[:, None] + factors[:, None, None] * (
        corners[None, :, :1] * across[:, None] + corners[None, :, 1:] * up_axis[:, None]
    )
    n, s = rings.shape[:2]
    start, end = n * s, n * s + 1
    vertices = np.vstack([rings.reshape(-1, 3), points[0], points[-1]])
    i, j = np.meshgrid(np.arange(n - 1), np.arange(s), indexing="ij")
    a, b = i * s + j, i * s + (j + 1) % s
    c, d = a + s, b + s
    k = np.arange(s)
    following, last = (k + 1) % s, (n - 1) * s
    faces = np.concatenate(
        [
            np.stack([a, b, d], -1).reshape(-1, 3),
            np.stack([a, d, c], -1).reshape(-1, 3),
            np.column_stack([following, k, np.full(s, start)]),
            np.column_stack([last + k, last + following, np.full(s, end)]),
        ]
    )
    solid = to_manifold(TriangleMesh(vertices, faces.astype(np.int64)))
    if solid.volume() < 0:
        solid = to_manifold(TriangleMesh(vertices, faces[:, ::-1].astype(np.int64)))
    return solid


def _transported_frames(tangent: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Frames across a path that do not twist."""
    first = np.cross(tangent[0], np.eye(3)[np.abs(tangent[0]).argmin()])
    across = [first / np.linalg.norm(first)]
    for t in tangent[1:]:
        carried = across[-1] - (across[-1] @ t) * t
        across.append(carried / np.linalg.norm(carried))
    return np.array(across), np.cross(tangent, np.array(across))


def box(x: float, y: float, z: float, radius: float = 0.0) -> Manifold:
    """A box centred on the origin, with rounded edges if ``radius`` > 0."""
    if radius <= 0:
        return Manifold.cube([x, y, z], center=True)
    radius = min(radius, 0.49 * min(x, y, z))
    core = np.array([x, y, z]) / 2 - radius
    corner = Manifold.sphere(radius, 16)
    signs = np.array(list(np.ndindex(2, 2, 2))) * 2 - 1
    return Manifold.batch_hull([corner.translate(sign * core) for sign in signs])


def ellipsoid(x: float, y: float, z: float) -> Manifold:
    """An ellipsoid with the given semi-axes, centred on the origin."""
    return Manifold.sphere(1.0, 40).scale([x, y, z])


def capsule(start: ArrayLike, end: ArrayLike, radius: float, end_radius: float | None = None) -> Manifold:
    """Hull of two balls (one of ``radius`` at ``start``, one of ``end_radius`` at ``end``)."""
    balls = [
        Manifold.sphere(radius, 24).translate(np.asarray(start, dtype=float)),
        Manifold.sphere(radius if end_radius is None else end_radius, 24).translate(np.asarray(end, dtype=float)),
    ]
    return Manifold.batch_hull(balls)


def cylinder(radius: float, height: float, top_radius: float | None = None, segments: int = SEGMENTS) -> Manifold:
    """A cylinder (or cone) along z, centred on the origin."""
    return Manifold.cylinder(height, radius, radius if top_radius is None else top_radius, segments, center=True)


def prism(outline: ArrayLike, height: float, rounding: float = 0.0, holes: Sequence[ArrayLike] = ()) -> Manifold:
    """Extrusion along z, centred in z, of a polygon (N, 2) whose corners may be rounded, minus ``holes``."""
    section = CrossSection([_counterclockwise(np.asarray(outline, dtype=float))])
    if rounding > 0:
        section = section.offset(-rounding, JoinType.Round, 2.0, 24).offset(rounding, JoinType.Round, 2.0, 24)
    for hole in holes:
        section = section - CrossSection([_counterclockwise(np.asarray(hole, dtype=float))])
    return section.extrude(height).translate([0, 0, -height / 2])


def along(solid: Manifold, axis: str) -> Manifold:
    """Turns a solid built along z so that it lies along ``x`` or ``y``."""
    return {"x": solid.rotate([0, 90, 0]), "y": solid.rotate([-90, 0, 0]), "z": solid}[axis]


def join(*solids: Manifold) -> Manifold:
    """Union of solids."""
    return union(list(solids))
