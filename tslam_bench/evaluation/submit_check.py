"""What a maintainer does with a pull request that adds a submission: one file, read, replayed and scored."""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.policies import list_baselines
from tslam_bench.evaluation.verify import verify
from tslam_bench.scoring.figures import FIGURES, IOU_AREA, interval, means
from tslam_bench.scoring.score_file import SubmissionScore
from tslam_bench.scoring.scoring import score_submission, worker_pool
from tslam_bench.scoring.submission import Submission, read_submission
from tslam_bench.scoring.verification import Tolerances, VerificationRecord
from tslam_bench.text import visible

FOLDER: Final = "leaderboard/submissions"
"""Where a pull request puts its file."""
LARGEST: Final = 95 * 10**6
"""Bytes of an archive that GitHub takes."""
_NAME: Final = re.compile(rf"{FOLDER}/[a-z0-9][a-z0-9_.-]{{0,63}}\.zip")
Progress = Callable[[str, int, int], None]


class _Late(Exception):
    """The time is up."""


@dataclass(frozen=True)
class Report:
    """What a check found.

    Attributes:
        name: of the file or folder.
        problems: why it cannot be taken as it is, a line each.
        remarks: what a maintainer should know.
        record: of the replay, as far as it came.
        score: None if the time was up before.
        seconds: the check took.
    """

    name: str
    problems: tuple[str, ...]
    remarks: tuple[str, ...]
    record: VerificationRecord | None
    score: SubmissionScore | None
    seconds: float

    def markdown(self) -> str:
        """The report as a page: all texts of strangers are shown letter by letter."""
        verdict = "cannot be taken as it is" if self.problems else "can be taken"
        lines = [f"## {_plain(self.name)}: {verdict}", ""]
        if self.score is not None:
            info, values = self.score.info, means(self.score.to_json()["aggregate"])
            heads = ["method", "authors", "set", "seeds", "tier", IOU_AREA.short, "95 %", *(f.short for f in FIGURES)]
            cells = [
                _plain(info.method),
                _plain(", ".join(info.authors)),
                _plain(info.object_set),
                str(len(info.seeds)),
                self.score.tier,
                IOU_AREA.text(values),
                interval(self.score.to_json()["aggregate"]["areas"]["iou_area"]),
                *(figure.text(values) for figure in FIGURES),
            ]
            lines += [f"| {' | '.join(row)} |" for row in (heads, ["---"] * len(heads), cells)] + [""]
        for title, texts in (("Problems", self.problems), ("Remarks", self.remarks)):
            if texts:
                lines += [f"### {title}", "", *(f"* {_plain(text)}" for text in texts), ""]
        return "\n".join([*lines, f"Checked in {self.seconds:.0f} s.", ""])


def check(
    path: Path,
    split: str = "test",
    minutes: float = 10.0,
    processes: int = 2,
    against: str | None = None,
    segments: bool = False,
    on_progress: Progress | None = None,
) -> Report:
    """Reads, replays and scores a submission, all of it within ``minutes``.

    Args:
        path: folder or zip archive.
        split: of its objects.
        minutes: after which it stops, between two objects.
        processes: that replay and score.
        against: git revision that a pull request is to be merged into: then it has to add this file and nothing else.
        segments: replay in segments, within tolerances: for rollouts of another kind of processor.
        on_progress: called with (stage, done, all).

    Raises:
        InvalidInputError: the submission is refused, or the pull request does more than add it.
        AssetError: an object is not prepared.
    """
    began, report = time.monotonic(), on_progress or (lambda stage, done, total: None)
    if against is not None:
        check_one_file(path, against)
    deadline = began + 60 * minutes

    def show(stage: str) -> Callable[[int, int], None]:
        def shown(done: int, total: int) -> None:
            report(stage, done, total)
            if done < total and time.monotonic() > deadline:
                raise _Late(f"{stage}: {done} of {total} done after {minutes:g} minutes")

        return shown

    submission = read_submission(path, split=split)
    record, score, late = None, None, None
    try:
        record = verify(path, None, Tolerances() if segments else None, processes, show("replay"), split)
        with worker_pool(processes) as pool:
            score = score_submission(submission, None, pool, show("score"), record=record)
    except _Late as error:
        late = f"{error}; the same command goes on with the replay"
    problems = [*_size(path), *([late] if late else [])]
    problems += [str(verdict) for verdict in record.departed[:20]] if record else []
    if record is not None and len(record.departed) > 20:
        problems.append(f"and {len(record.departed) - 20} more episodes do not reproduce")
    if score is not None:
        lacking = sum(len(result.missing) for result in score.results)
        if lacking:
            problems.append(f"{lacking} rollouts or reconstructions are missing; they count as empty")
    if record is not None and record.departed and not segments:
        problems.append("made on another kind of processor? then --segments tells")
    remarks = [*_names(submission), *(score.notes if score is not None else ())]
    return Report(path.name, tuple(problems), tuple(remarks), record, score, time.monotonic() - began)


