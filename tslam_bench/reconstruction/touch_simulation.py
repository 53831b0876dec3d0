"""Simulated exploration: what a hand would have touched and swept, without simulating a hand.

Rollouts of the real task cost seconds each and show few shapes; a network needs thousands of varied examples. This stands
in for them and keeps what matters: touches come in clusters, only where a finger can get at, and the voxel of a touch is
nearly always visited too; free space is swept in large pieces, never through the solid; surfaces are passed closely
without being touched. Ranges were chosen by comparison with rollouts of the random and the heuristic baseline
(docs/reconstruction.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt, label

from tslam_bench.constants import GRID_SIZE, VOXEL_EDGE, WORKSPACE_EDGE, WORKSPACE_LOW
from tslam_bench.grids import points_to_grid, voxel_centres
from tslam_bench.reconstruction.training_shapes import PlacedShape


@dataclass(frozen=True)
class TouchSimulation:
    """Ranges that examples are drawn from. Lengths in metres; ranges include both ends."""

    approaches: tuple[int, int] = (1, 8)
    """Directions the hand comes from: the poses that were explored."""
    touched_voxels: tuple[int, int] = (2, 300)
    """Touched voxels aimed at per approach, log-uniform over examples; never less than four in all."""
    sweeps: tuple[int, int] = (1, 20)
    """Balls of free space that the hand sweeps per approach. Examples with many sweeps tend to have many touches."""
    sweep_radius: tuple[float, float] = (0.035, 0.09)
    close_sweeps: float = 0.8
    """Share of approaches whose sweeps pass right beside the object; the others keep a voxel away from it."""
    finger_radius: float = 0.0075
    finger_length: float = 0.06
    grasp_radius: float = 0.03
    """The contacts of one grasp lie within this distance of each other's centre."""
    contacts_per_grasp: tuple[int, int] = (1, 12)
    patch_radius: tuple[float, float] = (0.003, 0.010)
    """Radius of the surface patch under one contact."""
    near_miss_gap: tuple[float, float] = (0.002, 0.010)
    """Gap under a finger that comes close without touching; there are as many of these as contacts."""
    contact_noise: float = 0.0003
    """Standard deviation of contact points across the surface."""


@dataclass(frozen=True, eq=False)
class SimulatedTouches:
    """What one example's hand felt and swept.

    Attributes:
        touched, visited: (32, 32, 32) bool over W.
        contact_points: (M, 3) points whose voxels are touched.
        finger_points: (K, 3) points of fingers; their voxels are visited.
        swept_voxels: (32, 32, 32) bool, free space swept away from the surface; visited too.
    """

    touched: NDArray[np.bool_]
    visited: NDArray[np.bool_]
    contact_points: NDArray[np.float64]
    finger_points: NDArray[np.float64]
    swept_voxels: NDArray[np.bool_]


_MAX_GRASPS = 300
_MAX_LOCAL = 2000  # surface samples looked at per grasp; they come in random order
_STEP = 0.007  # between samples along a finger (m), below the voxel edge


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _frames(directions: NDArray[np.float64], generator: np.random.Generator) -> NDArray[np.float64]:
    """Right-handed frames (M, 3, 3) whose last row is the direction, turned about it at random."""
    first = _unit(np.cross(directions, generator.standard_normal(directions.shape)))
    return np.stack([first, np.cross(directions, first), directions], axis=-2)


