"""Exact integrals over the solid that a closed mesh encloses, as sums over the tetrahedra of its faces and a point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tslam_bench.errors import AssetError
from tslam_bench.geometry.meshes import TriangleMesh


@dataclass(frozen=True, eq=False)
class Moments:
    """Moments of a solid.

    Attributes:
        volume: in the cube of the mesh's unit.
        centroid: (3,) centre of the volume.
        radius: root of the mean squared distance from the centroid.
        covariance: (3, 3) of its points about the centroid.
    """

    volume: float
    centroid: NDArray[np.float64]
    radius: float
    covariance: NDArray[np.float64]


def moments(mesh: TriangleMesh) -> Moments:
    """Moments of the solid in a closed mesh.

    Raises:
        AssetError: it encloses no volume.
    """
    reference = mesh.bounds.mean(axis=0)
    corners = mesh.triangles() - reference
    sixfold = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    total = corners.sum(axis=1)
    volume = float(sixfold.sum() / 6)
    if not volume > 0:
        raise AssetError("encloses no volume")
    offset = (sixfold[:, None] * total).sum(axis=0) / (24 * volume)
    # Integral of x x^T over the tetrahedron of a face and the origin: volume / 20 * (sum of v v^T + s s^T), s the sum of v.
    second = np.einsum("f,fki,fkj->ij", sixfold, corners, corners) + np.einsum("f,fi,fj->ij", sixfold, total, total)
    # The trace is summed by itself: figures of prepared objects rest on the last bits of the radius.
    trace = float((sixfold * ((corners**2).sum(axis=(1, 2)) + (total**2).sum(axis=1))).sum() / (120 * volume))
    covariance = second / (120 * volume) - np.outer(offset, offset)
    return Moments(volume, reference + offset, float(np.sqrt(trace - offset @ offset)), covariance)


# Hulls are scaled by the two below, which sum in another order than moments(): one routine would change the last bits of
# every hull, and with them the hashes of all prepared objects.


def volume(mesh: TriangleMesh) -> float:
    """Volume that a closed mesh encloses."""
    a, b, c = (mesh.triangles() - mesh.vertices.mean(axis=0)).transpose(1, 0, 2)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def centroid(mesh: TriangleMesh) -> NDArray[np.float64]:
    """Centre of mass (3,) of the volume that a closed mesh encloses."""
    reference = mesh.vertices.mean(axis=0)
    a, b, c = (mesh.triangles() - reference).transpose(1, 0, 2)
    sixfold = np.einsum("ij,ij->i", a, np.cross(b, c))
    return reference + (sixfold[:, None] * (a + b + c) / 4).sum(axis=0) / sixfold.sum()
