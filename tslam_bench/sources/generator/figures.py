"""Figures, plants and toys."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from tslam_bench.sources.generator.categories import Random, category
from tslam_bench.sources.generator.solids import (
    box,
    capsule,
    cylinder,
    ellipsoid,
    join,
    lathe,
    prism,
    smooth_profile,
    spline,
    sweep,
)


@category("train", 0.1, 0.2)
def cactus(g: Random) -> tuple[Manifold, int]:
    """A ribbed cactus with arms in a pot."""
    pot_height, ribs = g.uniform(0.6, 1.0), int(g.integers(6, 11))
    pot = lathe(np.array([(0.5, 0), (0.72, 0.75 * pot_height), (0.82, 0.75 * pot_height), (0.82, pot_height)]))
    height, radius = g.uniform(1.4, 2.4), g.uniform(0.32, 0.45)
    angle = np.linspace(0, 2 * np.pi, 12 * ribs, endpoint=False)
    outline = (radius * (1 + 0.12 * np.cos(ribs * angle)))[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    hull = lathe(
        smooth_profile([(0.9 * radius, 0), (1.15 * radius, 0.5), (1.1 * radius, 0.8), (0.3 * radius, 1.0)], 32)
    )
    trunk = prism(outline, height).translate([0, 0, height / 2]) ^ hull.scale([1, 1, height])
    parts = [pot, trunk.translate([0, 0, pot_height - 0.08])]
    for k in range(int(g.integers(1, 4))):
        z, reach, rise = pot_height + g.uniform(0.3, 0.6) * height, g.uniform(0.35, 0.6), g.uniform(0.3, 0.7)
        path = spline([(0, 0, z), (radius + 0.6 * reach, 0, z + 0.05), (radius + reach, 0, z + 0.3),
                       (radius + reach, 0, z + 0.3 + rise)], 28)  # fmt: skip
        arm = join(sweep(path, 0.19, side=(0, 1, 0)), Manifold.sphere(0.19, 20).translate(path[-1]))
        parts.append(arm.rotate([0, 0, 137 * k + g.uniform(-20, 20)]))
    return join(*parts), 0


@category("train", 0.1, 0.2)
def toy_boat(g: Random) -> tuple[Manifold, int]:
    """A boat with a cabin and a chimney or a mast."""
    length, width, height = g.uniform(2.2, 3.0), g.uniform(0.8, 1.1), g.uniform(0.45, 0.7)
    t = np.linspace(0, 1, 16)
    half = width / 2 * np.clip(1.15 - t**3, 0.02, 1)
    outline = np.vstack([np.column_stack([length * t, half]), np.column_stack([length * t, -half])[::-1]])
    outline = outline - [length / 2, 0]
    deck, keel = prism(outline, 0.1), prism(outline * [0.8, g.uniform(0.35, 0.7)], 0.1)
    body = Manifold.batch_hull([deck, keel.translate([-0.05 * length, 0, -height])])
    cabin_length = g.uniform(0.3, 0.45) * length
    cabin = box(cabin_length, 0.6 * width, 0.45, 0.06).translate([-0.15 * length, 0, 0.2])
    parts = [body, cabin]
    if g.random() < 0.5:
        count = int(g.integers(1, 3))
        parts += [
            cylinder(0.15, 0.7).translate([-0.15 * length + (k - (count - 1) / 2) * 0.45, 0, 0.7]) for k in range(count)
        ]
    else:
        mast = g.uniform(1.2, 1.9)
        parts.append(capsule([-0.1 * length, 0, 0], [-0.1 * length, 0, mast], 0.11, 0.09))
        sail = prism([(-0.02, 0.55), (0.38 * length, 0.55), (-0.02, 0.95 * mast)], 0.13).rotate([90, 0, 0])
        parts.append(sail.translate([-0.1 * length, 0, 0]))
        parts.append(box(0.3, 0.2, 0.5).translate([-0.1 * length, 0, 0.4]))
    return join(*parts), 0


@category("train", 0.08, 0.18)
def peg_doll(g: Random) -> tuple[Manifold, int]:
    """A doll with a turned body, arms, and a hat or hair."""
    height, belly = g.uniform(1.2, 1.8), g.uniform(0.5, 0.7)
    body = lathe(smooth_profile([(belly * g.uniform(0.8, 1.0), 0), (belly, 0.3 * height), (0.24, height)], 32))
    size = g.uniform(0.36, 0.5)
    top = height + 0.75 * size
    parts = [body, ellipsoid(size, size, size * g.uniform(1.0, 1.15)).translate([0, 0, top])]
    for sign in (-1, 1):
        hand = [sign * g.uniform(0.75, 1.0), g.uniform(-0.3, 0.2), g.uniform(0.35, 1.0) * height]
        parts.append(capsule([sign * 0.15, 0, 0.8 * height], hand, 0.16, 0.12))
    kind = int(g.integers(3))
    if kind == 0:
        parts.append(cylinder(size * 1.5, 0.13).translate([0, 0, top + 0.55 * size]))
        parts.append(cylinder(size * 0.85, 0.45).translate([0, 0, top + 0.55 * size + 0.25]))
    elif kind == 1:
        parts.append(cylinder(size * 0.9, 1.1 * size, 0.1).translate([0, 0, top + 1.0 * size]))
    else:
        parts += [Manifold.sphere(0.2, 24).translate([s * size, 0, top + 0.3 * size]) for s in (-1, 1)]
    return join(*parts), 0


@category("train", 0.1, 0.2)
def fish(g: Random) -> tuple[Manifold, int]:
    """A fish with fins."""
    length, tall, thick = g.uniform(1.1, 1.5), g.uniform(0.4, 0.7), g.uniform(0.28, 0.42)
    body = Manifold.batch_hull(
        [ellipsoid(0.75 * length, tall, thick), ellipsoid(0.16, 0.2, 0.13).translate([-1.1 * length, 0, 0])]
    )
    fork, fin = g.uniform(0.3, 0.55), g.uniform(0.15, 0.2)
    tail = prism([(0.2, 0.12), (-0.45, fork), (-0.25, 0), (-0.45, -fork), (0.2, -0.12)], fin, 0.03)
    back = prism(
        [(0.45 * length, 0), (-0.1 * length, g.uniform(0.3, 0.5)), (-0.5 * length, 0.05), (-0.3 * length, -0.3)], fin
    )
    parts = [body, tail.translate([-1.15 * length, 0, 0]), back.translate([0, 0.85 * tall, 0])]
    for sign in (-1, 1):
        tip = [-0.1 * length, -0.5 * tall, sign * (thick + g.uniform(0.2, 0.4))]
        parts.append(capsule([0.25 * length, -0.3 * tall, sign * 0.7 * thick], tip, 0.14, 0.1))
    return join(*parts).rotate([90, 0, 0]), 0
