"""Too good to be felt: remarks on an entry that a careful reader would ask about. Flags are shown; they change no figure.

A flag is a question, not a verdict: ``docs/verification.md`` says what raises each of them and which honest methods do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from tslam_bench.constants import F_SCORE_DISTANCES, VOXEL_EDGE, WORKSPACE_LOW
from tslam_bench.scoring.score_file import ObjectScore
from tslam_bench.scoring.submission import (
    EXPLORATION_ORDER,
    RECONSTRUCTED_POSES,
    Submission,
    reconstruction_name,
    rollout_name,
)

FAR_FROM_TOUCH: Final = 3.0
"""The true surface counts as unfelt where no touched voxel is within this many voxel edges (23 mm)."""
LEAST_UNFELT: Final = 0.1
"""Share of the true surface that has to be unfelt for a figure."""
MOST_RIGHT_UNFELT: Final = 0.4
"""Mean share of the unfelt surface that an entry may have within 1 % of W of its own, without a flag."""
REGISTERED_RIGHT_UNFELT: Final = 0.11
"""The same of the best registered reconstructor that was measured (``ifnet``; 24 val objects, two explorers)."""
_LAST: Final = max(RECONSTRUCTED_POSES)


def unfelt_surface(touched: NDArray[np.bool_], surface_points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which samples (N, 3) m of the true surface are far from every touched voxel of the grid (32, 32, 32), object frame."""
    if not touched.any():
        return np.ones(len(surface_points), dtype=bool)
    index = np.floor((surface_points - WORKSPACE_LOW) / VOXEL_EDGE).astype(np.int64)
    away = distance_transform_edt(~touched)
    return away[tuple(np.clip(index, 0, touched.shape[0] - 1).T)] > FAR_FROM_TOUCH


def right_where_unfelt(unfelt: NDArray[np.bool_], completeness: NDArray[np.float64]) -> float | None:
    """Share of the unfelt surface that a predicted one is near, or None where too little is unfelt.

    Args:
        unfelt: (N,) see :func:`unfelt_surface`.
        completeness: (N,) distance of each true sample to the predicted surface, metric units.
    """
    if unfelt.mean() < LEAST_UNFELT:
        return None
    return float((completeness[unfelt] <= F_SCORE_DISTANCES[0]).mean())


def unfelt_flags(shares: Sequence[float | None]) -> list[str]:
    """A flag for an entry whose reconstructions of one pose are right where nothing was felt, over all objects and seeds."""
    known = [share for share in shares if share is not None]
    if not known or np.mean(known) <= MOST_RIGHT_UNFELT:
        return []
    return [
        f"flag: after one pose {100 * np.mean(known):.0f} % of the surface that nothing had felt is right within 2.5 mm "
        f"({len(known)} reconstructions); the best registered method reaches {100 * REGISTERED_RIGHT_UNFELT:.0f} %"
    ]


def copy_flags(submission: Submission, results: Sequence[ObjectScore]) -> list[str]:
    """Flags for rollouts that are copies of each other, and for equal shapes that were rebuilt from other rollouts."""
    rollouts: dict[str, list[str]] = {}
    shapes: dict[str, list[str]] = {}
    for result in results:
        where = f"{result.object}, seed {result.seed}"
        for pose in EXPLORATION_ORDER:
            digest = submission.digest(rollout_name(result.object, pose, result.seed))
            rollouts.setdefault(digest, []).append(f"{where}, pose {pose}")
        explored = submission.rollouts_hash(result.object, result.seed)
        if explored and result.reasons[str(_LAST)] is None:
            names = (reconstruction_name(result.object, _LAST, result.seed, suffix) for suffix in ("npz", "ply"))
            shapes.setdefault("".join(map(submission.digest, names)), []).append(where)
    flags = [f"flag: one rollout under several names: {_some(places)}" for places in _repeated(rollouts)]
    return flags + [
        f"flag: one shape after {_LAST} poses of different rollouts: {_some(places)}" for places in _repeated(shapes)
    ]


def _repeated(groups: Mapping[str, list[str]]) -> list[list[str]]:
    return [places for digest, places in groups.items() if digest and len(places) > 1]


def _some(places: Sequence[str]) -> str:
    return "; ".join(places[:3]) + (f" and {len(places) - 3} more" if len(places) > 3 else "")
