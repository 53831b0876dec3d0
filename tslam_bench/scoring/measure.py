"""Scores of one object: its touched voxels and its reconstructions against the true shape (protocol section 10)."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench import grids
from tslam_bench.constants import F_SCORE_DISTANCES, GRID_SIZE, HORIZON, VOXEL_EDGE
from tslam_bench.geometry.interpolation import trilinear
from tslam_bench.geometry.sampling import IouPoints
from tslam_bench.objects.store import PreparedObject, load_object
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring import metrics
from tslam_bench.scoring.flags import (
    FEWEST_TOUCHES,
    Evidence,
    grid_ceiling,
    outline,
    right_where_unfelt,
    unfelt_surface,
)
from tslam_bench.scoring.prediction import prepare
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.scoring.score_file import CURVE_SPACING, ObjectScore
from tslam_bench.scoring.submission import EXPLORATION_ORDER, RECONSTRUCTED_POSES, Reconstruction, Submission
from tslam_bench.scoring.verification import VerificationRecord

VOXEL_HALF_DIAGONAL: Final = VOXEL_EDGE * np.sqrt(3) / 2
PLAUSIBLE_SLACK: Final = 2e-3
"""A touched voxel holds a contact point, which lies on the collision hulls; this much (m) is allowed for the error of
the field and for the linear step from probe to surface."""

SHAPE_METRICS: Final = {
    "iou": 0.0,
    "iou_raw": 0.0,
    "chamfer_l2": metrics.WORST_DISTANCE**2,
    "chamfer_l1": metrics.WORST_DISTANCE,
    "normal_consistency": 0.0,
    "f_score_1": 0.0,
    "f_score_2": 0.0,
}
"""Metrics of a reconstruction -> worst value, which an empty prediction is given. Metric units, squared or plain."""
_Compared = tuple[dict[str, float | None], str | None, NDArray[np.float64] | None]
"""Metrics, why the reconstruction counts as empty (or None), and the distance of each true sample to it (None if empty)."""
TOUCH_METRICS: Final = ("surface_iou", "touched_surface_recall")
"""Metrics of what was touched. A reference without rollouts has none."""
CALIBRATION_METRICS: Final = {"calibration_error": 1.0, "brier": 1.0}
"""Metrics of a volume's probability -> worst value, which a missing reconstruction is given. A mesh has none."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of one object with what is computed once for all submissions."""

    prepared: PreparedObject
    iou_points: IouPoints
    surface: metrics.NearestSamples
    coverage: metrics.TouchCoverage
    ceiling: float

    @staticmethod
    def of(prepared: PreparedObject) -> Truth:
        """Ground truth from a prepared object."""
        surface = metrics.NearestSamples(metrics.to_metric(prepared.surface_points))
        points = prepared.iou_points()
        ceiling = grid_ceiling(prepared.solid_at_iou_points, points)
        return Truth(prepared, points, surface, metrics.TouchCoverage(prepared.surface_points), ceiling)


@lru_cache(maxsize=64)
def load_truth(name: str, cache: Path | None = None, split: str = "test") -> Truth:
    """Ground truth of an object from the asset cache."""
    return Truth.of(load_object(name, split, cache))


def score_object(submission: Submission, truth: Truth, record: VerificationRecord | None = None) -> list[ObjectScore]:
    """Scores of one object, one per seed of the submission.

    With a ``record`` of a replay, touches are the replay's, and an episode that did not reproduce counts as untouched.
    """
    return [score for score, _ in score_seeds(submission, truth, record)]


def score_seeds(
    submission: Submission, truth: Truth, record: VerificationRecord | None = None
) -> list[tuple[ObjectScore, Evidence]]:
    """:func:`score_object`, and what flags are made of."""
    scorer = _Scorer(truth)
    return [_score_seed(submission, scorer, seed, record) for seed in submission.info.seeds]


