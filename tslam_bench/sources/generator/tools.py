"""Tools, boxes, appliances, rings and frames."""

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
    spline,
    superellipse,
    sweep,
)

# --- Tools ---------------------------------------------------------------------------------------------------------


@category("train", 0.16, 0.24)
def mallet(g: Random) -> tuple[Manifold, int]:
    """A mallet or hammer: a head across a handle."""
    length, radius = g.uniform(2.4, 3.4), g.uniform(0.11, 0.16)
    handle = sweep(
        np.column_stack([np.linspace(0, length, 24), np.zeros(24), np.zeros(24)]),
        superellipse(radius, radius * g.uniform(1.0, 1.4), 2.3, 24),
        scale=1 + 0.25 * np.cos(np.linspace(0, 2.4 * np.pi, 24)),
    )
    width = g.uniform(0.25, 0.42)
    if g.random() < 0.5:
        head = along(cylinder(width, g.uniform(1.2, 1.8), width * g.uniform(0.85, 1.0)), "y")
    else:
        head = box(2 * width, g.uniform(1.2, 1.8), 2 * width * g.uniform(0.8, 1.1), 0.06)
    return join(handle, head), 0


@category("train", 0.14, 0.24)
def screwdriver(g: Random) -> tuple[Manifold, int]:
    """A screwdriver with a fluted grip."""
    grip, shaft = g.uniform(1.2, 1.8), g.uniform(1.2, 2.2)
    lobes, depth = int(g.integers(4, 8)), g.uniform(0.04, 0.1)
    angle = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    radius = g.uniform(0.28, 0.38)
    outline = (radius * (1 - depth * (1 + np.cos(lobes * angle))))[:, None] * np.column_stack(
        [np.cos(angle), np.sin(angle)]
    )
    handle = prism(outline, grip) ^ lathe(smooth_profile([(0.24, -grip / 2), (0.42, -0.2 * grip), (0.42, 0.2 * grip),
                                                          (0.3, grip / 2)], 24))  # fmt: skip
    blade = cylinder(g.uniform(0.09, 0.12), shaft).translate([0, 0, grip / 2 + shaft / 2 - 0.05])
    tip = box(0.24, 0.1, 0.3).translate([0, 0, grip / 2 + shaft - 0.1])
    return along(join(handle, blade, tip), "x"), 0


@category("train", 0.14, 0.22)
def spoon(g: Random) -> tuple[Manifold, int]:
    """A spoon or ladle."""
    a, b, depth = g.uniform(0.5, 0.7), g.uniform(0.35, 0.5), g.uniform(0.2, 0.4)
    wall = g.uniform(0.1, 0.13)
    half = box(4, 4, 2).translate([0, 0, -1])
    scoop = (ellipsoid(a, b, depth) ^ half) - ellipsoid(a - wall, b - wall, depth - wall)
    length, lift = g.uniform(1.8, 2.6), g.uniform(0.1, 0.6)
    path = spline([(a - 0.8 * wall, 0, -0.07), (a + 0.4 * length, 0, 0.1), (a + length, 0, lift)], 28)
    widths = np.interp(np.linspace(0, 1, 28), [0, 0.3, 1], [0.8, 0.7, g.uniform(1.0, 1.6)])
    return join(scoop, sweep(path, superellipse(0.11, 0.075, 2.6, 20), scale=widths)), 0


@category("train", 0.12, 0.22)
def wrench(g: Random) -> tuple[Manifold, int]:
    """A spanner with a ring at one end and an open jaw at the other."""
    length, thickness = g.uniform(2.4, 3.4), g.uniform(0.2, 0.32)
    outer, inner = g.uniform(0.45, 0.58), g.uniform(0.24, 0.3)
    shaft = box(length, g.uniform(0.3, 0.42), thickness * g.uniform(0.7, 1.0))
    eye = prism(circle(outer, 40), thickness).translate([-length / 2, 0, 0])
    hole = prism(circle(inner, 6 if g.random() < 0.5 else 24), 2 * thickness).translate([-length / 2, 0, 0])
    jaw = prism(circle(g.uniform(0.52, 0.64), 40), thickness).translate([length / 2, 0, 0])
    gap = box(1.0, g.uniform(0.38, 0.5), 1.0).rotate([0, 0, g.uniform(-25, 25)])
    gap = gap.translate([length / 2 + 0.5, 0, 0])
    return join(shaft, eye, jaw) - hole - gap, 1


