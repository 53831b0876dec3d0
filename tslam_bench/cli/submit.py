"""``tslam-bench submit``: the check that a maintainer runs on a submission, for whoever is about to send one."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from tslam_bench.cli.commands import run_command
from tslam_bench.cli.progress import Stages
from tslam_bench.cli.score import object_table, summary_table
from tslam_bench.cli.terminal import cell
from tslam_bench.errors import InvalidInputError
from tslam_bench.files import atomic_file, check_output


@dataclass(frozen=True)
class Check:
    """Replay and score a submission as a maintainer does with a pull request, and print what a maintainer would see.

    Exit status 0 if it can be taken, 1 if something is wrong with it, 2 if it is refused or does more than add one file.
    """

    submission: Annotated[Path, tyro.conf.Positional]
    """Folder or zip archive."""
    minutes: float = 10.0
    """Stop after so long; the same command goes on."""
    processes: int = 2
    """Processes that replay and score."""
    segments: bool = False
    """Replay in segments, within tolerances: for rollouts of another kind of processor."""
    split: str = "test"
    """Split that it is of."""
    against: str | None = None
    """Git revision that the pull request goes into: it has to add this file and change nothing else."""
    report: Path | None = None
    """Also write the report as Markdown."""


def main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench submit``. Raises BenchmarkError for bad input."""
    about = "What to do with a submission before it is sent."
    run_command("tslam-bench submit", about, {"check": (Check, _check)}, arguments)


def _check(command: Check) -> None:
    from tslam_bench.evaluation.submit_check import check

    if command.processes < 1 or not command.minutes > 0:
        raise InvalidInputError("--processes, --minutes: have to be above 0")
    if command.report is not None:
        check_output(command.report, [command.submission])
    with Stages(f"check {command.submission.name}") as show:
        report = check(
            command.submission,
            command.split,
            command.minutes,
            command.processes,
            command.against,
            command.segments,
            show,
        )
    console = Console()
    if not console.is_terminal:
        console = Console(width=170)
    if report.score is not None:
        console.print(summary_table([report.score]))
        console.print(object_table(report.score))
        console.print(cell(f"tier: {report.score.tier}"))
    for style, kind, lines in (("yellow", "remark", report.remarks), ("red", "problem", report.problems)):
        for line in lines:
            console.print(cell(kind, style), cell(line))
    verdict = "cannot be taken as it is" if report.problems else "can be taken"
    console.print(cell(f"{report.name}: {verdict}; checked in {report.seconds:.0f} s"))
    if command.report is not None:
        with atomic_file(command.report) as temporary:
            temporary.write_text(report.markdown(), encoding="utf-8")
    if report.problems:
        sys.exit(1)
