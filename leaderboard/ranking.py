"""From score files to a ranking: one table per set of objects (protocol section 12).

Order: IoU area, then IoU at 8 poses, then Chamfer-L2 at 8 poses. Rank: going down the table, an entry shares the rank of
the leader of the current group if the 95 % interval of their paired difference in IoU area holds 0; otherwise it leads the
next group, and its rank counts all ranked entries above it. Entries that used privileged information are listed where their
score puts them, without a rank, and lead no group.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from tslam_bench.constants import ENVIRONMENT_ID, PROTOCOL_VERSION
from tslam_bench.evaluation.policies import list_baselines
from tslam_bench.objects.splits import object_set
from tslam_bench.scoring.aggregate import curve_intervals, interval, probability_of_improvement, resampled_means
from tslam_bench.scoring.figures import rounded
from tslam_bench.scoring.info import OBJECT_SETS
from tslam_bench.scoring.score_file import CURVE_SPACING, TIERS, SubmissionScore
from tslam_bench.scoring.submission import RECONSTRUCTED_POSES
from tslam_bench.version import __version__

LEADERBOARD_VERSION: Final = 4
"""Version of the layout of leaderboard.json. 4: tiers, bands of the curves, training records."""
DIGITS: Final = 7
"""Significant digits of the figures: sums of other processors differ only beyond them."""
REFERENCE_EXPLORER: Final = "heuristic"
"""Explorer over which the probability of improvement is given."""
RESERVED: Final = frozenset(spec.id for spec in list_baselines() if spec.kind != "own")
"""Ids of the benchmark's own explorers."""


def rank(scores: Sequence[SubmissionScore], training: Sequence[Mapping[str, Any]] = ()) -> dict[str, Any]:
    """The content of leaderboard.json.

    Args:
        training: records of trained policies (:func:`tslam_bench.leaderboard.training.read_records`).
        scores: scored submissions; of several with the same files, the most trustworthy one is kept, in whatever order they come.

    Returns:
        a dict of plain values: ``tables``, each with its ``objects`` and its ``entries`` in the order of the ranking.
    """
    scores = sorted(scores, key=_doubt, reverse=True)  # of equal keys, the last stays
    distinct = list({(score.content_hash, tuple(sorted(score.objects))): score for score in scores}.values())
    groups: dict[tuple[str, ...], list[SubmissionScore]] = {}
    for score in distinct:
        groups.setdefault(tuple(sorted(score.objects)), []).append(score)
    # The largest set of objects first.
    tables = [_table(group) for _, group in sorted(groups.items(), key=lambda item: (-len(item[0]), item[0]))]
    board = {
        "leaderboard_version": LEADERBOARD_VERSION,
        "protocol_version": PROTOCOL_VERSION,
        "package_version": __version__,
        "environment_id": ENVIRONMENT_ID,
        "reference_explorer": REFERENCE_EXPLORER,
        "curve_spacing": CURVE_SPACING,
        "tables": tables,
        "training": list(training),
    }
    return rounded(board, DIGITS)


def _table(group: Sequence[SubmissionScore]) -> dict[str, Any]:
    ordered = sorted(group, key=_sort_key)
    objects = ordered[0].objects
    name = ordered[0].info.object_set
    entries = [
        _entry(score, position, difference, group)
        for score, (position, difference) in zip(ordered, shared_ranks(ordered), strict=True)
    ]
    return {
        "object_set": name if name not in OBJECT_SETS or set(objects) == set(object_set(name)) else "custom",
        "objects": sorted(objects),
        "entries": entries,
    }


def shared_ranks(ordered: Sequence[SubmissionScore]) -> list[tuple[int | None, dict[str, float] | None]]:
    """Rank of every entry, and how far it is behind the leader of its group.

    Args:
        ordered: scores on the same objects, best first.

    Returns:
        for each score its rank (None if privileged), and ``mean``, ``low``, ``high`` of the difference in IoU area between
        the leader whose interval it was tested against and itself; None for who leads the first group, and for privileged
        entries.
    """
    ranks: list[tuple[int | None, dict[str, float] | None]] = []
    leader: tuple[int, float, np.ndarray] | None = None
    above = 0
    for score in ordered:
        if score.info.privileged:
            ranks.append((None, None))
            continue
        matrix = _area_matrix(score)
        mean, drawn = float(matrix.mean()), resampled_means(matrix)
        difference = None
        if leader is not None:
            low, high = interval(leader[2] - drawn)
            difference = {"mean": leader[1] - mean, "low": low, "high": high}
        if leader is None or difference is None or not difference["low"] <= 0 <= difference["high"]:
            leader = (above + 1, mean, drawn)
        ranks.append((leader[0], difference))
        above += 1
    return ranks


