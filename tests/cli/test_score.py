"""``tslam-bench score`` on a small run made of primitives."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import textwrap
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console
from scored_run import NAMES, fake_score, info

from tslam_bench.cli import main
from tslam_bench.cli.score import object_table, score_main, summary_table
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.scoring.scoring import score_submission, worker_pool
from tslam_bench.scoring.submission import SubmissionWriter, read_submission
from tslam_bench.scoring.untrusted_scores import parse_score


@pytest.fixture(autouse=True)
def use_cache(primitive_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TSLAM_BENCH_CACHE", str(primitive_cache))


def test_score_prints_a_table_and_writes_json(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = run / "submissions" / "mine-hull"
    score_main([str(path), "--objects", *NAMES, "--output", str(tmp_path / "score.json")])
    printed = capsys.readouterr().out
    value = json.loads((tmp_path / "score.json").read_text())
    assert parse_score(value, "file").objects == NAMES
    assert value == json.loads((run / "scores" / "mine-hull.json").read_text())
    for name in NAMES:
        assert name in printed
    for group, metric in (("areas", "iou_area"), ("1", "iou"), ("8", "iou"), ("8", "calibration_error")):
        assert f"{value['aggregate'][group][metric]['mean']:.3f}" in printed


def test_score_prints_json(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    score_main([str(run / "submissions" / "random-grid"), "--objects", "mug", "--json"])
    assert json.loads(capsys.readouterr().out)["objects"] == ["mug"]


@pytest.mark.parametrize(
    ("object_set", "seeds", "full"), [("test", (0,), False), ("test", (0, 1, 2), True), ("quick", (0,), True)]
)
def test_an_entry_of_few_seeds_says_so(object_set, seeds, full: bool, tmp_path: Path, primitive_cache: Path) -> None:
    with SubmissionWriter(tmp_path / "s", info("mine", "hull", object_set=object_set, seeds=seeds)):
        pass
    notes = score_submission(tmp_path / "s", ["mug"], cache=primitive_cache).notes
    assert any("not a full entry" in note for note in notes) is not full
    assert any(
        "missing, counted as empty: rollout of pose 0" in note for note in notes
    )  # all pieces are, and are named
    assert any("reconstruction of 1 pose, reconstruction of 2 poses" in note for note in notes)


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_one_bad_submission_takes_no_other_with_it(form: list[str], run: Path, tmp_path: Path, capsys) -> None:
    """Some are refused when they are read, one changes before its turn; the others are scored, written and shown."""
    (tmp_path / "broken").mkdir()
    with zipfile.ZipFile(tmp_path / "empty.zip", "w"):
        pass
    os.mkfifo(tmp_path / "pipe")
    names = ("random-grid", "mine-hull")
    paths = ["broken", "random-grid", "empty.zip", "pipe", "nowhere", "mine-hull"]
    arguments = [str(run / "submissions" / name) if name in names else str(tmp_path / name) for name in paths]
    with pytest.raises(InvalidInputError, match=r"4 of 6 failed, see above: .*broken, .*; the others are scored"):
        score_main([*arguments, "--objects", "mug", "--output", str(tmp_path / "scores"), *form])
    assert sorted(p.name for p in (tmp_path / "scores").iterdir()) == ["mine-hull.json", "random-grid.json"]
    printed, error = capsys.readouterr()
    lines = [line for line in error.splitlines() if line.startswith("tslam-bench score: ")]
    assert len(lines) == 4 and all(
        name in line for name, line in zip(("broken", "empty", "pipe", "nowhere"), lines, strict=True)
    )
    if form:
        assert [value["submission"]["explorer"] for value in json.loads(printed)] == ["random", "mine"]
    else:
        assert "random + grid" in printed and "<b>Mine</b>" in printed


def test_figures_are_shown_if_they_cannot_be_written(run: Path, tmp_path: Path, primitive_cache: Path) -> None:
    """A disk that is full after minutes of scoring."""
    code = f"""
        import resource
        from tslam_bench.cli import main
        arguments = ["score", {str(run / "submissions/random-grid")!r}, "--objects", "mug"]
        main(arguments)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
        main([*arguments, "--output", {str(tmp_path / "score.json")!r}])
    """
    environment = {**os.environ, "TSLAM_BENCH_CACHE": str(primitive_cache)}
    command = [sys.executable, "-c", textwrap.dedent(code)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stdout.count("random + grid, per object") == 2, done.stderr
    assert "score.json: cannot be written (File too large); make room" in done.stderr.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_process_that_is_killed_takes_one_submission_with_it() -> None:
    with worker_pool(2) as pool:
        assert pool is not None
        with pytest.raises(AssetError, match="was killed, probably for want of memory"):
            list(pool.map(os._exit, [1]))
        assert list(pool.map(abs, [-1, 2])) == [1, 2]


def test_several_scores_go_to_a_folder(run: Path, tmp_path: Path) -> None:
    paths = [str(run / "submissions" / name) for name in ("random-grid", "mine-hull")]
    score_main([*paths, "--objects", "mug", "--output", str(tmp_path / "scores")])
    assert sorted(p.name for p in (tmp_path / "scores").iterdir()) == ["mine-hull.json", "random-grid.json"]


def test_no_submission_and_no_other_file_is_written_over(run: Path, tmp_path: Path) -> None:
    submission = tmp_path / "random-grid"
    shutil.copytree(run / "submissions" / "random-grid", submission)
    before = read_submission(submission).content_hash
    (tmp_path / "notes.json").write_text('{"mine": 1}')
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "link").symlink_to(submission)
    for output, reason in (
        (submission / "submission.json", "would be written into .*random-grid, which is read"),
        (submission / "score.json", "would be written into"),
        (tmp_path / "link" / "score.json", "would be written into"),
        (submission, "would be written into"),
        (tmp_path / "notes.json", "notes.json: is no score file and stays"),
        (tmp_path / "notes.txt", "is no score file and stays"),
        (Path("/dev/null"), "is a device, no file, and stays"),
    ):
        with pytest.raises(InvalidInputError, match=reason):
            score_main([str(submission), "--objects", "mug", "--output", str(output)])
    assert read_submission(submission).content_hash == before
    assert (tmp_path / "notes.json").read_text() == '{"mine": 1}' and (tmp_path / "notes.txt").read_text() == "mine"


def test_a_score_file_is_written_again_and_through_a_link(run: Path, tmp_path: Path) -> None:
    (tmp_path / "scores").mkdir()
    (tmp_path / "score.json").symlink_to("scores/real.json")
    for _ in range(2):
        score_main([str(run / "submissions/random-grid"), "--objects", "mug", "--output", str(tmp_path / "score.json")])
        assert (tmp_path / "score.json").is_symlink()
        assert json.loads((tmp_path / "scores/real.json").read_text())["objects"] == ["mug"]


def test_names_with_dots_do_not_meet(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a.v1", "a.v2"):
        shutil.copytree(run / "submissions" / "random-grid", tmp_path / name)
    score_main(
        [*(str(tmp_path / name) for name in ("a.v1", "a.v2")), "--objects", "mug", "--output", str(tmp_path / "s")]
    )
    assert sorted(path.name for path in (tmp_path / "s").iterdir()) == ["a.v1.json", "a.v2.json"]
    monkeypatch.chdir(tmp_path / "a.v1")
    score_main([".", "--objects", "mug", "--output", str(tmp_path / "s")])


@pytest.mark.slow
def test_processes_do_not_change_the_score(run: Path, primitive_cache: Path) -> None:
    path = run / "submissions" / "mine-hull"
    with worker_pool(2) as pool:
        assert pool is not None
        in_processes = [score_submission(path, NAMES, pool, cache=primitive_cache).to_json() for _ in range(2)]
    assert in_processes == 2 * [score_submission(path, NAMES, cache=primitive_cache).to_json()]


def test_same_names_are_refused(run: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="same name"):
        path = str(run / "submissions" / "random-grid")
        score_main([path, path, "--objects", "mug", "--output", str(tmp_path)])


def test_names_are_not_read_as_markup(capsys: pytest.CaptureFixture[str]) -> None:
    """Square brackets mean colours to the library that prints the tables."""
    score = fake_score("a", [0.25])
    score = replace(score, info=replace(score.info, method="[red]mine[/] [/nothing]"))
    for table in (summary_table([score]), object_table(score)):
        Console(width=200).print(table)
        assert "[red]mine[/] [/nothing]" in capsys.readouterr().out


@pytest.mark.parametrize(
    "method", ["Ours [/w noise]", "[red]mine[/]", "a :smile: b", "back\\", "\\[x]", "a\u202eb", "力 Größe [/]", "]["]
)
def test_every_name_comes_through_the_tables_as_it_is(method: str, capsys: pytest.CaptureFixture[str]) -> None:
    score = fake_score("a", [0.25])
    score = replace(score, info=replace(score.info, method=method))
    for table in (summary_table([score]), object_table(score)):
        Console(width=200).print(table)
        assert method.replace("\u202e", "\\u202e") in capsys.readouterr().out


def test_a_terminal_without_unicode_gets_escapes(run: Path, tmp_path: Path, primitive_cache: Path) -> None:
    """What takes minutes to compute is not lost for a letter."""
    folder = tmp_path / "sub"
    shutil.copytree(run / "submissions" / "random-grid", folder)
    about = json.loads((folder / "submission.json").read_text()) | {"method": "Größe 力 [/w noise]"}
    (folder / "submission.json").write_text(json.dumps(about))
    for form in ([], ["--json"]):
        code = f"from tslam_bench.cli import main; main({['score', str(folder), '--objects', 'mug', *form]!r})"
        environment = {**os.environ, "PYTHONIOENCODING": "ascii", "TSLAM_BENCH_CACHE": str(primitive_cache)}
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=False)
        assert done.returncode == 0 and done.stdout.isascii(), done.stderr.decode()
        if form:
            assert json.loads(done.stdout)["submission"]["method"] == "Größe 力 [/w noise]"
        else:
            assert rb"Gr\xf6\xdfe \u529b [/w noise]" in done.stdout


def test_escape_characters_in_names_of_files_do_not_reach_the_terminal(run: Path, tmp_path: Path, capsys) -> None:
    folder = tmp_path / "sub\x1b[31m"
    shutil.copytree(run / "submissions" / "random-grid", folder)
    (folder / "notes\x1b[2J\n.txt").write_text("x")
    with pytest.raises(SystemExit):
        main(["score", str(folder), "--objects", "mug"])
    error = capsys.readouterr().err
    assert "\x1b" not in error.replace("\x1b[A", "") and "notes\\x1b[2J\\n.txt: not a file of a submission" in error


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "name at least one submission"),
        (["nothing-here"], "no such folder"),
        (["SUBMISSION", "--objects", "mugg"], "mugg"),
        (["SUBMISSION", "--objects", "hammer"], "tslam-bench assets prepare"),
        (["SUBMISSION", "--objects", "mug", "--workers", "0"], "--workers 0"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments: list[str], message: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    submission = str(run / "submissions" / "mine-hull")
    with pytest.raises(SystemExit) as caught:
        main(["score", *(submission if argument == "SUBMISSION" else argument for argument in arguments)])
    assert caught.value.code == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("tslam-bench:")]
    assert len(lines) == 1 and message in lines[0]
    assert list(tmp_path.iterdir()) == []
