"""Scores of a submission: per object and seed, and aggregated (protocol section 10)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import PROTOCOL_VERSION
from tslam_bench.scoring.aggregate import Estimate, estimate_all
from tslam_bench.scoring.info import SubmissionInfo
from tslam_bench.version import __version__

SCORE_VERSION: Final = 3
"""Version of the score file's layout."""
Tier = Literal["reported", "replayed", "attested", "hidden"]
TIERS: Final = get_args(Tier)
"""How far an entry was checked (protocol section 12), the least first."""
COUNTS: Final = ("1", "2", "4", "8")
"""Numbers of poses that are scored."""
CURVE_SPACING: Final = 10
"""Control steps between the stored samples of an exploration curve."""


@dataclass(frozen=True)
class ObjectScore:
    """Scores of one object and seed.

    Attributes:
        object, seed: what was scored.
        poses: ``"1"``, ``"2"``, ``"4"``, ``"8"`` -> metric -> value after so many poses of the exploration order; touch
            metrics are None for a reference without rollouts, calibration metrics are None for a mesh.
        reasons: the same keys -> why the reconstruction counts as empty, or None.
        areas: ``iou_area``, the mean of the IoU after 1, 2, 4 and 8 poses, by which entries are ranked;
            ``exploration_area`` and ``exploration_surface_iou_area``, areas under the curves of recall and of surface IoU
            over every step of all eight poses, None for a reference without rollouts.
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
        tier: how far it was checked.
        own_run: whether the explorer is what it calls itself: its rollouts were made by it on this machine.
        made_here: whether these figures were computed by this user on this machine, and not by whoever sent them.
    """

    info: SubmissionInfo
    content_hash: str
    objects: tuple[str, ...]
    asset_sha256: str
    results: tuple[ObjectScore, ...]
    aggregate: dict[str, dict[str, Estimate]]
    notes: tuple[str, ...]
    tier: Tier = "reported"
    own_run: bool = False
    made_here: bool = True

    @property
    def verified(self) -> bool:
        """Whether touches and exploration figures are those of a replay."""
        return self.tier != "reported"

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
            "tier": self.tier,
            "own_run": self.own_run,
            "objects": list(self.objects),
            "asset_sha256": self.asset_sha256,
            "results": [dict(vars(result)) for result in self.results],  # asdict would copy every figure
            "aggregate": {
                group: {name: dataclasses.asdict(estimate) for name, estimate in estimates.items()}
                for group, estimates in self.aggregate.items()
            },
            "notes": list(self.notes),
        }


def aggregate(results: Sequence[ObjectScore], objects: int) -> dict[str, dict[str, Estimate]]:
    """Estimates over objects and seeds of results in the order object by object, seed by seed."""
    rows = {
        "areas": [result.areas for result in results],
        **{count: [result.poses[count] for result in results] for count in COUNTS},
    }
    groups: dict[str, dict[str, NDArray]] = {}
    for group, values in rows.items():
        groups[group] = {
            name: np.array([row[name] for row in values], dtype=np.float64).reshape(objects, -1)
            for name in values[0]
            if all(row[name] is not None for row in values)
        }
    return {group: estimate_all(values) for group, values in groups.items()}
