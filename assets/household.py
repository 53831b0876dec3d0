"""Household shapes of the generator: one function per category, each drawing its proportions from a seeded generator.

Sizes inside a function are relative; the generator scales the result. Walls stay above about 3 % of the longest edge, so that
collision hulls can follow them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from manifold3d import Manifold

from tslam_bench.assets.solids import (
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
    vessel,
)

Random = np.random.Generator
MakeShape = Callable[[Random], tuple[Manifold, int]]


@dataclass(frozen=True)
class Category:
    """A kind of household thing.

    Attributes:
        name: category name.
        split: ``train`` or ``val``.
        make: draws one shape; returns it with the genus it is meant to have.
        size: range (m) of the longest edge.
    """

    name: str
    split: str
    make: MakeShape
    size: tuple[float, float]


CATEGORIES: dict[str, Category] = {}


def _category(split: str, low: float = 0.07, high: float = 0.2) -> Callable[[MakeShape], MakeShape]:
    """Registers a shape function under its own name."""

    def register(make: MakeShape) -> MakeShape:
        name = make.__name__.replace("_", "-")
        CATEGORIES[name] = Category(name, split, make, (low, high))
        return make

    return register


# --- Turned vessels ------------------------------------------------------------------------------------------------


@_category("train", 0.12, 0.24)
def bottle(g: Random) -> tuple[Manifold, int]:
    """A closed bottle: body, shoulder, neck, cap."""
    body, neck = 1.0, g.uniform(0.28, 0.45)
    height, shoulder = g.uniform(2.2, 4.2), g.uniform(0.55, 0.75)
    waist = g.uniform(0.82, 1.05)
    knots = [
        (body * g.uniform(0.85, 1.0), 0.0),
        (body, 0.12 * height),
        (body * waist, shoulder * height * 0.6),
        (body, shoulder * height),
        (neck, (shoulder + g.uniform(0.12, 0.18)) * height),
        (neck, 0.93 * height),
    ]
    solid = lathe(smooth_profile(knots, 48))
    cap_height = g.uniform(0.08, 0.14) * height
    cap = cylinder(neck * g.uniform(1.1, 1.35), cap_height).translate([0, 0, 0.92 * height + cap_height / 2])
    return join(solid, cap), 0


@_category("train", 0.12, 0.24)
def vase(g: Random) -> tuple[Manifold, int]:
    """An open vase with a belly."""
    height = g.uniform(1.8, 3.4)
    knots = [
        (g.uniform(0.45, 0.8), 0.0),
        (g.uniform(0.85, 1.1), g.uniform(0.3, 0.5) * height),
        (g.uniform(0.4, 0.65), g.uniform(0.72, 0.82) * height),
        (g.uniform(0.5, 0.9), height),
    ]
    return vessel(smooth_profile(knots, 48), g.uniform(0.11, 0.16), g.uniform(0.15, 0.3)), 0


@_category("train", 0.1, 0.2)
def bowl(g: Random) -> tuple[Manifold, int]:
    """An open bowl on a foot."""
    height, foot = g.uniform(0.6, 1.1), g.uniform(0.35, 0.55)
    rise = g.uniform(0.06, 0.12)
    knots = [(foot, 0.0), (foot * 1.02, rise), (g.uniform(0.75, 0.9), g.uniform(0.42, 0.55) * height), (1.0, height)]
    return vessel(smooth_profile(knots, 40), g.uniform(0.1, 0.15), rise + g.uniform(0.08, 0.14)), 0


@_category("train", 0.08, 0.16)
def tumbler(g: Random) -> tuple[Manifold, int]:
    """A drinking glass without a stem."""
    height, taper = g.uniform(1.8, 3.2), g.uniform(0.72, 1.0)
    profile = np.column_stack([np.linspace(taper, 1.0, 24), np.linspace(0, height, 24)])
    return vessel(profile, g.uniform(0.13, 0.2), g.uniform(0.15, 0.4)), 0


@_category("train", 0.12, 0.2)
def goblet(g: Random) -> tuple[Manifold, int]:
    """A cup on a stem and a foot."""
    stem, height = g.uniform(0.16, 0.24), g.uniform(1.0, 1.9)
    cup_height = g.uniform(1.2, 2.0)
    knots = [(stem * 1.1, 0.0), (g.uniform(0.7, 0.95), 0.35 * cup_height), (g.uniform(0.75, 1.0), cup_height)]
    cup = vessel(smooth_profile(knots, 32), g.uniform(0.13, 0.18), g.uniform(0.2, 0.35)).translate([0, 0, height])
    foot_knots = [(g.uniform(0.7, 0.9), 0.0), (0.6, 0.12), (stem, 0.4), (stem, height + 0.1)]
    return join(lathe(smooth_profile(foot_knots, 32)), cup), 0


@_category("train", 0.08, 0.14)
def mug(g: Random) -> tuple[Manifold, int]:
    """A mug with one handle."""
    height, wall = g.uniform(1.7, 2.6), g.uniform(0.12, 0.18)
    waist = g.uniform(0.88, 1.06)
    profile = smooth_profile([(g.uniform(0.85, 1.0), 0.0), (waist, height / 2), (1.0, height)], 32)
    reach, thickness = g.uniform(0.55, 0.85), g.uniform(0.1, 0.15)
    low, high = g.uniform(0.15, 0.3) * height, g.uniform(0.72, 0.86) * height
    inset = 1.0 - wall * 0.4
    path = spline(
        [(inset * 0.97, 0, low), (1 + 0.8 * reach, 0, low), (1 + reach, 0, (low + high) / 2),
         (1 + 0.8 * reach, 0, high), (inset * 0.97, 0, high)], 40
    )  # fmt: skip
    handle = sweep(path, superellipse(thickness, thickness * g.uniform(1.0, 1.7), 2.5, 20), side=(0, 1, 0))
    inner = lathe(np.column_stack([profile[:, 0] - wall * 0.9, profile[:, 1] + 0.01]))
    return join(vessel(profile, wall, g.uniform(0.12, 0.25)), handle - inner), 1


@_category("train", 0.14, 0.24)
def pitcher(g: Random) -> tuple[Manifold, int]:
    """A jug with a handle and a lip."""
    height, wall = g.uniform(2.4, 3.2), g.uniform(0.12, 0.17)
    knots = [(g.uniform(0.7, 0.9), 0.0), (1.0, 0.32 * height), (g.uniform(0.55, 0.75), 0.78 * height), (0.8, height)]
    profile = smooth_profile(knots, 40)
    body = vessel(profile, wall, 0.2)
    inner = lathe(np.column_stack([np.maximum(profile[:, 0] - wall * 0.8, 0.05), profile[:, 1] + 0.02]))
    middle = g.uniform(0.45, 0.6) * height
    path = spline(
        [(0.8, 0, 0.25 * height), (1.55, 0, 0.35 * height), (g.uniform(1.5, 1.8), 0, middle),
         (1.3, 0, 0.9 * height), (0.65, 0, 0.93 * height)], 40
    )  # fmt: skip
    handle = sweep(path, superellipse(0.12, g.uniform(0.12, 0.2), 2.5, 20), side=(0, 1, 0)) - inner
    return join(body, handle), 1


@_category("train", 0.16, 0.24)
def frying_pan(g: Random) -> tuple[Manifold, int]:
    """A pan with a long handle."""
    height, wall = g.uniform(0.25, 0.5), g.uniform(0.1, 0.14)
    profile = np.column_stack([np.linspace(g.uniform(0.75, 0.9), 1.0, 16), np.linspace(0, height, 16)])
    rise, length = g.uniform(0.0, 0.4), g.uniform(1.1, 1.9)
    path = spline([(0.92, 0, 0.6 * height), (1.3, 0, 0.7 * height + 0.2 * rise), (1 + length, 0, height + rise)], 24)
    handle = sweep(path, superellipse(g.uniform(0.09, 0.14), 0.08, 2.6, 20))
    inner = lathe(np.column_stack([profile[:, 0] - wall * 0.8, profile[:, 1] + 0.01]))
    return join(vessel(profile, wall), handle - inner), 0


@_category("train", 0.14, 0.24)
def cooking_pot(g: Random) -> tuple[Manifold, int]:
    """A pot with two loop handles, with or without a lid."""
    height, wall = g.uniform(0.8, 1.5), g.uniform(0.1, 0.14)
    profile = np.column_stack([np.full(8, 1.0), np.linspace(0, height, 8)])
    z, reach = g.uniform(0.6, 0.8) * height, g.uniform(0.28, 0.4)
    inner = cylinder(1 - wall * 0.6, 2 * height).translate([0, 0, height + wall])
    parts = [vessel(profile, wall)]
    for sign in (-1, 1):
        path = spline([(sign * 0.9, -0.32, z), (sign * (1 + reach), -0.26, z), (sign * (1 + reach), 0.26, z),
                       (sign * 0.9, 0.32, z)], 32)  # fmt: skip
        parts.append(sweep(path, 0.075) - inner)
    if g.random() < 0.5:
        lid = lathe(smooth_profile([(1.04, 0), (1.03, 0.08), (0.5, 0.22), (0.1, 0.27)], 24))
        knob = ellipsoid(0.16, 0.16, 0.12).translate([0, 0, 0.36])
        stem = cylinder(0.08, 0.3).translate([0, 0, 0.22])
        # A covered pot is solid: its inside cannot be felt.
        parts.append(join(lid, knob, stem).translate([0, 0, height - 0.01]))
        parts.append(cylinder(0.95, height).translate([0, 0, height / 2]))
    return join(*parts), 2


@_category("train", 0.16, 0.24)
def teapot(g: Random) -> tuple[Manifold, int]:
    """A covered (solid) teapot with a spout and a handle."""
    height = g.uniform(1.2, 1.8)
    body = lathe(smooth_profile([(0.6, 0), (1.0, 0.4 * height), (0.7, 0.88 * height), (0.35, height)], 40))
    knob = ellipsoid(0.18, 0.18, 0.16).translate([0, 0, height + 0.1])
    lid = cylinder(0.4, 0.16).translate([0, 0, height])
    reach = g.uniform(0.65, 1.0)
    spout_path = spline(
        [(0.6, 0, 0.3 * height), (1.2, 0, 0.45 * height), (1 + reach, 0, g.uniform(0.85, 1.1) * height)], 28
    )
    spout = sweep(spout_path, 0.24, scale=np.linspace(1.0, g.uniform(0.45, 0.6), 28))
    bulge = g.uniform(1.6, 1.9)
    handle_path = spline(
        [(-0.75, 0, 0.25 * height), (-1.4, 0, 0.25 * height), (-bulge, 0, 0.6 * height), (-1.3, 0, 0.9 * height),
         (-0.6, 0, 0.82 * height)], 36
    )  # fmt: skip
    handle = sweep(handle_path, g.uniform(0.1, 0.14), side=(0, 1, 0))
    return join(body, knob, lid, spout, handle), 1


@_category("train", 0.12, 0.22)
def plate(g: Random) -> tuple[Manifold, int]:
    """A plate or saucer."""
    height, wall = g.uniform(0.16, 0.3), g.uniform(0.08, 0.11)
    flat = g.uniform(0.55, 0.7)
    top = [(1.0, height), (flat, height * 0.35 + wall * 0.2), (0.0, wall)]
    under = [(0.0, 0.0), (flat * 0.9, 0.0), (1.0, height - wall)]
    outline = np.array([*under, *top])
    return ring_or_lathe(outline), 0


def ring_or_lathe(outline: np.ndarray) -> Manifold:
    """A closed outline (radius, z) that touches the axis, turned."""
    return ring(outline)


@_category("train", 0.1, 0.2)
def jar(g: Random) -> tuple[Manifold, int]:
    """A squat jar with a lid and a knob."""
    height = g.uniform(1.1, 1.9)
    body = lathe(
        smooth_profile([(0.75, 0), (1.0, 0.35 * height), (g.uniform(0.8, 1.0), 0.9 * height), (0.75, height)], 36)
    )
    lid = cylinder(g.uniform(0.8, 0.95), 0.18).translate([0, 0, height + 0.08])
    knob = ellipsoid(0.22, 0.22, g.uniform(0.16, 0.24)).translate([0, 0, height + 0.28])
    return join(body, lid, knob), 0


@_category("train", 0.12, 0.22)
def candlestick(g: Random) -> tuple[Manifold, int]:
    """A turned candlestick with its candle."""
    height = g.uniform(2.2, 3.4)
    waists = g.uniform(0.2, 0.36, 3)
    knots = [(1.0, 0), (0.8, 0.12), (waists[0], 0.22 * height), (g.uniform(0.38, 0.5), 0.45 * height),
             (waists[1], 0.62 * height), (0.5, 0.9 * height), (0.45, height)]  # fmt: skip
    length = g.uniform(0.5, 1.4)
    candle = cylinder(0.26, length).translate([0, 0, height + length / 2 - 0.01])
    return join(lathe(smooth_profile(knots, 56)), candle), 0


# --- Tools ---------------------------------------------------------------------------------------------------------


@_category("train", 0.16, 0.24)
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


@_category("train", 0.14, 0.24)
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


@_category("train", 0.14, 0.22)
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


@_category("train", 0.12, 0.22)
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


@_category("train", 0.14, 0.22)
def paint_brush(g: Random) -> tuple[Manifold, int]:
    """A flat brush: bristles, ferrule, handle."""
    width, length = g.uniform(0.5, 1.0), g.uniform(1.5, 2.2)
    bristles = box(g.uniform(0.5, 0.9), width, g.uniform(0.18, 0.26), 0.04).translate([-0.4, 0, 0])
    ferrule = box(0.35, width * 1.06, 0.3, 0.03).translate([0.15, 0, 0])
    path = np.column_stack([np.linspace(0.2, 0.2 + length, 28), np.zeros(28), np.zeros(28)])
    scale = np.interp(np.linspace(0, 1, 28), [0, 0.2, 0.6, 0.9, 1], [1.3, 0.75, 1.1, 0.8, 0.5])
    return join(bristles, ferrule, sweep(path, superellipse(g.uniform(0.18, 0.26), 0.13, 2.2, 24), scale=scale)), 0


@_category("train", 0.07, 0.14)
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


@_category("train", 0.1, 0.18)
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


@_category("train", 0.06, 0.2)
def carton(g: Random) -> tuple[Manifold, int]:
    """A box, sometimes with a gabled top."""
    x, y, z = g.uniform(0.5, 1.0, 3) + np.array([0, 0, 0.4])
    body = box(x, y, z, g.uniform(0.0, 0.08))
    if g.random() < 0.4:
        roof = prism([(-y / 2, 0), (y / 2, 0), (0.04, 0.35), (-0.04, 0.35)], x)
        body = join(box(x, y, z), roof.rotate([90, 0, 90]).translate([0, 0, z / 2 - 0.001]))
    return body, 0


@_category("train", 0.12, 0.2)
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


@_category("train", 0.1, 0.2)
def toaster(g: Random) -> tuple[Manifold, int]:
    """A toaster with two slots and a lever."""
    x, y, z = g.uniform(1.5, 1.9), g.uniform(0.9, 1.2), g.uniform(1.0, 1.3)
    body = box(x, y, z, g.uniform(0.12, 0.25))
    width = 0.2
    slots = [box(x * 0.7, width, 1.0).translate([0, s * y * 0.2, z / 2]) for s in (-1, 1)]
    lever = box(0.2, 0.3, 0.14, 0.04).translate([x / 2 + 0.05, 0, g.uniform(-0.2, 0.25)])
    feet = [cylinder(0.1, 0.14).translate([sx * x * 0.35, sy * y * 0.3, -z / 2]) for sx in (-1, 1) for sy in (-1, 1)]
    return join(body, lever, *feet) - join(*slots), 0


@_category("train", 0.08, 0.18)
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


@_category("train", 0.06, 0.16)
def bangle(g: Random) -> tuple[Manifold, int]:
    """A thick ring, plain or set with a stone."""
    section = superellipse(g.uniform(0.14, 0.28), g.uniform(0.14, 0.4), g.uniform(2, 4), 28) + np.array([1.0, 0.0])
    solid = ring(section, 64)
    if g.random() < 0.4:
        solid = join(solid, ellipsoid(0.35, 0.3, 0.3).translate([1.2, 0, 0]))
    return solid, 1


@_category("train", 0.12, 0.22)
def picture_frame(g: Random) -> tuple[Manifold, int]:
    """An open frame."""
    x, y, border = g.uniform(1.6, 2.2), g.uniform(1.2, 1.8), g.uniform(0.22, 0.36)
    depth = g.uniform(0.2, 0.35)
    outer = box(x, y, depth, 0.05)
    if g.random() < 0.5:
        return outer - box(x - 2 * border, y - 2 * border, 1.0), 1
    hole = prism(superellipse(x / 2 - border, y / 2 - border, 2.0, 48), 1.0)
    return outer - hole, 1


@_category("train", 0.07, 0.13)
def padlock(g: Random) -> tuple[Manifold, int]:
    """A padlock."""
    x, z, depth = g.uniform(1.2, 1.6), g.uniform(1.0, 1.5), g.uniform(0.5, 0.7)
    rise, half = g.uniform(0.7, 1.2), g.uniform(0.34, 0.45) * x
    path = spline([(-half, 0, 0), (-half, 0, 0.5 * rise), (0, 0, rise + 0.2), (half, 0, 0.5 * rise), (half, 0, 0)], 40)
    shackle = sweep(path, g.uniform(0.13, 0.18), side=(0, 1, 0)).translate([0, 0, z / 2 - 0.1])
    return join(box(x, depth, z, g.uniform(0.08, 0.2)), shackle), 1


@_category("train", 0.12, 0.2)
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


# --- Furniture, scaled to the hand ----------------------------------------------------------------------------------


@_category("train", 0.1, 0.2)
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


@_category("train", 0.14, 0.24)
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


@_category("train", 0.14, 0.24)
def table_lamp(g: Random) -> tuple[Manifold, int]:
    """A lamp with a closed shade."""
    height = g.uniform(1.4, 2.2)
    stand = lathe(
        smooth_profile([(0.6, 0), (0.5, 0.15), (0.14, 0.4), (g.uniform(0.14, 0.35), 0.6 * height), (0.14, height)], 36)
    )
    shade = cylinder(g.uniform(0.8, 1.0), g.uniform(0.8, 1.1), g.uniform(0.4, 0.65)).translate([0, 0, height + 0.3])
    return join(stand, shade), 0


# --- Toys and figures ------------------------------------------------------------------------------------------------


@_category("train", 0.1, 0.2)
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


@_category("train", 0.08, 0.2)
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


@_category("train", 0.08, 0.18)
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


@_category("train", 0.08, 0.18)
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


@_category("train", 0.08, 0.2)
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


# --- Held out: categories of val -------------------------------------------------------------------------------------


@_category("val", 0.1, 0.2)
def bucket(g: Random) -> tuple[Manifold, int]:
    """A bucket with a raised bail."""
    height, wall = g.uniform(1.6, 2.2), g.uniform(0.12, 0.16)
    profile = np.column_stack([np.linspace(g.uniform(0.65, 0.85), 1.0, 16), np.linspace(0, height, 16)])
    rise = g.uniform(0.8, 1.3)
    path = spline([(-0.95, 0, height - 0.1), (-0.8, 0, height + 0.6 * rise), (0, 0, height + rise),
                   (0.8, 0, height + 0.6 * rise), (0.95, 0, height - 0.1)], 40)  # fmt: skip
    return join(vessel(profile, wall), sweep(path, 0.09, side=(0, 1, 0))), 1


@_category("val", 0.08, 0.18)
def mushroom(g: Random) -> tuple[Manifold, int]:
    """A mushroom."""
    height = g.uniform(0.8, 1.5)
    stem = lathe(smooth_profile([(g.uniform(0.35, 0.5), 0), (0.28, 0.5 * height), (0.35, height)], 28))
    cap = ellipsoid(1.0, 1.0, g.uniform(0.5, 0.9)) ^ box(4, 4, 2).translate([0, 0, 1 - 0.12])
    return join(stem, cap.translate([0, 0, height])), 0


@_category("val", 0.1, 0.2)
def rocket(g: Random) -> tuple[Manifold, int]:
    """A toy rocket with fins."""
    height = g.uniform(2.4, 3.4)
    body = lathe(
        smooth_profile([(0.4, 0), (g.uniform(0.55, 0.7), 0.4 * height), (0.4, 0.75 * height), (0.06, height)], 44)
    )
    count, reach = int(g.integers(3, 5)), g.uniform(0.9, 1.3)
    fin = prism([(0, 0.05), (reach, -0.35), (reach, 0.15), (0, g.uniform(0.9, 1.3))], 0.16).rotate([90, 0, 0])
    return join(body, *[fin.rotate([0, 0, 360 * k / count]) for k in range(count)]), 0


@_category("val", 0.08, 0.16)
def cogwheel(g: Random) -> tuple[Manifold, int]:
    """A cogwheel with a bore."""
    teeth, depth = int(g.integers(8, 15)), g.uniform(0.12, 0.2)
    angle = np.linspace(0, 2 * np.pi, teeth * 12, endpoint=False)
    radius = 1 + depth * np.clip(2.2 * np.sin(teeth * angle), -1, 1)
    outline = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return prism(outline, g.uniform(0.3, 0.7), holes=[circle(g.uniform(0.25, 0.5), 36)]), 1


@_category("val", 0.1, 0.2)
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


@_category("val", 0.12, 0.22)
def bench(g: Random) -> tuple[Manifold, int]:
    """A long bench on two plank legs."""
    length, width, height = g.uniform(2.2, 3.2), g.uniform(0.7, 1.0), g.uniform(0.7, 1.1)
    thickness = g.uniform(0.16, 0.24)
    legs = [box(thickness, width * 0.9, height).translate([s * length * 0.36, 0, -height / 2]) for s in (-1, 1)]
    rail = box(length * 0.7, thickness * 0.8, thickness * 1.2).translate([0, 0, -height * g.uniform(0.5, 0.75)])
    with_rail = g.random() < 0.5
    return join(box(length, width, thickness, 0.05), *legs, *([rail] if with_rail else [])), 1 if with_rail else 0