def _sort_key(score: SubmissionScore) -> tuple[Any, ...]:
    at_8 = score.aggregate["8"]
    # Names last, so that the order never depends on the order of the files.
    names = (score.info.explorer, score.info.reconstructor, score.info.method, score.content_hash)
    return (-score.aggregate["areas"]["iou_area"].mean, -at_8["iou"].mean, at_8["chamfer_l2"].mean, *names)


def _doubt(score: SubmissionScore) -> tuple[Any, ...]:
    """Lower for figures that were made here, and of a replay; and what differs at all is told apart by its text."""
    return not score.made_here, -TIERS.index(score.tier), json.dumps(score.to_json(), sort_keys=True)


def _entry(
    score: SubmissionScore, position: int | None, difference: dict[str, float] | None, group: Sequence[SubmissionScore]
) -> dict[str, Any]:
    objects = sorted(score.objects)
    results: dict[str, list[Any]] = {name: [] for name in objects}
    for result in score.results:
        results[result.object].append(result)
    written = score.to_json()
    return {
        **{name: written[name] for name in ("submission", "content_hash", "verified", "tier", "aggregate", "notes")},
        "claimed": _claimed(score),
        "rank": position,
        "behind_leader": difference,
        "improvement": _improvement(score, group),
        "per_object": {
            name: {
                "areas": _means([r.areas for r in rows]),
                **{str(count): _means([r.poses[str(count)] for r in rows]) for count in RECONSTRUCTED_POSES},
            }
            for name, rows in results.items()
        },
        "recall_curve": _mean_curve([r.recall_curve for r in score.results]),
        "recall_band": _band(score),
        "surface_iou_curve": _mean_curve([r.surface_iou_curve for r in score.results]),
    }


def _claimed(score: SubmissionScore) -> bool:
    """Whether an entry calls itself by the id of a registered policy, which nothing here bears out."""
    return score.info.explorer in RESERVED and not score.own_run


def _improvement(score: SubmissionScore, group: Sequence[SubmissionScore]) -> float | None:
    """Probability of improvement in IoU area over the reference explorer with the same reconstructor, or None."""
    same = [
        other
        for other in group
        if other.info.explorer == REFERENCE_EXPLORER
        and other.info.reconstructor == score.info.reconstructor
        and not _claimed(other)
    ]
    if not same or score in same:
        return None
    reference = min(same, key=_sort_key)
    return probability_of_improvement(_area_matrix(score), _area_matrix(reference))


def _area_matrix(score: SubmissionScore) -> np.ndarray:
    """IoU area (objects, seeds) in the order of their names and numbers, so that entries can be paired."""
    matrix = score.matrix("areas", "iou_area")
    return matrix[np.argsort(score.objects)][:, np.argsort(score.info.seeds)]


def _means(rows: Sequence[dict[str, float | None]]) -> dict[str, float | None]:
    return {metric: _mean([row[metric] for row in rows]) for metric in rows[0]}


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if len(known) == len(values) and known else None


def _mean_curve(curves: Sequence[Sequence[float]]) -> list[float]:
    if not curves or not all(curves):
        return []
    return [round(float(value), 5) for value in np.mean(np.array(curves), axis=0)]


def _band(score: SubmissionScore) -> dict[str, list[float]]:
    """95 % interval of the mean recall at every point of the curve; empty for a reference without rollouts."""
    curves = [result.recall_curve for result in score.results]
    if not curves or not all(curves):
        return {"low": [], "high": []}
    low, high = curve_intervals(np.array(curves).reshape(len(score.objects), -1, len(curves[0])))
    return {"low": [round(float(x), 5) for x in low], "high": [round(float(x), 5) for x in high]}
