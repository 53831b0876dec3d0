"""``tslam-bench leaderboard``: from submissions and score files to a ranking and its page."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import tyro

from tslam_bench.cli.batch import Batch
from tslam_bench.cli.progress import Progress
from tslam_bench.cli.score import check_workers
from tslam_bench.constants import QUICK_OBJECTS
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import atomic_file, check_output, ensure_writable_directory
from tslam_bench.objects.store import asset_sha256
from tslam_bench.scoring.score_file import SubmissionScore
from tslam_bench.scoring.scoring import score_submission, worker_pool
from tslam_bench.scoring.submission import INFO_FILE, Submission, read_submission
from tslam_bench.scoring.untrusted_scores import is_score_file, read_score
from tslam_bench.scoring.verification import find_record

from .page import build_page
from .pictures import TOUCHED_AS_THEY_ARE, Picture, make_pictures, touched_picture
from .ranking import rank
from .shown import PICTURES, Key, Links, Shown, read_links, write_links, write_pictures
from .training import find_records, read_records

PAGE_FILE: Final = "index.html"
DATA_FILE: Final = "leaderboard.json"
PICTURE_FOLDER: Final = ".pictures"
"""Everything that was drawn for this folder; the page shows what lies in ``PICTURES``."""


@dataclass(frozen=True)
class LeaderboardArguments:
    """Ranks submissions and builds a static page in one folder: index.html, its pictures/ and leaderboard.json.

    Submissions without a score file of the same content are scored first.
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Submissions, score files, or folders that hold them (also in their subfolders submissions/ and scores/). The training
    curves of models in their subfolder models/ are shown too."""
    output: Path = Path("leaderboard_page")
    """Folder for the page."""
    scores: Path | None = None
    """Folder of score files; their submissions are looked for in the folder submissions/ beside it."""
    training: tuple[Path, ...] = ()
    """Folders of trained policies, or folders that hold such: their training curves are shown."""
    trust_scores: bool = False
    """Take the figures of score files that were made elsewhere as they are, even where their submissions are at hand and
    could be scored. They never count as replayed."""
    split: str = "test"
    """Split that the submissions are of; pictures are drawn of the test split."""
    pictured: int = 12
    """Objects in the gallery, the quick ones first; 0 leaves the gallery out."""
    viewer: int = 0
    """Objects that can be turned in 3D and whose episodes can be played, the quick ones first; each takes about a second for
    every entry and every explorer. Their page lies in the subfolder viewer/."""
    workers: int = 1
    """Processes that score and draw."""
    json: bool = False
    """Print the ranking as JSON."""


def page_main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench leaderboard``.

    Raises:
        BenchmarkError: bad input; the message is one line.
    """
    parsed = tyro.cli(LeaderboardArguments, args=list(arguments), prog="tslam-bench leaderboard")
    check_workers(parsed.workers)
    paths = [*parsed.paths, *([parsed.scores] if parsed.scores else [])]
    if not paths:
        raise InvalidInputError("leaderboard: name submissions, score files or a folder that holds them")
    score_files, submission_paths = find_inputs(paths)
    if not score_files and not submission_paths:
        raise InvalidInputError(f"{paths[0]}: holds neither submissions nor score files; run tslam-bench score first")
    batch = Batch("tslam-bench leaderboard", len(score_files) + len(submission_paths))
    scores: list[SubmissionScore] = []
    for path in score_files:
        with batch.item(str(path)):
            scores.append(read_score(path))
    submissions: dict[str, Submission] = {}
    for path in submission_paths:
        with batch.item(str(path)):
            submission = read_submission(path, split=parsed.split)
            submissions.setdefault(submission.content_hash, submission)
    if not scores and not submissions:
        batch.finish("there is nothing to show")
    _check_output(parsed.output)  # before hours of scoring, not after
    scores = _score_missing(scores, submissions, parsed.workers, parsed.trust_scores, batch)
    if not scores:
        batch.finish("there is nothing to show")
    places = [path.parent if path.name == "scores" else path for path in paths if path.is_dir()]
    records: list[Path] = []
    for path in find_records([*parsed.training, *places]):
        with batch.item(str(path)):
            read_records([path])
            records.append(path)
    leaderboard = rank(scores, read_records(records))

    pictures = plan_pictures(leaderboard, submissions, parsed.pictured if parsed.split == "test" else 0)
    with Progress("pictures", "picture", leave=False) as bar:
        drawn = make_pictures(
            list(dict.fromkeys(pictures.values())), parsed.output / PICTURE_FOLDER, parsed.workers, bar.show
        )
    images = {key: drawn[picture] for key, picture in pictures.items() if picture in drawn}
    if parsed.viewer > 0 and submissions and parsed.split == "test":
        from .viewer import write_entries_viewer  # needs libigl, which scoring and pages do without

        turned = {name for table in leaderboard["tables"] for name in first_objects(table, parsed.viewer)}
        with Progress("viewer", "object", leave=False) as bar:
            write_links(write_entries_viewer(parsed.output, submissions, turned, on_progress=bar.show), parsed.output)
    size = write_page(leaderboard, write_pictures(images, parsed.output / PICTURES), parsed.output)
    if parsed.json:
        print(json.dumps(leaderboard, indent=2, sort_keys=True))
    else:
        entries = sum(len(table["entries"]) for table in leaderboard["tables"])
        print(
            f"{parsed.output / PAGE_FILE}: {entries} entries, {size / 2**20:.1f} MiB, {len(images)} pictures beside it"
        )
    batch.finish("the page shows the others")


