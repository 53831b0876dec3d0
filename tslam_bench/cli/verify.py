"""``tslam-bench verify``: replays a submission's rollouts and writes a record that scoring uses."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from tslam_bench.cli.commands import parse
from tslam_bench.cli.progress import Progress
from tslam_bench.errors import InvalidInputError
from tslam_bench.scoring.verification import Tolerances, record_path


@dataclass(frozen=True)
class Verify:
    """Replays every rollout of a submission on the CPU and writes a record that tslam-bench score uses.

    Exit status 0 if every episode reproduces, 1 if one departs; each that departs is named with its step. A record of the same
    files is gone on with: delete it to begin again.
    """

    submission: Annotated[Path, tyro.conf.Positional]
    """Folder or zip archive that holds submission.json."""
    output: Path | None = None
    """The record; default: SUBMISSION.verification.json, beside the submission, where score finds it."""
    processes: int = 1
    """Processes that replay. The verdicts do not depend on it."""
    segments: bool = False
    """Replay each ten steps from their joint checkpoint, within tolerances: for rollouts of another kind of processor."""
    tolerances: Tolerances = field(default_factory=Tolerances)
    """What segments may be off by."""
    json: bool = False
    """Print the verdicts as JSON."""


def main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench verify`` with the given arguments. Raises BenchmarkError for bad input."""
    parsed: Verify = parse("tslam-bench verify", Verify, arguments)
    if parsed.processes < 1:
        raise InvalidInputError(f"--processes {parsed.processes}: give at least 1")
    from tslam_bench.evaluation.verify import verify

    with Progress(f"verify {parsed.submission.name}", "episode", leave=False) as bar:
        tolerances = parsed.tolerances if parsed.segments else None
        record = verify(parsed.submission, parsed.output, tolerances, parsed.processes, bar.show)
    if parsed.json:
        verdicts = [{k: v for k, v in asdict(verdict).items() if k != "touched"} for verdict in record.verdicts]
        print(json.dumps({"content_hash": record.content_hash, "mode": record.mode, "episodes": verdicts}, indent=2))
    else:
        for verdict in record.departed:
            print(verdict)
        file, all_of_them = parsed.output or record_path(parsed.submission), len(record.verdicts)
        print(f"{file}: {all_of_them - len(record.departed)} of {all_of_them} episodes reproduce")
    if record.departed:
        sys.exit(1)
