"""Hidden splits: made from a secret, committed to, judged on, and opened."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tslam_bench.cli import main
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.verify import verify
from tslam_bench.files import CACHE_VARIABLE
from tslam_bench.objects.hand import hand_directory, load_hand
from tslam_bench.objects.splits import prepared_names
from tslam_bench.objects.store import load_object
from tslam_bench.preparation import hidden
from tslam_bench.scoring.submission import read_submission
from tslam_bench.scoring.untrusted_scores import read_score
from tslam_bench.scoring.verification import record_path
from tslam_bench.sources.generator.generate import draw
from tslam_bench.sources.generator.hidden import hidden_sources

SECRET = "correct horse battery"


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    load_hand()  # fails with the command that prepares it
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        target = hand_directory(folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(hand_directory(), target_is_directory=True)
        patch.setenv(CACHE_VARIABLE, str(folder))
        yield folder


@pytest.fixture(scope="module")
def commitment(cache: Path, tmp_path_factory) -> Path:
    """A hidden split of one carton, the cheapest shape."""
    file = tmp_path_factory.mktemp("public") / "hidden.commitment.json"
    given = ("--seed", SECRET, "--count", "1", "--categories", "carton", "--workers", "1", "--commitment", str(file))
    main(["assets", "hide", *given])
    return file


def test_the_split_is_what_the_secret_gives_and_the_commitment_says_nothing(commitment: Path, cache: Path) -> None:
    assert prepared_names("hidden") == ["h000"]
    prepared = load_object("h000", "hidden")
    (source,) = hidden_sources("hidden", SECRET, 1, ("carton",))
    assert np.allclose(prepared.vertices.max(axis=0), source.load(cache).mesh.extents / 2, atol=1e-3)
    assert not np.allclose(draw("carton", 0)[0].extents, prepared.vertices.max(axis=0) * 2, atol=1e-3)
    opening = hidden.opening_path("hidden")
    assert opening.stat().st_mode & 0o777 == 0o600
    public = commitment.read_text()
    assert SECRET in opening.read_text() and SECRET not in public and "carton" not in public
    assert json.loads(public)["count"] == 1
    record = (cache / "objects" / "hidden" / "h000" / "record.json").read_text()
    assert SECRET not in record


def test_an_opening_proves_that_nothing_was_exchanged(commitment: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    opening = hidden.opening_path("hidden")
    main(["assets", "hide", "--open", str(opening), "--commitment", str(commitment)])
    said = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in said] == ["the", "1", "1"]
    content = json.loads(opening.read_text())
    item = content["objects"][0]
    lies = {
        "another seed": content | {"seed": SECRET + "!"},
        "an object more": content | {"objects": [item, item]},
        "another object": content | {"objects": [item | {"source_sha256": "0" * 64}]},
        "other products": content | {"objects": [item | {"products_sha256": "0" * 64}]},
    }
    for name, lie in lies.items():
        (tmp_path / "lie.json").write_text(json.dumps(lie))
        with pytest.raises(InvalidInputError, match="is not what"):
            hidden.check_opening(tmp_path / "lie.json", commitment)
        # Even who commits to the lie itself is found.
        hidden.commit(lie, tmp_path / "own.json")
        if name != "an object more":
            with pytest.raises(InvalidInputError, match=r"is not what the seed gives|has other products"):
                hidden.check_opening(tmp_path / "lie.json", tmp_path / "own.json")
    (tmp_path / "lie.json").write_text("[" * 100_000)
    for broken in (tmp_path / "lie.json", commitment, tmp_path / "missing.json"):
        with pytest.raises(InvalidInputError):
            hidden.check_opening(broken, commitment)
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))  # somebody else, who has the two files alone
    assert hidden.check_opening(opening, commitment)[-1].startswith("0 of them are prepared here")


def test_a_hidden_split_is_explored_replayed_and_scored(commitment: Path, tmp_path: Path, capsys) -> None:
    words = ("--policy", "random_targets", "--reconstructor", "hull", "--processes", "0", "--policy-salt", "ab")
    main(["evaluate", *words, "--split", "hidden", "--output", str(tmp_path)])
    folder = tmp_path / "submissions" / "random_targets-hull"
    with pytest.raises(
        InvalidInputError, match="is not of split 'test'; choose one of quick, test, or say --split hidden"
    ):
        read_submission(folder)
    with pytest.raises(InvalidInputError, match="not of split 'val'"):
        read_submission(folder, split="val")
    assert read_submission(folder, split="hidden").info.object_set == "hidden"
    record = verify(folder, split="hidden")
    assert len(record.verdicts) == 8 and record.departed == () and record.tier == "replayed"
    capsys.readouterr()
    main(["score", str(folder), "--split", "hidden", "--output", str(tmp_path / "score.json"), "--json"])
    score = json.loads(capsys.readouterr().out)
    assert (
        score["tier"] == "replayed"
        and score["objects"] == ["h000"]
        and score["aggregate"]["areas"]["iou_area"]["mean"] > 0
    )
    assert read_score(tmp_path / "score.json").objects == ("h000",)
    value = json.loads(record_path(folder).read_text())
    record_path(folder).write_text(json.dumps(value | {"split": "test"}))
    main(["score", str(folder), "--split", "hidden", "--json"])
    assert json.loads(capsys.readouterr().out)["tier"] == "reported"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--seed", "1234", "--name", "other"), "at least 12 characters"),
        (("--name", "test"), "is one of the benchmark's own"),
        (("--name", "../x"), "split"),
        (("--count", "0"), "must be at least 1"),
        (("--categories", "spaceship", "--name", "other"), "spaceship"),
        (("--seed", SECRET + "!"), "holds objects of another seed"),
    ],
)
def test_what_cannot_be_hidden_is_one_line(arguments, message: str, commitment: Path, capsys) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["assets", "hide", *arguments])
    assert caught.value.code == 2 and message in capsys.readouterr().err


def test_secrets_give_different_shapes_in_a_different_order() -> None:
    one, other = (hidden_sources("hidden", secret, 100) for secret in (SECRET, SECRET + "!"))
    assert one == hidden_sources("hidden", SECRET, 100) and [s.category for s in one] != [s.category for s in other]
    assert len({source.category for source in one[:60]}) == 60, "one of each kind before any comes again"
