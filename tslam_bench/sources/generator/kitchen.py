"""Things of kitchen, bath and laundry."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from tslam_bench.sources.generator.categories import Random, category
from tslam_bench.sources.generator.solids import (
    along,
    box,
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


@category("train", 0.14, 0.22)
def fork(g: Random) -> tuple[Manifold, int]:
    """A fork with two to four tines."""
    count, pitch = int(g.integers(2, 5)), g.uniform(0.28, 0.36)
    width, thickness = (count - 1) * pitch, g.uniform(0.16, 0.2)
    depth, droop = g.uniform(0.7, 1.2), g.uniform(0.0, 0.35)
    shoulder = width / 2 + 0.12
    head = prism([(-0.05, -shoulder), (-0.05, shoulder), (0.3, shoulder * 0.9), (0.75, 0.14), (0.75, -0.14),
                  (0.3, -shoulder * 0.9)], thickness)  # fmt: skip
    parts = [head]
    for k in range(count):
        y = k * pitch - width / 2
        path = spline([(0.05, y, 0), (-0.5 * depth, y, -0.4 * droop), (-depth, y, 0.1 - 0.2 * droop)], 16)
        parts.append(sweep(path, thickness / 2, scale=np.linspace(1.0, 0.7, 16)))
    length = g.uniform(1.6, 2.4)
    path = spline([(0.6, 0, 0), (0.6 + 0.5 * length, 0, g.uniform(0.0, 0.3)), (0.6 + length, 0, g.uniform(0, 0.3))], 28)
    widths = np.interp(np.linspace(0, 1, 28), [0, 0.4, 1], [1.0, 0.8, g.uniform(1.1, 1.9)])
    return join(*parts, sweep(path, superellipse(0.14, 0.085, 2.6, 20), scale=widths)), 0


@category("train", 0.09, 0.18)
def funnel(g: Random) -> tuple[Manifold, int]:
    """A funnel, open at both ends, with or without a loop to hang it by."""
    wall, mouth = g.uniform(0.11, 0.15), 1.0
    neck, cone, tube, rim = g.uniform(0.27, 0.38), g.uniform(0.6, 1.3), g.uniform(0.5, 1.3), g.uniform(0.0, 0.3)
    slant = wall * np.hypot(cone, mouth - neck) / cone
    tip = neck * g.uniform(0.8, 1.0)
    outer = [(tip, 0), (neck, tube), (mouth, tube + cone), (mouth, tube + cone + rim)]
    inner = [(mouth - slant, tube + cone + rim), (mouth - slant, tube + cone), (neck - wall, tube + 0.25 * wall),
             (tip - wall, 0)]  # fmt: skip
    body = ring(np.array([*outer, *inner]))
    if g.random() < 0.5:
        return body, 1
    z = tube + cone + rim
    loop = ring(circle(0.085, 16) + np.array([g.uniform(0.2, 0.3), 0]), 32).translate([1.16, 0, z - 0.085])
    return join(body, loop - cylinder(mouth - 0.5 * wall, 1.0).translate([0, 0, z])), 2


@category("train", 0.14, 0.22)
def whisk(g: Random) -> tuple[Manifold, int]:
    """A whisk of two or three thick wire loops."""
    loops, wire = int(g.integers(2, 4)), g.uniform(0.1, 0.12)
    belly, length, top = g.uniform(0.6, 0.8), g.uniform(1.3, 2.0), g.uniform(0.35, 0.5)
    grip = g.uniform(1.0, 1.8)
    handle = lathe(smooth_profile([(0.16, -grip), (0.2, -0.8 * grip), (0.15, -0.4 * grip), (0.24, 0.1)], 24))
    half = np.array([(0.12, 0.0), (top * belly, 0.25 * length), (belly, 0.62 * length), (0.62 * belly, 0.93 * length)])
    knots = np.vstack([half, [(0.0, length)], half[::-1] * [-1, 1]])
    path = spline(np.column_stack([knots[:, 0], np.zeros(len(knots)), knots[:, 1]]), 48)
    wires = [sweep(path, wire, side=(0, 1, 0)).rotate([0, 0, 180 * k / loops]) for k in range(loops)]
    return join(handle, *wires), 2 * loops - 1


@category("train", 0.14, 0.22)
def tongs(g: Random) -> tuple[Manifold, int]:
    """Tongs: two springy arms with paddles."""
    length, gap = g.uniform(2.2, 3.2), g.uniform(0.3, 0.5)
    path = spline(
        [(length, 0, g.uniform(0.14, 0.3)), (0.6 * length, 0, gap), (0.25, 0, 0.8 * gap), (0, 0, 0), (0.25, 0, -0.8 * gap),
         (0.6 * length, 0, -gap), (length, 0, -g.uniform(0.14, 0.3))], 64
    )  # fmt: skip
    arms = sweep(path, superellipse(0.085, g.uniform(0.14, 0.24), 3, 20), side=(0, 1, 0))
    paddles = [
        ellipsoid(g.uniform(0.25, 0.4), g.uniform(0.2, 0.32), 0.09).translate([*path[index, :2], path[index, 2]])
        for index in (0, -1)
    ]
    return join(arms, *paddles), 0


@category("train", 0.1, 0.17)
def corkscrew(g: Random) -> tuple[Manifold, int]:
    """A corkscrew: a cross grip and a thick helix."""
    turns, pitch, wire = g.uniform(2.5, 4.0), g.uniform(0.42, 0.55), g.uniform(0.1, 0.12)
    radius, shaft = g.uniform(0.2, 0.28), g.uniform(0.4, 0.8)
    angle = np.linspace(0, 2 * np.pi * turns, int(28 * turns))
    swing = radius * np.clip(angle / np.pi, 0, 1)
    path = np.column_stack([swing * np.cos(angle), swing * np.sin(angle), -shaft - pitch * angle / (2 * np.pi)])
    path = np.vstack([[0, 0, -0.5 * shaft], path])
    scale = np.clip(np.linspace(3.0, 0.5, len(path)), 0.5, 1.0)
    screw = sweep(path, wire, scale=scale)
    width = g.uniform(0.9, 1.4)
    grip_path = np.column_stack([np.linspace(-width, width, 24), np.zeros(24), np.zeros(24)])
    swell = 1 + g.uniform(0.0, 0.3) * np.cos(np.linspace(-np.pi, np.pi, 24))
    grip = sweep(grip_path, superellipse(0.2, g.uniform(0.2, 0.28), 2.4, 24), scale=swell)
    return join(grip, cylinder(wire * 1.15, shaft + 0.1).translate([0, 0, -shaft / 2]), screw), 0


@category("train", 0.12, 0.22)
def cake_stand(g: Random) -> tuple[Manifold, int]:
    """A plate on a pedestal."""
    height, rim, wall = g.uniform(0.6, 1.3), g.uniform(0.0, 0.14), g.uniform(0.11, 0.15)
    foot, stem = g.uniform(0.45, 0.75), g.uniform(0.13, 0.22)
    profile = smooth_profile(
        [(foot, 0), (foot * 0.8, 0.12), (stem, 0.45 * height), (stem * g.uniform(1, 1.6), 0.7 * height), (0.3, height)],
        32,
    )
    plate = [(0, height - 0.02), (0.95, height - 0.02), (1.0, height + wall + rim), (0.86, height + wall + rim),
             (0.82, height + wall), (0, height + wall)]  # fmt: skip
    return join(lathe(profile), ring(np.array(plate))), 0


@category("train", 0.14, 0.24)
def muffin_tin(g: Random) -> tuple[Manifold, int]:
    """A baking tin with round or square hollows."""
    rows, columns = [(1, 2), (1, 3), (1, 4), (2, 2)][int(g.integers(4))]
    height, radius, floor = g.uniform(0.35, 0.6), g.uniform(0.33, 0.4), 0.13
    border = g.uniform(0.1, 0.25)
    body = box(columns + border, rows + border, height, 0.05).translate([0, 0, height / 2])
    square = g.random() < 0.35
    outline = superellipse(radius, radius, 5) if square else circle(radius, 20)
    hollow = prism(outline, height).translate([0, 0, height / 2 + floor])
    hollows = [
        hollow.translate([i - (columns - 1) / 2, j - (rows - 1) / 2, 0]) for i in range(columns) for j in range(rows)
    ]
    return body - join(*hollows), 0


@category("train", 0.08, 0.15)
def soap_dish(g: Random) -> tuple[Manifold, int]:
    """A shallow dish with drain slots, on feet or flat."""
    a, b, power = 1.0, g.uniform(0.6, 0.85), g.uniform(2.0, 5.0)
    height, wall, floor = g.uniform(0.35, 0.55), g.uniform(0.1, 0.14), g.uniform(0.11, 0.15)
    body = prism(superellipse(a, b, power), height).translate([0, 0, height / 2])
    hollow = prism(superellipse(a - wall, b - wall, power), height).translate([0, 0, height / 2 + floor])
    count = int(g.integers(2, 5))
    spacing = 1.1 / count
    slots = [
        box(min(0.5 * spacing, 0.2), g.uniform(0.7, 1.1) * b, 1.0).translate([(k - (count - 1) / 2) * spacing, 0, 0])
        for k in range(count)
    ]
    feet = []
    if g.random() < 0.5:
        feet = [box(0.2, 0.2, 0.3, 0.04).translate([sx * 0.6, sy * 0.5 * b, 0]) for sx in (-1, 1) for sy in (-1, 1)]
        slots = [slot ^ box(0.9, 4, 4) for slot in slots]
    return join(body - hollow - join(*slots), *[foot - hollow for foot in feet]), count


@category("train", 0.14, 0.22)
def clothes_iron(g: Random) -> tuple[Manifold, int]:
    """An iron: a pointed sole, a body and a closed handle."""
    length, width = g.uniform(2.2, 2.8), g.uniform(0.55, 0.7)
    t = np.linspace(0, 1, 20)
    side = width * np.sqrt(np.clip(1 - t**2.2, 0, 1))
    outline = np.vstack([np.column_stack([t * length - 0.8, side]), np.column_stack([t * length - 0.8, -side])[::-1]])
    sole = prism(outline, 0.2)
    low, body = sole.scale([0.94, 0.94, 1]).translate([0, 0, 0.1]), g.uniform(0.4, 0.7)
    upper = prism(outline * [0.72, 0.55], 0.1).translate([0, 0, body])
    rise, back = body + g.uniform(0.5, 0.75), -0.5
    front = 0.42 * length
    path = spline(
        [(back, 0, body - 0.1), (back - 0.1, 0, 0.75 * rise + 0.1), (0.1 * length, 0, rise + 0.1), (front, 0, 0.85 * rise),
         (front + 0.1, 0, body - 0.15)], 40
    )  # fmt: skip
    handle = sweep(path, superellipse(0.13, g.uniform(0.14, 0.2), 2.5, 20), side=(0, 1, 0))
    return join(sole, Manifold.batch_hull([low, upper]), handle), 1


@category("train", 0.14, 0.22)
def hair_dryer(g: Random) -> tuple[Manifold, int]:
    """A hair dryer: a hollow barrel and a grip."""
    length, nozzle = g.uniform(1.8, 2.6), g.uniform(0.32, 0.48)
    profile = smooth_profile(
        [
            (0.42, -0.6),
            (g.uniform(0.6, 0.75), -0.25),
            (0.6, 0.3),
            (nozzle * 1.05, 0.75 * length - 0.6),
            (nozzle, length - 0.6),
        ],
        36,
    )
    barrel = lathe(profile)
    bore = cylinder(nozzle - 0.13, 1.2).translate([0, 0, length - 0.6])
    intake = cylinder(0.26, 0.4).translate([0, 0, -0.6])
    lean, reach = g.uniform(-0.1, 0.5), g.uniform(1.2, 1.8)
    path = spline([(0, 0, 0.1), (-0.1 * lean, 0, -0.5 * reach), (-lean, 0, -reach)], 20)
    grip = sweep(path, superellipse(g.uniform(0.22, 0.3), 0.2, 2.6, 24), side=(0, 1, 0))
    return join(along(barrel, "x"), grip) - along(bore, "x") - along(intake, "x"), 0


@category("train", 0.14, 0.22)
def spray_bottle(g: Random) -> tuple[Manifold, int]:
    """A spray bottle with head, nozzle and trigger."""
    height, flat = g.uniform(1.6, 2.4), g.uniform(0.6, 0.95)
    knots = [(0.72, 0), (0.8, 0.15), (g.uniform(0.6, 0.8), 0.6 * height), (0.3, height), (0.28, height + 0.3)]
    body = lathe(smooth_profile(knots, 40)).scale([1, flat, 1])
    top, reach = height + 0.45, g.uniform(0.55, 0.85)
    head = prism(
        [(-0.5, 0), (0.35, -0.1), (reach, 0.05), (reach, 0.32), (-0.2, 0.42), (-0.55, 0.3)], g.uniform(0.36, 0.46), 0.04
    )
    head = head.rotate([90, 0, 0]).translate([0, 0, top])
    nozzle = along(cylinder(0.16, 0.25), "x").translate([reach + 0.05, 0, top + 0.18])
    bend = g.uniform(0.0, 0.25)
    path = spline([(0.42, 0, top + 0.05), (0.52 + bend, 0, top - 0.35), (0.5 + 0.5 * bend, 0, top - 0.75)], 20)
    trigger = sweep(path, superellipse(0.09, 0.13, 2.5, 16), side=(0, 1, 0))
    collar = cylinder(0.34, 0.25).translate([0, 0, height + 0.3])
    return join(body, collar, head, nozzle, trigger), 0


@category("train", 0.16, 0.24)
def watering_can(g: Random) -> tuple[Manifold, int]:
    """A watering can: an open body, a spout with a rose, a handle at the back."""
    height, wall, taper = g.uniform(1.2, 2.0), g.uniform(0.13, 0.17), g.uniform(0.75, 1.0)
    profile = smooth_profile([(1.0, 0), (g.uniform(0.9, 1.05), 0.5 * height), (taper, height)], 24)
    reach, rise = g.uniform(0.9, 1.5), height * g.uniform(0.85, 1.25)
    spout_path = spline([(0.85, 0, 0.2 * height), (1.25, 0, 0.35 * height), (1 + reach, 0, rise)], 28)
    spout = sweep(spout_path, 0.2, scale=np.linspace(1.0, g.uniform(0.65, 0.85), 28))
    tangent = spout_path[-1] - spout_path[-2]
    tilt = np.degrees(np.arctan2(tangent[0], tangent[2]))
    rose = cylinder(0.15, 0.32, g.uniform(0.3, 0.45)).rotate([0, tilt, 0]).translate(spout_path[-1])
    low = g.uniform(0.15, 0.35) * height
    handle_path = spline(
        [(-0.93, 0, low), (-1.5, 0, low + 0.15), (-g.uniform(1.5, 1.8), 0, 0.75 * height), (-1.3, 0, height + 0.1),
         (-taper + 0.08, 0, 0.88 * height)], 36
    )  # fmt: skip
    handle = sweep(handle_path, superellipse(0.11, 0.13, 2.4, 20), side=(0, 1, 0))
    inner = lathe(np.column_stack([profile[:, 0] - 0.6 * wall, profile[:, 1] + 0.02]))
    return join(vessel(profile, wall), join(spout, rose, handle) - inner), 1


@category("train", 0.14, 0.22)
def colander(g: Random) -> tuple[Manifold, int]:
    """A bowl with large holes and two grips."""
    height, wall = g.uniform(0.5, 1.1), g.uniform(0.13, 0.16)
    knots = [(g.uniform(0.4, 0.55), 0.0), (g.uniform(0.78, 0.9), 0.45 * height), (1.0, height)]
    bowl = vessel(smooth_profile(knots, 32), wall, wall)
    count, radius = int(g.integers(4, 10)), g.uniform(0.12, 0.15)
    hole = (
        along(cylinder(radius, 1.2, segments=20), "x")
        .rotate([0, g.uniform(15, 30), 0])
        .translate([1.0, 0, 0.45 * height])
    )
    holes = [hole.rotate([0, 0, 360 * (k + 0.5) / count]) for k in range(count)]
    holes.append(cylinder(g.uniform(0.12, 0.2), 1.0, segments=24))
    grips = []
    for sign in (-1, 1):
        grip = prism(superellipse(0.22, g.uniform(0.3, 0.45), 3), 0.13).translate([sign * 1.1, 0, height - 0.065])
        grips.append(grip - cylinder(1.0 - 0.5 * wall, 2.0))
    return join(bowl - join(*holes), *grips), count + 1
