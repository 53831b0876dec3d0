"""Score files: written with a seal, and read without trusting whoever wrote them.

Every field is checked. Of a file that was not made here (it has no seal of this user and machine), what follows from others is
computed again: the area of an IoU, all aggregates. Its other figures are whatever its sender says: it counts as not verified, and
says so.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from tslam_bench.constants import HORIZON, PROTOCOL_VERSION
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import read_plain_file, write_json
from tslam_bench.objects.splits import OBJECTS
from tslam_bench.scoring.aggregate import Estimate
from tslam_bench.scoring.info import SubmissionInfo, check_info
from tslam_bench.scoring.measure import CALIBRATION_METRICS, SHAPE_METRICS, TOUCH_METRICS
from tslam_bench.scoring.rollout import OBJECT_NAME
from tslam_bench.scoring.score_file import (
    COUNTS,
    CURVE_SPACING,
    SCORE_VERSION,
    TIERS,
    ObjectScore,
    SubmissionScore,
    aggregate,
)
from tslam_bench.scoring.seal import seal, sealed_here
from tslam_bench.scoring.submission import EXPLORATION_ORDER
from tslam_bench.scoring.untrusted_json import parse_json

MAX_SCORE_SIZE: Final = 64 * 2**20
"""Bytes of a score file; one of 50 objects and 100 seeds has 45 MB."""
MAX_OBJECTS: Final = 1000
"""Of an organiser's own split."""
MAX_NOTES: Final = 20_000
MAX_NOTE: Final = 4000
"""Characters of a note."""
NOT_MADE_HERE: Final = "scored elsewhere: all figures are those of a score file that somebody sent"
"""Note on an entry whose figures were not computed here."""
_REMEDY: Final = "score the submission again"
_CURVE: Final = HORIZON * len(EXPLORATION_ORDER) // CURVE_SPACING + 1
_CURVE_AREAS: Final = ("exploration_area", "exploration_surface_iou_area")
_SLACK: Final = 1e-6
"""By so much, rounded sums may leave their range."""
_LARGEST: Final = {name: worst for name, worst in SHAPE_METRICS.items() if worst > 1}
"""Largest values of distances; those of all other metrics are 1."""


class _Wrong(Exception):
    """What is wrong with a score file."""


def sealed_json(score: SubmissionScore) -> dict[str, Any]:
    """Plain values for a score file: the score, and the seal of figures made here where there is a key to seal with."""
    content = score.to_json()
    if not score.made_here:
        return content
    try:
        return {**content, "seal": seal(content)}
    except AssetError:
        return content  # the cache may not be written: the file is as good as one from elsewhere


def write_score(path: Path, score: SubmissionScore) -> None:
    """Writes a score file, atomically."""
    write_json(path, sealed_json(score))


def read_score(path: Path, vouched: bool = False) -> SubmissionScore:
    """Reads a score file.

    Args:
        vouched: the caller knows who made the file, as of one that is kept beside this package's sources: it counts as one
            that was made here.

    Raises:
        InvalidInputError: it is missing, not one of this version, or a field is not what it can be.
    """
    return parse_score(_parse(path), str(path), vouched)


def is_score_file(path: Path) -> bool:
    """Whether a file is, or was meant as, a score file of any version."""
    try:
        value = _parse(path)
    except InvalidInputError:
        return False
    return isinstance(value, dict) and "score_version" in value


def parse_score(value: Any, where: str, vouched: bool = False) -> SubmissionScore:
    """The score in a score file's content.

    Args:
        where: the file's name for messages.
        vouched: see :func:`read_score`.

    Raises:
        InvalidInputError: not one of this version, or a field is not what it can be.
    """
    try:
        return _score(value, vouched)
    except (_Wrong, InvalidInputError) as error:
        raise InvalidInputError(f"{where}: not a score file ({error}); {_REMEDY}") from error


def _parse(path: Path) -> Any:
    data = read_plain_file(path, MAX_SCORE_SIZE)
    try:
        return parse_json(data)
    except ValueError as error:
        reason = " ".join(str(error).split())[:120]
        raise InvalidInputError(f"{path}: not a score file ({reason}); {_REMEDY}") from error


