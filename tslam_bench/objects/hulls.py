"""Convex hulls as few arrays, as files hold them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

Hull = tuple[NDArray[np.float64], NDArray[np.int64]]
"""vertices (v, 3) in metres and faces (f, 3) of one hull."""


def pack_hulls(hulls: Sequence[Hull]) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Hulls in three arrays: all vertices, all faces (indices within their hull), offsets (H + 1, 2) of both."""
    counts = np.array([[len(vertices), len(faces)] for vertices, faces in hulls], dtype=np.int64)
    offsets = np.concatenate([np.zeros((1, 2), dtype=np.int64), np.cumsum(counts, axis=0)])
    return np.concatenate([v for v, _ in hulls]), np.concatenate([f for _, f in hulls]), offsets


def unpack_hulls(vertices: NDArray[np.float64], faces: NDArray[np.int64], offsets: NDArray) -> Iterable[Hull]:
    """Inverse of :func:`pack_hulls`."""
    for (v0, f0), (v1, f1) in itertools.pairwise(offsets.tolist()):
        yield vertices[v0:v1], faces[f0:f1]