@category("train", 0.14, 0.22)
def paint_brush(g: Random) -> tuple[Manifold, int]:
    """A flat brush: bristles, ferrule, handle."""
    width, length = g.uniform(0.5, 1.0), g.uniform(1.5, 2.2)
    bristles = box(g.uniform(0.5, 0.9), width, g.uniform(0.18, 0.26), 0.04).translate([-0.4, 0, 0])
    ferrule = box(0.35, width * 1.06, 0.3, 0.03).translate([0.15, 0, 0])
    path = np.column_stack([np.linspace(0.2, 0.2 + length, 28), np.zeros(28), np.zeros(28)])
    scale = np.interp(np.linspace(0, 1, 28), [0, 0.2, 0.6, 0.9, 1], [1.3, 0.75, 1.1, 0.8, 0.5])
    return join(bristles, ferrule, sweep(path, superellipse(g.uniform(0.18, 0.26), 0.13, 2.2, 24), scale=scale)), 0


@category("train", 0.07, 0.14)
def key(g: Random) -> tuple[Manifold, int]:
    """A thick key with a bow, a shaft and teeth."""
    thickness, length = g.uniform(0.22, 0.32), g.uniform(1.6, 2.2)
    bow = prism(superellipse(g.uniform(0.5, 0.65), g.uniform(0.5, 0.75), g.uniform(2, 4)), thickness)
    hole = prism(circle(g.uniform(0.2, 0.3), 28), 1.0)
    shaft = box(length, g.uniform(0.2, 0.3), thickness).translate([0.4 + length / 2, 0, 0])
    teeth = [
        box(0.16, g.uniform(0.25, 0.5), thickness).translate([0.4 + length - 0.1 - 0.3 * k, -0.22, 0])
        for k in range(int(g.integers(2, 5)))
    ]
    return join(bow, shaft, *teeth) - hole, 1


@category("train", 0.1, 0.18)
def comb(g: Random) -> tuple[Manifold, int]:
    """A comb with thick teeth."""
    count, thickness = int(g.integers(6, 10)), g.uniform(0.25, 0.35)
    pitch, depth = 0.42, g.uniform(0.7, 1.1)
    width = count * pitch
    spine = box(width, 0.45, thickness, 0.08)
    teeth = [
        capsule([(k + 0.5) * pitch - width / 2, -0.1, 0], [(k + 0.5) * pitch - width / 2, -0.2 - depth, 0], 0.12, 0.09)
        for k in range(count)
    ]
    return join(spine, *teeth), 0


# --- Boxes and appliances ------------------------------------------------------------------------------------------


@category("train", 0.06, 0.2)
def carton(g: Random) -> tuple[Manifold, int]:
    """A box, sometimes with a gabled top."""
    x, y, z = g.uniform(0.5, 1.0, 3) + np.array([0, 0, 0.4])
    body = box(x, y, z, g.uniform(0.0, 0.08))
    if g.random() < 0.4:
        roof = prism([(-y / 2, 0), (y / 2, 0), (0.04, 0.35), (-0.04, 0.35)], x)
        body = join(box(x, y, z), roof.rotate([90, 0, 90]).translate([0, 0, z / 2 - 0.001]))
    return body, 0


@category("train", 0.12, 0.2)
def remote_control(g: Random) -> tuple[Manifold, int]:
    """A flat handset with raised buttons."""
    length, width, depth = g.uniform(2.4, 3.4), g.uniform(0.7, 1.0), g.uniform(0.3, 0.45)
    parts = [box(length, width, depth, g.uniform(0.08, 0.14))]
    rows, columns = int(g.integers(3, 6)), int(g.integers(2, 4))
    for i in range(rows):
        for j in range(columns):
            position = [(i - rows / 2 + 0.5) * 0.36 - 0.3, (j - columns / 2 + 0.5) * 0.26, depth / 2]
            parts.append(cylinder(0.09, 0.12, segments=20).translate(position))
    return join(*parts), 0


@category("train", 0.1, 0.2)
def toaster(g: Random) -> tuple[Manifold, int]:
    """A toaster with two slots and a lever."""
    x, y, z = g.uniform(1.5, 1.9), g.uniform(0.9, 1.2), g.uniform(1.0, 1.3)
    body = box(x, y, z, g.uniform(0.12, 0.25))
    width = 0.2
    slots = [box(x * 0.7, width, 1.0).translate([0, s * y * 0.2, z / 2]) for s in (-1, 1)]
    lever = box(0.2, 0.3, 0.14, 0.04).translate([x / 2 + 0.05, 0, g.uniform(-0.2, 0.25)])
    feet = [cylinder(0.1, 0.14).translate([sx * x * 0.35, sy * y * 0.3, -z / 2]) for sx in (-1, 1) for sy in (-1, 1)]
    return join(body, lever, *feet) - join(*slots), 0


