"""The categories that are held out for val."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from tslam_bench.sources.generator.categories import Random, category
from tslam_bench.sources.generator.solids import (
    box,
    capsule,
    circle,
    cylinder,
    ellipsoid,
    join,
    lathe,
    prism,
    ring,
    smooth_profile,
    spline,
    sweep,
    vessel,
)


@category("val", 0.1, 0.2)
def bucket(g: Random) -> tuple[Manifold, int]:
    """A bucket with a raised bail."""
    height, wall = g.uniform(1.6, 2.2), g.uniform(0.12, 0.16)
    profile = np.column_stack([np.linspace(g.uniform(0.65, 0.85), 1.0, 16), np.linspace(0, height, 16)])
    rise = g.uniform(0.8, 1.3)
    path = spline([(-0.95, 0, height - 0.1), (-0.8, 0, height + 0.6 * rise), (0, 0, height + rise),
                   (0.8, 0, height + 0.6 * rise), (0.95, 0, height - 0.1)], 40)  # fmt: skip
    return join(vessel(profile, wall), sweep(path, 0.09, side=(0, 1, 0))), 1


@category("val", 0.08, 0.18)
def mushroom(g: Random) -> tuple[Manifold, int]:
    """A mushroom."""
    height = g.uniform(0.8, 1.5)
    stem = lathe(smooth_profile([(g.uniform(0.35, 0.5), 0), (0.28, 0.5 * height), (0.35, height)], 28))
    cap = ellipsoid(1.0, 1.0, g.uniform(0.5, 0.9)) ^ box(4, 4, 2).translate([0, 0, 1 - 0.12])
    return join(stem, cap.translate([0, 0, height])), 0


@category("val", 0.1, 0.2)
def rocket(g: Random) -> tuple[Manifold, int]:
    """A toy rocket with fins."""
    height = g.uniform(2.4, 3.4)
    body = lathe(
        smooth_profile([(0.4, 0), (g.uniform(0.55, 0.7), 0.4 * height), (0.4, 0.75 * height), (0.06, height)], 44)
    )
    count, reach = int(g.integers(3, 5)), g.uniform(0.9, 1.3)
    fin = prism([(0, 0.05), (reach, -0.35), (reach, 0.15), (0, g.uniform(0.9, 1.3))], 0.16).rotate([90, 0, 0])
    return join(body, *[fin.rotate([0, 0, 360 * k / count]) for k in range(count)]), 0


@category("val", 0.08, 0.16)
def cogwheel(g: Random) -> tuple[Manifold, int]:
    """A cogwheel with a bore."""
    teeth, depth = int(g.integers(8, 15)), g.uniform(0.12, 0.2)
    angle = np.linspace(0, 2 * np.pi, teeth * 12, endpoint=False)
    radius = 1 + depth * np.clip(2.2 * np.sin(teeth * angle), -1, 1)
    outline = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return prism(outline, g.uniform(0.3, 0.7), holes=[circle(g.uniform(0.25, 0.5), 36)]), 1


@category("val", 0.1, 0.2)
def trophy(g: Random) -> tuple[Manifold, int]:
    """A cup with two handles on a plinth."""
    height = g.uniform(1.5, 2.0)
    plinth = box(1.1, 1.1, 0.4, 0.05).translate([0, 0, 0.2])
    knots = [(0.4, 0.35), (0.18, 0.6), (0.2, 0.85), (g.uniform(0.75, 0.9), 0.85 + 0.45 * height), (0.85, 0.85 + height)]
    body = lathe(smooth_profile(knots, 48))
    parts = [plinth, body]
    for sign in (-1, 1):
        path = spline([(sign * 0.45, 0, 1.2), (sign * 1.2, 0, 1.35), (sign * 1.35, 0, 0.6 + 0.7 * height),
                       (sign * 0.7, 0, 0.75 + 0.9 * height)], 36)  # fmt: skip
        parts.append(sweep(path, g.uniform(0.09, 0.12), side=(0, 1, 0)))
    return join(*parts), 2


@category("val", 0.12, 0.22)
def bench(g: Random) -> tuple[Manifold, int]:
    """A long bench on two plank legs."""
    length, width, height = g.uniform(2.2, 3.2), g.uniform(0.7, 1.0), g.uniform(0.7, 1.1)
    thickness = g.uniform(0.16, 0.24)
    legs = [box(thickness, width * 0.9, height).translate([s * length * 0.36, 0, -height / 2]) for s in (-1, 1)]
    rail = box(length * 0.7, thickness * 0.8, thickness * 1.2).translate([0, 0, -height * g.uniform(0.5, 0.75)])
    with_rail = g.random() < 0.5
    return join(box(length, width, thickness, 0.05), *legs, *([rail] if with_rail else [])), 1 if with_rail else 0


@category("val", 0.1, 0.18)
def hourglass(g: Random) -> tuple[Manifold, int]:
    """Two bulbs between plates that are held by posts."""
    height, posts, waist = g.uniform(1.8, 2.6), int(g.integers(3, 5)), g.uniform(0.16, 0.24)
    bulb = g.uniform(0.42, 0.52)
    knots = [(0.3, 0), (bulb, 0.22 * height), (waist, 0.5 * height), (bulb, 0.78 * height), (0.3, height)]
    parts = [lathe(smooth_profile(knots, 48))]
    square = posts == 4 and g.random() < 0.5
    for z in (0, height):
        plate = box(1.6, 1.6, 0.2, 0.04) if square else cylinder(1.0, 0.2)
        parts.append(plate.translate([0, 0, z]))
    reach = 0.92 if square else 0.8
    post = cylinder(g.uniform(0.1, 0.13), height).translate([reach, 0, height / 2])
    parts += [post.rotate([0, 0, 360 * k / posts + 45]) for k in range(posts)]
    return join(*parts), posts


@category("val", 0.1, 0.2)
def anchor(g: Random) -> tuple[Manifold, int]:
    """An anchor: shank, stock, ring, two arms with flukes."""
    length, reach, thick = g.uniform(1.8, 2.4), g.uniform(0.8, 1.1), g.uniform(0.12, 0.17)
    rise = g.uniform(0.4, 0.7)
    arms = spline([(-reach, 0, rise), (-0.6 * reach, 0, 0.12), (0, 0, 0), (0.6 * reach, 0, 0.12), (reach, 0, rise)], 40)
    eye = ring(circle(0.11, 16) + np.array([g.uniform(0.26, 0.34), 0]), 36).rotate([90, 0, 0])
    parts = [
        capsule([0, 0, 0], [0, 0, length], thick * 1.15, thick),
        sweep(arms, thick, side=(0, 1, 0)),
        eye.translate([0, 0, length + 0.3]),
        capsule([-0.6 * reach, 0, 0.84 * length], [0.6 * reach, 0, 0.84 * length], 0.11),
    ]
    for sign in (-1, 1):
        fluke = prism([(-0.26, -0.05), (0.26, -0.05), (0, 0.36)], 0.2).rotate([90, 0, 0])
        parts.append(fluke.translate([sign * reach, 0, rise]))
    return join(*parts), 1


@category("val", 0.1, 0.2)
def tobacco_pipe(g: Random) -> tuple[Manifold, int]:
    """A pipe with a hollow bowl and a bent stem."""
    height, wall = g.uniform(0.9, 1.3), g.uniform(0.14, 0.18)
    profile = smooth_profile([(0.22, 0), (g.uniform(0.44, 0.56), 0.4 * height), (g.uniform(0.4, 0.5), height)], 28)
    reach, rise = g.uniform(1.6, 2.4), g.uniform(0.1, 1.0)
    path = spline([(0, 0, 0.25), (0.5 * reach, 0, 0.2 + 0.15 * rise), (reach, 0, 0.3 + rise)], 32)
    scale = np.interp(np.linspace(0, 1, 32), [0, 0.9, 1], [1.0, 0.6, 0.75])
    stem = sweep(path, 0.2, scale=scale, side=(0, 1, 0)) - cylinder(0.2, 2 * height).translate([0, 0, 0.35 + height])
    return join(vessel(profile, wall, 0.4), stem), 0


@category("val", 0.12, 0.2)
def slingshot(g: Random) -> tuple[Manifold, int]:
    """A forked grip with knobs."""
    grip, rise, spread = g.uniform(1.0, 1.5), g.uniform(0.9, 1.4), g.uniform(0.5, 0.8)
    thick = g.uniform(0.16, 0.2)
    parts = [capsule([0, 0, -grip], [0, 0, 0.1], thick * 1.35, thick * 1.1)]
    for sign in (-1, 1):
        path = spline([(0, 0, -0.1), (sign * 0.8 * spread, 0, 0.35 * rise), (sign * spread, 0, rise)], 28)
        parts.append(sweep(path, thick, scale=np.linspace(1.05, 0.85, 28), side=(0, 1, 0)))
        parts.append(cylinder(thick * 1.3, 0.2).translate([*path[-1]]))
    return join(*parts), 0
