"""``submit check``: what a maintainer would see, and the rule of one added file."""

from __future__ import annotations

import dataclasses
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from prepared_shapes import prepare_primitive

from tslam_bench.cli import main
from tslam_bench.constants import SURFACE_SAMPLES
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.submit_check import Report, check, check_one_file
from tslam_bench.files import CACHE_VARIABLE
from tslam_bench.objects import store
from tslam_bench.objects.hand import hand_directory, load_hand
from tslam_bench.scoring.submission import ROLLOUTS, read_submission, rollout_name
from tslam_bench.scoring.verification import record_path

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """A split of one box."""
    load_hand()  # fails with the command that prepares it
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        hand_directory(folder).parent.mkdir(parents=True, exist_ok=True)
        hand_directory(folder).symlink_to(hand_directory(), target_is_directory=True)
        mesh = trimesh.creation.box(extents=(0.12, 0.1, 0.08))
        box = dataclasses.replace(prepare_primitive(mesh, [mesh], "box", spacing=4e-3), split="tiny")
        _, faces = trimesh.sample.sample_surface(mesh, SURFACE_SAMPLES, seed=np.random.default_rng(0))
        store.write(box, np.asarray(faces), folder)
        patch.setenv(CACHE_VARIABLE, str(folder))
        yield folder


@pytest.fixture(scope="module")
def submission(cache, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("run")
    words = (
        "--policy",
        "random_targets",
        "--reconstructor",
        "grid",
        "--split",
        "tiny",
        "--seeds",
        "0",
        "--policy-salt",
        "5a",
    )
    main(["evaluate", *words, "--processes", "0", "--output", str(output), "--authors", "A [link](http://x) @team"])
    return output / "submissions" / "random_targets-grid"


def test_an_honest_submission_can_be_taken(submission: Path, tmp_path: Path, capsys) -> None:
    archive = Path(shutil.make_archive(str(tmp_path / "entry"), "zip", submission))
    words = ("--split", "tiny", "--processes", "1", "--report", str(tmp_path / "report.md"))
    main(["submit", "check", str(archive), *words])
    out = capsys.readouterr().out
    assert "entry.zip: can be taken" in out and "tier: replayed" in out and "all 8 episodes reproduce" in out
    assert "is the id of a registered baseline" in out
    page = (tmp_path / "report.md").read_text()
    assert "[link]" not in page and "@team" not in page and "A &#91;link&#93;" in page
    assert record_path(archive).is_file(), "the record serves tslam-bench score too"


def test_what_is_wrong_with_a_submission_is_named(submission: Path, tmp_path: Path, capsys) -> None:
    entry = shutil.copytree(submission, tmp_path / "entry")
    rollout = read_submission(entry, split="tiny").rollout("box", 3, 0)
    assert rollout is not None
    dataclasses.replace(rollout, pose=4).save(entry / ROLLOUTS)
    (entry / rollout_name("box", 5, 0)).unlink()
    with pytest.raises(SystemExit) as caught:
        main(["submit", "check", str(entry), "--split", "tiny", "--processes", "1"])
    out = " ".join(capsys.readouterr().out.split())
    assert caught.value.code == 1 and "box, pose 4, seed 0: start depart" in out and "--segments tells" in out
    assert "1 rollouts or reconstructions are missing" in out and "entry: cannot be taken as it is" in out
    record_path(entry).unlink()
    report = check(entry, "tiny", minutes=1e-9, processes=1)
    assert report.score is None and report.problems[-1].startswith("replay: 0 of 7 done after")
    (entry / "stray.txt").write_text("?")
    with pytest.raises(SystemExit) as caught:
        main(["submit", "check", str(entry), "--split", "tiny"])
    assert caught.value.code == 2 and "stray.txt" in capsys.readouterr().err


def test_a_report_without_a_score_says_why() -> None:
    page = Report("x.zip", ("late <b>",), (), None, None, 1.0).markdown()
    assert "cannot be taken" in page and "<b>" not in page


# --- One file --------------------------------------------------------------------------------------------------


def git(folder: Path, *words: str) -> None:
    identity = ("-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false")
    subprocess.run(["git", *identity, *words], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """Has one submission; the branch of the request is checked out."""
    folder = tmp_path / "repository"
    (folder / "leaderboard/submissions").mkdir(parents=True)
    (folder / "leaderboard/submissions/old.zip").write_bytes(b"old")
    (folder / "code.py").write_text("1\n")
    git(folder, "init", "--initial-branch", "main")
    git(folder, "add", ".")
    git(folder, "commit", "-m", "before")
    git(folder, "checkout", "-b", "request")
    return folder


def changed(folder: Path, name: str, content: str | None = "new", link: bool = False) -> None:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if content is None:
        path.unlink()
    elif link:
        path.symlink_to(content)
    else:
        path.write_text(content)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ([("leaderboard/submissions/new.zip", "new")], None),
        ([], "is not added"),
        ([("leaderboard/submissions/new.zip", "new"), ("code.py", "2")], "adds one file and changes nothing else"),
        ([("leaderboard/submissions/new.zip", "a"), ("leaderboard/submissions/b.zip", "b")], "adds one file"),
        ([("leaderboard/submissions/new.zip", "a"), ("leaderboard/submissions/old.zip", None)], "adds one file"),
        ([("leaderboard/submissions/new.zip", "new"), (".github/workflows/x.yml", "on: push")], "adds one file"),
    ],
)
def test_a_request_adds_one_file(changes, message: str | None, repository: Path) -> None:
    for name, content in changes:
        changed(repository, name, content)
    git(repository, "add", "--all")
    git(repository, "commit", "--allow-empty", "-m", "request")
    path = repository / "leaderboard/submissions/new.zip"
    if message is None:
        check_one_file(path, "main")
        return
    with pytest.raises(InvalidInputError, match=message):
        check_one_file(path, "main")


@pytest.mark.parametrize(
    ("name", "content", "link", "message"),
    [
        ("leaderboard/submissions/old.zip", "better", False, "entries are not changed afterwards"),
        ("leaderboard/submissions/new.zip", "../../../../etc/passwd", True, "a new, plain file"),
        ("leaderboard/new.zip", "new", False, "put it at"),
        ("leaderboard/submissions/New Entry.zip", "new", False, "put it at"),
        ("leaderboard/submissions/.zip", "new", False, "put it at"),
    ],
)
def test_the_file_is_new_plain_and_in_its_place(
    name: str, content: str, link: bool, message: str, repository: Path
) -> None:
    changed(repository, name, content, link)
    git(repository, "add", "--all")
    git(repository, "commit", "-m", "request")
    with pytest.raises(InvalidInputError, match=message):
        check_one_file(repository / name, "main")


def test_revisions_that_are_none_are_one_line(repository: Path) -> None:
    for revision in ("--output=x", "nowhere"):
        with pytest.raises(InvalidInputError) as caught:
            check_one_file(repository / "leaderboard/submissions/new.zip", revision)
        assert "\n" not in str(caught.value)
    assert not (repository / "x").exists()


def test_the_workflow_runs_this_command_with_no_rights_of_its_own() -> None:
    workflow = yaml.safe_load((ROOT / ".github/workflows/submission.yml").read_text())
    assert workflow[True].keys() == {"pull_request"} and workflow["permissions"] == {"contents": "read"}
    (job,) = workflow["jobs"].values()
    scripts = [step["run"] for step in job["steps"] if "run" in step]
    assert any("tslam-bench submit check" in script for script in scripts)
    assert not any("${{" in script for script in scripts), "texts of a request are no part of a script"