class _Scorer:
    """Scores reconstructions of one object; one that equals the one before, as a reference's do, is not scored again."""

    def __init__(self, truth: Truth) -> None:
        self.truth = truth
        self._last: tuple[Volume, _Compared] | None = None

    def score(self, reconstruction: Reconstruction | None) -> _Compared:
        if not isinstance(reconstruction, Volume):
            return _compare(reconstruction, self.truth)
        if self._last is None or not _same(self._last[0], reconstruction):
            self._last = reconstruction, _compare(reconstruction, self.truth)
        return self._last[1]


def _same(first: Volume, second: Volume) -> bool:
    return first.interpolation == second.interpolation and np.array_equal(first.probability, second.probability)


def _score_seed(
    submission: Submission, scorer: _Scorer, seed: int, record: VerificationRecord | None
) -> tuple[ObjectScore, Evidence]:
    truth = scorer.truth
    name = truth.prepared.name
    rollouts = {pose: submission.rollout(name, pose, seed) for pose in EXPLORATION_ORDER}
    reference = submission.info.privileged and not any(rollouts.values())
    missing = [] if reference else [f"rollout of pose {pose}" for pose, rollout in rollouts.items() if rollout is None]
    stored = {pose: rollout for pose, rollout in rollouts.items() if rollout is not None}
    if record is not None:
        rollouts = {p: None if rollout is None else record.replayed(rollout) for p, rollout in rollouts.items()}
    touched_step = merge_touched_steps(rollouts)

    total = HORIZON * len(EXPLORATION_ORDER)
    recall = truth.coverage.recall_curve(touched_step, total)
    surface = metrics.surface_iou_curve(touched_step, truth.prepared.surface, total)
    poses: dict[str, dict[str, float | None]] = {}
    reasons: dict[str, str | None] = {}
    right: float | None = None
    for count, members in RECONSTRUCTED_POSES.items():
        touch: dict[str, float | None] = {
            "surface_iou": float(surface[count * HORIZON]),
            "touched_surface_recall": float(recall[count * HORIZON]),
        }
        reconstruction = submission.reconstruction(name, count, seed)
        absent = [pose for pose in members if rollouts[pose] is None]
        reason = None
        if reconstruction is None:
            missing.append(f"reconstruction of {count} pose{'s' if count > 1 else ''}")
        elif absent and not reference:
            why = "did not reproduce" if stored.keys() >= set(absent) else "are missing or did not reproduce"
            why = "are missing" if stored.keys().isdisjoint(absent) else why
            reason = f"rollouts of poses {', '.join(map(str, absent))} {why}"
            reconstruction = None
        shape, found, completeness = scorer.score(reconstruction)
        if count == 1 and completeness is not None and not reference:
            felt = (touched_step >= 0) & (touched_step < HORIZON)
            right = right_where_unfelt(unfelt_surface(felt, truth.prepared.surface_points), completeness)
        poses[str(count)] = {**shape, **(dict.fromkeys(touch) if reference else touch)}
        reasons[str(count)] = reason or found

    curve_areas = {
        "exploration_area": metrics.area_under_curve(recall),
        "exploration_surface_iou_area": metrics.area_under_curve(surface),
    }
    score = ObjectScore(
        object=name,
        seed=seed,
        poses=poses,
        reasons=reasons,
        areas={
            "iou_area": float(np.mean([values["iou"] for values in poses.values()])),
            **(dict.fromkeys(curve_areas) if reference else curve_areas),
        },
        recall_curve=[] if reference else [round(float(x), 5) for x in recall[::CURVE_SPACING]],
        surface_iou_curve=[] if reference else [round(float(x), 5) for x in surface[::CURVE_SPACING]],
        implausible_touches=implausible_touches(touched_step >= 0, truth.prepared),
        missing=missing,
    )
    iou_8 = poses[str(max(RECONSTRUCTED_POSES))]["iou"]
    evidence = Evidence(
        right=right,
        excess=None if reference or iou_8 is None else iou_8 - truth.ceiling,
        ceiling=truth.ceiling,
        actions={pose: outline(rollout.actions) for pose, rollout in stored.items()},
        touches={
            pose: hashlib.sha256(rollout.touched_step.tobytes()).hexdigest()
            for pose, rollout in stored.items()
            if rollout.touched.sum() >= FEWEST_TOUCHES
        },
        shape="" if reconstruction is None else _hash(reconstruction),
    )
    return score, evidence


