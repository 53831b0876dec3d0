"""``grid``: the touched voxels as they are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tslam_bench.reconstruction.inputs import check_grids
from tslam_bench.reconstruction.volume import Volume


class GridReconstructor:
    """Probability 1 in every touched voxel and 0 elsewhere, constant inside a voxel. Nothing touched: empty."""

    name = "grid"

    def reconstruct(self, touched: NDArray[np.bool_], visited: NDArray[np.bool_]) -> Volume:
        """Touched and visited grids (32, 32, 32) bool, object frame -> 32^3 volume with nearest interpolation."""
        touched, _ = check_grids(touched, visited)
        return Volume(touched.astype(np.float32), "nearest")
