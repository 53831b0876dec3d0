"""Records of trained policies, thinned for a chart: how many voxels an episode of training touched, step by step.

A record is the folder of a trained model: ``model.json`` says what was trained, ``curve.jsonl`` holds a line per iteration.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.weights import METADATA_FILE
from tslam_bench.files import read_plain_file
from tslam_bench.scoring.untrusted_json import parse_json

CURVE_FILE: Final = "curve.jsonl"
FIGURE: Final = "episode/touched_voxels"
"""What is shown: the only figure that means the same under every reward."""
BINS: Final = 80
"""Most points of a curve."""
PER_BIN: Final = 4
"""Iterations of one run that a point stands for, at least: below, there is no band to speak of."""
MAX_SIZE: Final = 64 * 2**20
"""Bytes of a record's file; one of 10 million steps has less than 10 MB."""
MAX_NAME: Final = 64


def find_records(folders: Iterable[Path]) -> list[Path]:
    """Folders of trained models: ``folders`` themselves, what they hold, and what their subfolder ``models`` holds."""
    found: dict[Path, None] = {}
    for folder in folders:
        for place in (folder, *_subfolders(folder), *_subfolders(folder / "models")):
            if (place / METADATA_FILE).is_file() and (place / CURVE_FILE).is_file():
                found[place] = None
    return list(found)


def read_records(folders: Sequence[Path]) -> list[dict[str, Any]]:
    """One curve per baseline, in the order of their names; runs of one baseline with several seeds are put together.

    Returns:
        dicts of plain values: ``explorer``; ``runs``, their number; ``steps``, ``mean``, ``low``, ``high``: voxels touched per
        episode, the mean and the 10th and 90th percentile over all iterations of all runs in bins of equal width.

    Raises:
        InvalidInputError: a folder holds no record of a trained policy.
    """
    runs: dict[str, list[np.ndarray]] = {}
    for folder in folders:
        name, curve = _read(folder)
        if len(curve):
            runs.setdefault(name, []).append(curve)
    return [{"explorer": name, "runs": len(curves), **_binned(curves)} for name, curves in sorted(runs.items())]


def _subfolders(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []


def _read(folder: Path) -> tuple[str, np.ndarray]:
    """Name of the baseline and its curve (iterations, 2): steps, figure. Iterations without an episode are left out."""
    try:
        about = parse_json(read_plain_file(folder / METADATA_FILE, MAX_SIZE))
        name = about["baseline"]
        lines = read_plain_file(folder / CURVE_FILE, MAX_SIZE).decode("utf-8").splitlines()
        rows = [json.loads(line) for line in lines]
        curve = np.array([(float(row["steps"]), float(row[FIGURE])) for row in rows if FIGURE in row], dtype=np.float64)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InvalidInputError(f"{folder}: no record of a trained policy ({error!r:.100}); leave it out") from error
    if not isinstance(name, str) or not 0 < len(name) <= MAX_NAME:
        raise InvalidInputError(f"{folder}: {METADATA_FILE} names no baseline; leave it out")
    if not np.isfinite(curve).all() or (curve < 0).any():
        raise InvalidInputError(
            f"{folder}: {CURVE_FILE} holds a figure that is no finite number from 0 on; leave it out"
        )
    return name, curve.reshape(-1, 2)


def _binned(curves: Sequence[np.ndarray]) -> dict[str, list[float]]:
    """Points of the chart: the end of each bin that holds an iteration, and mean and percentiles of those."""
    points = np.concatenate(curves)
    bins = min(BINS, max(1, max(len(curve) for curve in curves) // PER_BIN))
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