def _hash(shape: Reconstruction) -> str:
    """Of its values, whatever file they lie in."""
    arrays = [shape.probability] if isinstance(shape, Volume) else [shape.vertices, shape.faces]
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()


def score_reconstruction(
    reconstruction: Reconstruction | None, truth: Truth
) -> tuple[dict[str, float | None], str | None]:
    """Shape and calibration metrics of one reconstruction, and why it counts as empty (or None)."""
    values, reason, _ = _compare(reconstruction, truth)
    return values, reason


def _compare(reconstruction: Reconstruction | None, truth: Truth) -> _Compared:
    prepared, weights = truth.prepared, truth.iou_points.weights
    prediction = prepare(reconstruction, truth.iou_points.points)
    if reconstruction is None:
        calibration: dict[str, float | None] = dict(CALIBRATION_METRICS)
    elif prediction.probability is None:
        calibration = dict.fromkeys(CALIBRATION_METRICS)
    else:
        at_points = (prediction.probability, prepared.solid_at_iou_points, weights)
        calibration = {
            "calibration_error": metrics.calibration_error(*at_points),
            "brier": metrics.brier_score(*at_points),
        }
    if prediction.reason is not None:
        return {**SHAPE_METRICS, **calibration}, prediction.reason, None
    match = metrics.match_surfaces(metrics.to_metric(prediction.points), truth.surface)
    values = {
        "iou": metrics.iou(prediction.solid, prepared.solid_at_iou_points, weights),
        "iou_raw": metrics.iou(prediction.solid, prepared.raw_solid_at_iou_points, weights),
        "chamfer_l2": metrics.chamfer_l2(match),
        "chamfer_l1": metrics.chamfer_l1(match),
        "normal_consistency": metrics.normal_consistency(prediction.normals, prepared.surface_normals, match),
        "f_score_1": metrics.f_score(match, F_SCORE_DISTANCES[0]),
        "f_score_2": metrics.f_score(match, F_SCORE_DISTANCES[1]),
        **calibration,
    }
    return values, None, match.completeness


def merge_touched_steps(rollouts: dict[int, Rollout | None]) -> NDArray[np.int64]:
    """First step at which each voxel was touched, in the object frame, over the poses one after the other.

    Args:
        rollouts: pose -> rollout (its grids in the world frame of that pose) in the order of exploration; a missing one
            takes its 200 steps and touches nothing.

    Returns:
        (32, 32, 32) steps from 0 to 200 times the poses, -1 for never.
    """
    never = np.iinfo(np.int64).max
    first = np.full((GRID_SIZE,) * 3, never)
    for position, (pose, rollout) in enumerate(rollouts.items()):
        if rollout is not None:
            steps = grids.world_to_object(rollout.touched_step, pose).astype(np.int64)
            first = np.minimum(first, np.where(steps >= 0, steps + position * HORIZON, never))
    return np.where(first == never, -1, first)


def implausible_touches(touched: NDArray[np.bool_], prepared: PreparedObject) -> float:
    """Share of touched voxels (object frame) too far from the collision hulls to hold a contact point; 0 if none.

    A necessary condition, not a proof: a contact point is on the hulls' surface, so the signed distance at its voxel's
    centre is at most half the voxel's diagonal.
    """
    centres = grids.voxel_centres()[touched]
    if len(centres) == 0:
        return 0.0
    field = prepared.field
    # Beyond the grid the border's value counts: it is the padding or more, and too far in any case.
    distance = trilinear(field.values, field.origin, field.spacing, centres)
    return float(np.mean(np.abs(distance) > VOXEL_HALF_DIAGONAL + PLAUSIBLE_SLACK))
