"""Inside tests on regular grids by counting signed surface crossings along z.

Exact for a watertight mesh, and independent of winding numbers, so that each method can check the other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tslam_bench.geometry.meshes import TriangleMesh

_NUDGE = np.array([0.000_618, 0.000_382])  # of the spacing: keeps columns off vertices and edges of axis-aligned meshes
_CHUNK = 4_000_000


def _candidate_columns(
    low: NDArray[np.int64], high: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """All (triangle, ix, iy) with low <= (ix, iy) <= high, for (T, 2) index bounds."""
    size = np.maximum(high - low + 1, 0)
    count = size[:, 0] * size[:, 1]
    triangle = np.repeat(np.arange(len(count)), count)
    rank = np.arange(len(triangle)) - np.repeat(np.cumsum(count) - count, count)
    ix = low[triangle, 0] + rank // size[triangle, 1]
    iy = low[triangle, 1] + rank % size[triangle, 1]
    return triangle, ix, iy


def inside_grid(
    mesh: TriangleMesh, origin: NDArray[np.float64], spacing: float, shape: tuple[int, int, int]
) -> NDArray[np.bool_]:
    """Which samples of a regular grid lie inside a watertight mesh.

    Args:
        mesh: watertight mesh with outward faces.
        origin: (3,) position of sample [0, 0, 0] (m).
        spacing: distance of neighbouring samples (m).
        shape: samples per axis.

    Returns:
        ``shape`` bool: the surface winds around the sample at least once.
    """
    nx, ny, nz = shape
    corners = (mesh.triangles() - origin) / spacing
    corners[..., :2] -= _NUDGE
    low = np.maximum(np.ceil(corners[..., :2].min(axis=1)).astype(np.int64), 0)
    high = np.minimum(np.floor(corners[..., :2].max(axis=1)).astype(np.int64), [nx - 1, ny - 1])
    a, b, c = corners.transpose(1, 0, 2)
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    crossings = np.zeros((nx * ny, nz + 1), dtype=np.int32)
    count = np.maximum(high - low + 1, 0).prod(axis=1)
    count[area == 0] = 0  # seen edge-on: no column crosses it
    ends = np.cumsum(count)
    start = 0
    while start < len(count):
        stop = int(np.searchsorted(ends, (ends[start - 1] if start else 0) + _CHUNK, side="right"))
        stop = max(stop, start + 1)
        part = np.flatnonzero(count[start:stop]) + start
        triangle, ix, iy = _candidate_columns(low[part], high[part])
        triangle = part[triangle]
        px, py = ix.astype(np.float64), iy.astype(np.float64)
        ax, ay, az = a[triangle].T
        bx, by, bz = b[triangle].T
        cx, cy, cz = c[triangle].T
        twice = area[triangle]
        wa = ((bx - px) * (cy - py) - (by - py) * (cx - px)) / twice
        wb = ((cx - px) * (ay - py) - (cy - py) * (ax - px)) / twice
        wc = 1.0 - wa - wb
        hit = (wa >= 0) & (wb >= 0) & (wc >= 0)
        z = (wa * az + wb * bz + wc * cz)[hit]
        level = np.clip(np.ceil(z), 0, nz).astype(np.int64)  # first sample above the crossing
        # Going up, a face that looks down is an entrance (+1), one that looks up an exit (-1).
        np.add.at(crossings, (ix[hit] * ny + iy[hit], level), np.where(twice[hit] > 0, -1, 1).astype(np.int32))
        start = stop
    return (np.cumsum(crossings[:, :nz], axis=1) > 0).reshape(shape)