def check_one_file(path: Path, against: str) -> None:
    """Raises InvalidInputError unless HEAD, seen from where it left ``against``, adds ``path`` and changes nothing else.

    The file has to lie in ``leaderboard/submissions/``, as a zip archive with a plain name.
    """
    if against.startswith("-"):
        raise InvalidInputError(f"--against {against}: not a revision")
    folder = path.absolute().parent
    root = Path(_git(folder, "rev-parse", "--show-toplevel").strip())
    listed = _git(root, "diff", "--raw", "--no-renames", "-z", f"{against}...HEAD").split("\0")
    changes = [(listed[i].split(), listed[i + 1]) for i in range(0, len(listed) - 1, 2)]
    named = path.absolute().relative_to(root).as_posix() if path.absolute().is_relative_to(root) else str(path)
    for (_, mode, _, _, status), name in changes:
        if name != named:
            raise InvalidInputError(
                f"{visible(name)[:200]}: a pull request with a submission adds one file and changes nothing else"
            )
        if status != "A" or mode != "100644":
            raise InvalidInputError(
                f"{visible(name)[:200]}: has to be a new, plain file; entries are not changed afterwards"
            )
    if not changes:
        raise InvalidInputError(f"{path}: is not added between {against} and HEAD; commit it")
    if not _NAME.fullmatch(named):
        raise InvalidInputError(f"{visible(named)[:200]}: put it at {FOLDER}/NAME.zip, NAME of a-z, 0-9, '_', '.', '-'")


def _git(folder: Path, *words: str) -> str:
    try:
        done = subprocess.run(["git", "-C", str(folder), *words], capture_output=True, check=False)
    except OSError as error:
        raise InvalidInputError(f"git: cannot be run ({error.strerror}); --against needs it") from error
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip().splitlines()
        raise InvalidInputError(f"git {words[0]}: {visible(said[-1])[:200] if said else 'failed'}")
    return done.stdout.decode(errors="surrogateescape")


def _size(path: Path) -> list[str]:
    if path.is_dir():
        size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
        return [f"{size / 1e6:.0f} MB, more than GitHub takes as one file"] if size > LARGEST else []
    size = path.stat().st_size
    return [f"the archive has {size / 1e6:.0f} MB, GitHub takes {LARGEST / 1e6:.0f}"] if size > LARGEST else []


def _names(submission: Submission) -> list[str]:
    explorer = submission.info.explorer
    if explorer in {spec.id for spec in list_baselines() if spec.kind != "own"}:
        return [
            f"explorer {explorer!r} is the id of a registered baseline: shown as claimed unless its code is attested"
        ]
    return []


def _plain(text: str) -> str:
    """Markdown that shows a stranger's text as it is: no links, no mentions, no markup."""
    return "".join(c if c.isalnum() or c in " .,:;()-/'+%" else f"&#{ord(c)};" for c in visible(text))
