"""``carve``: the hull of the touches without the free space that was swept."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from tslam_bench.constants import GRID_SIZE
from tslam_bench.grids import voxel_centres
from tslam_bench.reconstruction.hull import HullReconstructor, hull_planes
from tslam_bench.reconstruction.inputs import check_grids, empty_volume
from tslam_bench.reconstruction.volume import Volume


def carved_voxels(touched: NDArray[np.bool_], visited: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The voxels that may be solid, (32, 32, 32) bool.

    They are the touched voxels, visited or not, and the voxels with centres in the hull of the touched centres
    (:func:`tslam_bench.reconstruction.hull.hull_points`) that were not visited; without those that no path over faces of such
    voxels connects with a touched one. Nothing touched: none.
    """
    touched, visited = check_grids(touched, visited)
    if not touched.any():
        return touched
    planes = hull_planes(touched)
    distance = (voxel_centres().reshape(-1, 3) @ planes[:, :3].T + planes[:, 3]).max(axis=1)
    inside = (
        distance.reshape(touched.shape) <= 1e-9
    )  # m: far above rounding, far below the distance of any other centre
    components, _ = label(touched | (inside & ~visited))  # connected over faces
    return np.isin(components, np.unique(components[touched]))


class CarveReconstructor:
    """What free space leaves of the hull (:func:`carved_voxels`). Nothing touched: empty.

    The probability is the smaller of two: that of ``hull``, and the carved voxels (1) among the others (0), linear between
    voxel centres. So its 0.5 level is the hull's where the hull bounds the shape, and lies midway between the centres of kept
    and of removed voxels where free space does: on their common faces. There is no other number in it.

    Args:
        resolution: cells per axis of the volume, an odd multiple of 32 (see ``HullReconstructor``).

    Raises:
        InvalidInputError: the resolution is not in 2..512.
    """

    name = "carve"

    def __init__(self, resolution: int = 3 * GRID_SIZE) -> None:
        self._hull = HullReconstructor(resolution)
        self._centres = voxel_centres(resolution).reshape(-1, 3)

    def reconstruct(self, touched: NDArray[np.bool_], visited: NDArray[np.bool_]) -> Volume:
        """Touched and visited grids (32, 32, 32) bool, object frame -> volume with linear interpolation."""
        touched, visited = check_grids(touched, visited)
        if not touched.any():
            return empty_volume()
        hull = self._hull.reconstruct(touched, visited).probability
        kept = Volume(carved_voxels(touched, visited).astype(np.float32)).query(self._centres)
        return Volume(np.minimum(hull, kept.reshape(hull.shape)), "linear")
