"""A scalar field that is linear on tetrahedra, and the surface that bounds where it reaches a level.

Marching cubes draws a surface that is not the level set of the trilinear field: where samples alternate, or lie on the level,
solid and surface differ by 10 % and more. So the field itself is made of pieces that triangles can follow: every cell of the
lattice of samples is cut into 24 tetrahedra, each spanned by the cell's centre, the centre of one of its faces and an edge of
that face, and the field is linear on each. The value at a centre is the mean of the corners, as in trilinear interpolation,
which this field equals at corners, on edges and at the centres of faces and cells; and it has the cell's symmetries. The
surface is found tetrahedron by tetrahedron (Payne and Toga, 1990, "Surface mapping brain function on 3D models"), so it is
the boundary of the region at or above the level, to 1e-4 of a cell.

Compiled loops; numpy and numba only.
"""

from __future__ import annotations

import itertools
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.compiled import njit

APART: Final = 1e-4
"""Corners of the surface stay this far from the ends of the edges that they lie on, as a share of the edge. Where samples equal
the level, corners of many triangles would be one point, and a mesh whose equal corners are merged would not be closed."""


def _tetrahedra() -> NDArray[np.int64]:
    """(24, 4, 3) corners of a cell's tetrahedra in half cell edges from its lower corner, positively oriented.

    The order is the one in which :func:`_cell_values` lists its nodes' places: centre, face centre, two corners.
    """
    cells = []
    for axis, side, second, edge in itertools.product(range(3), (0, 2), (1, 2), (0, 2)):
        middle = (axis + second) % 3
        along = 3 - axis - middle
        face = np.ones(3, dtype=np.int64)
        face[axis] = side
        first = face.copy()
        first[middle] = edge
        last = first.copy()
        first[along], last[along] = 0, 2
        corners = np.array([np.ones(3, dtype=np.int64), face, first, last])
        if np.linalg.det(corners[1:] - corners[0]) < 0:
            corners[[2, 3]] = corners[[3, 2]]
        cells.append(corners)
    return np.array(cells)


_TETRAHEDRA: Final = _tetrahedra()
_EVEN: Final = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
"""Even permutations that bring each corner to the front."""
_PAIRS: Final = np.array(
    [p for p in itertools.permutations(range(4)) if np.linalg.det(np.eye(4)[list(p)]) > 0 and p[0] < p[1]]
)
"""(6, 4) even permutations: one for each pair that may be inside."""


@njit(cache=True)
def interpolate(values: NDArray, positions: NDArray) -> NDArray:
    """The field at ``positions``.

    Args:
        values: (R, R, R) float32 samples.
        positions: (M, 3) float64 in cell edges, sample ``[i, j, k]`` at (i, j, k); beyond the outermost samples the field
            goes on as it is there.

    Returns:
        (M,) float32.
    """
    last = values.shape[0] - 1
    result = np.empty(len(positions), dtype=np.float32)
    low = np.empty(3, dtype=np.int64)
    off = np.empty(3)  # from the cell's centre
    for row in range(len(positions)):
        for axis in range(3):
            position = min(max(positions[row, axis], 0.0), float(last))
            low[axis] = max(min(int(position), last - 1), 0)
            off[axis] = position - low[axis] - 0.5
        x, y, z = low
        step = 1 if last > 0 else 0
        v000, v001 = np.float64(values[x, y, z]), np.float64(values[x, y, z + step])
        v010, v011 = np.float64(values[x, y + step, z]), np.float64(values[x, y + step, z + step])
        v100, v101 = np.float64(values[x + step, y, z]), np.float64(values[x + step, y, z + step])
        v110, v111 = np.float64(values[x + step, y + step, z]), np.float64(values[x + step, y + step, z + step])
        if v000 == v001 == v010 == v011 == v100 == v101 == v110 == v111:
            result[row] = v000
            continue
        a, b, c = abs(off[0]), abs(off[1]), abs(off[2])
        # first: axis of the face that the point is nearest to; second: of the edge; third: along the edge.
        if a >= b and a >= c:
            first, second = 0, (1 if b >= c else 2)
        elif b >= c:
            first, second = 1, (0 if a >= c else 2)
        else:
            first, second = 2, (0 if a >= b else 1)
        third = 3 - first - second
        # The two corners of the edge and the two of the opposite edge of the face.
        near = np.zeros(3, dtype=np.int64)
        near[first] = step if off[first] >= 0 else 0
        far = near.copy()
        near[second] = step if off[second] >= 0 else 0
        far[second] = step - near[second]
        i, j, k = x + near[0], y + near[1], z + near[2]
        p, q, r = x + far[0], y + far[1], z + far[2]
        di, dj, dk = (step if third == 0 else 0), (step if third == 1 else 0), (step if third == 2 else 0)
        start, end = np.float64(values[i, j, k]), np.float64(values[i + di, j + dj, k + dk])
        other = np.float64(values[p, q, r]) + np.float64(values[p + di, q + dj, r + dk])
        face = 0.25 * ((start + end) + other)
        centre = 0.125 * (((v000 + v001) + (v010 + v011)) + ((v100 + v101) + (v110 + v111)))
        result[row] = (
            centre
            + 2 * abs(off[first]) * (face - centre)
            + 2 * abs(off[second]) * (0.5 * (start + end) - face)
            + off[third] * (end - start)
        )
    return result


