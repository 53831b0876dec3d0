"""Shape metrics as small pure functions (protocol section 10).

Every distance is in metric units: 1 is the workspace edge, 0.25 m. Callers divide metres by ``WORKSPACE_EDGE``.
Definitions follow Mescheder et al. (Occupancy Networks, 2019), whose evaluation the tSLAM paper uses, and, for the
F-score, Knapitsch et al. (Tanks and Temples, 2017). ``docs/metrics.md`` lists the traps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.compiled import njit
from tslam_bench.constants import GRID_SIZE, VOXEL_EDGE, WORKSPACE_EDGE, WORKSPACE_LOW
from tslam_bench.geometry.nearest import NearestSamples

WORST_DISTANCE: Final = math.sqrt(3)
"""Diagonal of the workspace in metric units: the distance an empty prediction is charged, and the cap of all others."""
CALIBRATION_BINS: Final = 15
"""Bins of equal volume in the expected calibration error."""


def iou(predicted: NDArray[np.bool_], true: NDArray[np.bool_], weights: NDArray[np.float64] | None = None) -> float:
    """Intersection over union of two boolean arrays of one shape: ``|A and B| / |A or B|`` in [0, 1].

    One side empty: 0. Both empty: 1 (equal sets).

    Args:
        predicted, true: what is solid, at points or voxels.
        weights: volume that each point stands for, in any unit; by default all stand for the same.
    """
    predicted, true = np.asarray(predicted, dtype=bool), np.asarray(true, dtype=bool)
    if predicted.shape != true.shape:
        raise ValueError(f"iou: shapes {predicted.shape} and {true.shape} differ")
    if weights is None:
        both, either = float(np.count_nonzero(predicted & true)), float(np.count_nonzero(predicted | true))
    else:
        if np.shape(weights) != true.shape:
            raise ValueError(f"iou: {np.shape(weights)} weights for {true.shape} points")
        both, either = float(np.sum(weights[predicted & true])), float(np.sum(weights[predicted | true]))
    return both / either if either else 1.0


def brier_score(probability: NDArray, true: NDArray[np.bool_], weights: NDArray[np.float64]) -> float:
    """Mean squared difference of an occupancy probability and the truth, weighted by volume; in [0, 1], 0 is perfect.

    Args:
        probability: (M,) in [0, 1].
        true: (M,) bool.
        weights: (M,) volume that each point stands for.
    """
    squared = np.square(np.asarray(probability, dtype=np.float64) - true)
    return float((weights * squared).sum() / weights.sum())  # not `@`: its last bits depend on the number of threads


def calibration_error(
    probability: NDArray, true: NDArray[np.bool_], weights: NDArray[np.float64], bins: int = CALIBRATION_BINS
) -> float:
    """Expected calibration error: how far the probability is from the share that is solid, on average; in [0, 1].

    Points sorted by probability are cut into bins of equal volume. The error is the mean over bins of the distance
    between mean probability and solid share (Naeini et al., 2015; equal mass: Nguyen and O'Connor, 2015). Points of equal
    probability that a cut divides share their outcomes evenly, so the order of the points does not matter.

    Args:
        probability: (M,) in [0, 1], not empty.
        true: (M,) bool.
        weights: (M,) volume that each point stands for.
        bins: number of bins.
    """
    probability = np.asarray(probability, dtype=np.float32)
    zero = probability <= 0
    some = np.flatnonzero(~zero)
    order = some[np.argsort(probability[some])]  # most of W is at 0 exactly: there is nothing to sort there
    values = probability[order].astype(np.float64)
    # Sums up to the end of each group of equal probability, that at 0 first.
    ends = np.append(values[1:] != values[:-1], True) if len(order) else np.zeros(0, dtype=bool)
    volume, solid = weights[order], weights[order] * true[order]
    none = float(weights[zero].sum())
    reached = np.concatenate([[0.0, none], (none + np.cumsum(volume))[ends]])
    missed = float(weights[zero & true].sum())
    summed = np.concatenate([[0.0, -missed], (np.cumsum(volume * values - solid) - missed)[ends]])
    # Within a group both sums grow in proportion: linear interpolation divides it evenly.
    cuts = np.interp(np.linspace(0, reached[-1], bins + 1), reached, summed)
    return float(np.abs(np.diff(cuts)).sum() / reached[-1])


def sample_surface(
    triangles: NDArray, count: int, generator: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Area-uniform samples of a triangle mesh, with the normals of the faces they lie on.

    Args:
        triangles: (F, 3, 3) corners in any unit, counter-clockwise seen from outside.
        count: number of samples.
        generator: the only source of randomness.

    Returns:
        points (count, 3) in the unit of ``triangles``, in the order of the faces; unit normals (count, 3).

    Raises:
        ValueError: the mesh has no area.
    """
    triangles = np.ascontiguousarray(triangles, dtype=np.float64).reshape(-1, 3, 3)
    cumulative = _cumulative_area(triangles)
    if len(cumulative) == 0 or not cumulative[-1] > 0:
        raise ValueError("sample_surface: the mesh has no area")
    # The sums of exponential numbers, divided by the last, are uniform numbers in order: no search for each, and faces that
    # are neighbours in memory are read one after the other.
    ordered = np.cumsum(generator.exponential(size=count + 1))
    return _place(triangles, cumulative, ordered / ordered[-1] * cumulative[-1], generator.random((2, count)))


@njit(cache=True)
def _normal(triangles: NDArray, face: int) -> tuple[float, float, float]:
    """Cross product of two edges of a triangle."""
    ax, bx = triangles[face, 1, 0] - triangles[face, 0, 0], triangles[face, 2, 0] - triangles[face, 0, 0]
    ay, by = triangles[face, 1, 1] - triangles[face, 0, 1], triangles[face, 2, 1] - triangles[face, 0, 1]
    az, bz = triangles[face, 1, 2] - triangles[face, 0, 2], triangles[face, 2, 2] - triangles[face, 0, 2]
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@njit(cache=True)
def _cumulative_area(triangles: NDArray) -> NDArray:
    """Twice the area of each triangle and of all before it: (F,)."""
    total = 0.0
    result = np.empty(len(triangles))
    for face in range(len(triangles)):
        x, y, z = _normal(triangles, face)
        total += np.sqrt(x * x + y * y + z * z)
        result[face] = total
    return result


@njit(cache=True)
def _place(triangles: NDArray, cumulative: NDArray, reached: NDArray, within: NDArray) -> tuple[NDArray, NDArray]:
    """Samples and their normals, at cumulative areas ``reached`` in rising order; a face without area holds none."""
    count = within.shape[1]
    points, normals = np.empty((count, 3)), np.empty((count, 3))
    face, chosen = -1, -1
    below = 0.0
    x = y = z = length = 1.0
    for row in range(count):
        while chosen < 0 or (below <= reached[row] and face < len(cumulative) - 1):
            face += 1
            if cumulative[face] > below:
                chosen, below = face, cumulative[face]
                x, y, z = _normal(triangles, face)
                length = np.sqrt(x * x + y * y + z * z)
        u, v = within[0, row], within[1, row]
        if u + v > 1:
            u, v = 1 - u, 1 - v
        for axis in range(3):
            corner = triangles[chosen, 0, axis]
            points[row, axis] = (
                corner + u * (triangles[chosen, 1, axis] - corner) + v * (triangles[chosen, 2, axis] - corner)
            )
        normals[row, 0], normals[row, 1], normals[row, 2] = x / length, y / length, z / length
    return points, normals


@dataclass(frozen=True)
class SurfaceMatch:
    """Nearest neighbours between samples of a predicted and of a true surface.

    Attributes:
        accuracy: (P,) distance of every predicted sample to the nearest true one, at most ``WORST_DISTANCE``.
        completeness: (T,) distance of every true sample to the nearest predicted one, at most ``WORST_DISTANCE``.
        nearest_true: (P,) index of that true sample.
        nearest_predicted: (T,) index of that predicted sample.
    """

    accuracy: NDArray[np.float64]
    completeness: NDArray[np.float64]
    nearest_true: NDArray[np.int64]
    nearest_predicted: NDArray[np.int64]


def match_surfaces(predicted: NDArray | NearestSamples, true: NDArray | NearestSamples) -> SurfaceMatch:
    """Nearest neighbours both ways between samples (P, 3) and (T, 3) in metric units, or their search structures."""
    predicted = predicted if isinstance(predicted, NearestSamples) else NearestSamples(predicted)
    true = true if isinstance(true, NearestSamples) else NearestSamples(true)
    accuracy, nearest_true = true.query(predicted)
    completeness, nearest_predicted = predicted.query(true)
    return SurfaceMatch(
        accuracy=np.minimum(accuracy, WORST_DISTANCE),
        completeness=np.minimum(completeness, WORST_DISTANCE),
        nearest_true=nearest_true,
        nearest_predicted=nearest_predicted,
    )


def chamfer_l2(match: SurfaceMatch) -> float:
    """``0.5 * (mean_p d(p, GT)^2 + mean_q d(q, P)^2)``, squared metric units; an empty prediction has 3.

    Of a surface of area A with itself, N samples a side, it is A / (pi N), not 0: the samples differ.
    """
    return 0.5 * float(np.mean(match.accuracy**2) + np.mean(match.completeness**2))


def chamfer_l1(match: SurfaceMatch) -> float:
    """``0.5 * (mean_p d(p, GT) + mean_q d(q, P))``, metric units; an empty prediction has sqrt(3)."""
    return 0.5 * float(np.mean(match.accuracy) + np.mean(match.completeness))


def normal_consistency(predicted_normals: NDArray, true_normals: NDArray, match: SurfaceMatch) -> float:
    """Mean of both directions of ``|n . n_nearest|`` in [0, 1]; an empty prediction has 0.

    Unoriented: normals at random give 0.5, the faces of a finely voxelised sphere 0.67 (axis-aligned normals: at most
    0.83), whatever the resolution.

    Args:
        predicted_normals, true_normals: (P, 3) and (T, 3) unit normals of the matched samples.
    """
    there = np.abs(np.einsum("ij,ij->i", predicted_normals, true_normals[match.nearest_true]))
    back = np.abs(np.einsum("ij,ij->i", true_normals, predicted_normals[match.nearest_predicted]))
    return 0.5 * float(there.mean() + back.mean())


def f_score(match: SurfaceMatch, distance: float) -> float:
    """Harmonic mean of precision (predicted samples within ``distance`` of the truth) and recall; 0 if both are 0.

    Args:
        distance: threshold in metric units.
    """
    precision = float(np.mean(match.accuracy <= distance))
    recall = float(np.mean(match.completeness <= distance))
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


class TouchCoverage:
    """Which true surface samples have a touched voxel near, and since when.

    A sample is covered once a voxel whose centre lies within one voxel edge of it is touched. Only the 27 voxels around
    a sample can be that near, so the candidates are found once per object.
    """

    def __init__(self, surface_points: NDArray) -> None:
        """Args: surface_points: (T, 3) true surface samples, metres, object frame, inside W."""
        self.count = len(surface_points)
        cells = (np.asarray(surface_points, dtype=np.float64) - WORKSPACE_LOW) / VOXEL_EDGE
        home = np.floor(cells).astype(np.int64)
        if self.count == 0 or (home < 0).any() or (home >= GRID_SIZE).any():
            raise ValueError("TouchCoverage: the surface samples must be non-empty and lie inside the workspace")
        offsets = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        near = np.empty((self.count, len(offsets)), dtype=bool)
        for k, offset in enumerate(offsets):
            near[:, k] = np.square(home + offset + 0.5 - cells).sum(axis=1) <= 1.0
        sample, column = np.nonzero(near)
        # One layer of padding: a neighbour outside W is never touched.
        self._padded = (GRID_SIZE + 2,) * 3
        self._voxel = np.ravel_multi_index(tuple((home[sample] + offsets[column] + 1).T), self._padded)
        # Every sample has at least its own voxel (at most sqrt(3)/2 edges away), so no segment is empty.
        self._start = np.searchsorted(sample, np.arange(self.count))

    def first_step(self, touched_step: NDArray) -> NDArray[np.int64]:
        """Step at which every sample was first covered.

        Args:
            touched_step: (32, 32, 32) integers, object frame: step at which a voxel was first touched, -1 for never.

        Returns:
            (T,) steps; the largest int64 for samples never covered.
        """
        never = np.iinfo(np.int64).max
        steps = np.full(self._padded, never, dtype=np.int64)
        own = np.asarray(touched_step).astype(np.int64)
        steps[1:-1, 1:-1, 1:-1] = np.where(own >= 0, own, never)
        return np.minimum.reduceat(steps.reshape(-1)[self._voxel], self._start)

    def recall(self, touched: NDArray[np.bool_]) -> float:
        """Touched-surface recall: share of the samples that touched voxels (32, 32, 32) cover."""
        first = self.first_step(np.where(touched, 0, -1))
        return float(np.mean(first == 0))

    def recall_curve(self, touched_step: NDArray, steps: int) -> NDArray[np.float64]:
        """Recall after 0, 1, ..., ``steps`` control steps: (steps + 1,), starting at 0.

        ``touched_step`` counts from 0: a voxel touched in step 0 counts after 1 step.
        """
        first = self.first_step(touched_step)
        counts = np.bincount(first[first < steps], minlength=steps)
        return np.concatenate([[0.0], np.cumsum(counts)]) / self.count


def surface_iou_curve(touched_step: NDArray, surface: NDArray[np.bool_], steps: int) -> NDArray[np.float64]:
    """IoU of touched voxels with those that the true surface crosses, after 0, 1, ..., ``steps`` control steps: (steps + 1,).

    Never called IoU alone.

    Args:
        touched_step: (32, 32, 32) integers: step (from 0) at which a voxel was first touched, -1 for never.
        surface: (32, 32, 32) bool, not empty.
    """
    first = touched_step.astype(np.int64)
    on, off = first[surface], first[~surface]
    hits = np.cumsum(np.bincount(on[(on >= 0) & (on < steps)], minlength=steps))
    misses = np.cumsum(np.bincount(off[(off >= 0) & (off < steps)], minlength=steps))
    return np.concatenate([[0.0], hits / (np.count_nonzero(surface) + misses)])


def area_under_curve(values: NDArray) -> float:
    """Mean height of a curve sampled at equal steps, by the trapezoidal rule; 1 for a curve that is 1 throughout."""
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 1 or len(values) < 2:
        raise ValueError(f"area_under_curve: shape {values.shape}, expected at least two values in one dimension")
    return float(np.mean(values[1:] + values[:-1])) / 2


def to_metric(metres: NDArray) -> NDArray[np.float64]:
    """Metres -> metric units."""
    return np.asarray(metres, dtype=np.float64) / WORKSPACE_EDGE