@category("train", 0.08, 0.18)
def book(g: Random) -> tuple[Manifold, int]:
    """A closed book whose cover stands over the pages."""
    x, y, z = g.uniform(1.4, 1.9), g.uniform(1.0, 1.3), g.uniform(0.3, 0.55)
    cover = 0.09
    outline = prism(
        [(-y / 2, -z / 2), (y / 2, -z / 2), (y / 2, -z / 2 + cover), (-y / 2 + cover, -z / 2 + cover),
         (-y / 2 + cover, z / 2 - cover), (y / 2, z / 2 - cover), (y / 2, z / 2), (-y / 2, z / 2)], x
    )  # fmt: skip
    pages = box(y - 0.12, z - cover, x - 0.16)
    return along(join(outline, pages), "x").rotate([90, 0, 0]), 0


# --- Rings and frames ----------------------------------------------------------------------------------------------


@category("train", 0.06, 0.16)
def bangle(g: Random) -> tuple[Manifold, int]:
    """A thick ring, plain or set with a stone."""
    section = superellipse(g.uniform(0.14, 0.28), g.uniform(0.14, 0.4), g.uniform(2, 4), 28) + np.array([1.0, 0.0])
    solid = ring(section, 64)
    if g.random() < 0.4:
        solid = join(solid, ellipsoid(0.35, 0.3, 0.3).translate([1.2, 0, 0]))
    return solid, 1


@category("train", 0.12, 0.22)
def picture_frame(g: Random) -> tuple[Manifold, int]:
    """An open frame."""
    x, y, border = g.uniform(1.6, 2.2), g.uniform(1.2, 1.8), g.uniform(0.22, 0.36)
    depth = g.uniform(0.2, 0.35)
    outer = box(x, y, depth, 0.05)
    if g.random() < 0.5:
        return outer - box(x - 2 * border, y - 2 * border, 1.0), 1
    hole = prism(superellipse(x / 2 - border, y / 2 - border, 2.0, 48), 1.0)
    return outer - hole, 1


@category("train", 0.07, 0.13)
def padlock(g: Random) -> tuple[Manifold, int]:
    """A padlock."""
    x, z, depth = g.uniform(1.2, 1.6), g.uniform(1.0, 1.5), g.uniform(0.5, 0.7)
    rise, half = g.uniform(0.7, 1.2), g.uniform(0.34, 0.45) * x
    path = spline([(-half, 0, 0), (-half, 0, 0.5 * rise), (0, 0, rise + 0.2), (half, 0, 0.5 * rise), (half, 0, 0)], 40)
    shackle = sweep(path, g.uniform(0.13, 0.18), side=(0, 1, 0)).translate([0, 0, z / 2 - 0.1])
    return join(box(x, depth, z, g.uniform(0.08, 0.2)), shackle), 1


@category("train", 0.12, 0.2)
def spectacles(g: Random) -> tuple[Manifold, int]:
    """Unfolded spectacles with thick rims."""
    a, b, power = g.uniform(0.5, 0.6), g.uniform(0.38, 0.5), g.uniform(2.0, 3.5)
    rim, depth, length = g.uniform(0.11, 0.15), g.uniform(0.16, 0.22), g.uniform(1.7, 2.1)
    parts = []
    for sign in (-1, 1):
        centre = np.array([sign * (a + 0.12), 0])
        outline, hole = superellipse(a, b, power) + centre, superellipse(a - rim, b - rim, power) + centre
        parts.append(prism(outline, depth, holes=[hole]).rotate([90, 0, 0]))
        x = sign * (2 * a + 0.1)
        path = spline([(x, -0.02, 0.1), (x, 0.3, 0.12), (x, 0.7 * length, 0.1), (x, length, -0.3)], 28)
        parts.append(sweep(path, superellipse(0.075, 0.1, 2.5, 16), side=(0, 0, 1)))
    bridge = box(0.4, depth, 0.14).translate([0, 0, 0.05])
    return join(bridge, *parts), 2
