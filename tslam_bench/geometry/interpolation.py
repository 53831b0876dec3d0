"""Values between the samples of a regular grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates


def trilinear(values: NDArray, origin: NDArray, spacing: float, points: NDArray) -> NDArray[np.float64]:
    """Trilinear value (M,) of grid ``values`` (nx, ny, nz) at ``points`` (M, 3); beyond it the nearest border value.

    Args:
        origin: (3,) position of sample [0, 0, 0].
        spacing: distance of neighbouring samples.
    """
    index = (np.asarray(points, dtype=np.float64) - origin) / spacing
    return map_coordinates(values, index.T, output=np.float64, order=1, mode="nearest")
