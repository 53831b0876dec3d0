"""Winding numbers at any points by counting signed crossings above them: exact for closed meshes, at a cost that is bounded.

The tree of :func:`igl.fast_winding_number` is the better way where faces are small; where very many are as long as the mesh, each
of them is near to every point, and it would look at all of them for each. Here a face is only compared with the points below and
above it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tslam_bench.compiled import njit

_POINTS_PER_CELL = 8
_MOST_CELLS = 512


def crossing_numbers(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], points: NDArray[np.float64], most_work: int
) -> NDArray[np.int32] | None:
    """How often a closed mesh winds around each point.

    Args:
        vertices, faces: (V, 3) and (F, 3), closed, counter-clockwise seen from outside.
        points: (M, 3) in the same unit.
        most_work: comparisons of a point with a face, and visits of cells, before it is given up.

    Returns:
        (M,) 1 inside, 0 outside, more where a mesh overlaps itself; None if that is too much work.
    """
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    cells = int(np.clip(np.sqrt(len(points) / _POINTS_PER_CELL), 1, _MOST_CELLS))
    edge = np.maximum((high - low) / cells, 1e-12) * (1 + 1e-9)
    cell = np.minimum(((points[:, :2] - low) / edge).astype(np.int64), cells - 1)
    flat = cell[:, 1] * cells + cell[:, 0]
    order = np.argsort(flat, kind="stable")
    starts = np.searchsorted(flat[order], np.arange(cells * cells + 1))
    numbers = np.zeros(len(points), dtype=np.int32)
    done = _count(vertices, faces, points[order], starts, cells, low, edge, numbers, most_work)
    if not done:
        return None
    result = np.empty_like(numbers)
    result[order] = numbers
    return result


@njit(cache=True)
def _count(
    vertices: NDArray,
    faces: NDArray,
    points: NDArray,
    starts: NDArray,
    cells: int,
    low: NDArray,
    edge: NDArray,
    numbers: NDArray,
    most_work: int,
) -> bool:
    """Adds up the crossings of every face above every point; False if there is too much to do.

    Args:
        points: in the order of their cells, cell ``y * cells + x`` from ``starts[cell]`` on.
    """
    work = 0
    corner = np.empty((3, 3))
    for face in faces:
        for k in range(3):
            corner[k] = vertices[face[k]]
        bottom = (min(corner[0, 1], corner[1, 1], corner[2, 1]) - low[1]) / edge[1]
        top = (max(corner[0, 1], corner[1, 1], corner[2, 1]) - low[1]) / edge[1]
        for row in range(max(int(np.floor(bottom - 1e-6)), 0), min(int(np.floor(top + 1e-6)), cells - 1) + 1):
            # Where the triangle is between the lower and the upper end of this row of cells.
            down, up = low[1] + (row - 1e-6) * edge[1], low[1] + (row + 1 + 1e-6) * edge[1]
            left, right = np.inf, -np.inf
            for k in range(3):
                x0, y0 = corner[k, 0], corner[k, 1]
                x1, y1 = corner[(k + 1) % 3, 0], corner[(k + 1) % 3, 1]
                if max(y0, y1) < down or min(y0, y1) > up:
                    continue
                for y in (min(max(y0, down), up), min(max(y1, down), up)):
                    x = x0 if y0 == y1 else x0 + (y - y0) / (y1 - y0) * (x1 - x0)
                    left, right = min(left, x), max(right, x)
                if y0 == y1:
                    left, right = min(left, x1), max(right, x1)
            first = max(int(np.floor((left - low[0]) / edge[0] - 1e-6)), 0)
            last = min(int(np.floor((right - low[0]) / edge[0] + 1e-6)), cells - 1)
            if last < first:
                continue
            begin, end = starts[row * cells + first], starts[row * cells + last + 1]
            work += end - begin + last - first + 1
            if work > most_work:
                return False
            for index in range(begin, end):
                numbers[index] += _crossing(corner, face, points[index, 0], points[index, 1], points[index, 2])
    return True


@njit(cache=True)
def _crossing(corner: NDArray, face: NDArray, x: float, y: float, z: float) -> int:
    """1 if the line upwards from a point leaves through a face, -1 if it enters, 0 if it misses it.

    The projected triangle winds around the point as its edges to the right say. An edge's answer does not depend on which
    of its two faces asks, so nothing is counted twice or left out where faces meet.
    """
    turns = 0
    for k in range(3):
        a, b = k, (k + 1) % 3
        if (corner[a, 1] > y) == (corner[b, 1] > y):
            continue
        up = corner[b, 1] > y
        if face[a] > face[b]:
            a, b = b, a
        share = (y - corner[a, 1]) / (corner[b, 1] - corner[a, 1])
        if x < corner[a, 0] + share * (corner[b, 0] - corner[a, 0]):
            turns += 1 if up else -1
    if turns == 0:
        return 0
    ux, uy, uz = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    vx, vy, vz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    normal = ux * vy - uy * vx
    height = (corner[0, 2] + corner[1, 2] + corner[2, 2]) / 3
    if normal != 0:
        px, py = x - corner[0, 0], y - corner[0, 1]
        height = corner[0, 2] + ((px * vy - py * vx) * uz + (ux * py - uy * px) * vz) / normal
    return turns if height > z else 0
