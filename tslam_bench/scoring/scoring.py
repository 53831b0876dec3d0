"""Scores of a submission: every object, seed and number of poses, then aggregated (protocol sections 10 and 12).

Rollouts are not replayed: a score says ``verified: false`` until something has simulated the stored actions again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench import grids
from tslam_bench.constants import (
    F_SCORE_DISTANCES,
    GRID_SIZE,
    HORIZON,
    PROTOCOL_VERSION,
    VOXEL_EDGE,
)
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.geometry.interpolation import trilinear
from tslam_bench.geometry.sampling import IouPoints
from tslam_bench.objects.splits import object_set, resolve_name
from tslam_bench.objects.store import PreparedObject, asset_sha256, load_object
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring import metrics
from tslam_bench.scoring.aggregate import Estimate, estimate_all
from tslam_bench.scoring.info import SubmissionInfo, parse_info
from tslam_bench.scoring.prediction import prepare
from tslam_bench.scoring.submission import (
    EXPLORATION_ORDER,
    RECONSTRUCTED_POSES,
    Reconstruction,
    Rollout,
    Submission,
    read_submission,
)
from tslam_bench.version import __version__

SCORE_VERSION: Final = 2
"""Version of the score file's layout."""
CURVE_SPACING: Final = 10
"""Control steps between the stored samples of an exploration curve."""
FULL_ENTRY_SEEDS: Final = 3
"""Fewest seeds of a full entry on the test split."""
VOXEL_HALF_DIAGONAL: Final = VOXEL_EDGE * np.sqrt(3) / 2
PLAUSIBLE_SLACK: Final = 2e-3
"""A touched voxel holds a contact point, which lies on the collision hulls; this much (m) is allowed for the error of
the field and for the linear step from probe to surface."""

EXPECTED_IMPLAUSIBLE: Final = 0.02
"""A share of implausible touches up to this is not remarked on: where a finger presses several millimetres into the union of
hulls, the field's gradient is no longer the way out. Of 450 honest sets of eight poses, eight had any, at most 0.8 %."""

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
CALIBRATION_METRICS: Final = {"calibration_error": 1.0, "brier": 1.0}
"""Metrics of a volume's probability -> worst value, which a missing reconstruction is given. A mesh has none."""
TOUCH_METRICS: Final = ("surface_iou", "touched_surface_recall")
"""Metrics of the merged touched voxels."""
AREAS: Final = ("iou_area", "exploration_area", "exploration_surface_iou_area")
"""Mean of the IoU after 1, 2, 4 and 8 poses, by which entries are ranked; areas under the curves of recall and of surface
IoU over the steps of all eight poses."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of one object with what is computed once for all submissions."""

    prepared: PreparedObject
    iou_points: IouPoints
    surface: metrics.NearestSamples
    coverage: metrics.TouchCoverage

    @staticmethod
    def of(prepared: PreparedObject) -> Truth:
        """Ground truth from a prepared object."""
        surface = metrics.NearestSamples(metrics.to_metric(prepared.surface_points))
        return Truth(prepared, prepared.iou_points(), surface, metrics.TouchCoverage(prepared.surface_points))


@lru_cache(maxsize=64)
def load_truth(name: str, cache: Path | None = None) -> Truth:
    """Ground truth of a test object from the asset cache."""
    return Truth.of(load_object(name, cache=cache))


@dataclass(frozen=True)
class ObjectScore:
    """Scores of one object and seed.

    Attributes:
        object, seed: what was scored.
        poses: ``"1"``, ``"2"``, ``"4"``, ``"8"`` -> metric -> value after so many poses of the exploration order; touch
            metrics are None for a reference without rollouts, calibration metrics are None for a mesh.
        reasons: the same keys -> why the reconstruction counts as empty, or None.
        areas: ``AREAS``; those of the curves (from every step) are None for a reference without rollouts.
        recall_curve, surface_iou_curve: values every ``CURVE_SPACING`` control steps over all eight poses, from step 0.
        implausible_touches: share of touched voxels that cannot hold a point of the object's surface.
        missing: rollouts and reconstructions that the submission lacks.
    """

    object: str
    seed: int
    poses: dict[str, dict[str, float | None]]
    reasons: dict[str, str | None]
    areas: dict[str, float | None]
    recall_curve: list[float]
    surface_iou_curve: list[float]
    implausible_touches: float
    missing: list[str]