def page_texts(leaderboard: Mapping[str, Any], pictures: Mapping[Key, Shown], links: Links) -> dict[str, str]:
    """File name -> text: the page and its data."""
    data = json.dumps(leaderboard, sort_keys=True, allow_nan=False, separators=(",", ":"))
    return {PAGE_FILE: build_page(leaderboard, pictures, links), DATA_FILE: data + "\n"}


def write_page(leaderboard: Mapping[str, Any], pictures: Mapping[Key, Shown], folder: Path) -> int:
    """Writes a page, which links to the viewer that lies in ``folder``, and its data, the page last; returns its bytes."""
    texts = page_texts(leaderboard, pictures, read_links(folder))
    for name in (DATA_FILE, PAGE_FILE):
        with atomic_file(folder / name) as temporary:
            temporary.write_text(texts[name], encoding="utf-8")
    return len(texts[PAGE_FILE].encode("utf-8"))


def _check_output(folder: Path) -> None:
    """Raises a BenchmarkError unless a page can be written to ``folder`` without destroying anything but an older page."""
    ensure_writable_directory(folder)
    page, data = folder / PAGE_FILE, folder / DATA_FILE
    if (folder / INFO_FILE).exists():
        raise InvalidInputError(f"--output {folder}: is a submission; choose another folder")
    if page.exists() and not data.exists():
        raise InvalidInputError(f"{page}: is not a leaderboard's page and stays; choose another folder")
    for path in (page, data):
        check_output(path)


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
                    if (entry / INFO_FILE).is_file() or (entry.suffix == ".zip" and entry.is_file()):
                        submissions[entry] = None
                    elif entry.suffix == ".json" and is_score_file(entry):
                        scores[entry] = None
    return list(scores), list(submissions)


def first_objects(table: Mapping[str, Any], count: int) -> list[str]:
    """The first objects of a table, the quick ones before others."""
    return sorted(table["objects"], key=lambda name: (name not in QUICK_OBJECTS, name))[: max(count, 0)]


def plan_pictures(
    leaderboard: dict[str, Any], submissions: dict[str, Submission], objects: int
) -> dict[tuple[str, str, str], Picture]:
    """The pictures of a page: (kind, content hash, object) -> picture, of submissions whose files are at hand.

    Args:
        objects: how many objects to show, the quick ones first.
    """
    pictures: dict[tuple[str, str, str], Picture] = {}
    for table in leaderboard["tables"]:
        names = first_objects(table, objects)
        for entry in table["entries"]:
            key = entry["content_hash"]
            if key not in submissions:
                continue
            submission = submissions[key]
            seed = submission.info.seeds[0]
            for name in names:
                pictures["truth", "", name] = Picture("truth", name)
                touched = touched_picture(submission, name, seed)
                if touched:
                    pictures["touched", key, name] = touched
                if submission.info.reconstructor != TOUCHED_AS_THEY_ARE:
                    part = submission.of_object(name)
                    pictures["reconstruction", key, name] = Picture("reconstruction", name, part, key, seed)
    return pictures


def _score_missing(
    scores: list[SubmissionScore], submissions: dict[str, Submission], workers: int, trust: bool, batch: Batch
) -> list[SubmissionScore]:
    """Adds scores of submissions that have none.

    One of other assets, or from before the replay beside them, does not count, nor (without ``trust``) one made elsewhere.
    """
    current = [score for score in scores if _is_current(score, submissions.get(score.content_hash), trust)]
    scored = {score.content_hash for score in current}
    before = {score.content_hash: score.objects for score in scores if score.made_here or trust}
    missing = [submission for key, submission in submissions.items() if key not in scored]
    with worker_pool(workers if missing else 1) as pool:
        for submission in missing:
            name = Path(submission.location).name
            with batch.item(submission.location), Progress(f"score {name}", "object", leave=False) as bar:
                objects = before.get(submission.content_hash)
                current.append(score_submission(submission, objects, pool, bar.show))
    return current


def _is_current(score: SubmissionScore, submission: Submission | None, trust: bool) -> bool:
    if submission is None:
        return True
    if not (score.made_here or trust):
        return False
    try:
        record = find_record(submission, score.objects)[0]
        if record is not None and record.tier != score.tier:
            return False
        return score.asset_sha256 == asset_sha256(score.objects, submission.split)
    except AssetError:
        return True  # the objects are not here: the score is the best there is