def _score(value: Any, vouched: bool) -> SubmissionScore:
    if not isinstance(value, dict) or "score_version" not in value:
        raise _Wrong("no score_version")
    if value["score_version"] != SCORE_VERSION or value.get("protocol_version") != PROTOCOL_VERSION:
        raise _Wrong("of another version")
    claimed = value.get("seal")
    content = {name: field for name, field in value.items() if name != "seal"}
    made_here = vouched or (claimed is not None and sealed_here(content, claimed))
    content.setdefault("tier", "replayed" if content.get("verified") is True else "reported")  # older files have none
    _keys(
        content,
        "the file",
        *("score_version", "protocol_version", "package_version", "submission", "content_hash", "verified"),
        *("tier", "own_run"),
        *("objects", "asset_sha256", "results", "aggregate", "notes"),
    )
    _text(content["package_version"], "package_version", 100)
    info = check_info(content["submission"])
    for name in ("content_hash", "asset_sha256"):
        if not re.fullmatch(r"[0-9a-f]{64}", _text(content[name], name, 64)):
            raise _Wrong(f"{name} is no SHA-256")
    for name in ("verified", "own_run"):
        if not isinstance(content[name], bool):
            raise _Wrong(f"{name} is neither true nor false")
    if content["tier"] not in TIERS:
        raise _Wrong(f"tier is none of {', '.join(TIERS)}")
    most = len(OBJECTS) if info.split == "test" else MAX_OBJECTS
    objects = tuple(_text(name, "objects", 80) for name in _list(content["objects"], "objects", most))
    known = OBJECTS if info.split == "test" else [name for name in objects if re.fullmatch(OBJECT_NAME, name)]
    if not objects or len(set(objects)) < len(objects) or not set(objects) <= set(known):
        raise _Wrong(f"objects are not different objects of the {info.split} split")
    episodes = [(name, seed) for name in objects for seed in info.seeds]
    results = _list(content["results"], "results", len(episodes))
    if len(results) != len(episodes):
        raise _Wrong(
            f"{len(results)} results; expected one for each of {len(objects)} objects and {len(info.seeds)} seeds"
        )
    scores = tuple(_result(result, name, seed, info) for result, (name, seed) in zip(results, episodes, strict=True))
    notes = [_text(note, "notes", MAX_NOTE) for note in _list(content["notes"], "notes", MAX_NOTES)]
    return SubmissionScore(
        info=info,
        content_hash=content["content_hash"],
        objects=objects,
        asset_sha256=content["asset_sha256"],
        results=scores,
        aggregate=_estimates(content["aggregate"]) if made_here else aggregate(scores, len(objects)),
        notes=tuple(notes) if made_here else (NOT_MADE_HERE, *(note for note in notes if note != NOT_MADE_HERE)),
        tier=content["tier"] if made_here else TIERS[0],
        own_run=content["own_run"] and made_here,
        made_here=made_here,
    )


def _result(value: Any, name: str, seed: int, info: SubmissionInfo) -> ObjectScore:
    where = f"the result of {name}, seed {seed}"
    _keys(value, where, *(field.name for field in dataclasses.fields(ObjectScore)))
    if value["object"] != name or value["seed"] != seed or isinstance(value["seed"], bool):
        raise _Wrong(f"{where} is of another object or seed")
    _keys(value["poses"], f"{where}: poses", *COUNTS)
    poses: dict[str, dict[str, float | None]] = {}
    # A reference without rollouts has no figures of touch, a mesh claims no probability.
    touch = info.privileged and value["recall_curve"] == []
    for count in COUNTS:
        here = f"{where}: after {count} poses"
        given = value["poses"][count]
        _keys(given, here, *SHAPE_METRICS, *CALIBRATION_METRICS, *TOUCH_METRICS)
        mesh = all(given[metric] is None for metric in CALIBRATION_METRICS)
        absent = {*(TOUCH_METRICS if touch else ()), *(CALIBRATION_METRICS if mesh else ())}
        poses[count] = {
            metric: None if metric in absent else _number(given[metric], f"{here}: {metric}", _LARGEST.get(metric, 1.0))
            for metric in (*SHAPE_METRICS, *CALIBRATION_METRICS, *TOUCH_METRICS)
        }
    _keys(value["reasons"], f"{where}: reasons", *COUNTS)
    _keys(value["areas"], f"{where}: areas", "iou_area", *_CURVE_AREAS)
    areas: dict[str, float | None] = {"iou_area": float(np.mean([poses[count]["iou"] for count in COUNTS]))}
    for area in _CURVE_AREAS:
        areas[area] = None if touch else _number(value["areas"][area], f"{where}: {area}")
    curves = {
        curve: [_number(x, f"{where}: {curve}") for x in _list(value[curve], f"{where}: {curve}", _CURVE)]
        for curve in ("recall_curve", "surface_iou_curve")
    }
    if any(len(curve) != (0 if touch else _CURVE) for curve in curves.values()):
        raise _Wrong(f"{where}: a curve has not {0 if touch else _CURVE} values")
    return ObjectScore(
        object=name,
        seed=seed,
        poses=poses,
        reasons={
            count: None if reason is None else _text(reason, f"{where}: reasons", MAX_NOTE)
            for count, reason in value["reasons"].items()
        },
        areas=areas,
        **curves,
        implausible_touches=_number(value["implausible_touches"], f"{where}: implausible_touches"),
        missing=[_text(piece, f"{where}: missing", 100) for piece in _list(value["missing"], f"{where}: missing", 100)],
    )


def _estimates(value: Any) -> dict[str, dict[str, Estimate]]:
    """The aggregate of a file that was made here."""
    return {group: {name: Estimate(**row) for name, row in estimates.items()} for group, estimates in value.items()}


def _keys(value: Any, where: str, *names: str) -> None:
    if not isinstance(value, dict):
        raise _Wrong(f"{where}: no JSON object")
    for name in (*names, *value):
        if name not in value:
            raise _Wrong(f"{where}: {name} is missing")
        if name not in names:
            raise _Wrong(f"{where}: unknown field {name[:40]!r}")


def _list(value: Any, where: str, most: int) -> Sequence[Any]:
    if not isinstance(value, list) or len(value) > most:
        raise _Wrong(f"{where}: no list, or one of more than {most} values")
    return value


def _text(value: Any, where: str, most: int) -> str:
    if not isinstance(value, str) or len(value) > most:
        raise _Wrong(f"{where}: no text of at most {most} characters")
    return value


def _number(value: Any, where: str, high: float = 1.0) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= high + _SLACK:
        raise _Wrong(f"{where} is {repr(value)[:40]}; expected a number from 0 to {high:g}")
    return float(value)
