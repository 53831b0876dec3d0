"""Too good to be felt: remarks on an entry that a careful reader would ask about. Flags are shown; they change no figure.

A flag is a question, not a verdict: ``docs/verification.md`` says what raises each of them and which honest methods do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from tslam_bench.constants import (
    F_SCORE_DISTANCES,
    GRID_SIZE,
    OCCUPANCY_THRESHOLD,
    VOXEL_EDGE,
    WORKSPACE_EDGE,
    WORKSPACE_LOW,
)
from tslam_bench.geometry.sampling import IouPoints
from tslam_bench.reconstruction.volume import Interpolation, Volume
from tslam_bench.scoring.metrics import iou
from tslam_bench.scoring.score_file import ObjectScore
from tslam_bench.scoring.submission import RECONSTRUCTED_POSES

FAR_FROM_TOUCH: Final = 3.0
"""The true surface counts as unfelt where no touched voxel is within this many voxel edges (23 mm)."""
LEAST_UNFELT: Final = 0.1
"""Share of the true surface that has to be unfelt for a figure."""
MOST_RIGHT_UNFELT: Final = 0.4
"""Mean share of the unfelt surface that an entry may have within 1 % of W of its own, without a flag."""
REGISTERED_RIGHT_UNFELT: Final = 0.16
"""The same of the best registered reconstructor that was measured (``retrieval``; ``benchmarks/flags.py``)."""
COPIED_ACTIONS: Final = 0.002
"""Two episodes' actions whose ten-step means are this close on the mean (of a range of 2) are one and the same."""
FEWEST_TOUCHES: Final = 20
"""Touched voxels of an episode below which equal touches say nothing."""
_BLOCK: Final = 10
_READINGS: Final = (0.05, 0.1, 0.2, 0.35, 0.5)
"""Shares of a cell from which it counts as solid."""
_MOST_COPIES: Final = 20
"""Groups of copies that are named."""
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


@dataclass(frozen=True, eq=False)
class Evidence:
    """What flags are made of: facts of one object and seed that no figure shows.

    Attributes:
        right: see :func:`right_where_unfelt`, of the shape of one pose.
        excess: IoU after all poses less what a grid can hold (:func:`grid_ceiling`); None for a missing shape.
        ceiling: that.
        actions: pose -> :func:`outline` of the episode's actions.
        touches: pose -> hash of the touched voxels with their steps; none of an episode that touched little.
        shape: hash of the values (not of the file) of the shape after all poses; empty if there is none.
    """

    right: float | None
    excess: float | None
    ceiling: float
    actions: Mapping[int, NDArray[np.float32]]
    touches: Mapping[int, str]
    shape: str


def grid_ceiling(true: NDArray[np.bool_], points: IouPoints, cells: int = GRID_SIZE) -> float:
    """IoU that a grid of ``cells``^3 reaches which knows how much of each cell is solid: the best of several ways to read it.

    No bound: values chosen for it could say more. But who is only told cells, as touch is, does not get there.

    Args:
        true: (M,) bool, ground truth at ``points``.
        points: where the IoU is measured.
    """
    edge = WORKSPACE_EDGE / cells
    index = np.clip(np.floor((points.points - WORKSPACE_LOW) / edge).astype(np.int64), 0, cells - 1)
    flat = np.ravel_multi_index(tuple(index.T), (cells,) * 3)
    volume = np.bincount(flat, points.weights, cells**3)
    share = np.bincount(flat, points.weights * true, cells**3) / np.maximum(volume, 1e-30)
    best = 0.0
    for threshold in _READINGS:
        probability = np.clip(0.5 + (share - threshold), 0, 1).reshape((cells,) * 3)
        for interpolation in get_args(Interpolation):
            read = Volume(probability, interpolation).query(points.points) >= OCCUPANCY_THRESHOLD
            best = max(best, iou(read, true, points.weights))
    return best


