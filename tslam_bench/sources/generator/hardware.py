"""Furniture scaled to the hand, fittings, and things of workshop and wardrobe."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from tslam_bench.sources.generator.categories import Random, category
from tslam_bench.sources.generator.solids import (
    along,
    box,
    capsule,
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


@category("train", 0.12, 0.24)
def table(g: Random) -> tuple[Manifold, int]:
    """A table on four legs, with or without a lower shelf, or on a pedestal."""
    length, width, height = g.uniform(1.4, 2.4), g.uniform(1.0, 1.4), g.uniform(0.7, 1.3)
    thickness = g.uniform(0.14, 0.22)
    kind = int(g.integers(4))
    if kind == 0:
        top = prism(superellipse(length / 2, width / 2, g.uniform(2, 4)), thickness)
        foot = lathe(
            smooth_profile([(0.55 * width / 2, -height), (0.16, -0.8 * height), (g.uniform(0.14, 0.24), 0)], 28)
        )
        return join(top, foot), 0
    top = box(length, width, thickness, 0.04)
    leg, splay = g.uniform(0.14, 0.2), g.uniform(0.0, 0.12)
    x, y = (length - leg) / 2 - 0.05, (width - leg) / 2 - 0.05
    feet = [(sx * x, sy * y) for sx in (-1, 1) for sy in (-1, 1)]
    if kind == 1:
        legs = [capsule([a, b, 0], [a * (1 + splay), b * (1 + splay), -height], 0.6 * leg, 0.45 * leg) for a, b in feet]
        return join(top, *legs), 0
    legs = [box(leg, leg, height).translate([a, b, -height / 2]) for a, b in feet]
    if kind == 2:
        return join(top, *legs), 0
    shelf = box(2 * x, 2 * y, 0.15).translate([0, 0, -height * g.uniform(0.55, 0.8)])
    return join(top, *legs, shelf), 3


@category("train", 0.14, 0.24)
def shelf(g: Random) -> tuple[Manifold, int]:
    """A set of shelves, open or with a back."""
    count = int(g.integers(3, 6))
    width, depth, height = g.uniform(0.9, 1.6), g.uniform(0.45, 0.7), g.uniform(1.5, 2.2)
    board = g.uniform(0.1, 0.14)
    parts = [box(board, depth, height).translate([sx * (width - board) / 2, 0, 0]) for sx in (-1, 1)]
    levels = np.linspace(-(height - board) / 2, (height - board) / 2, count)
    levels[1:-1] += g.uniform(-0.12, 0.12, count - 2)
    parts += [box(width, depth, board).translate([0, 0, z]) for z in levels]
    if g.random() < 0.5:
        return join(*parts, box(width, 0.1, height).translate([0, depth / 2 - 0.05, 0])), 0
    return join(*parts), count - 1


@category("train", 0.14, 0.24)
def ladder(g: Random) -> tuple[Manifold, int]:
    """A ladder."""
    count, pitch = int(g.integers(3, 7)), g.uniform(0.45, 0.6)
    length, width = count * pitch + 0.3, g.uniform(0.8, 1.1)
    rail, taper = g.uniform(0.14, 0.2), g.uniform(0.0, 0.12)
    round_rungs = g.random() < 0.5
    parts = []
    for sign in (-1, 1):
        foot, top = np.array([sign * (width / 2 + taper), 0, 0]), np.array([sign * (width / 2 - taper), 0, length])
        parts.append(sweep(np.linspace(foot, top, 4), superellipse(rail / 2, 0.7 * rail, 4, 16), side=(0, 1, 0)))
    for k in range(count):
        z = (k + 0.5) * pitch + 0.15
        rung = cylinder(0.085, width, segments=20) if round_rungs else box(0.14, g.uniform(0.16, 0.22), width)
        half = width / 2 + taper - 2 * taper * z / length
        parts.append(along(rung, "x").scale([2 * half / width, 1, 1]).translate([0, 0, z]))
    return join(*parts), count - 1


@category("train", 0.1, 0.2)
def crate(g: Random) -> tuple[Manifold, int]:
    """An open crate with slots in its sides and hand holes in its ends."""
    x, y, z = g.uniform(1.3, 1.9), g.uniform(0.9, 1.2), g.uniform(0.7, 1.1)
    wall, count = g.uniform(0.1, 0.13), int(g.integers(1, 4))
    body = box(x, y, z) - box(x - 2 * wall, y - 2 * wall, z).translate([0, 0, wall])
    pitch = (z - wall) / (count + 0.4)
    slots = []
    for k in range(count):
        height = -z / 2 + wall + (k + 0.7) * pitch
        slots.append(box(x - 4 * wall, 2 * y, 0.45 * pitch).translate([0, 0, height]))
    hand = along(prism(superellipse(0.12, g.uniform(0.2, 0.3), 3), 2 * x), "x").translate([0, 0, 0.22 * z])
    return body - join(*slots) - hand, 2 * count + 2


@category("train", 0.16, 0.24)
def clothes_hanger(g: Random) -> tuple[Manifold, int]:
    """A clothes hanger with or without a bar."""
    half, rise, radius = g.uniform(1.3, 1.6), g.uniform(0.5, 0.8), g.uniform(0.1, 0.13)
    sag = g.uniform(0.0, 0.15)
    shoulders = spline([(-half, 0, 0), (-0.55 * half, 0, 0.5 * rise + sag), (0, 0, rise), (0.55 * half, 0, 0.5 * rise + sag),
                        (half, 0, 0)], 48)  # fmt: skip
    parts = [sweep(shoulders, superellipse(radius, radius * g.uniform(1.0, 1.6), 2.4, 20), side=(0, 1, 0))]
    hook = g.uniform(0.26, 0.36)
    angle = np.linspace(-np.pi / 2, np.pi, 28)[::-1] - np.radians(0)
    arc = np.column_stack([hook * np.cos(angle), np.zeros(28), rise + 0.35 + hook + hook * np.sin(angle)])[::-1]
    path = np.vstack([[(0, 0, rise - 0.02)], [(0, 0, rise + 0.18)], arc])
    parts.append(sweep(path, 0.095, side=(0, 1, 0)))
    with_bar = g.random() < 0.65
    if with_bar:
        parts.append(capsule([-half, 0, 0], [half, 0, 0], 0.1))
    return join(*parts), 1 if with_bar else 0


@category("train", 0.12, 0.22)
def faucet(g: Random) -> tuple[Manifold, int]:
    """A tap: base, goose neck and lever or wheels."""
    radius, height, reach = g.uniform(0.14, 0.2), g.uniform(0.9, 1.7), g.uniform(0.8, 1.3)
    base = cylinder(g.uniform(0.4, 0.55), 0.16).translate([0, 0, 0.08])
    column = cylinder(radius * 1.4, 0.6).translate([0, 0, 0.3])
    path = spline([(0, 0, 0.3), (0, 0, height), (0.5 * reach, 0, height + g.uniform(0.2, 0.5)), (reach, 0, height),
                   (reach, 0, height - g.uniform(0.15, 0.35))], 40)  # fmt: skip
    parts = [base, column, sweep(path, radius, side=(0, 1, 0))]
    if g.random() < 0.5:
        lever = capsule([0, 0, 0.5], [0, -g.uniform(0.7, 1.0), g.uniform(0.5, 0.9)], 0.14, 0.11)
        parts.append(lever)
    else:
        for sign in (-1, 1):
            y = sign * g.uniform(0.55, 0.75)
            parts.append(capsule([0, 0, 0.4], [0, y, 0.4], 0.14))
            parts.append(
                along(cylinder(g.uniform(0.24, 0.32), 0.18, segments=int(g.choice([5, 6, 24]))), "y").translate(
                    [0, y, 0.4]
                )
            )
    return join(*parts), 0


@category("train", 0.14, 0.22)
def shower_head(g: Random) -> tuple[Manifold, int]:
    """A hand shower: a disc with nozzles on a curved grip."""
    radius, nozzles = g.uniform(0.55, 0.8), int(g.integers(5, 9))
    head = lathe(smooth_profile([(radius * 0.95, 0), (radius, 0.12), (0.3, g.uniform(0.35, 0.5))], 24))
    studs = [cylinder(0.09, 0.2, segments=16).translate([0.62 * radius, 0, 0]).rotate([0, 0, 360 * k / nozzles])
             for k in range(nozzles)]  # fmt: skip
    length, drop = g.uniform(1.6, 2.3), g.uniform(0.0, 0.9)
    path = spline([(0, 0, 0.3), (0.5, 0, 0.42), (length, 0, 0.3 - drop)], 32)
    scale = np.interp(np.linspace(0, 1, 32), [0, 0.3, 0.7, 1], [1.0, 0.85, g.uniform(0.9, 1.2), 0.75])
    grip = sweep(path, superellipse(0.2, g.uniform(0.17, 0.22), 2.3, 24), scale=scale, side=(0, 1, 0))
    return join(head, *studs, grip), 0


@category("train", 0.08, 0.18)
def pipe_fitting(g: Random) -> tuple[Manifold, int]:
    """A tube fitting with two or three arms, with or without collars."""
    bore, wall, arm = g.uniform(0.24, 0.36), g.uniform(0.18, 0.26), g.uniform(0.75, 1.2)
    outer = bore + wall
    angles = [[0, 90], [0, 110], [0, 135], [0, 90, 180], [0, 120, 240]][int(g.integers(5))]
    collar = g.uniform(0.0, 0.12)
    solid, empty = [Manifold.sphere(outer, 32)], [Manifold.sphere(bore, 24)]
    for number, angle in enumerate(angles):
        length = arm * (1.0 if number else g.uniform(1.0, 1.5))
        tube = [cylinder(outer, length, segments=32).translate([0, 0, length / 2])]
        if collar > 0.03:
            tube.append(cylinder(outer + collar, 0.3, segments=32).translate([0, 0, length - 0.15]))
        solid += [part.rotate([0, 90, angle]) for part in tube]
        empty.append(
            cylinder(bore, length + 0.2, segments=24).translate([0, 0, length / 2 + 0.1]).rotate([0, 90, angle])
        )
    return join(*solid) - join(*empty), len(angles) - 1


@category("train", 0.06, 0.16)
def bolt(g: Random) -> tuple[Manifold, int]:
    """A bolt with a hexagonal or slotted head, thread grooves, and sometimes its nut."""
    radius, length, head = g.uniform(0.3, 0.42), g.uniform(1.4, 2.6), g.uniform(0.3, 0.5)
    pitch, depth = g.uniform(0.22, 0.3), g.uniform(0.05, 0.09)
    start = g.uniform(0.2, 0.5) * length
    profile = [(radius, 0.0), (radius, start)]
    z = start
    while z + pitch < length:
        profile += [(radius - depth, z + 0.5 * pitch), (radius, z + pitch)]
        z += pitch
    profile += [(radius, length - 0.02), (radius * 0.8, length)]
    shaft = lathe(np.array(profile)).translate([0, 0, head / 2 - 0.01])
    if g.random() < 0.6:
        top = cylinder(g.uniform(0.62, 0.75), head, segments=6)
    else:
        top = ellipsoid(0.7, 0.7, head) ^ box(4, 4, 4).translate([0, 0, -2 + 0.6 * head])
        top = top - box(0.22, 3, 0.5 * head).translate([0, 0, -head])
    parts = [top, shaft]
    if g.random() < 0.5:
        nut = cylinder(0.68, g.uniform(0.3, 0.45), segments=6).rotate([0, 0, g.uniform(0, 60)])
        parts.append(nut.translate([0, 0, head / 2 + g.uniform(0.6, 0.85) * length]))
    return join(*parts), 0


@category("train", 0.06, 0.14)
def spool(g: Random) -> tuple[Manifold, int]:
    """A spool with a bore, bare or wound."""
    height, flange, core = g.uniform(1.2, 2.4), g.uniform(0.16, 0.24), g.uniform(0.4, 0.6)
    bore = core - g.uniform(0.16, 0.24)
    wound = g.uniform(core, 0.95)
    outline = [(bore, 0), (1, 0), (1, 0.6 * flange), (wound, flange), (wound + g.uniform(-0.0, 0.06), height / 2),
               (wound, height - flange), (1, height - 0.6 * flange), (1, height), (bore, height)]  # fmt: skip
    return ring(np.array(outline)), 1


@category("train", 0.1, 0.18)
def tape_dispenser(g: Random) -> tuple[Manifold, int]:
    """A desk dispenser with a roll of tape."""
    length, radius, width = g.uniform(1.9, 2.4), g.uniform(0.5, 0.65), g.uniform(0.5, 0.8)
    rise, low = radius * g.uniform(0.75, 1.0) + 0.2, g.uniform(0.25, 0.4)
    outline = [(-0.75, 0), (length - 0.75, 0), (length - 0.7, rise), (length - 0.9, rise), (0.75, low), (-0.6, low),
               (-0.75, low)]  # fmt: skip
    base = prism(outline, width, 0.04).rotate([90, 0, 0])
    roll = ring(np.array([(radius - g.uniform(0.2, 0.28), -0.32 * width), (radius, -0.32 * width), (radius, 0.32 * width),
                          (radius - 0.24, 0.32 * width)]))  # fmt: skip
    return join(base, along(roll, "y").translate([0, 0, low + 0.86 * radius])), 1


@category("train", 0.12, 0.22)
def magnifying_glass(g: Random) -> tuple[Manifold, int]:
    """A round or oval frame on a handle, with or without its lens."""
    a, b, rim, depth = 1.0, g.uniform(0.75, 1.0), g.uniform(0.15, 0.2), g.uniform(0.2, 0.32)
    frame = prism(superellipse(a, b, 2), depth, holes=[superellipse(a - rim, b - rim, 2)])
    length, radius = g.uniform(1.2, 2.2), g.uniform(0.14, 0.2)
    profile = smooth_profile([(radius * 0.8, 0), (radius * g.uniform(0.8, 1.0), 0.3 * length), (radius * 1.3, 0.8 * length),
                              (radius, length)], 28)  # fmt: skip
    handle = along(lathe(profile), "x").translate([a - 0.5 * rim, 0, 0])
    handle = handle - cylinder(1.0, 4.0).scale([a - rim, b - rim, 1])
    if g.random() < 0.5:
        return join(frame, handle, prism(superellipse(a - 0.5 * rim, b - 0.5 * rim, 2), 0.13)), 0
    return join(frame, handle), 1


@category("train", 0.09, 0.18)
def kettlebell(g: Random) -> tuple[Manifold, int]:
    """A weight with a grip on top."""
    squash, foot = g.uniform(0.85, 1.05), g.uniform(0.65, 0.85)
    ball = ellipsoid(1, 1, squash) ^ box(4, 4, 4).translate([0, 0, 2 - foot])
    rise, wide, thick = g.uniform(0.65, 0.95), g.uniform(0.55, 0.75), g.uniform(0.15, 0.22)
    path = spline([(-0.55, 0, 0.6 * squash), (-wide, 0, squash + 0.4 * rise), (-0.5 * wide, 0, squash + rise),
                   (0.5 * wide, 0, squash + rise), (wide, 0, squash + 0.4 * rise), (0.55, 0, 0.6 * squash)], 48)  # fmt: skip
    return join(ball, sweep(path, thick, side=(0, 1, 0))), 1


@category("train", 0.14, 0.24)
def mug_tree(g: Random) -> tuple[Manifold, int]:
    """A stand with a trunk and branches."""
    height, count = g.uniform(2.0, 2.8), int(g.integers(4, 8))
    base = cylinder(g.uniform(0.55, 0.8), 0.22, g.uniform(0.5, 0.6)).translate([0, 0, 0.11])
    parts = [base, capsule([0, 0, 0], [0, 0, height], 0.15, 0.12)]
    turn = g.uniform(80, 140)
    for k in range(count):
        z = height * (0.35 + 0.55 * k / count)
        length, angle = g.uniform(0.5, 0.75), np.radians(turn * k)
        tip = np.array([length * np.cos(angle), length * np.sin(angle), z + g.uniform(0.2, 0.45)])
        parts.append(capsule([0, 0, z], tip, 0.1, 0.09))
        if k % 2 == 0:
            parts.append(Manifold.sphere(0.14, 20).translate(tip))
    return join(*parts), 0
