"""Occupancy grids and the eight poses: exact index arithmetic in numpy (protocol sections 1 and 3).

A grid has shape ``(..., 32, 32, 32)``, index ``[ix, iy, iz]``; voxel ``i`` covers ``[low + i h, low + (i + 1) h)`` on each
axis. Because every pose is a quarter-turn or half-turn about the workspace centre, turning a grid is a permutation of
its voxels: no resampling, no loss.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import GRID_SIZE, NUM_POSES, VOXEL_EDGE, WORKSPACE_LOW
from tslam_bench.errors import InvalidInputError

_QUARTER_TURNS = ((1, 0), (0, 1), (-1, 0), (0, -1))  # (cos, sin) of yaw 0, 90, 180, 270 degrees


def check_pose(pose: int) -> int:
    """Returns ``pose`` as an int. Raises InvalidInputError unless it is one of 0..7."""
    whole = isinstance(pose, (int, np.integer)) or (isinstance(pose, (float, np.floating)) and float(pose).is_integer())
    if isinstance(pose, bool) or not whole or not 0 <= int(pose) < NUM_POSES:
        raise InvalidInputError(f"pose {pose!r}: unknown; choose an integer from 0 to {NUM_POSES - 1}")
    return int(pose)


def pose_rotation(pose: int) -> NDArray[np.int64]:
    """Rotation of pose ``pose``: world point = rotation @ object point.

    Yaw of ``90 deg * (pose % 4)`` about world z, after a half-turn about world x for poses 4..7.

    Returns:
        (3, 3) signed permutation matrix.
    """
    pose = check_pose(pose)
    c, s = _QUARTER_TURNS[pose % 4]
    yaw = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=np.int64)
    flip = np.diag([1, -1, -1] if pose >= 4 else [1, 1, 1]).astype(np.int64)
    return yaw @ flip


def turn(grid: NDArray, rotation: NDArray[np.int64]) -> NDArray:
    """Moves every voxel of ``grid`` (..., N, N, N) to where ``rotation`` takes its centre.

    ``rotation`` (3, 3) is a signed permutation.
    """
    lead = grid.ndim - 3
    source_axis = np.abs(rotation).argmax(axis=1)  # output axis a reads input axis source_axis[a]
    turned = grid.transpose(*range(lead), *(lead + source_axis))
    reversed_axes = tuple(lead + a for a in range(3) if rotation[a, source_axis[a]] < 0)
    return np.flip(turned, axis=reversed_axes) if reversed_axes else turned


def object_to_world(grid: NDArray, pose: int) -> NDArray:
    """Grid (..., 32, 32, 32) in the object frame -> the same solid in the world frame for an object in ``pose``."""
    return np.ascontiguousarray(turn(grid, pose_rotation(pose)))


def world_to_object(grid: NDArray, pose: int) -> NDArray:
    """Grid (..., 32, 32, 32) sensed in the world frame -> object frame. Inverse of :func:`object_to_world`."""
    return np.ascontiguousarray(turn(grid, pose_rotation(pose).T))


def merge(grids: Iterable[NDArray]) -> NDArray[np.bool_]:
    """Union of boolean grids of one shape (protocol section 6: touched or, visited or)."""
    return np.logical_or.reduce([np.asarray(grid, dtype=bool) for grid in grids])


def voxel_centres(size: int = GRID_SIZE) -> NDArray[np.float64]:
    """Centres of a ``size``^3 grid over W: (size, size, size, 3) in metres."""
    axis = WORKSPACE_LOW + (np.arange(size) + 0.5) * (VOXEL_EDGE * GRID_SIZE / size)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)


def points_to_grid(points: NDArray) -> NDArray[np.bool_]:
    """Voxels that contain at least one of ``points`` (M, 3) in metres; points outside W are left out."""
    index = np.floor((np.asarray(points, dtype=np.float64) - WORKSPACE_LOW) / VOXEL_EDGE).astype(np.int64)
    index = index[((index >= 0) & (index < GRID_SIZE)).all(axis=1)]
    grid = np.zeros((GRID_SIZE,) * 3, dtype=bool)
    grid[tuple(index.T)] = True
    return grid


def pack(grid: NDArray) -> NDArray[np.uint8]:
    """Boolean grid (32, 32, 32) -> (4096,) packed bits, C order."""
    return np.packbits(np.asarray(grid, dtype=bool).reshape(-1))


def unpack(bits: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Inverse of :func:`pack`. Raises InvalidInputError for anything but (4096,) uint8."""
    bits = np.asarray(bits)
    if bits.shape != (GRID_SIZE**3 // 8,) or bits.dtype != np.uint8:
        raise InvalidInputError(f"packed grid: shape {bits.shape} {bits.dtype}, expected ({GRID_SIZE**3 // 8},) uint8")
    return np.unpackbits(bits).astype(bool).reshape((GRID_SIZE,) * 3)