def outline(actions: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means over ten steps each of an episode's actions (200, 28): (560,), by which copies are found that were touched up."""
    return actions.reshape(-1, _BLOCK, actions.shape[1]).mean(axis=1, dtype=np.float64).astype(np.float32).reshape(-1)


def flags(results: Sequence[ObjectScore], evidence: Sequence[Evidence]) -> list[str]:
    """All flags of an entry: one piece of evidence for each result."""
    return [*copy_flags(results, evidence), *unfelt_flags([e.right for e in evidence]), *ceiling_flags(evidence)]


def ceiling_flags(evidence: Sequence[Evidence]) -> list[str]:
    """A flag for an entry whose shapes are finer than the grid in which touches are told, on the mean over objects and seeds."""
    known = [e for e in evidence if e.excess is not None]
    if not known or np.mean([e.excess for e in known]) <= 0:
        return []
    ceiling = float(np.mean([e.ceiling for e in known]))
    reached = ceiling + float(np.mean([e.excess for e in known]))
    return [
        f"flag: IoU {reached:.3f} after {_LAST} poses; a grid of {GRID_SIZE}^3 that knows how much of each cell is solid holds "
        f"{ceiling:.3f}"
    ]


def copy_flags(results: Sequence[ObjectScore], evidence: Sequence[Evidence]) -> list[str]:
    """Flags for episodes that are copies of each other, and for equal shapes that were rebuilt from other episodes."""
    where = [f"{result.object}, seed {result.seed}" for result in results]
    outlines = {
        f"{place}, pose {pose}": actions
        for place, e in zip(where, evidence, strict=True)
        for pose, actions in e.actions.items()
    }
    touches: dict[str, list[str]] = {}
    shapes: dict[str, list[str]] = {}
    for place, e in zip(where, evidence, strict=True):
        for pose, digest in e.touches.items():
            touches.setdefault(digest, []).append(f"{place}, pose {pose}")
        if e.actions:
            shapes.setdefault(e.shape, []).append(place)
    lines = [f"flag: the same actions in several episodes: {_some(places)}" for places in _alike(outlines)]
    lines += [f"flag: the same touches in several episodes: {_some(places)}" for places in _repeated(touches)]
    lines += [
        f"flag: one shape after {_LAST} poses of different rollouts: {_some(places)}" for places in _repeated(shapes)
    ]
    if len(lines) > _MOST_COPIES:
        lines = [*lines[:_MOST_COPIES], f"flag: {len(lines) - _MOST_COPIES} more groups of copies"]
    return lines


def _alike(outlines: Mapping[str, NDArray[np.float32]]) -> list[list[str]]:
    """Groups of episodes whose actions are equal but for what might be retouched."""
    if len(outlines) < 2:
        return []
    names, rows = list(outlines), np.stack(list(outlines.values()))
    # Sums tell most apart, and what they do not is compared in full.
    sums = rows.mean(axis=1, dtype=np.float64)
    order = np.argsort(sums)
    parent = list(range(len(names)))

    def root(index: int) -> int:
        while parent[index] != index:
            index = parent[index]
        return index

    for position, first in enumerate(order):
        for second in order[position + 1 :]:
            if sums[second] - sums[first] > COPIED_ACTIONS:
                break
            if np.abs(rows[first] - rows[second]).mean() <= COPIED_ACTIONS:
                parent[root(int(second))] = root(int(first))
    groups: dict[int, list[str]] = {}
    for index, name in enumerate(names):
        groups.setdefault(root(index), []).append(name)
    return [places for places in groups.values() if len(places) > 1]


def _repeated(groups: Mapping[str, list[str]]) -> list[list[str]]:
    return [places for digest, places in groups.items() if digest and len(places) > 1]


def _some(places: Sequence[str]) -> str:
    return "; ".join(places[:3]) + (f" and {len(places) - 3} more" if len(places) > 3 else "")
