"""Exact nearest neighbours between two sets of surface samples, as compiled loops.

Both sets are sorted along a Morton curve, cut into leaves of 32, and boxed in a balanced tree. The samples of a leaf look
together for their neighbours in the other set: they start from the leaf in which the ones before them found theirs, and
visit only boxes nearer than the worst distance that they know. Tight boxes matter: the cells of a k-d tree do not hug a flat
face that is parallel to an axis, and a query a few millimetres off such a face then visits most of it.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.compiled import njit

_LEAF: Final = 32
"""Samples of a leaf: many, since comparing them is one loop of vector instructions."""


class NearestSamples:
    """Samples of one surface, ready to be searched and to search.

    Raises:
        ValueError: ``points`` is not (M, 3) with at least one row.
    """

    def __init__(self, points: NDArray) -> None:
        """Args: points: (M, 3), not empty."""
        points = np.asarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
            raise ValueError(f"NearestSamples: shape {points.shape}; expected (M, 3) with at least one sample")
        self._order = morton_order(points)
        self._leaves, self._boxes = _build(points, self._order)

    def query(self, other: NearestSamples) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Distance (Q,) from each sample of ``other`` to the nearest of these, and the index (Q,) of that one."""
        squared, nearest = _search(self._leaves, self._boxes, self._order, other._leaves, other._boxes, other._order)
        return np.sqrt(squared), nearest


def morton_order(points: NDArray) -> NDArray[np.int64]:
    """Permutation (M,) that sorts ``points`` (M, 3) along a Morton curve of 1024 cells per axis of their bounding box."""
    low, extent = points.min(axis=0), max(float(np.ptp(points, axis=0).max()), 1e-12)
    return _sort(_morton_codes(np.asarray(points, dtype=np.float64), low, 1023 / extent))


@njit(cache=True)
def _morton_codes(points: NDArray, low: NDArray, scale: float) -> NDArray:
    codes = np.empty(len(points), dtype=np.int64)
    for row in range(len(points)):
        code = 0
        for axis in range(3):
            cell = min(max(int((points[row, axis] - low[axis]) * scale), 0), 1023)
            # Spreads ten bits so that two zeros follow each.
            cell = (cell | (cell << 16)) & 0x030000FF
            cell = (cell | (cell << 8)) & 0x0300F00F
            cell = (cell | (cell << 4)) & 0x030C30C3
            cell = (cell | (cell << 2)) & 0x09249249
            code |= cell << axis
        codes[row] = code
    return codes


@njit(cache=True)
def _sort(codes: NDArray) -> NDArray:
    """Stable permutation that sorts codes of 30 bits: three counting sorts of ten."""
    order = np.arange(len(codes))
    moved = np.empty_like(order)
    for shift in (0, 10, 20):
        starts = np.zeros(1025, dtype=np.int64)
        for code in codes:
            starts[((code >> shift) & 1023) + 1] += 1
        starts = np.cumsum(starts)
        for index in order:
            digit = (codes[index] >> shift) & 1023
            moved[starts[digit]] = index
            starts[digit] += 1
        order, moved = moved, order
    return order


