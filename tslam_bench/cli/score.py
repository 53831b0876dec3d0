"""``tslam-bench score``: scores of submissions as tables and JSON."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from tslam_bench.cli.batch import Batch
from tslam_bench.cli.progress import Progress
from tslam_bench.cli.terminal import cell
from tslam_bench.errors import BenchmarkError, InvalidInputError
from tslam_bench.files import check_output
from tslam_bench.scoring.figures import FIGURES, IOU_AREA, interval, means
from tslam_bench.scoring.score_file import ObjectScore, SubmissionScore
from tslam_bench.scoring.scoring import score_submission, worker_pool
from tslam_bench.scoring.submission import Submission, read_submission
from tslam_bench.scoring.untrusted_scores import is_score_file, sealed_json, write_score
from tslam_bench.scoring.verification import VerificationRecord


@dataclass(frozen=True)
class ScoreArguments:
    """Scores submissions against the prepared test objects: a table, and JSON on request."""

    submissions: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders or zip archives that hold submission.json."""
    output: Path | None = None
    """JSON file for the scores; with several submissions, a folder that gets one file each, as soon as it is scored."""
    objects: tuple[str, ...] = ()
    """Objects to score; empty: those of the submission's object set."""
    split: str = "test"
    """Split that the submissions are of: test, or an organiser's own (tslam-bench assets hide)."""
    verification: tuple[Path, ...] = ()
    """Records of tslam-bench verify, one for each submission that has one; default: SUBMISSION.verification.json beside it."""
    workers: int = 1
    """Processes."""
    json: bool = False
    """Print JSON instead of a table."""


def score_main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench score``.

    Raises:
        BenchmarkError: bad input; the message is one line.
    """
    parsed = tyro.cli(ScoreArguments, args=list(arguments), prog="tslam-bench score")
    if not parsed.submissions:
        raise InvalidInputError("score: name at least one submission, a folder or a zip archive")
    check_workers(parsed.workers)
    files = _score_files(parsed.submissions, parsed.output)
    batch = Batch("tslam-bench score", len(parsed.submissions))
    submissions: dict[Path, Submission] = {}
    for path in parsed.submissions:  # all of them first: what is refused is known before hours of scoring, not after
        with batch.item(str(path)):
            submissions[path] = read_submission(path, split=parsed.split)
    records = _records(parsed.verification, submissions.values())
    scores: list[SubmissionScore] = []
    unwritten: list[BenchmarkError] = []
    with worker_pool(parsed.workers) as pool:
        for path, file in zip(parsed.submissions, files, strict=True):
            if path not in submissions:
                continue
            with batch.item(str(path)), Progress(f"score {path.name}", "object", leave=False) as bar:
                submission = submissions[path]
                record = records.get(submission.content_hash)
                scores.append(score_submission(submission, parsed.objects or None, pool, bar.show, record=record))
                if file is not None:
                    try:
                        write_score(file, scores[-1])
                    except BenchmarkError as error:  # a full disk, say: the figures are there to be seen all the same
                        unwritten.append(error)
    if scores:
        _print_scores(scores, parsed.json, len(parsed.submissions))
    batch.finish("the others are scored" if scores else "none is scored")
    if unwritten:
        raise unwritten[0]


def _print_scores(scores: Sequence[SubmissionScore], as_json: bool, asked: int) -> None:
    if as_json:
        values = [sealed_json(score) for score in scores]
        print(json.dumps(values[0] if asked == 1 else values, indent=2, sort_keys=True))
        return
    console = Console()
    if not console.is_terminal:
        console = Console(width=170)  # a file or a pipe has no width
    console.print(summary_table(scores))
    for score in scores:
        if len(scores) == 1:
            console.print(object_table(score))
        for note in score.notes:
            console.print(cell("note", "yellow"), cell(f"{score.info.method}: {note}"))


def _records(files: Sequence[Path], submissions: Collection[Submission]) -> dict[str, VerificationRecord]:
    """The records by content hash; each is of one of the submissions.

    Raises:
        InvalidInputError: a record is not to be trusted, or is of other files.
    """
    hashes = {submission.content_hash for submission in submissions}
    records = {}
    for file in files:
        record = VerificationRecord.read(file)
        if record.content_hash not in hashes:
            raise InvalidInputError(f"{file}: made for other files than the given submissions; run verify again")
        records[record.content_hash] = record
    return records


def summary_table(scores: Sequence[SubmissionScore]) -> Table:
    """One row per submission."""
    table = _table(
        "Scores: IoU area is the mean of the IoU after 1, 2, 4 and 8 poses; all that names no number is after 8"
    )
    table.add_column("method", no_wrap=True)
    _add_columns(table, IOU_AREA.short, "95 %", *(figure.short for figure in FIGURES))
    for score in scores:
        aggregate: dict[str, Any] = score.to_json()["aggregate"]
        values = means(aggregate)
        table.add_row(
            cell(score.info.method + (" (privileged)" if score.info.privileged else "")),
            IOU_AREA.text(values),
            interval(aggregate["areas"]["iou_area"]),
            *(figure.text(values) for figure in FIGURES),
        )
    return table


def object_table(score: SubmissionScore) -> Table:
    """One row per object and seed of one submission."""
    table = _table(f"{score.info.method}, per object; all that names no number is after 8 poses")
    table.add_column("object")
    _add_columns(table, "seed", IOU_AREA.short, *(figure.short for figure in FIGURES))
    table.add_column("remark")
    for result in score.results:
        values = {**result.poses, "areas": result.areas}
        table.add_row(
            result.object,
            str(result.seed),
            IOU_AREA.text(values),
            *(figure.text(values) for figure in FIGURES),
            cell(_remark(result)),
        )
    return table


def _table(title: str) -> Table:
    return Table(title=cell(title, "italic"), title_justify="left", box=SIMPLE, padding=(0, 1, 0, 0))


def _add_columns(table: Table, *names: str) -> None:
    """Columns of figures; a long head takes two lines."""
    for name in names:
        table.add_column(name if len(name) < 6 else name.replace(" ", "\n"), justify="right", no_wrap=name != "95 %")


def _remark(result: ObjectScore) -> str:
    """Why reconstructions count as empty: "8: missing"."""
    return "; ".join(f"{count}: {reason}" for count, reason in result.reasons.items() if reason is not None)


def _score_files(paths: Sequence[Path], output: Path | None) -> list[Path | None]:
    """Where the score of each submission goes, or None; known, and looked at, before hours of scoring, not after.

    Raises:
        InvalidInputError: two go to one file, or one would destroy something that is no score file.
    """
    if output is None:
        return [None] * len(paths)
    files = [output / f"{_name(path)}.json" for path in paths]
    if len(paths) == 1 and not output.is_dir():
        files = [output]
    for file in files:
        check_output(file, paths)
        if file.exists() and not is_score_file(file):
            raise InvalidInputError(f"{file}: is no score file and stays; name another file")
        if files.count(file) > 1:
            raise InvalidInputError(f"{file}: two submissions have the same name; score one after the other")
    return [*files]


def _name(submission: Path) -> str:
    """A submission's name without the ending of an archive; that of a folder may hold dots."""
    name = submission.name if submission.name not in ("", "..") else submission.resolve().name
    return name[:-4] if name.lower().endswith(".zip") else name


def check_workers(workers: int) -> None:
    """Raises InvalidInputError for a number of processes below 1."""
    if workers < 1:
        raise InvalidInputError(f"--workers {workers}: give at least 1")
