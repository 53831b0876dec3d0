"""Writes docs/results.md, and the README's table, from the results that are kept in leaderboard/results/.

bash baselines/run_all.sh --scripted                       # the run itself
python docs/build_results.py --run runs/scripted           # keep its figures, write the pages
python docs/build_results.py [--check]                     # write (or compare) the pages from what is kept
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import tyro
from sections import filled, write_or_check

from tslam_bench.cli.ending import one_line_errors
from tslam_bench.errors import InvalidInputError
from tslam_bench.files import write_json

ROOT: Final = Path(__file__).parent.parent
KEPT: Final = ROOT / "leaderboard" / "results" / "scripted.json"
PAGE: Final = ROOT / "docs" / "results.md"
README: Final = ROOT / "README.md"
POSES: Final = ("1", "2", "4", "8")
README_RECONSTRUCTORS: Final = ("ifnet", "carve")


@dataclass(frozen=True)
class Config:
    """Writes the pages of results."""

    run: Path | None = None
    """Folder of a finished run whose figures are to be kept."""
    check: bool = False
    """Only compare; exit with status 1 if a page is out of date."""


def touched_voxels(run: Path) -> dict[str, float]:
    """Mean touched voxels per pose of every explorer whose rollouts the run holds."""
    from tslam_bench.evaluation.rollouts import Rollout

    counts = {}
    for folder in sorted((run / "rollouts").iterdir()):
        files = sorted(folder.glob("*/pose*_seed*.npz"))
        counts[folder.name] = float(np.mean([Rollout.load(path).touched.sum() for path in files]))
    return counts


def kept_figures(run: Path) -> dict[str, Any]:
    """What is kept of a run: aggregates, ranks, means per number of poses, touched voxels.

    Raises:
        InvalidInputError: the run is not finished, or holds more than one table.
    """
    path = run / "leaderboard.json"
    if not path.is_file():
        raise InvalidInputError(f"{path}: missing; let the run finish first")
    board = json.loads(path.read_text(encoding="utf-8"))
    if len(board["tables"]) != 1:
        raise InvalidInputError(f"{path}: {len(board['tables'])} tables, expected one")
    (table,) = board["tables"]
    entries = []
    for entry in table["entries"]:
        rows = entry["per_object"].values()
        recall = {count: _mean(row[count]["touched_surface_recall"] for row in rows) for count in POSES}
        info = entry["submission"]
        entries.append(
            {
                "explorer": info["explorer"],
                "reconstructor": info["reconstructor"],
                "rank": entry["rank"],
                "behind_leader": entry["behind_leader"],
                "aggregate": entry["aggregate"],
                "improvement": entry["improvement"],
                "recall": recall,
                "seeds": len(info["seeds"]),
                "iou_area_per_object": {name: row["areas"]["iou_area"] for name, row in entry["per_object"].items()},
            }
        )
    return {"objects": len(table["objects"]), "touched_voxels": touched_voxels(run), "entries": entries}


def _mean(values: Iterable[float | None]) -> float | None:
    known = list(values)
    return None if any(value is None for value in known) else float(np.mean([float(v) for v in known if v is not None]))


def exploration_table(kept: Mapping[str, Any]) -> str:
    """Touched voxels and surface, a row per explorer."""
    lines = [
        "| explorer | touched voxels per pose | surface touched after 1 / 2 / 4 / 8 poses | touch area |",
        "|---|---|---|---|",
    ]
    seen = {}
    for entry in kept["entries"]:
        if entry["explorer"] in kept["touched_voxels"]:
            seen.setdefault(entry["explorer"], entry)
    for name, entry in sorted(seen.items(), key=lambda item: -kept["touched_voxels"][item[0]]):
        recall = " / ".join(f"{entry['recall'][count]:.3f}" for count in POSES)
        area = entry["aggregate"]["areas"]["exploration_area"]
        lines.append(f"| `{name}` | {kept['touched_voxels'][name]:.0f} | {recall} | {_interval(area)} |")
    return "\n".join(lines)


def _interval(estimate: Mapping[str, float]) -> str:
    return f"{estimate['mean']:.3f} ({estimate['low']:.3f} to {estimate['high']:.3f})"


def score_table(kept: Mapping[str, Any], entries: Sequence[Mapping[str, Any]]) -> str:
    """Scores, a row per entry."""
    lines = [
        "| rank | explorer | reconstructor | IoU area (95 %) | 1 | 2 | 4 | 8 | CD-L2 x100 | NC | ECE | P(better) |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for entry in entries:
        groups = entry["aggregate"]
        ious = " | ".join(f"{groups[count]['iou']['mean']:.3f}" for count in POSES)
        at_8 = groups["8"]
        calibration = at_8.get("calibration_error")
        cells = (
            "-" if entry["rank"] is None else str(entry["rank"]),
            f"`{entry['explorer']}`",
            f"`{entry['reconstructor']}`",
            _interval(groups["areas"]["iou_area"]),
            ious,
            f"{100 * at_8['chamfer_l2']['mean']:.3f}",
            f"{at_8['normal_consistency']['mean']:.3f}",
            "-" if calibration is None else f"{calibration['mean']:.3f}",
            "-" if entry["improvement"] is None else f"{entry['improvement']:.2f}",
        )
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def texts_of(kept: Mapping[str, Any]) -> dict[Path, dict[str, str]]:
    """Page -> section -> text."""
    short = [entry for entry in kept["entries"] if entry["reconstructor"] in README_RECONSTRUCTORS]
    return {
        PAGE: {"exploration": exploration_table(kept), "scores": score_table(kept, kept["entries"])},
        README: {"results": score_table(kept, short)},
    }


def main(config: Config) -> None:
    """Keeps figures, writes or compares pages."""
    with one_line_errors("build_results"):
        if config.run is not None:
            write_json(KEPT, kept_figures(config.run))
        kept = json.loads(KEPT.read_text(encoding="utf-8"))
        write_or_check({page: filled(page, texts) for page, texts in texts_of(kept).items()}, config.check)


if __name__ == "__main__":
    main(tyro.cli(Config))
