"""``tslam-bench score`` and ``tslam-bench leaderboard``."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import tyro
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from tslam_bench.cli.progress import Progress
from tslam_bench.constants import QUICK_OBJECTS
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import atomic_file, ensure_writable_directory, write_json
from tslam_bench.objects.store import asset_sha256
from tslam_bench.scoring.aggregate import Estimate
from tslam_bench.scoring.scoring import ObjectScore, SubmissionScore, score_submission, worker_pool
from tslam_bench.scoring.submission import INFO_FILE, RECONSTRUCTED_POSES, Submission, read_submission

from .page import build_page
from .pictures import TOUCHED_AS_THEY_ARE, Picture, make_pictures, touched_picture
from .ranking import rank

PAGE_FILE: Final = "index.html"
DATA_FILE: Final = "leaderboard.json"
PICTURE_FOLDER: Final = ".pictures"
_SHAPE_HEADS: Final = ("CD-L2\nx1e-2", "CD-L1", "NC", "F 1%", "F 2%", "surf.\nIoU")


@dataclass(frozen=True)
class ScoreArguments:
    """Scores submissions against the prepared test objects: a table, and JSON on request."""

    submissions: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders or zip archives that hold submission.json."""
    output: Path | None = None
    """JSON file for the scores; with several submissions, a folder that gets one file each, as soon as it is scored."""
    objects: tuple[str, ...] = ()
    """Objects to score; empty: those of the submission's object set."""
    workers: int = 1
    """Processes."""
    json: bool = False
    """Print JSON instead of a table."""


@dataclass(frozen=True)
class LeaderboardArguments:
    """Ranks submissions and builds one static page: index.html and leaderboard.json.

    Submissions without a score file of the same content are scored first.
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Submissions, score files, or folders that hold them (also in their subfolders submissions/ and scores/)."""
    output: Path = Path("leaderboard_page")
    """Folder for the page."""
    scores: Path | None = None
    """Folder of score files; their submissions are looked for in the folder submissions/ beside it."""
    pictured: int = 12
    """Objects in the gallery, the quick ones first; 0 leaves the gallery out."""
    workers: int = 1
    """Processes that score and draw."""
    json: bool = False
    """Print the ranking as JSON."""


def score_main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench score``.

    Raises:
        BenchmarkError: bad input; the message is one line.
    """
    parsed = tyro.cli(ScoreArguments, args=list(arguments), prog="tslam-bench score")
    if not parsed.submissions:
        raise InvalidInputError("score: name at least one submission, a folder or a zip archive")
    _check_workers(parsed.workers)
    files = _score_files(parsed.submissions, parsed.output)
    scores = []
    with worker_pool(parsed.workers) as pool:
        for path, file in zip(parsed.submissions, files, strict=True):
            with Progress(f"score {path.name}", "object", leave=False) as bar:
                scores.append(score_submission(path, parsed.objects or None, pool, bar.show))
            if file is not None:
                write_json(file, scores[-1].to_json())
    if parsed.json:
        values = [score.to_json() for score in scores]
        print(json.dumps(values[0] if len(values) == 1 else values, indent=2, sort_keys=True))
        return
    console = Console()
    if not console.is_terminal:
        console = Console(width=170)  # a file or a pipe has no width
    console.print(summary_table(scores))
    for score in scores:
        if len(scores) == 1:
            console.print(object_table(score))
        for note in score.notes:
            console.print(f"[yellow]note[/] {score.info.method}: {note}", highlight=False)


def page_main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench leaderboard``.

    Raises:
        BenchmarkError: bad input; the message is one line.
    """
    parsed = tyro.cli(LeaderboardArguments, args=list(arguments), prog="tslam-bench leaderboard")
    _check_workers(parsed.workers)
    paths = [*parsed.paths, *([parsed.scores] if parsed.scores else [])]
    if not paths:
        raise InvalidInputError("leaderboard: name submissions, score files or a folder that holds them")
    score_files, submission_paths = find_inputs(paths)
    if not score_files and not submission_paths:
        raise InvalidInputError(f"{paths[0]}: holds neither submissions nor score files; run tslam-bench score first")
    scores = [_read_score(path) for path in score_files]
    submissions: dict[str, tuple[Path, Submission]] = {}
    for path in submission_paths:
        submission = read_submission(path)
        submissions.setdefault(submission.content_hash, (path, submission))
    ensure_writable_directory(parsed.output)  # before hours of scoring, not after
    scores = _score_missing(scores, submissions, parsed.workers)
    leaderboard = rank(scores)

    pictures = plan_pictures(leaderboard, submissions, parsed.pictured)
    with Progress("pictures", "picture", leave=False) as bar:
        drawn = make_pictures(
            list(dict.fromkeys(pictures.values())), parsed.output / PICTURE_FOLDER, parsed.workers, bar.show
        )
    images = {key: drawn[picture] for key, picture in pictures.items() if picture in drawn}
    html = build_page(leaderboard, images)
    write_json(parsed.output / DATA_FILE, leaderboard)
    with atomic_file(parsed.output / PAGE_FILE) as temporary:
        temporary.write_text(html, encoding="utf-8")
    if parsed.json:
        print(json.dumps(leaderboard, indent=2, sort_keys=True))
        return
    entries = sum(len(table["entries"]) for table in leaderboard["tables"])
    print(f"{parsed.output / PAGE_FILE}: {entries} entries, {len(html.encode()) / 2**20:.1f} MiB")


