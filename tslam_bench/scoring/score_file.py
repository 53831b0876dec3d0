"""Scores of a submission, as they are stored: per object and seed, and aggregated (protocol section 10)."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import PROTOCOL_VERSION
from tslam_bench.errors import InvalidInputError
from tslam_bench.scoring.aggregate import Estimate
from tslam_bench.scoring.info import SubmissionInfo, parse_info
from tslam_bench.version import __version__

SCORE_VERSION: Final = 2
"""Version of the score file's layout."""
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


def is_score_file(path: Path) -> bool:
    """Whether a file is, or was meant as, a score file of any version."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(value, dict) and "score_version" in value