def surface(values: NDArray, level: float, most: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Boundary of the region where the field is at least ``level``, cut off half a cell beyond the outermost samples.

    Args:
        values: (R, R, R) float32 samples; the field goes on for half a cell beyond them, as it is there.
        level: the level.
        most: triangles that are made at most.

    Returns:
        triangles (T, 3, 3): corners in cells from the lower corner of the whole (sample ``[i, j, k]`` at i + 0.5, ...),
        counter-clockwise seen from outside; keys (T, 3): equal where triangles share a corner.

    Raises:
        ValueError: there are more than ``most``; nothing was made then.
    """
    solid = values >= level
    shape = (0, 3, 3)
    if not solid.any():
        return np.zeros(shape), np.zeros((0, 3), dtype=np.int64)
    size = values.shape[0]
    # Only the part around the solid is looked at: from one sample below it to one above.
    low, high = [], []
    for axis in range(3):
        there = np.flatnonzero(solid.any(axis=tuple(a for a in range(3) if a != axis)))
        low.append(max(int(there[0]) - 1, 0))
        high.append(min(int(there[-1]) + 2, size))
    part = values[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
    # Two layers around it: the outermost samples again, on the faces of the whole, and minus infinity beyond them, which
    # closes the surface there. Where the part ends inside the whole, the layers lie outside the solid anyway.
    padded = np.pad(np.pad(part.astype(np.float64), 1, mode="edge"), 1, constant_values=-np.inf)
    axes = np.zeros((3, 2 * max(padded.shape)))
    for axis in range(3):
        samples = np.arange(low[axis], high[axis]) + 0.5
        ends = [0.0 if low[axis] == 0 else samples[0] - 0.5, float(size) if high[axis] == size else samples[-1] + 0.5]
        places = np.concatenate([[ends[0] - 1, ends[0]], samples, [ends[1], ends[1] + 1]])
        axes[axis, : 2 * len(places) : 2] = places
        axes[axis, 1 : 2 * len(places) - 1 : 2] = (places[1:] + places[:-1]) / 2
    count = _count(padded, level, most)
    if count > most:
        raise ValueError(f"the surface has more than {most:,} triangles")
    triangles, keys = np.empty((count, 3, 3)), np.empty((count, 3), dtype=np.int64)
    _fill(padded, axes, level, triangles, keys)
    return triangles, keys


@njit(cache=True)
def _crossed(values: NDArray, level: float, i: int, j: int, k: int) -> bool:
    """Whether the corners of a cell lie on both sides of ``level``."""
    first = values[i, j, k] >= level
    for di in range(2):
        for dj in range(2):
            for dk in range(2):
                if (values[i + di, j + dj, k + dk] >= level) != first:
                    return True
    return False


@njit(cache=True)
def _cell_values(values: NDArray, i: int, j: int, k: int, nodes: NDArray) -> None:
    """Fills ``nodes`` (3, 3, 3), in half cell edges: corners, centres of the faces (means) and of the cell."""
    for di in range(2):
        for dj in range(2):
            for dk in range(2):
                nodes[2 * di, 2 * dj, 2 * dk] = values[i + di, j + dj, k + dk]
    for s in (0, 2):
        nodes[s, 1, 1] = 0.25 * ((nodes[s, 0, 0] + nodes[s, 0, 2]) + (nodes[s, 2, 0] + nodes[s, 2, 2]))
        nodes[1, s, 1] = 0.25 * ((nodes[0, s, 0] + nodes[0, s, 2]) + (nodes[2, s, 0] + nodes[2, s, 2]))
        nodes[1, 1, s] = 0.25 * ((nodes[0, 0, s] + nodes[0, 2, s]) + (nodes[2, 0, s] + nodes[2, 2, s]))
    below = (nodes[0, 0, 0] + nodes[0, 0, 2]) + (nodes[0, 2, 0] + nodes[0, 2, 2])
    above = (nodes[2, 0, 0] + nodes[2, 0, 2]) + (nodes[2, 2, 0] + nodes[2, 2, 2])
    nodes[1, 1, 1] = 0.125 * (below + above)


@njit(cache=True)
def _count(values: NDArray, level: float, most: int) -> int:
    """Number of triangles of the surface; more than ``most`` are not all counted."""
    nodes = np.empty((3, 3, 3))
    total = 0
    for i in range(values.shape[0] - 1):
        if total > most:
            break
        for j in range(values.shape[1] - 1):
            for k in range(values.shape[2] - 1):
                if not _crossed(values, level, i, j, k):
                    continue
                _cell_values(values, i, j, k, nodes)
                for tetrahedron in range(24):
                    inside = 0
                    for corner in range(4):
                        x, y, z = _TETRAHEDRA[tetrahedron, corner]
                        inside += nodes[x, y, z] >= level
                    total += (0, 1, 2, 1, 0)[inside]
    return total


@njit(cache=True)
def _fill(values: NDArray, axes: NDArray, level: float, triangles: NDArray, keys: NDArray) -> None:
    """Writes the triangles that :func:`_count` counted.

    Args:
        axes: (3, ...) coordinates of the lattice of half cell edges.
    """
    nodes = np.empty((3, 3, 3))
    inside = np.empty(4, dtype=np.bool_)
    place = np.empty((4, 3), dtype=np.int64)
    value = np.empty(4)
    row = 0
    for i in range(values.shape[0] - 1):
        for j in range(values.shape[1] - 1):
            for k in range(values.shape[2] - 1):
                if not _crossed(values, level, i, j, k):
                    continue
                _cell_values(values, i, j, k, nodes)
                for tetrahedron in range(24):
                    count = 0
                    for corner in range(4):
                        x, y, z = _TETRAHEDRA[tetrahedron, corner]
                        value[corner] = nodes[x, y, z]
                        inside[corner] = value[corner] >= level
                        count += inside[corner]
                        place[corner, 0], place[corner, 1], place[corner, 2] = 2 * i + x, 2 * j + y, 2 * k + z
                    if count == 1 or count == 3:
                        alone = 0
                        while inside[alone] != (count == 1):
                            alone += 1
                        for turn in range(3):
                            # The lone corner outside: seen from the other side.
                            other = _EVEN[alone, 1 + turn if count == 1 else 3 - turn]
                            _cross(triangles, keys, row, turn, value, place, axes, level, alone, other, inside[alone])
                        row += 1
                    elif count == 2:
                        pair = 0
                        while not (inside[_PAIRS[pair, 0]] and inside[_PAIRS[pair, 1]]):
                            pair += 1
                        a, b, c, d = _PAIRS[pair]
                        _cross(triangles, keys, row, 0, value, place, axes, level, a, c, True)
                        _cross(triangles, keys, row, 1, value, place, axes, level, a, d, True)
                        _cross(triangles, keys, row, 2, value, place, axes, level, b, d, True)
                        triangles[row + 1, 0], keys[row + 1, 0] = triangles[row, 0], keys[row, 0]
                        triangles[row + 1, 1], keys[row + 1, 1] = triangles[row, 2], keys[row, 2]
                        _cross(triangles, keys, row + 1, 2, value, place, axes, level, b, c, True)
                        row += 2


@njit(cache=True)
def _cross(
    triangles: NDArray,
    keys: NDArray,
    row: int,
    column: int,
    value: NDArray,
    place: NDArray,
    axes: NDArray,
    level: float,
    first: int,
    second: int,
    first_inside: bool,
) -> None:
    """Writes where the edge between two corners of a tetrahedron crosses the level."""
    a, b = (first, second) if first_inside else (second, first)
    share = (value[a] - level) / (value[a] - value[b])  # 0 towards the outside, where the value is minus infinity
    share = min(max(share, APART), 1 - APART)
    key_a, key_b = np.int64(0), np.int64(0)
    length = axes.shape[1]
    for axis in range(3):
        start, end = axes[axis, place[a, axis]], axes[axis, place[b, axis]]
        triangles[row, column, axis] = start + share * (end - start)
        key_a, key_b = key_a * length + place[a, axis], key_b * length + place[b, axis]
    keys[row, column] = key_a * length**3 + key_b
