"""Records of trained policies, thinned for a chart: how many voxels an episode of training touched, step by step.

A record is the folder of a trained model (``model.json`` says what was trained, ``curve.jsonl`` holds a line per iteration), or
the JSON file beside shipped weights, whose curve has few points, each the mean over several iterations.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.weights import METADATA_FILE, WEIGHTS_SUFFIX
from tslam_bench.files import read_plain_file
from tslam_bench.scoring.untrusted_json import parse_json

CURVE_FILE: Final = "curve.jsonl"
FIGURE: Final = "episode/touched_voxels"
"""What is shown: the only figure that means the same under every reward."""
SHORT_FIGURE: Final = "touched_voxels"
"""Its name in the record of shipped weights."""
BINS: Final = 80
"""Most points of a curve."""
PER_BIN: Final = 4
"""Recorded figures that a point stands for, at least: below, there is no band to speak of."""
MAX_SIZE: Final = 64 * 2**20
"""Bytes of a record's file; one of 10 million steps has less than 10 MB."""
MAX_NAME: Final = 64


def find_records(folders: Iterable[Path]) -> list[Path]:
    """Records in ``folders``, in what they hold, and in what their subfolder ``models`` holds."""
    found: dict[Path, None] = {}
    for folder in folders:
        for place in (folder, *_inside(folder), *_inside(folder / "models")):
            model = (place / METADATA_FILE).is_file() and (place / CURVE_FILE).is_file()
            if model or (place.suffix == ".json" and place.with_suffix(WEIGHTS_SUFFIX).is_file()):
                found[place] = None
    return list(found)


def read_records(records: Sequence[Path]) -> list[dict[str, Any]]:
    """One curve per baseline, in the order of their names; runs of one baseline with several seeds are put together.

    Returns:
        dicts of plain values: ``explorer``; ``runs``, their number; ``steps``, ``mean``, ``low``, ``high``: voxels touched per
        episode, the mean and the 10th and 90th percentile over all that was recorded of all runs in bins of equal width.

    Raises:
        InvalidInputError: what is named is no record of a trained policy.
    """
    runs: dict[str, list[np.ndarray]] = {}
    for record in records:
        name, curve = _read(record)
        if len(curve):
            runs.setdefault(name, []).append(curve)
    return [{"explorer": name, "runs": len(curves), **_binned(curves)} for name, curves in sorted(runs.items())]


def _inside(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []


def _read(record: Path) -> tuple[str, np.ndarray]:
    """Name of the baseline and its curve (points, 2): steps, figure. Iterations without an episode are left out."""
    try:
        if record.is_dir():
            about = parse_json(read_plain_file(record / METADATA_FILE, MAX_SIZE))
            lines = read_plain_file(record / CURVE_FILE, MAX_SIZE).decode("utf-8").splitlines()
            rows = [json.loads(line) for line in lines]
            points = [(float(row["steps"]), float(row[FIGURE])) for row in rows if FIGURE in row]
        else:
            about = parse_json(read_plain_file(record, MAX_SIZE))
            given = about["curve"]
            points = [(float(a), float(b)) for a, b in zip(given["steps"], given[SHORT_FIGURE], strict=True)]
        name = about["baseline"]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InvalidInputError(f"{record}: no record of a trained policy ({error!r:.100}); leave it out") from error
    curve = np.array(points, dtype=np.float64).reshape(-1, 2)
    if not isinstance(name, str) or not 0 < len(name) <= MAX_NAME:
        raise InvalidInputError(f"{record}: names no baseline; leave it out")
    if not np.isfinite(curve).all() or (curve < 0).any():
        raise InvalidInputError(f"{record}: its curve holds a figure that is no finite number from 0 on; leave it out")
    return name, curve


def _binned(curves: Sequence[np.ndarray]) -> dict[str, list[float]]:
    """Points of the chart: the end of each bin that holds an iteration, and mean and percentiles of those."""
    points = np.concatenate(curves)
    bins = min(BINS, max(len(curve) for curve in curves), max(1, len(points) // PER_BIN))
    width = points[:, 0].max() / bins or 1.0
    which = np.clip(np.ceil(points[:, 0] / width - 1e-9), 1, bins).astype(int)
    result: dict[str, list[float]] = {"steps": [], "mean": [], "low": [], "high": []}
    for index in np.unique(which):
        values = points[which == index, 1]
        low, high = np.percentile(values, [10, 90])
        result["steps"].append(math.ceil(index * width))
        for key, value in (("mean", values.mean()), ("low", low), ("high", high)):
            result[key].append(round(float(value), 3))
    return result
