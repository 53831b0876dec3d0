"""The seeded points at which solids are compared (protocol section 10)."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import IOU_POINTS, WORKSPACE_EDGE, WORKSPACE_LOW

IOU_POINTS_SEED = 20211108
"""Seed of the IoU points (the first day of CoRL 2021)."""


@cache
def iou_points() -> NDArray[np.float64]:
    """Uniform points in W, the same for every object and every submission: (100000, 3) metres, read-only."""
    generator = np.random.Generator(np.random.PCG64(IOU_POINTS_SEED))
    points = WORKSPACE_LOW + WORKSPACE_EDGE * generator.random((IOU_POINTS, 3))
    points.setflags(write=False)
    return points