@njit(cache=True)
def _build(points: NDArray, order: NDArray) -> tuple[NDArray, NDArray]:
    """Sorted samples in leaves, the last one filled up with copies of its last sample, and a heap-shaped tree of boxes.

    Returns:
        (L, 3, 32) samples; (2 n, 6) lower and upper corners: the root is 1, the children of i are 2 i and 2 i + 1, leaf l is
        n + l, with n >= L a power of two; boxes beyond the last leaf are empty (lower corner above the upper).
    """
    leaves = (len(points) + _LEAF - 1) // _LEAF
    ordered = np.empty((leaves, 3, _LEAF))
    for row in range(leaves * _LEAF):
        for axis in range(3):
            ordered[row // _LEAF, axis, row % _LEAF] = points[order[min(row, len(points) - 1)], axis]
    size = 1
    while size < leaves:
        size *= 2
    boxes = np.empty((2 * size, 6))
    boxes[:, :3], boxes[:, 3:] = np.inf, -np.inf
    for leaf in range(leaves):
        for axis in range(3):
            boxes[size + leaf, axis] = ordered[leaf, axis].min()
            boxes[size + leaf, 3 + axis] = ordered[leaf, axis].max()
    for box in range(size - 1, 0, -1):
        for axis in range(3):
            boxes[box, axis] = min(boxes[2 * box, axis], boxes[2 * box + 1, axis])
            boxes[box, 3 + axis] = max(boxes[2 * box, 3 + axis], boxes[2 * box + 1, 3 + axis])
    return ordered, boxes


@njit(cache=True, fastmath={"nnan", "nsz"})
def _gap(boxes: NDArray, box: int, x0: float, y0: float, z0: float, x1: float, y1: float, z1: float) -> float:
    """Squared distance of a box from the box of the other corners; infinite if it is empty."""
    x = max(boxes[box, 0] - x1, x0 - boxes[box, 3], 0.0)
    y = max(boxes[box, 1] - y1, y0 - boxes[box, 4], 0.0)
    z = max(boxes[box, 2] - z1, z0 - boxes[box, 5], 0.0)
    return x * x + y * y + z * z


@njit(cache=True)
def _search(
    samples: NDArray, boxes: NDArray, order: NDArray, queries: NDArray, query_boxes: NDArray, query_order: NDArray
) -> tuple[NDArray, NDArray]:
    """Squared distances (Q,) and indices (Q,) of the nearest samples, in the queries' own order."""
    size, query_size = len(boxes) // 2, len(query_boxes) // 2
    count = len(query_order)
    squared, nearest = np.empty(count), np.empty(count, dtype=np.int64)
    best, found, distances = np.empty(_LEAF), np.empty(_LEAF, dtype=np.int64), np.empty(_LEAF)
    stack, gaps = np.empty(64, dtype=np.int64), np.empty(64)
    hint = 0  # leaf of the samples in which the last query found its neighbour
    for leaf in range(len(queries)):
        x0, y0, z0, x1, y1, z1 = query_boxes[query_size + leaf]
        best[:] = np.inf
        worst = _compare(samples, boxes, hint, queries, leaf, best, found, distances)
        stack[0], gaps[0] = 1, _gap(boxes, 1, x0, y0, z0, x1, y1, z1)
        top = 1
        while top > 0:
            top -= 1
            box, gap = stack[top], gaps[top]
            if gap >= worst:
                continue
            if box >= size:
                if box - size != hint:
                    worst = _compare(samples, boxes, box - size, queries, leaf, best, found, distances)
                continue
            left, right = 2 * box, 2 * box + 1
            gap_left, gap_right = _gap(boxes, left, x0, y0, z0, x1, y1, z1), _gap(boxes, right, x0, y0, z0, x1, y1, z1)
            if gap_left > gap_right:
                left, right, gap_left, gap_right = right, left, gap_right, gap_left
            if gap_right < worst:
                stack[top], gaps[top] = right, gap_right
                top += 1
            if gap_left < worst:  # on top: the nearer box is visited first
                stack[top], gaps[top] = left, gap_left
                top += 1
        for k in range(min(_LEAF, count - leaf * _LEAF)):
            squared[query_order[leaf * _LEAF + k]] = best[k]
            nearest[query_order[leaf * _LEAF + k]] = order[min(found[k], len(order) - 1)]
        hint = found[_LEAF - 1] // _LEAF
    return squared, nearest


@njit(cache=True, fastmath={"nnan", "nsz"})
def _compare(
    samples: NDArray,
    boxes: NDArray,
    leaf: int,
    queries: NDArray,
    query_leaf: int,
    best: NDArray,
    found: NDArray,
    distances: NDArray,
) -> float:
    """Compares a leaf of queries with a leaf of samples; returns the largest of the best squared distances.

    Args:
        best, found: (32,) squared distance and sample that each query knows; updated.
        distances: (32,) scratch.
    """
    worst = 0.0
    box = len(boxes) // 2 + leaf
    for k in range(_LEAF):
        x, y, z = queries[query_leaf, 0, k], queries[query_leaf, 1, k], queries[query_leaf, 2, k]
        limit = best[k]
        if _gap(boxes, box, x, y, z, x, y, z) < limit:
            least = np.inf
            for s in range(_LEAF):
                dx, dy, dz = samples[leaf, 0, s] - x, samples[leaf, 1, s] - y, samples[leaf, 2, s] - z
                distances[s] = dx * dx + dy * dy + dz * dz
            for s in range(_LEAF):
                least = min(least, distances[s])
            if least < limit:
                limit = least
                best[k] = least
                for s in range(_LEAF):
                    if distances[s] == least:
                        found[k] = leaf * _LEAF + s
                        break
        worst = max(worst, limit)
    return worst