@dataclass(frozen=True)
class SubmissionScore:
    """Scores of a submission.

    Attributes:
        info: what the submission says about itself.
        content_hash: SHA-256 of its files.
        objects: names, in the order of scoring.
        asset_sha256: hash of the objects' products that were scored against.
        results: one per object and seed.
        aggregate: ``"areas"`` and ``"1"``, ``"2"``, ``"4"``, ``"8"`` (poses) -> metric -> estimate over objects and seeds;
            without the metrics that some result lacks.
        notes: one line each: what a reader of the figures should know.
        verified: whether its rollouts were replayed and reproduced.
    """

    info: SubmissionInfo
    content_hash: str
    objects: tuple[str, ...]
    asset_sha256: str
    results: tuple[ObjectScore, ...]
    aggregate: dict[str, dict[str, Estimate]]
    notes: tuple[str, ...]
    verified: bool = False

    def matrix(self, group: str, metric: str) -> NDArray[np.float64]:
        """Values of one metric: (objects, seeds). ``group`` is a key of ``aggregate``."""
        values = [(result.areas if group == "areas" else result.poses[group])[metric] for result in self.results]
        return np.array(values, dtype=np.float64).reshape(len(self.objects), -1)

    def to_json(self) -> dict[str, Any]:
        """Plain values for a score file."""
        return {
            "score_version": SCORE_VERSION,
            "protocol_version": PROTOCOL_VERSION,
            "package_version": __version__,
            "submission": self.info.to_json(),
            "content_hash": self.content_hash,
            "verified": self.verified,
            "objects": list(self.objects),
            "asset_sha256": self.asset_sha256,
            "results": [dataclasses.asdict(result) for result in self.results],
            "aggregate": {
                group: {name: dataclasses.asdict(estimate) for name, estimate in estimates.items()}
                for group, estimates in self.aggregate.items()
            },
            "notes": list(self.notes),
        }

    @staticmethod
    def from_json(value: Any, where: str) -> SubmissionScore:
        """Reads a score file's content. Raises InvalidInputError if it is not one of this version."""
        try:
            if value["score_version"] != SCORE_VERSION or value["protocol_version"] != PROTOCOL_VERSION:
                raise InvalidInputError(f"{where}: score file of another version; score the submission again")
            return SubmissionScore(
                info=parse_info(json.dumps(value["submission"]).encode()),
                content_hash=str(value["content_hash"]),
                objects=tuple(value["objects"]),
                asset_sha256=str(value["asset_sha256"]),
                results=tuple(ObjectScore(**result) for result in value["results"]),
                aggregate={
                    group: {name: Estimate(**estimate) for name, estimate in estimates.items()}
                    for group, estimates in value["aggregate"].items()
                },
                notes=tuple(value["notes"]),
                verified=bool(value["verified"]),
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise InvalidInputError(f"{where}: not a score file ({error}); score the submission again") from error


@contextlib.contextmanager
def worker_pool(workers: int) -> Iterator[ProcessPoolExecutor | None]:
    """Processes for :func:`score_submission`, which keep what they loaded for the next submission; None for one worker."""
    if workers <= 1:
        yield None
        return
    # spawn: a forked copy of a process whose libraries have started threads may hang
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool


def score_submission(
    path: Path | str,
    objects: Sequence[str] | None = None,
    pool: ProcessPoolExecutor | None = None,
    on_progress: Callable[[int, int], None] | None = None,
    cache: Path | None = None,
) -> SubmissionScore:
    """Scores a submission against the prepared objects of the asset cache.

    Args:
        path: folder or zip archive.
        objects: names to score; by default those of the submission's object set.
        pool: processes that score objects (:func:`worker_pool`); the result does not depend on it.
        on_progress: called with (done, all) objects.
        cache: asset cache; by default the user's.

    Raises:
        InvalidInputError: the submission is refused, or an object is unknown.
        AssetError: an object is not prepared.
    """
    submission = read_submission(path)
    names = tuple(dict.fromkeys(resolve_name(name) for name in (objects or object_set(submission.info.object_set))))
    results: list[ObjectScore] = []
    for done, scores in enumerate(_score_all(submission, Path(path), names, pool, cache), start=1):
        results += scores
        if on_progress:
            on_progress(done, len(names))
    return SubmissionScore(
        info=submission.info,
        content_hash=submission.content_hash,
        objects=names,
        asset_sha256=asset_sha256(names, cache=cache),
        results=tuple(results),
        aggregate=aggregate(results, len(names)),
        notes=_notes(submission, results, names, cache),
    )


def _score_all(
    submission: Submission, path: Path, names: Sequence[str], pool: ProcessPoolExecutor | None, cache: Path | None
) -> Iterator[list[ObjectScore]]:
    if pool is None:
        for name in names:
            yield score_object(submission, load_truth(name, cache))
        return
    count = len(names)
    yield from pool.map(_score_in_process, [path] * count, [submission.content_hash] * count, names, [cache] * count)


@lru_cache(maxsize=4)
def _open_submission(path: Path, content_hash: str) -> Submission:
    """A submission that the parent process has checked; the hash tells apart what was at ``path`` at different times."""
    return read_submission(path, check=False)


def _score_in_process(path: Path, content_hash: str, name: str, cache: Path | None) -> list[ObjectScore]:
    return score_object(_open_submission(path, content_hash), load_truth(name, cache))


def score_object(submission: Submission, truth: Truth) -> list[ObjectScore]:
    """Scores of one object, one per seed of the submission."""
    scorer = _Scorer(truth)
    return [_score_seed(submission, scorer, seed) for seed in submission.info.seeds]


class _Scorer:
    """Scores reconstructions of one object; one that equals the one before, as a reference's do, is not scored again."""

    def __init__(self, truth: Truth) -> None:
        self.truth = truth
        self._last: tuple[Volume, tuple[dict[str, float | None], str | None]] | None = None

    def score(self, reconstruction: Reconstruction | None) -> tuple[dict[str, float | None], str | None]:
        if not isinstance(reconstruction, Volume):
            return score_reconstruction(reconstruction, self.truth)
        if self._last is None or not _same(self._last[0], reconstruction):
            self._last = reconstruction, score_reconstruction(reconstruction, self.truth)
        return self._last[1]


def _same(first: Volume, second: Volume) -> bool:
    return first.interpolation == second.interpolation and np.array_equal(first.probability, second.probability)


def _score_seed(submission: Submission, scorer: _Scorer, seed: int) -> ObjectScore:
    truth = scorer.truth
    name = truth.prepared.name
    rollouts = {pose: submission.rollout(name, pose, seed) for pose in EXPLORATION_ORDER}
    reference = submission.info.privileged and not any(rollouts.values())
    missing = [] if reference else [f"rollout of pose {pose}" for pose, rollout in rollouts.items() if rollout is None]
    touched_step = merge_touched_steps(rollouts)

    total = HORIZON * len(EXPLORATION_ORDER)
    recall = truth.coverage.recall_curve(touched_step, total)
    surface = metrics.surface_iou_curve(touched_step, truth.prepared.surface, total)
    poses: dict[str, dict[str, float | None]] = {}
    reasons: dict[str, str | None] = {}
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
            reason = f"rollouts of poses {', '.join(map(str, absent))} are missing"
            reconstruction = None
        shape, found = scorer.score(reconstruction)
        poses[str(count)] = {**shape, **(dict.fromkeys(touch) if reference else touch)}
        reasons[str(count)] = reason or found

    curve_areas = {
        "exploration_area": metrics.area_under_curve(recall),
        "exploration_surface_iou_area": metrics.area_under_curve(surface),
    }
    return ObjectScore(
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


def score_reconstruction(
    reconstruction: Reconstruction | None, truth: Truth
) -> tuple[dict[str, float | None], str | None]:
    """Shape and calibration metrics of one reconstruction, and why it counts as empty (or None)."""
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
        return {**SHAPE_METRICS, **calibration}, prediction.reason
    match = metrics.match_surfaces(metrics.to_metric(prediction.points), truth.surface)
    return {
        "iou": metrics.iou(prediction.solid, prepared.solid_at_iou_points, weights),
        "iou_raw": metrics.iou(prediction.solid, prepared.raw_solid_at_iou_points, weights),
        "chamfer_l2": metrics.chamfer_l2(match),
        "chamfer_l1": metrics.chamfer_l1(match),
        "normal_consistency": metrics.normal_consistency(prediction.normals, prepared.surface_normals, match),
        "f_score_1": metrics.f_score(match, F_SCORE_DISTANCES[0]),
        "f_score_2": metrics.f_score(match, F_SCORE_DISTANCES[1]),
        **calibration,
    }, None


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


def aggregate(results: Sequence[ObjectScore], objects: int) -> dict[str, dict[str, Estimate]]:
    """Estimates over objects and seeds of results in the order object by object, seed by seed."""
    rows = {
        "areas": [result.areas for result in results],
        **{str(count): [result.poses[str(count)] for result in results] for count in RECONSTRUCTED_POSES},
    }
    groups: dict[str, dict[str, NDArray]] = {}
    for group, values in rows.items():
        groups[group] = {
            name: np.array([row[name] for row in values], dtype=np.float64).reshape(objects, -1)
            for name in values[0]
            if all(row[name] is not None for row in values)
        }
    return {group: estimate_all(values) for group, values in groups.items()}


def _notes(
    submission: Submission, results: Sequence[ObjectScore], names: Sequence[str], cache: Path | None
) -> tuple[str, ...]:
    notes = []
    if tuple(names) != object_set(submission.info.object_set):
        notes.append(f"scored on chosen objects ({len(names)}), not on the object set {submission.info.object_set!r}")
    if submission.info.object_set == "test" and len(submission.info.seeds) < FULL_ENTRY_SEEDS:
        notes.append(f"not a full entry: {len(submission.info.seeds)} of at least {FULL_ENTRY_SEEDS} seeds")
    empty: dict[str, list[str]] = {}
    for result in results:
        where = f"{result.object}, seed {result.seed}"
        if result.missing:
            notes.append(f"{where}: missing, counted as empty: {', '.join(result.missing)}")
        for count, reason in result.reasons.items():
            if reason is not None and reason != "missing":
                empty.setdefault(reason, []).append(f"{where}, {count} poses")
        if result.implausible_touches > EXPECTED_IMPLAUSIBLE:
            share = f"{100 * result.implausible_touches:.1f} %"
            notes.append(f"{where}: {share} of the touched voxels are too far from the object to hold a contact")
    for reason, places in empty.items():
        more = f" and {len(places) - 3} more" if len(places) > 3 else ""
        notes.append(f"counted as empty, {reason}: {'; '.join(places[:3])}{more}")
    # A submission hashes the objects it holds: the whole set, or the chosen ones.
    hashes = [asset_sha256(names, cache=cache)]
    with contextlib.suppress(AssetError):
        hashes.append(asset_sha256(object_set(submission.info.object_set), cache=cache))
    if submission.info.asset_manifest_sha256 not in hashes:
        notes.append("the rollouts were made with other assets, or of other objects, than the ones scored against")
    return tuple(notes)
