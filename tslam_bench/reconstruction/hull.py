"""``hull``: the convex hull of the touched voxel centres."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from tslam_bench.constants import GRID_SIZE, VOXEL_EDGE, WORKSPACE_EDGE, WORKSPACE_LOW
from tslam_bench.errors import InvalidInputError
from tslam_bench.reconstruction.inputs import check_grids, empty_volume
from tslam_bench.reconstruction.volume import Volume

_CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))


def hull_points(touched: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The points whose convex hull is the reconstruction: (M, 3) in metres, object frame.

    They are the centres of the touched voxels. Centres that span no volume (fewer than four, or all on a line or in a
    plane) are replaced by the corners of their voxels, which thickens the flat hull to one voxel; a single touched
    voxel then gives exactly that voxel.
    """
    centres = np.argwhere(touched).astype(np.float64) + 0.5
    # Exact: the differences are small integers, far from the tolerance of the rank.
    if len(centres) > 0 and np.linalg.matrix_rank(centres - centres[0]) < 3:
        centres = np.unique((centres[:, None] + _CORNERS).reshape(-1, 3), axis=0)
    return np.asarray(WORKSPACE_LOW + VOXEL_EDGE * centres, dtype=np.float64)


def hull_planes(touched: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Half-spaces of the hull of a grid with at least one touched voxel.

    Returns:
        (F, 4) rows ``(n, d)``, ``n`` the outward unit normal: ``x`` is in the hull iff ``n @ x + d <= 0`` (m) for all.
    """
    equations = ConvexHull(hull_points(touched)).equations
    # Qhull triangulates its facets: one row of the many equal ones is enough. 1e-9 m is far below any real difference.
    return equations[np.unique(np.round(equations, 9), axis=0, return_index=True)[1]]


class HullReconstructor:
    """Convex hull of the touched voxel centres (:func:`hull_points`); free space is not used. Nothing touched: empty.

    The probability is ``0.5 - s / (2 e)`` clipped to [0, 1], with ``e`` the cell edge and ``s`` the largest signed
    plane distance (m, negative inside): exact inside the hull, never more than the distance outside it, and zero
    exactly on it. So the 0.5 level of the trilinear volume is the hull, rounded at edges by less than a cell.

    Args:
        resolution: cells per axis of the volume. An odd multiple of 32 puts a sample on every voxel centre, hence on
            every corner of the hull: at 96 the volume and the exact hull agree to IoU 0.999 from 20 random touches on.

    Raises:
        InvalidInputError: the resolution is not in 2..512.
    """

    name = "hull"

    def __init__(self, resolution: int = 3 * GRID_SIZE) -> None:
        if not 2 <= resolution <= 512:
            raise InvalidInputError(f"hull resolution {resolution}: choose 2 to 512 cells per axis")
        self.resolution = resolution

    def reconstruct(self, touched: NDArray[np.bool_], visited: NDArray[np.bool_]) -> Volume:
        """Touched and visited grids (32, 32, 32) bool, object frame -> volume with linear interpolation."""
        touched, _ = check_grids(touched, visited)
        if not touched.any():
            return empty_volume()
        planes = hull_planes(touched)
        points = hull_points(touched)
        edge = WORKSPACE_EDGE / self.resolution
        # Cells further than one edge from the bounding box are at 0 whatever the planes say.
        low = np.floor((points.min(axis=0) - WORKSPACE_LOW) / edge).astype(int) - 2
        high = np.ceil((points.max(axis=0) - WORKSPACE_LOW) / edge).astype(int) + 2
        low, high = np.maximum(low, 0), np.minimum(high, self.resolution)
        axes = [WORKSPACE_LOW + (np.arange(low[a], high[a]) + 0.5) * edge for a in range(3)]
        probability = np.zeros((self.resolution,) * 3, dtype=np.float32)
        for i, x in enumerate(axes[0]):  # one slab at a time keeps the (cells, planes) product small
            slab = np.stack(np.meshgrid([x], axes[1], axes[2], indexing="ij"), axis=-1).reshape(-1, 3)
            distance = (slab @ planes[:, :3].T + planes[:, 3]).max(axis=1)
            values = np.clip(0.5 - distance / (2 * edge), 0, 1)
            probability[low[0] + i, low[1] : high[1], low[2] : high[2]] = values.reshape(len(axes[1]), len(axes[2]))
        return Volume(probability, "linear")
