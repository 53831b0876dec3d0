"""The hand's skin: probe sites that sample touch, and volume points that sample where the hand has been (section 5).

Both are fixed in link frames and made from the collision shapes by a deterministic rule, so they need no file. A change of the
rule changes observations, so it bumps the environment ids.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tslam_bench.hand_constants import SKIN_LINKS
from tslam_bench.objects.hand import CollisionShape

AXIS_SPACING = 3e-3
"""Largest distance between probes on a capsule's axis (m)."""
FACE_SPACING = 5e-3
"""Largest distance between neighbouring probes on a box's face (m)."""
VOLUME_SPACING = 7.0e-3
"""Largest distance between neighbouring volume points (m): below a voxel edge, so that few voxels are missed."""


@dataclass(frozen=True)
class PointSet:
    """Points fixed in link frames, sorted by link.

    Attributes:
        link: (P,) int64 index into ``SKIN_LINKS``.
        position: (P, 3) float32 in the link's frame (m).
        radius: (P,) float32 (m).
    """

    link: NDArray[np.int64]
    position: NDArray[np.float32]
    radius: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.link)


@dataclass(frozen=True)
class Skin:
    """Probes (touch) and volume points (visited voxels) of the hand."""

    probes: PointSet
    volume: PointSet


def build_skin(shapes: Sequence[CollisionShape]) -> Skin:
    """Lays probes and volume points on the collision shapes of the links that wear skin."""
    return Skin(_points(shapes, _probe_points), _points(shapes, _volume_points))


def dense_volume_points(shapes: Sequence[CollisionShape], spacing: float) -> PointSet:
    """Every point of a cubic lattice of ``spacing`` (m) inside the shapes: the yardstick for the volume sample."""

    def lattice(shape: CollisionShape) -> tuple[NDArray[np.float64], float]:
        if shape.kind == "capsule":
            radius, half = shape.size
            extent = np.array([radius, radius, half + radius])
        else:
            extent = np.array(shape.size)
        axes = [np.arange(-np.floor(e / spacing), np.floor(e / spacing) + 1) * spacing for e in extent]
        points = _grid(axes)
        if shape.kind == "capsule":
            beyond = np.maximum(np.abs(points[:, 2]) - half, 0.0)
            points = points[points[:, 0] ** 2 + points[:, 1] ** 2 + beyond**2 <= radius**2]
        return points, 0.0

    return _points(shapes, lattice)


def _points(shapes: Sequence[CollisionShape], rule) -> PointSet:
    links, positions, radii = [], [], []
    for index, name in enumerate(SKIN_LINKS):
        for shape in shapes:
            if shape.link != name:
                continue
            local, radius = rule(shape)
            positions.append(local @ _matrix(shape.quaternion).T + np.array(shape.position))
            links.append(np.full(len(local), index, dtype=np.int64))
            radii.append(np.full(len(local), radius))
    return PointSet(
        np.concatenate(links),
        np.concatenate(positions).astype(np.float32),
        np.concatenate(radii).astype(np.float32),
    )


def _matrix(quaternion: Sequence[float]) -> NDArray[np.float64]:
    w, x, y, z = np.asarray(quaternion, dtype=np.float64) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _line(half: float, spacing: float) -> NDArray[np.float64]:
    """Evenly spaced from -half to half, both included, at most ``spacing`` apart."""
    return np.linspace(-half, half, int(np.ceil(2 * half / spacing - 1e-9)) + 1)


def _grid(axes: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _on_axis(stations: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([np.zeros_like(stations), np.zeros_like(stations), stations], axis=1)


def _probe_points(shape: CollisionShape) -> tuple[NDArray[np.float64], float]:
    if shape.kind == "capsule":
        radius, half = shape.size
        return _on_axis(_line(half, AXIS_SPACING)), radius
    points = _grid([_line(edge, FACE_SPACING) for edge in shape.size])
    return points[(np.abs(points) >= np.array(shape.size) - 1e-9).any(axis=1)], 0.0


def _volume_points(shape: CollisionShape) -> tuple[NDArray[np.float64], float]:
    if shape.kind == "box":
        return _grid([_line(edge, VOLUME_SPACING) for edge in shape.size]), 0.0
    radius, half = shape.size
    stations = _line(half, VOLUME_SPACING)
    around = int(np.ceil(2 * np.pi * radius / VOLUME_SPACING))
    angle = 2 * np.pi * np.arange(around) / around
    rings = [
        np.stack([radius * np.cos(angle + turn), radius * np.sin(angle + turn), np.full(around, z)], axis=1)
        for z, turn in zip(stations, np.arange(len(stations)) * np.pi / around, strict=True)
    ]
    caps: list[NDArray[np.float64]] = []
    for end in (-1.0, 1.0):
        caps.append(np.array([[0.0, 0.0, end * (half + radius)]]))
        tilt = np.pi / 4
        on_cap = max(4, int(np.ceil(2 * np.pi * radius * np.cos(tilt) / VOLUME_SPACING)))
        turn = 2 * np.pi * np.arange(on_cap) / on_cap
        height = np.full(on_cap, end * (half + radius * np.sin(tilt)))
        caps.append(np.stack([radius * np.cos(tilt) * np.cos(turn), radius * np.cos(tilt) * np.sin(turn), height], 1))
    return np.concatenate([_on_axis(stations), *rings, *caps]), 0.0
