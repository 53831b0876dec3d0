"""Triangles as their corners, (F, 3, 3) in any unit, counter-clockwise from outside: normals, areas, points on them.

numpy only, so that scoring can use it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def _edge_products(corners: NDArray) -> NDArray:
    """(F, 3) cross products of two edges: outward, and twice as long as the area is large."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def areas(corners: NDArray) -> NDArray:
    """(F,) areas."""
    return np.linalg.norm(_edge_products(corners), axis=1) / 2


def face_normals(corners: NDArray) -> NDArray:
    """(F, 3) outward unit normals; zero for triangles without area."""
    normals = _edge_products(corners)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)


def points_on(corners: NDArray, u: NDArray, v: NDArray) -> NDArray:
    """(M, 3) points of triangles (M, 3, 3): uniform over each where ``u`` and ``v`` (M, 1) are uniform in [0, 1].

    R. Osada et al., "Shape distributions", ACM Transactions on Graphics 2002, section 4.2.
    """
    root = np.sqrt(u)
    return (1 - root) * corners[:, 0] + root * (1 - v) * corners[:, 1] + root * v * corners[:, 2]