def find_inputs(paths: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Score files and submissions that ``paths`` name or hold, each once, in the order found.

    Raises:
        InvalidInputError: a path does not exist.
    """
    scores: dict[Path, None] = {}
    submissions: dict[Path, None] = {}
    for path in paths:
        if not path.exists():
            raise InvalidInputError(f"{path}: no such file or folder; check the path")
        if path.is_file():
            (scores if path.suffix == ".json" else submissions)[path] = None
        elif (path / INFO_FILE).is_file():
            submissions[path] = None
        else:
            beside = [path.parent / "submissions"] if path.name == "scores" else []
            for folder in (path, path / "scores", path / "submissions", *beside):
                for entry in sorted(folder.iterdir()) if folder.is_dir() else ():
                    if (entry / INFO_FILE).is_file() or (entry.suffix == ".zip" and zipfile.is_zipfile(entry)):
                        submissions[entry] = None
                    elif entry.suffix == ".json" and _is_score_file(entry):
                        scores[entry] = None
    return list(scores), list(submissions)


def plan_pictures(
    leaderboard: dict[str, Any], submissions: dict[str, tuple[Path, Submission]], objects: int
) -> dict[tuple[str, str, str], Picture]:
    """The pictures of a page: (kind, content hash, object) -> picture, of submissions whose files are at hand.

    Args:
        objects: how many objects to show, the quick ones first.
    """
    pictures: dict[tuple[str, str, str], Picture] = {}
    for table in leaderboard["tables"]:
        names = sorted(table["objects"], key=lambda name: (name not in QUICK_OBJECTS, name))[:objects]
        for entry in table["entries"]:
            key = entry["content_hash"]
            if key not in submissions:
                continue
            path, submission = submissions[key]
            seed = submission.info.seeds[0]
            for name in names:
                pictures["truth", "", name] = Picture("truth", name)
                touched = touched_picture(path, submission, name, seed)
                if touched:
                    pictures["touched", key, name] = touched
                if submission.info.reconstructor != TOUCHED_AS_THEY_ARE:
                    pictures["reconstruction", key, name] = Picture("reconstruction", name, path, key, seed)
    return pictures


def summary_table(scores: Sequence[SubmissionScore]) -> Table:
    """One row per submission."""
    table = Table(
        title="Scores: IoU area is the mean of the IoU after 1, 2, 4 and 8 poses; all that names no number is after 8",
        title_justify="left",
        box=SIMPLE,
        padding=(0, 1, 0, 0),
    )
    table.add_column("method", no_wrap=True)
    names = ("IoU\narea", "95 %", *(f"IoU {count}" for count in RECONSTRUCTED_POSES), "ECE", *_SHAPE_HEADS)
    for name in (*names, "recall", "explor.\narea"):
        table.add_column(name, justify="right", no_wrap=name != "95 %")
    for score in scores:
        at_8, areas = score.aggregate["8"], score.aggregate["areas"]
        area = areas["iou_area"]
        table.add_row(
            score.info.method + (" (privileged)" if score.info.privileged else ""),
            _mean(area),
            f"{area.low:.2f}-{area.high:.2f}",
            *(_mean(score.aggregate[str(count)]["iou"]) for count in RECONSTRUCTED_POSES),
            _mean(at_8.get("calibration_error")),
            _mean(at_8["chamfer_l2"], 4, 100),
            *(_mean(at_8.get(name)) for name in ("chamfer_l1", "normal_consistency", "f_score_1", "f_score_2")),
            *(_mean(at_8.get(name)) for name in ("surface_iou", "touched_surface_recall")),
            _mean(areas.get("exploration_area")),
        )
    return table


def object_table(score: SubmissionScore) -> Table:
    """One row per object and seed of one submission."""
    title = f"{score.info.method}, per object; all that names no number is after 8 poses"
    table = Table(title=title, title_justify="left", box=SIMPLE, padding=(0, 1, 0, 0))
    names = ("object", "seed", "IoU\narea", *(f"IoU {count}" for count in RECONSTRUCTED_POSES), "ECE", *_SHAPE_HEADS)
    for name in (*names, "recall", "explor.\narea", "remark"):
        table.add_column(name, justify="left" if name in ("object", "remark") else "right")
    for result in score.results:
        values = result.poses["8"]
        table.add_row(
            result.object,
            str(result.seed),
            _number(result.areas["iou_area"]),
            *(_number(result.poses[str(count)]["iou"]) for count in RECONSTRUCTED_POSES),
            _number(values["calibration_error"]),
            _number(values["chamfer_l2"], 4, 100),
            *(_number(values[name]) for name in ("chamfer_l1", "normal_consistency", "f_score_1", "f_score_2")),
            *(_number(values[name]) for name in ("surface_iou", "touched_surface_recall")),
            _number(result.areas["exploration_area"]),
            _remark(result),
        )
    return table


def _remark(result: ObjectScore) -> str:
    """Why reconstructions count as empty: "8: missing"."""
    return "; ".join(f"{count}: {reason}" for count, reason in result.reasons.items() if reason is not None)


def _score_missing(
    scores: list[SubmissionScore], submissions: dict[str, tuple[Path, Submission]], workers: int
) -> list[SubmissionScore]:
    """Adds scores of submissions that have none; a score of other assets or of another version does not count."""
    current = [score for score in scores if score.content_hash not in submissions or _is_current(score)]
    scored = {score.content_hash for score in current}
    missing = [path for key, (path, _) in submissions.items() if key not in scored]
    with worker_pool(workers if missing else 1) as pool:
        for path in missing:
            with Progress(f"score {path.name}", "object", leave=False) as bar:
                current.append(score_submission(path, None, pool, bar.show))
    return current


def _is_current(score: SubmissionScore) -> bool:
    try:
        return score.asset_sha256 == asset_sha256(score.objects)
    except AssetError:
        return True  # the objects are not here: the score is the best there is


def _is_score_file(path: Path) -> bool:
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(value, dict) and "score_version" in value


def _read_score(path: Path) -> SubmissionScore:
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"{path}: not a score file ({error}); score the submission again") from error
    return SubmissionScore.from_json(value, str(path))


def _score_files(paths: Sequence[Path], output: Path | None) -> list[Path | None]:
    """Where the score of each submission goes, or None; known before hours of scoring, not after."""
    if output is None:
        return [None] * len(paths)
    if len(paths) == 1:
        return [output / f"{paths[0].stem}.json" if output.is_dir() else output]
    names = [path.stem for path in paths]
    if len(set(names)) != len(names):
        raise InvalidInputError("score: two submissions have the same name; write them to different folders")
    return [output / f"{name}.json" for name in names]


def _check_workers(workers: int) -> None:
    if workers < 1:
        raise InvalidInputError(f"--workers {workers}: give at least 1")


def _mean(estimate: Estimate | None, digits: int = 3, factor: float = 1.0) -> str:
    return _number(None if estimate is None else estimate.mean, digits, factor)


def _number(value: float | None, digits: int = 3, factor: float = 1.0) -> str:
    return "-" if value is None else f"{factor * value:.{digits}f}"
