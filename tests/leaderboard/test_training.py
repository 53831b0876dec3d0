"""Training records: found, read, thinned."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tslam_bench.errors import InvalidInputError
from tslam_bench.leaderboard.training import BINS, find_records, read_records


def record(folder: Path, name: str, touched: np.ndarray, spacing: int = 100) -> Path:
    """A record as training leaves it; NaN: an iteration in which no episode ended."""
    folder.mkdir(parents=True)
    (folder / "model.json").write_text(json.dumps({"baseline": name, "seed": 0}))
    rows = [{"steps": spacing * (k + 1), "train/entropy": 1.0} for k in range(len(touched))]
    for row, value in zip(rows, touched, strict=True):
        row |= {} if np.isnan(value) else {"episode/touched_voxels": float(value)}
    (folder / "curve.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def test_records_are_found_where_runs_keep_them(tmp_path: Path) -> None:
    one = record(tmp_path / "models" / "a", "tslam", np.arange(8.0))
    (tmp_path / "models" / "half").mkdir()
    (tmp_path / "models" / "half" / "curve.jsonl").touch()
    assert find_records([tmp_path]) == find_records([tmp_path / "models"]) == find_records([one, tmp_path]) == [one]
    assert find_records([tmp_path / "missing"]) == []


def test_a_point_is_the_mean_and_the_middle_of_its_bin(tmp_path: Path) -> None:
    """Two runs of 400 iterations: 5 iterations of each per point."""
    draws = np.random.default_rng(0).gamma(3, 20, (2, 5 * BINS))
    folders = [record(tmp_path / str(k), "tslam", row) for k, row in enumerate(draws)]
    (curve,) = read_records(folders)
    assert curve["explorer"] == "tslam" and curve["runs"] == 2
    assert curve["steps"] == [500 * (k + 1) for k in range(BINS)]
    groups = draws.reshape(2, BINS, 5).transpose(1, 0, 2).reshape(BINS, 10)
    assert curve["mean"] == pytest.approx(groups.mean(axis=1), abs=1e-3)
    ordered = np.sort(groups, axis=1)  # percentiles of ten values, interpolated
    assert curve["low"] == pytest.approx(0.1 * ordered[:, 0] + 0.9 * ordered[:, 1], abs=1e-3)
    assert curve["high"] == pytest.approx(0.9 * ordered[:, 8] + 0.1 * ordered[:, 9], abs=1e-3)


def test_records_of_shipped_weights_are_read_too(tmp_path: Path) -> None:
    for seed, first in ((0, 10.0), (1, 20.0)):
        about = {
            "baseline": "tslam",
            "seed": seed,
            "curve": {"steps": [100, 200], "touched_voxels": [first, first + 5]},
        }
        (tmp_path / f"tslam-{seed}.json").write_text(json.dumps(about))
        (tmp_path / f"tslam-{seed}.safetensors").touch()
    (tmp_path / "notes.json").write_text("{}")
    (curve,) = read_records(find_records([tmp_path]))
    assert (curve["explorer"], curve["runs"], curve["steps"], curve["mean"]) == ("tslam", 2, [200], [17.5])


def test_short_runs_and_iterations_without_an_episode(tmp_path: Path) -> None:
    folders = [
        record(tmp_path / "b", "tslam_knn", np.array([np.nan, 2.0, 4.0])),
        record(tmp_path / "a", "tslam", np.array([5.0])),
        record(tmp_path / "c", "tslam_points", np.array([np.nan])),
    ]
    curves = read_records(folders)
    assert [(c["explorer"], c["steps"], c["mean"]) for c in curves] == [
        ("tslam", [100], [5.0]),
        ("tslam_knn", [300], [3.0]),
    ]


@pytest.mark.parametrize(
    "line",
    ["", "{}\n[", '{"steps": 1, "episode/touched_voxels": "x"}', '{"steps": 1, "episode/touched_voxels": NaN}', "3"],
)
def test_what_is_no_record_is_refused_in_one_line(line: str, tmp_path: Path) -> None:
    folder = record(tmp_path / "a", "tslam", np.array([1.0]))
    (folder / ("curve.jsonl" if line else "model.json")).write_text(line)
    with pytest.raises(InvalidInputError, match="leave it out") as caught:
        read_records([folder])
    assert "\n" not in str(caught.value)
