"""Writes docs/leaderboard/, docs/results.md and the README's table from leaderboard/results/ and baselines/weights/.

bash baselines/run_all.sh --full                           # the run itself
python docs/build_results.py --run runs/full               # keep its score files and pictures; write the pages
python docs/build_results.py [--check]                     # write (or compare) the pages from what is kept

A kept score file is a score file with figures of six significant digits. The tables are those of the test set; until score
files of it are kept, they come from leaderboard/results/scripted.json, a summary of an earlier run.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import tyro
from sections import filled, write_or_check

from tslam_bench.cli.ending import one_line_errors
from tslam_bench.errors import InvalidInputError
from tslam_bench.files import atomic_file
from tslam_bench.leaderboard.commands import find_inputs, page_texts, plan_pictures
from tslam_bench.leaderboard.pictures import make_pictures
from tslam_bench.leaderboard.ranking import rank
from tslam_bench.leaderboard.shown import PICTURES, Key, read_pictures, write_pictures
from tslam_bench.leaderboard.training import find_records, read_records
from tslam_bench.scoring.figures import (
    EXPLORATION_AREA,
    FIGURES,
    IOU_AREA,
    MISSING,
    Figure,
    interval,
    means,
    number,
    rounded,
)
from tslam_bench.scoring.score_file import SubmissionScore
from tslam_bench.scoring.submission import RECONSTRUCTED_POSES, read_submission
from tslam_bench.scoring.untrusted_scores import parse_score, read_score

ROOT: Final = Path(__file__).parent.parent
RESULTS: Final = ROOT / "leaderboard" / "results"
SUMMARY: Final = RESULTS / "scripted.json"
WEIGHTS: Final = ROOT / "baselines" / "weights"
"""Shipped weights; their records hold training curves."""
SITE: Final = ROOT / "docs" / "leaderboard"
PAGE: Final = ROOT / "docs" / "results.md"
README: Final = ROOT / "README.md"
README_RECONSTRUCTORS: Final = ("ifnet", "carve")
DIGITS: Final = 6
"""Significant digits of a kept figure."""
COUNTS: Final = tuple(str(count) for count in RECONSTRUCTED_POSES)
COLUMNS: Final = tuple(
    figure for figure in FIGURES if figure.metric in ("iou", "calibration_error", "chamfer_l2", "normal_consistency")
)


@dataclass(frozen=True)
class Config:
    """Writes the pages of results."""

    run: Path | None = None
    """Folder of a finished run that is to be kept; entries of the same name and set of objects are replaced."""
    pictured: int = 12
    """Objects of the run in the page's gallery."""
    workers: int = 1
    """Processes that draw them."""
    check: bool = False
    """Only compare; exit with status 1 if a page is out of date."""


def kept_scores() -> list[SubmissionScore]:
    """The score files in leaderboard/results/, which whoever changes them here vouches for."""
    return [read_score(path, vouched=True) for path in sorted((RESULTS / "scores").glob("*.json"))]


def kept_board() -> dict[str, Any]:
    """The ranking of what is kept."""
    return rank(kept_scores(), read_records(find_records([WEIGHTS])))


def keep(config: Config, run: Path) -> None:
    """Copies a run's score files and pictures to where the pages are built from.

    Raises:
        InvalidInputError: it holds no score files, or one that was not made here.
    """
    score_files, submission_paths = find_inputs([run])
    if not score_files:
        raise InvalidInputError(f"{run}: holds no score files; let the run finish first")
    for path in score_files:
        score = read_score(path)
        if not score.made_here:
            raise InvalidInputError(f"{path}: was not made on this machine; score its submission here")
        text = json.dumps(_rounded(score).to_json(), sort_keys=True, allow_nan=False, separators=(",", ":")) + "\n"
        with atomic_file(RESULTS / "scores" / f"{score.info.object_set}-{path.name}") as temporary:
            temporary.write_text(text, encoding="utf-8")
        if score.info.object_set == "test":
            SUMMARY.unlink(missing_ok=True)
    board = kept_board()
    submissions = {submission.content_hash: submission for submission in map(read_submission, submission_paths)}
    planned = plan_pictures(board, submissions, config.pictured)
    drawn = make_pictures(list(dict.fromkeys(planned.values())), run / ".pictures", config.workers)
    images = _pictures_of(board) | {key: drawn[picture] for key, picture in planned.items() if picture in drawn}
    write_pictures(images, SITE / PICTURES)


def _pictures_of(board: Mapping[str, Any]) -> dict[Key, bytes]:
    """The pictures that the page has, of entries and objects that are still there."""
    objects = {("", name) for table in board["tables"] for name in table["objects"]}
    objects |= {
        (e["content_hash"], name) for table in board["tables"] for e in table["entries"] for name in table["objects"]
    }
    shown = read_pictures(SITE / PICTURES)
    return {key: (SITE / picture.address).read_bytes() for key, picture in shown.items() if key[1:] in objects}


def _rounded(score: SubmissionScore) -> SubmissionScore:
    """The same score, its figures rounded, and what follows from others computed again from those."""
    again = parse_score(rounded(score.to_json(), DIGITS), score.content_hash)
    return replace(score, results=again.results, aggregate=again.aggregate)


# --- Tables of the documents -------------------------------------------------------------------------------------


def table_entries(board: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Entries of the test set, or of the summary of an earlier run."""
    for table in board["tables"]:
        if table["object_set"] == "test":
            return [{**entry["submission"], **entry} for entry in table["entries"]]
    return json.loads(SUMMARY.read_text(encoding="utf-8"))["entries"] if SUMMARY.is_file() else []


def exploration_table(entries: Sequence[Mapping[str, Any]]) -> str:
    """Touched surface, a row per explorer."""
    lines = [
        f"| explorer | surface touched after {' / '.join(COUNTS)} poses | {EXPLORATION_AREA.short} |",
        "|---|---|---|",
    ]
    seen: dict[str, Mapping[str, Any]] = {}
    for entry in entries:
        if "touched_surface_recall" in entry["aggregate"]["8"]:
            seen.setdefault(entry["explorer"], entry)
    for name, entry in sorted(
        seen.items(), key=lambda item: -item[1]["aggregate"]["areas"]["exploration_area"]["mean"]
    ):
        groups = entry["aggregate"]
        recall = " / ".join(number(groups[count]["touched_surface_recall"]["mean"]) for count in COUNTS)
        lines.append(f"| `{name}` | {recall} | {_with_interval(groups, EXPLORATION_AREA)} |")
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


def texts_of(board: Mapping[str, Any]) -> dict[Path, dict[str, str]]:
    """Page -> section -> text."""
    entries = table_entries(board)
    short = [entry for entry in entries if entry["reconstructor"] in README_RECONSTRUCTORS]
    return {
        PAGE: {"exploration": exploration_table(entries), "scores": score_table(entries)},
        README: {"results": score_table(short)},
    }


def main(config: Config) -> None:
    """Keeps a run, writes or compares pages."""
    with one_line_errors("build_results"):
        if config.run is not None:
            keep(config, config.run)
        board = kept_board()
        pages = {page: filled(page, texts) for page, texts in texts_of(board).items()}
        # Without the viewer: its data hold the true meshes and the hand, which this repository does not contain.
        site = page_texts(board, read_pictures(SITE / PICTURES), links={}) if board["tables"] else {}
        write_or_check(pages | {SITE / name: text for name, text in site.items()}, config.check)


if __name__ == "__main__":
    main(tyro.cli(Config))
