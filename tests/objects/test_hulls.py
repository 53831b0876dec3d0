"""Hulls in few arrays."""

import numpy as np
from manifold3d import Manifold

from tslam_bench.geometry.meshes import from_manifold
from tslam_bench.objects.hulls import pack_hulls, unpack_hulls


def test_packing_is_undone_by_unpacking():
    hulls = [from_manifold(Manifold.cube([1, 2, 3])), from_manifold(Manifold.sphere(1.0, 8))]
    for hull, (vertices, faces) in zip(hulls, unpack_hulls(*pack_hulls(hulls)), strict=True):
        np.testing.assert_array_equal(hull.vertices, vertices)
        np.testing.assert_array_equal(hull.faces, faces)
