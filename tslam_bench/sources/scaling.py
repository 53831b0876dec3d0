"""Brings imported meshes to the size of hand-held things (protocol section 8)."""

from __future__ import annotations

import zlib

import numpy as np

from tslam_bench.errors import AssetError
from tslam_bench.geometry.meshes import TriangleMesh

SCALING_SEED = 20211112
LONGEST_EDGE = (0.04, 0.24)
"""Range (m) of the longest bounding-box edge."""


def scale_to_hand(mesh: TriangleMesh, name: str) -> tuple[TriangleMesh, float]:
    """Scales a mesh so that its longest edge is drawn uniformly from the range, seeded by the object's name.

    Returns:
        the mesh, centred on its bounding box, and the factor.

    Raises:
        AssetError: the mesh has no extent.
    """
    generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence([SCALING_SEED, zlib.crc32(name.encode())])))
    longest = float(generator.uniform(*LONGEST_EDGE))
    extent = float(mesh.extents.max())
    if not (np.isfinite(extent) and extent > 0):
        raise AssetError("the mesh has no extent")
    factor = longest / extent
    low, high = mesh.bounds
    return TriangleMesh((mesh.vertices - (low + high) / 2) * factor, mesh.faces), factor
