"""Turned vessels, open and covered."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from tslam_bench.sources.generator.categories import Random, category
from tslam_bench.sources.generator.solids import (
    cylinder,
    ellipsoid,
    join,
    lathe,
    ring,
    smooth_profile,
    spline,
    superellipse,
    sweep,
    vessel,
)


@category("train", 0.12, 0.24)
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


@category("train", 0.12, 0.24)
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


@category("train", 0.1, 0.2)
def bowl(g: Random) -> tuple[Manifold, int]:
    """An open bowl on a foot."""
    height, foot = g.uniform(0.6, 1.1), g.uniform(0.35, 0.55)
    rise = g.uniform(0.06, 0.12)
    knots = [(foot, 0.0), (foot * 1.02, rise), (g.uniform(0.75, 0.9), g.uniform(0.42, 0.55) * height), (1.0, height)]
    return vessel(smooth_profile(knots, 40), g.uniform(0.1, 0.15), rise + g.uniform(0.08, 0.14)), 0


@category("train", 0.08, 0.16)
def tumbler(g: Random) -> tuple[Manifold, int]:
    """A drinking glass without a stem."""
    height, taper = g.uniform(1.8, 3.2), g.uniform(0.72, 1.0)
    profile = np.column_stack([np.linspace(taper, 1.0, 24), np.linspace(0, height, 24)])
    return vessel(profile, g.uniform(0.13, 0.2), g.uniform(0.15, 0.4)), 0


@category("train", 0.12, 0.2)
def goblet(g: Random) -> tuple[Manifold, int]:
    """A cup on a stem and a foot."""
    stem, height = g.uniform(0.16, 0.24), g.uniform(1.0, 1.9)
    cup_height = g.uniform(1.2, 2.0)
    knots = [(stem * 1.1, 0.0), (g.uniform(0.7, 0.95), 0.35 * cup_height), (g.uniform(0.75, 1.0), cup_height)]
    cup = vessel(smooth_profile(knots, 32), g.uniform(0.13, 0.18), g.uniform(0.2, 0.35)).translate([0, 0, height])
    foot_knots = [(g.uniform(0.7, 0.9), 0.0), (0.6, 0.12), (stem, 0.4), (stem, height + 0.1)]
    return join(lathe(smooth_profile(foot_knots, 32)), cup), 0


@category("train", 0.08, 0.14)
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


@category("train", 0.14, 0.24)
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


@category("train", 0.16, 0.24)
def frying_pan(g: Random) -> tuple[Manifold, int]:
    """A pan with a long handle."""
    height, wall = g.uniform(0.25, 0.5), g.uniform(0.1, 0.14)
    profile = np.column_stack([np.linspace(g.uniform(0.75, 0.9), 1.0, 16), np.linspace(0, height, 16)])
    rise, length = g.uniform(0.0, 0.4), g.uniform(1.1, 1.9)
    path = spline([(0.92, 0, 0.6 * height), (1.3, 0, 0.7 * height + 0.2 * rise), (1 + length, 0, height + rise)], 24)
    handle = sweep(path, superellipse(g.uniform(0.09, 0.14), 0.08, 2.6, 20))
    inner = lathe(np.column_stack([profile[:, 0] - wall * 0.8, profile[:, 1] + 0.01]))
    return join(vessel(profile, wall), handle - inner), 0


@category("train", 0.14, 0.24)
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


@category("train", 0.16, 0.24)
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


@category("train", 0.12, 0.22)
def plate(g: Random) -> tuple[Manifold, int]:
    """A plate or saucer."""
    height, wall = g.uniform(0.16, 0.3), g.uniform(0.08, 0.11)
    flat = g.uniform(0.55, 0.7)
    top = [(1.0, height), (flat, height * 0.35 + wall * 0.2), (0.0, wall)]
    under = [(0.0, 0.0), (flat * 0.9, 0.0), (1.0, height - wall)]
    return ring([*under, *top]), 0


@category("train", 0.1, 0.2)
def jar(g: Random) -> tuple[Manifold, int]:
    """A squat jar with a lid and a knob."""
    height = g.uniform(1.1, 1.9)
    body = lathe(
        smooth_profile([(0.75, 0), (1.0, 0.35 * height), (g.uniform(0.8, 1.0), 0.9 * height), (0.75, height)], 36)
    )
    lid = cylinder(g.uniform(0.8, 0.95), 0.18).translate([0, 0, height + 0.08])
    knob = ellipsoid(0.22, 0.22, g.uniform(0.16, 0.24)).translate([0, 0, height + 0.28])
    return join(body, lid, knob), 0


@category("train", 0.12, 0.22)
def candlestick(g: Random) -> tuple[Manifold, int]:
    """A turned candlestick with its candle."""
    height = g.uniform(2.2, 3.4)
    waists = g.uniform(0.2, 0.36, 3)
    knots = [(1.0, 0), (0.8, 0.12), (waists[0], 0.22 * height), (g.uniform(0.38, 0.5), 0.45 * height),
             (waists[1], 0.62 * height), (0.5, 0.9 * height), (0.45, height)]  # fmt: skip
    length = g.uniform(0.5, 1.4)
    candle = cylinder(0.26, length).translate([0, 0, height + length / 2 - 0.01])
    return join(lathe(smooth_profile(knots, 56)), candle), 0
