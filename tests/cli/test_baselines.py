"""``tslam-bench baselines`` from the outside."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tslam_bench import cli
from tslam_bench.evaluation.policies import list_baselines
from tslam_bench.evaluation.weights import WEIGHTS_VARIABLE

ROOT = Path(__file__).parents[2]


def run(capsys, *arguments: str) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of ``tslam-bench``."""
    try:
        cli.main(list(arguments))
        status = 0
    except SystemExit as ended:
        status = int(ended.code or 0)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_list_as_table_and_json(capsys) -> None:
    status, table, _ = run(capsys, "baselines", "list")
    rows = [line.split() for line in table.splitlines()[1:]]
    assert status == 0 and [row[0] for row in rows] == [spec.id for spec in list_baselines()]
    status, text, _ = run(capsys, "baselines", "list", "--json")
    records = json.loads(text)
    assert status == 0 and [record["id"] for record in records] == [row[0] for row in rows]
    assert [record["kind"] for record in records] == [row[1] for row in rows]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("baselines", "nope"), "nope"),
        (("baselines", "train", "nope"), "'nope': unknown; choose one of"),
        (("baselines", "train", "random"), "nothing to train"),
        (("baselines", "train", "tslam", "--split", "test"), "train split only"),
        (("baselines", "train", "tslam", "--steps", "0"), "steps 0"),
        (("baselines", "train", "tslam@1"), "give the id alone"),
        (("baselines", "export", "nowhere", "--output", "weights"), "nowhere: is no directory of a trained model"),
        (("evaluate", "--policy", "random@1", "--objects", "mug"), "only a learned explorer has one"),
        (("evaluate", "--policy", "nope"), "'nope': unknown"),
        (("evaluate", "--policy", "random", "--objects", "mugg"), "mug"),
        (("evaluate", "--policy", "random", "--objects", "mug", "--seeds", "1", "1"), "different"),
        (("evaluate", "--policy", "random", "--reconstructor", "hulk"), "'hulk'"),
    ],
)
def test_bad_input_is_one_line_and_status_2(capsys, arguments, message: str, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    status, _, errors = run(capsys, *arguments)
    assert status == 2 and errors.startswith("tslam-bench: ") and errors.count("\n") == 1
    assert message in errors
    assert list(tmp_path.iterdir()) == []


def test_missing_model_names_the_training_command(capsys, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "nowhere"))
    status, _, errors = run(
        capsys,
        *("evaluate", "--policy", "tslam", "--objects", "mug", "--reconstructor", "grid"),
        "--output",
        str(tmp_path),
    )
    assert status == 2 and "tslam-bench baselines train tslam" in errors and errors.count("\n") == 1


def test_documented_table_is_the_registry() -> None:
    text = (ROOT / "docs" / "baselines.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (\w+) \| `?([\w-]+)`? \| (\w+) \| (.+) \|$", text, re.MULTILINE)
    expected = [
        (s.id, s.kind, s.reward_mode or "-", "yes" if s.privileged else "no", s.summary) for s in list_baselines()
    ]
    assert rows == expected
