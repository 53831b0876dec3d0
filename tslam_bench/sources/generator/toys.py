"""Furniture scaled to the hand, toys and figures."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from tslam_bench.sources.generator.categories import Random, category
from tslam_bench.sources.generator.solids import (
    along,
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
)

# --- Furniture, scaled to the hand ----------------------------------------------------------------------------------


@category("train", 0.1, 0.2)
def stool(g: Random) -> tuple[Manifold, int]:
    """A stool on three or four legs."""
    height, count = g.uniform(1.1, 2.0), int(g.integers(3, 5))
    seat = cylinder(0.9, g.uniform(0.18, 0.3)) if g.random() < 0.5 else box(1.5, 1.5, g.uniform(0.18, 0.3), 0.06)
    splay, radius = g.uniform(0.0, 0.35), g.uniform(0.1, 0.14)
    legs = []
    for k in range(count):
        direction = np.array([np.cos(2 * np.pi * (k + 0.5) / count), np.sin(2 * np.pi * (k + 0.5) / count)])
        top, foot = 0.62 * direction, (0.62 + splay) * direction
        legs.append(capsule([*top, 0], [*foot, -height], radius, radius * g.uniform(0.75, 1.0)))
    return join(seat, *legs), 0


@category("train", 0.14, 0.24)
def chair(g: Random) -> tuple[Manifold, int]:
    """A chair with a closed back."""
    width, depth, height = g.uniform(1.0, 1.3), g.uniform(1.0, 1.3), g.uniform(0.9, 1.2)
    leg = g.uniform(0.14, 0.2)
    parts = [box(width, depth, g.uniform(0.16, 0.25), 0.04)]
    for sx in (-1, 1):
        for sy in (-1, 1):
            parts.append(box(leg, leg, height).translate([sx * (width - leg) / 2, sy * (depth - leg) / 2, -height / 2]))
    rise = g.uniform(1.0, 1.5)
    back = box(width, g.uniform(0.15, 0.2), rise, 0.05).rotate([g.uniform(-14, 0), 0, 0])
    parts.append(back.translate([0, depth / 2 - 0.08, rise / 2 - 0.05]))
    return join(*parts), 0


@category("train", 0.14, 0.24)
def table_lamp(g: Random) -> tuple[Manifold, int]:
    """A lamp with a closed shade."""
    height = g.uniform(1.4, 2.2)
    stand = lathe(
        smooth_profile([(0.6, 0), (0.5, 0.15), (0.14, 0.4), (g.uniform(0.14, 0.35), 0.6 * height), (0.14, height)], 36)
    )
    shade = cylinder(g.uniform(0.8, 1.0), g.uniform(0.8, 1.1), g.uniform(0.4, 0.65)).translate([0, 0, height + 0.3])
    return join(stand, shade), 0


# --- Toys and figures ------------------------------------------------------------------------------------------------


@category("train", 0.1, 0.2)
def dumbbell(g: Random) -> tuple[Manifold, int]:
    """Two weights on a bar."""
    bar, gap = g.uniform(0.14, 0.24), g.uniform(0.9, 1.5)
    radius, width = g.uniform(0.45, 0.7), g.uniform(0.4, 0.7)
    kind = g.integers(3)
    parts = [along(cylinder(bar, gap + 2 * width), "x")]
    for sign in (-1, 1):
        weight = [cylinder(radius, width), cylinder(radius, width, segments=6), ellipsoid(radius, radius, width)][kind]
        parts.append(along(weight, "x").translate([sign * (gap + width) / 2, 0, 0]))
    return join(*parts), 0


@category("train", 0.08, 0.2)
def quadruped(g: Random) -> tuple[Manifold, int]:
    """A four-legged animal with head, ears and tail."""
    length, belly = g.uniform(1.3, 2.0), g.uniform(0.42, 0.62)
    body = ellipsoid(length / 2 + 0.2, belly, belly * g.uniform(0.9, 1.1))
    height, leg = g.uniform(0.5, 1.0), g.uniform(0.15, 0.22)
    parts = [body]
    for sx in (-1, 1):
        for sy in (-1, 1):
            hip = [sx * length * 0.34, sy * belly * 0.5, -0.1]
            foot = [sx * length * 0.36, sy * belly * 0.55, -belly - height + leg]
            parts.append(capsule(hip, foot, leg * 1.2, leg))
    neck = g.uniform(0.2, 0.9)
    head = np.array([length / 2 + 0.3 + 0.2 * neck, 0, belly * 0.6 + neck])
    size = g.uniform(0.3, 0.42)
    parts.append(capsule([length * 0.35, 0, 0.1], head, 0.3, 0.24))
    parts.append(ellipsoid(size * g.uniform(1.0, 1.4), size, size).translate(head))
    parts.append(capsule(head, head + np.array([size + g.uniform(0.1, 0.35), 0, -0.1]), 0.2, 0.16))
    for sy in (-1, 1):
        ear = head + np.array([-0.1, sy * size * 0.7, size * g.uniform(0.9, 1.5)])
        parts.append(capsule(head + np.array([-0.05, sy * size * 0.6, 0.1]), ear, 0.13, 0.1))
    parts.append(
        capsule([-length / 2, 0, 0.1], [-length / 2 - g.uniform(0.25, 0.6), 0, g.uniform(-0.3, 0.6)], 0.14, 0.1)
    )
    return join(*parts), 0


@category("train", 0.08, 0.18)
def toy_car(g: Random) -> tuple[Manifold, int]:
    """A car with four wheels."""
    length, width = g.uniform(2.2, 3.0), g.uniform(1.0, 1.3)
    low, cabin = g.uniform(0.4, 0.55), g.uniform(0.35, 0.55)
    body = box(length, width, low, 0.12)
    start, stop = -g.uniform(0.2, 0.45) * length, g.uniform(0.05, 0.3) * length
    roof = prism([(start, 0), (stop, 0), (stop - 0.3, cabin), (start + 0.15, cabin)], width * 0.9, 0.05)
    parts = [body, roof.rotate([90, 0, 0]).translate([0, 0, low / 2 - 0.02])]
    radius = g.uniform(0.3, 0.4)
    for sx in (-1, 1):
        for sy in (-1, 1):
            wheel = along(cylinder(radius, 0.3), "y")
            parts.append(wheel.translate([sx * length * 0.3, sy * (width / 2 - 0.06), -low / 2]))
    return join(*parts), 0


@category("train", 0.08, 0.18)
def chess_piece(g: Random) -> tuple[Manifold, int]:
    """A turned chess piece."""
    height = g.uniform(1.6, 2.6)
    neck = g.uniform(0.22, 0.32)
    knots = [(0.75, 0), (0.72, 0.16), (0.5, 0.3), (neck, 0.62 * height), (0.45, 0.78 * height), (0.3, 0.84 * height)]
    body = lathe(smooth_profile(knots, 44))
    top = [
        Manifold.sphere(0.42, 32),
        ellipsoid(0.36, 0.36, 0.55),
        cylinder(0.45, 0.5, 0.6) - box(0.2, 2, 0.4).translate([0, 0, 0.3]) - box(2, 0.2, 0.4).translate([0, 0, 0.3]),
    ][int(g.integers(3))]
    return join(body, top.translate([0, 0, height])), 0


@category("train", 0.08, 0.2)
def doughnut_stack(g: Random) -> tuple[Manifold, int]:
    """Rings of shrinking size on a peg with a ball on top."""
    count, z, radius = int(g.integers(3, 6)), 0.0, 1.0
    parts = []
    shrink = g.uniform(0.78, 0.88)
    for _ in range(count):
        tube = g.uniform(0.2, 0.28) * (0.5 + 0.5 * radius)
        parts.append(ring(circle(tube, 28) + np.array([radius - tube, 0]), 56).translate([0, 0, z]))
        parts.append(cylinder(radius - tube, 2 * tube * 0.9).translate([0, 0, z]))
        z += 2 * tube * 0.92
        radius *= shrink
    parts.append(Manifold.sphere(radius * 0.55, 32).translate([0, 0, z + 0.1]))
    parts.append(cylinder(0.18, z + 0.2).translate([0, 0, z / 2]))
    return join(*parts), 0