def _open_space(placed: PlacedShape, surface: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Voxels (32, 32, 32) outside the solid and its surface that a finger reaches from the rim of W: all of them, and
    those that are not next to the solid."""
    solid = placed.inside(voxel_centres()) | points_to_grid(surface)
    clear = distance_transform_edt(~solid) > 1.5
    components, _ = label(clear)
    rim = np.ones_like(clear)
    rim[1:-1, 1:-1, 1:-1] = False
    connected = np.unique(components[rim & clear])
    reached = binary_dilation(np.isin(components, connected) & clear, np.ones((3, 3, 3))) & ~solid
    return reached, reached & clear


def _squared_distances(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Between points (M, 3) and (N, 3): (M, N)."""
    x, y, z = (np.square(first[:, None, axis] - second[None, :, axis]) for axis in range(3))
    return x + y + z


def _is_open(space: NDArray[np.bool_], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether points (M, 3) are in voxels of ``space`` or outside W."""
    index = np.floor((points - WORKSPACE_LOW) / VOXEL_EDGE).astype(np.int64)
    outside = np.asarray(((index < 0) | (index >= GRID_SIZE)).any(axis=1))
    index = np.clip(index, 0, GRID_SIZE - 1)
    return outside | space[index[:, 0], index[:, 1], index[:, 2]]


def _sweeps(
    direction: NDArray[np.float64], count: int, simulation: TouchSimulation, generator: np.random.Generator
) -> NDArray[np.bool_]:
    """Voxels in ``count`` balls on the side of W that the hand comes from."""
    half = WORKSPACE_EDGE / 2
    centres = voxel_centres()
    swept = np.zeros((GRID_SIZE,) * 3, dtype=bool)
    for _ in range(count):
        centre = half * (generator.uniform(0, 0.9) * direction + 0.45 * generator.standard_normal(3))
        radius = generator.uniform(*simulation.sweep_radius)
        x, y, z = (np.square(centres[..., a] - centre[a]) for a in range(3))
        swept |= x + y + z < radius**2
    return np.asarray(swept & (centres @ direction > half * generator.uniform(-0.7, 0.3)))


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
    approaches = int(generator.integers(*simulation.approaches, endpoint=True))
    activity = generator.random()
    few, many = np.log(simulation.touched_voxels)
    share = np.clip(activity + generator.uniform(-0.3, 0.3), 0, 1)
    aimed = max(4, round(approaches * float(np.exp(few + share * (many - few)))))
    least, most = simulation.sweeps
    directions = _unit(generator.standard_normal((approaches, 3)))

    surface, normals = placed.surface()
    swept = np.zeros((GRID_SIZE,) * 3, dtype=bool)
    close, clear = _open_space(placed, surface)
    for direction in directions:
        space = close if generator.random() < simulation.close_sweeps else clear
        count = int(generator.integers(least, least + round(activity * (most - least)), endpoint=True))
        swept |= _sweeps(direction, count, simulation, generator) & space

    axis, skin = _finger_samples(simulation)
    touched = np.zeros((GRID_SIZE,) * 3, dtype=bool)
    contacts, fingers = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for _ in range(_MAX_GRASPS):
        # A grasp: fingers close around one place of the surface, from one side; half of them stop short of it.
        direction = directions[generator.integers(approaches)]
        focus = surface[generator.integers(len(surface))]
        count = int(generator.integers(*simulation.contacts_per_grasp, endpoint=True))
        distances = _squared_distances(focus[None], surface)[0]
        around = np.flatnonzero(distances < simulation.grasp_radius**2)
        beyond = np.flatnonzero(distances < (simulation.grasp_radius + simulation.patch_radius[1]) ** 2)[:_MAX_LOCAL]
        local, local_normals = surface[beyond], normals[beyond]
        chosen = around[generator.integers(len(around), size=2 * count)]
        touches = np.arange(2 * count) < count
        gap = np.where(touches, 0.0005, generator.uniform(*simulation.near_miss_gap, 2 * count))
        point, normal = surface[chosen], normals[chosen]
        pointing = _unit(normal + 0.8 * direction + 0.4 * generator.standard_normal(normal.shape))
        tips = point + (simulation.finger_radius + gap)[:, None] * normal
        bodies = tips[:, None] + np.concatenate([axis, skin]) @ _frames(pointing, generator)  # (2 count, A + K, 3)
        inside = placed.inside(bodies)
        # The lookup is coarser than the gap under the tip, so skin points may seem inside: the axis decides.
        reachable = ((normal * direction).sum(axis=1) > -0.3) & ~inside[:, : len(axis)].any(axis=1)
        reachable &= _is_open(close, bodies[:, len(axis) - 1])  # the finger's base connects to the outside
        radius = generator.uniform(*simulation.patch_radius, 2 * count)
        patches = (_squared_distances(point, local) < radius[:, None] ** 2) & (normal @ local_normals.T > 0.3)
        for index in np.flatnonzero(reachable):
            fingers.append(bodies[index][~inside[index]])
            if not touches[index]:
                continue
            near = np.flatnonzero(patches[index])
            noise = simulation.contact_noise * generator.standard_normal((len(near), 1))
            patch = local[near] + noise * local_normals[near]
            contacts.append(patch)
            fingers.append(local[near] + 0.001 * local_normals[near])  # the skin is within 1 mm of what it touches
            touched |= points_to_grid(patch)
            if np.count_nonzero(touched) >= aimed:
                break
        if np.count_nonzero(touched) >= aimed:
            break
    finger_points = np.concatenate(fingers)
    visited = swept | points_to_grid(finger_points)
    return SimulatedTouches(touched, visited, np.concatenate(contacts), finger_points, swept)
