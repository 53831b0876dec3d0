"""Simulated exploration: what a hand would have touched and swept, without simulating a hand.

Rollouts of the real task cost seconds each and show few shapes; a network needs thousands of varied examples. This
stands in for them: strokes of a palm that comes from one side and stops at the object, and fingers that reach a surface
point from outside. What matters is kept: touches come in small patches, only where something can get at, with 1 mm of
noise across the surface; free space is swept from outside, never through the solid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tslam_bench import grids
from tslam_bench.constants import WORKSPACE_EDGE
from tslam_bench.reconstruction.training_shapes import PlacedShape


@dataclass(frozen=True)
class TouchSimulation:
    """Ranges that examples are drawn from. Lengths in metres; ranges include both ends."""

    touched_voxels: tuple[int, int] = (4, 300)
    """Touched voxels aimed at, log-uniform."""
    approaches: tuple[int, int] = (1, 8)
    """Directions the hand comes from, as many as there are poses."""
    strokes: tuple[int, int] = (1, 6)
    """Palm strokes per approach."""
    palm: tuple[float, float, float] = (0.08, 0.09, 0.025)
    """Palm: width, length, thickness."""
    finger_radius: float = 0.0075
    finger_length: float = 0.06
    patch_radius: tuple[float, float] = (0.003, 0.012)
    """Radius of the surface patch under one contact."""
    contact_noise: float = 0.001
    """Standard deviation of contact points across the surface."""


@dataclass(frozen=True, eq=False)
class SimulatedTouches:
    """Grids (32, 32, 32) bool over W, and the contact points (M, 3) and swept points (K, 3) they come from."""

    touched: NDArray[np.bool_]
    visited: NDArray[np.bool_]
    contact_points: NDArray[np.float64]
    swept_points: NDArray[np.float64]


_BATCH = 48  # contacts tried at a time
_MAX_CONTACTS = 600
_STEP = 0.007  # between samples along strokes and fingers (m), below the voxel edge


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _frames(directions: NDArray[np.float64], generator: np.random.Generator) -> NDArray[np.float64]:
    """Right-handed frames (M, 3, 3) whose last row is the direction, turned about it at random."""
    first = _unit(np.cross(directions, generator.standard_normal(directions.shape)))
    return np.stack([first, np.cross(directions, first), directions], axis=-2)


def _palm_samples(simulation: TouchSimulation) -> NDArray[np.float64]:
    """Points (K, 3) in the palm's box, at most 1.25 cm apart, the third axis its thickness."""
    axes = [np.linspace(-size / 2, size / 2, int(np.ceil(size / 0.0125)) + 1) for size in simulation.palm]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _stroke(placed: PlacedShape, direction: NDArray, simulation: TouchSimulation, generator) -> NDArray[np.float64]:
    """Points swept by a palm that moves from outside W against ``direction``, past or up to the object."""
    frame = _frames(direction[None], generator)[0]
    half = WORKSPACE_EDGE / 2
    aim = generator.uniform(-half, half, 3) * 0.7
    facing = _unit(direction + 0.5 * generator.standard_normal(3))
    palm = _palm_samples(simulation) @ _frames(facing[None], generator)[0]
    start = aim + direction * (1.5 * half - aim @ direction)
    length = generator.uniform(0.5 * half, 2.5 * half)
    drift = 0.3 * generator.standard_normal(2) @ frame[:2]
    path = np.arange(0, length, _STEP)[:, None] * (drift - direction)
    points = start + path[:, None] + palm  # (steps, samples, 3)
    blocked = placed.inside(points).any(axis=1)
    stop = int(blocked.argmax()) if blocked.any() else len(path)
    return points[:stop].reshape(-1, 3)


def _finger_samples(simulation: TouchSimulation) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A finger along +z whose tip is a ball about the origin: its axis (A, 3), and points on its skin (K, 3)."""
    along = np.arange(0, simulation.finger_length, _STEP)[:, None] * np.array([0.0, 0.0, 1.0])
    angle = np.arange(6) * np.pi / 3
    around = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    pole = np.array([0.0, 0.0, -1.0])
    tip = np.concatenate([pole[None], 0.87 * around + 0.5 * pole, 0.5 * around + 0.87 * pole])
    skin = np.concatenate([tip, (along[:, None] / simulation.finger_radius + around).reshape(-1, 3)])
    return along, simulation.finger_radius * skin


def simulate_touches(
    placed: PlacedShape, generator: np.random.Generator, simulation: TouchSimulation | None = None
) -> SimulatedTouches:
    """Explores a placed shape for a random while. May touch fewer voxels than aimed at where little can be reached."""
    simulation = simulation or TouchSimulation()
    low, high = simulation.touched_voxels
    aimed = round(float(np.exp(generator.uniform(np.log(low), np.log(high)))))
    directions = _unit(generator.standard_normal((generator.integers(*simulation.approaches, endpoint=True), 3)))

    swept = [np.zeros((0, 3))]
    for direction in directions:
        for _ in range(generator.integers(*simulation.strokes, endpoint=True)):
            swept.append(_stroke(placed, direction, simulation, generator))

    surface, normals = placed.surface()
    axis, skin = _finger_samples(simulation)
    touched = np.zeros((grids.GRID_SIZE,) * 3, dtype=bool)
    contacts = [np.zeros((0, 3))]
    tried = 0
    while touched.sum() < aimed and tried < _MAX_CONTACTS:
        tried += _BATCH
        candidates = generator.choice(len(surface), _BATCH)
        direction = directions[generator.choice(len(directions), _BATCH)]
        point, normal = surface[candidates], normals[candidates]
        pointing = _unit(normal + 0.8 * direction + 0.4 * generator.standard_normal(normal.shape))
        tips = point + (simulation.finger_radius + 0.0005) * normal
        frames = _frames(pointing, generator)
        bodies = tips[:, None] + np.concatenate([axis, skin]) @ frames  # (M, A + K, 3)
        inside = placed.inside(bodies)
        # The lookup is coarser than the gap under the tip, so skin points may seem inside: the axis decides.
        reachable = ((normal * direction).sum(axis=1) > -0.3) & ~inside[:, : len(axis)].any(axis=1)
        for index in np.flatnonzero(reachable):
            swept.append(bodies[index][~inside[index]])
            radius = generator.uniform(*simulation.patch_radius)
            near = (np.square(surface - point[index]).sum(axis=1) < radius**2) & (normals @ normal[index] > 0.3)
            near[candidates[index]] = True
            offset = simulation.contact_noise * generator.standard_normal((int(near.sum()), 1))
            patch = surface[near] + offset * normals[near]
            contacts.append(patch)
            touched |= grids.points_to_grid(patch)
            if touched.sum() >= aimed:
                break
    swept_points = np.concatenate(swept)
    return SimulatedTouches(touched, grids.points_to_grid(swept_points), np.concatenate(contacts), swept_points)
