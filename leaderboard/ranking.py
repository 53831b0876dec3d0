"""From score files to a ranking: one table per set of objects (protocol section 12).

Rank: IoU at 8 poses, ties by Chamfer-L2 at 8 poses, then by exploration area. Entries that used privileged information are
listed where their score puts them, without a rank.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from tslam_bench import __version__
from tslam_bench.constants import ENVIRONMENT_ID, PROTOCOL_VERSION
from tslam_bench.leaderboard.aggregate import probability_of_improvement
from tslam_bench.leaderboard.scoring import CURVE_SPACING, SubmissionScore, object_set

LEADERBOARD_VERSION: Final = 1
"""Version of the layout of leaderboard.json."""
REFERENCE_EXPLORER: Final = "heuristic"
"""Explorer over which the probability of improvement is given."""


def rank(scores: Sequence[SubmissionScore]) -> dict[str, Any]:
    """The content of leaderboard.json.

    Args:
        scores: scored submissions; of several with the same files, one is kept.

    Returns:
        a dict of plain values: ``tables``, each with its ``objects`` and its ``entries`` in the order of the ranking.
    """
    distinct = list({(score.content_hash, score.objects): score for score in scores}.values())
    groups: dict[tuple[str, ...], list[SubmissionScore]] = {}
    for score in distinct:
        groups.setdefault(tuple(sorted(score.objects)), []).append(score)
    # The largest set of objects first.
    tables = [_table(group) for _, group in sorted(groups.items(), key=lambda item: (-len(item[0]), item[0]))]
    return {
        "leaderboard_version": LEADERBOARD_VERSION,
        "protocol_version": PROTOCOL_VERSION,
        "package_version": __version__,
        "environment_id": ENVIRONMENT_ID,
        "reference_explorer": REFERENCE_EXPLORER,
        "curve_spacing": CURVE_SPACING,
        "tables": tables,
    }


def _table(group: Sequence[SubmissionScore]) -> dict[str, Any]:
    ordered = sorted(group, key=_sort_key)
    objects = ordered[0].objects
    name = ordered[0].info.object_set
    entries = []
    position = 0
    for score in ordered:
        if not score.info.privileged:
            position += 1
        entries.append(_entry(score, None if score.info.privileged else position, group))
    return {
        "object_set": name if set(objects) == set(object_set(name)) else "custom",
        "objects": sorted(objects),
        "entries": entries,
    }


def _sort_key(score: SubmissionScore) -> tuple[Any, ...]:
    at_8 = score.aggregate["8"]
    area = score.aggregate["exploration"].get("exploration_area")
    # Names last, so that the order never depends on the order of the files.
    names = (score.info.explorer, score.info.reconstructor, score.info.method, score.content_hash)
    return (-at_8["iou"].mean, at_8["chamfer_l2"].mean, -(area.mean if area else 0.0), *names)


def _entry(score: SubmissionScore, position: int | None, group: Sequence[SubmissionScore]) -> dict[str, Any]:
    objects = sorted(score.objects)
    results: dict[str, list[Any]] = {name: [] for name in objects}
    for result in score.results:
        results[result.object].append(result)
    return {
        "rank": position,
        "submission": score.info.to_json(),
        "content_hash": score.content_hash,
        "verified": score.verified,
        "aggregate": {
            group_name: {metric: dataclasses.asdict(estimate) for metric, estimate in estimates.items()}
            for group_name, estimates in score.aggregate.items()
        },
        "improvement": _improvement(score, group),
        "per_object": {
            name: {
                protocol: {
                    metric: _mean([r.protocols[protocol][metric] for r in rows]) for metric in rows[0].protocols["8"]
                }
                for protocol in ("4", "8")
            }
            for name, rows in results.items()
        },
        "poses": {
            count: {metric: _mean([r.poses[count][metric] for r in score.results]) for metric in values}
            for count, values in score.results[0].poses.items()
        },
        "recall_curve": _mean_curve([r.recall_curve for r in score.results]),
        "surface_iou_curve": _mean_curve([r.surface_iou_curve for r in score.results]),
        "notes": list(score.notes),
    }


def _improvement(score: SubmissionScore, group: Sequence[SubmissionScore]) -> float | None:
    """Probability of improvement in IoU at 8 poses over the reference explorer with the same reconstructor, or None."""
    if score.info.explorer == REFERENCE_EXPLORER:
        return None
    same = [
        s for s in group if s.info.explorer == REFERENCE_EXPLORER and s.info.reconstructor == score.info.reconstructor
    ]
    if not same:
        return None
    reference = min(same, key=_sort_key)
    return probability_of_improvement(_iou_matrix(score), _iou_matrix(reference))


def _iou_matrix(score: SubmissionScore) -> np.ndarray:
    return score.matrix("iou", 8)[np.argsort(score.objects)]


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if len(known) == len(values) and known else None


def _mean_curve(curves: Sequence[Sequence[float]]) -> list[float]:
    if not curves or not all(curves):
        return []
    return [round(float(value), 5) for value in np.mean(np.array(curves), axis=0)]
