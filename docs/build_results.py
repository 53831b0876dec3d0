"""Writes docs/results.md, and the README's table, from the results that are kept in leaderboard/results/.

bash baselines/run_all.sh --scripted                       # the run itself
python docs/build_results.py --run runs/scripted           # keep its figures, write the pages
python docs/build_results.py [--check]                     # write (or compare) the pages from what is kept
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import tyro
from sections import filled, write_or_check

from tslam_bench.cli.ending import one_line_errors
from tslam_bench.errors import InvalidInputError
from tslam_bench.files import write_json
from tslam_bench.scoring.figures import EXPLORATION_AREA, FIGURES, IOU_AREA, MISSING, Figure, interval, means, number
from tslam_bench.scoring.submission import RECONSTRUCTED_POSES

ROOT: Final = Path(__file__).parent.parent
KEPT: Final = ROOT / "leaderboard" / "results" / "scripted.json"
PAGE: Final = ROOT / "docs" / "results.md"
README: Final = ROOT / "README.md"
README_RECONSTRUCTORS: Final = ("ifnet", "carve")
COUNTS: Final = tuple(str(count) for count in RECONSTRUCTED_POSES)
COLUMNS: Final = tuple(
    figure for figure in FIGURES if figure.metric in ("iou", "calibration_error", "chamfer_l2", "normal_consistency")
)


@dataclass(frozen=True)
class Config:
    """Writes the pages of results."""

    run: Path | None = None
    """Folder of a finished run whose figures are to be kept."""
    check: bool = False
    """Only compare; exit with status 1 if a page is out of date."""


def touched_voxels(run: Path) -> dict[str, float]:
    """Mean touched voxels per pose of every explorer whose rollouts the run holds."""
    from tslam_bench.scoring.rollout import Rollout

    counts = {}
    for folder in sorted((run / "rollouts").iterdir()):
        files = sorted(folder.glob("*/pose*_seed*.npz"))
        counts[folder.name] = float(np.mean([Rollout.load(path).touched.sum() for path in files]))
    return counts


def kept_figures(run: Path) -> dict[str, Any]:
    """What is kept of a run: aggregates, ranks, touched voxels.

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
        info = entry["submission"]
        entries.append(
            {
                "explorer": info["explorer"],
                "reconstructor": info["reconstructor"],
                "rank": entry["rank"],
                "behind_leader": entry["behind_leader"],
                "aggregate": entry["aggregate"],
                "improvement": entry["improvement"],
                "seeds": len(info["seeds"]),
                "iou_area_per_object": {name: row["areas"]["iou_area"] for name, row in entry["per_object"].items()},
            }
        )
    return {"objects": len(table["objects"]), "touched_voxels": touched_voxels(run), "entries": entries}


def exploration_table(kept: Mapping[str, Any]) -> str:
    """Touched voxels and surface, a row per explorer."""
    lines = [
        f"| explorer | touched voxels per pose | surface touched after {' / '.join(COUNTS)} poses | {EXPLORATION_AREA.short} |",
        "|---|---|---|---|",
    ]
    seen = {}
    for entry in kept["entries"]:
        if entry["explorer"] in kept["touched_voxels"]:
            seen.setdefault(entry["explorer"], entry)
    for name, entry in sorted(seen.items(), key=lambda item: -kept["touched_voxels"][item[0]]):
        groups = entry["aggregate"]
        recall = " / ".join(number(groups[count]["touched_surface_recall"]["mean"]) for count in COUNTS)
        area = _with_interval(groups, EXPLORATION_AREA)
        lines.append(f"| `{name}` | {kept['touched_voxels'][name]:.0f} | {recall} | {area} |")
    return "\n".join(lines)


def score_table(entries: Sequence[Mapping[str, Any]]) -> str:
    """Scores, a row per entry."""
    heads = ("rank", "explorer", "reconstructor", f"{IOU_AREA.short} (95 %)", *(f.short for f in COLUMNS), "P(better)")
    lines = [f"| {' | '.join(heads)} |", "|" + len(heads) * "---|"]
    for entry in entries:
        values = means(entry["aggregate"])
        cells = (
            str(entry["rank"] or MISSING),
            f"`{entry['explorer']}`",
            f"`{entry['reconstructor']}`",
            _with_interval(entry["aggregate"], IOU_AREA),
            *(figure.text(values) for figure in COLUMNS),
            number(entry["improvement"], 2),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _with_interval(groups: Mapping[str, Any], figure: Figure) -> str:
    return f"{figure.text(means(groups))} ({interval(groups[figure.group][figure.metric])})"


def texts_of(kept: Mapping[str, Any]) -> dict[Path, dict[str, str]]:
    """Page -> section -> text."""
    short = [entry for entry in kept["entries"] if entry["reconstructor"] in README_RECONSTRUCTORS]
    return {
        PAGE: {"exploration": exploration_table(kept), "scores": score_table(kept["entries"])},
        README: {"results": score_table(short)},
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
