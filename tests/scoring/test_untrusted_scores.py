"""Score files: what was made here is read back, what somebody sent is computed again, and what lies is refused."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scored_run import NAMES

from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import CACHE_VARIABLE
from tslam_bench.scoring import untrusted_scores
from tslam_bench.scoring.aggregate import estimate_all
from tslam_bench.scoring.seal import KEY_FILE, seal, sealed_here
from tslam_bench.scoring.untrusted_scores import NOT_MADE_HERE, parse_score, read_score, sealed_json, write_score


@pytest.fixture(autouse=True)
def use_cache(primitive_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(primitive_cache))


@pytest.fixture
def value(run: Path) -> Any:
    """A score file that was made here."""
    return json.loads((run / "scores" / "heuristic-hull.json").read_text())


@pytest.fixture
def foreign(value: Any) -> Any:
    """The same without its seal."""
    return {name: field for name, field in value.items() if name != "seal"}


def refused(value: Any, *fragments: str) -> None:
    with pytest.raises(InvalidInputError) as caught:
        parse_score(value, "somewhere.json")
    message = str(caught.value)
    assert "\n" not in message and len(message) < 500 and message.startswith("somewhere.json: not a score file"), (
        message
    )
    for fragment in (*fragments, "score the submission again"):
        assert fragment in message, message


def test_what_was_made_here_is_read_back(value: Any, tmp_path: Path) -> None:
    score = parse_score(value, "file")
    assert score.made_here and json.loads(json.dumps(sealed_json(score))) == value
    write_score(tmp_path / "again.json", score)
    assert json.loads((tmp_path / "again.json").read_text()) == value
    matrix = score.matrix("areas", "iou_area")
    assert matrix.shape == (2, 1) and score.aggregate["areas"]["iou_area"].mean == pytest.approx(matrix.mean())
    assert not score.verified and NOT_MADE_HERE not in score.notes


def test_only_what_was_verified_here_is_verified(value: Any, foreign: Any, monkeypatch, tmp_path: Path) -> None:
    claim = {"verified": True, "tier": "attested"}
    assert not parse_score({**foreign, **claim}, "file").verified
    assert not parse_score({**value, **claim}, "file").verified  # the seal is of other content
    sealed = {**foreign, **claim}
    sealed["seal"] = seal(sealed)
    assert parse_score(sealed, "file").verified and parse_score(sealed, "file").tier == "attested"
    older = {
        name: field for name, field in sealed.items() if name not in ("tier", "seal")
    }  # from before there were tiers
    assert parse_score({**older, "seal": seal(older)}, "file").tier == "replayed"
    for claimed in ("", "0" * 64, None, 7, sealed["seal"][:-1], "\u00e9"):
        assert not parse_score({**sealed, "seal": claimed}, "file").made_here
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))  # another user, or another machine
    elsewhere = parse_score(sealed, "file")
    assert not elsewhere.verified and not elsewhere.made_here and elsewhere.notes[0] == NOT_MADE_HERE
    # Written again, a stranger's figures do not become one's own.
    assert "seal" not in sealed_json(elsewhere)
    assert parse_score(sealed_json(elsewhere), "file").notes.count(NOT_MADE_HERE) == 1


def test_aggregates_of_a_stranger_are_computed_again(foreign: Any) -> None:
    """The means say 2, the IoU areas 1; the IoUs after 1, 2, 4 and 8 poses say something else."""
    for group in foreign["aggregate"].values():
        for estimate in group.values():
            estimate.update(dict.fromkeys(estimate, 2.0))
    ious = [[result["poses"][count]["iou"] for count in "1248"] for result in foreign["results"]]
    for result in foreign["results"]:
        result["areas"]["iou_area"] = 1.0
    score = parse_score(foreign, "file")
    expected = estimate_all({"iou_area": np.mean(ious, axis=1)[:, None]})["iou_area"]
    assert score.aggregate["areas"]["iou_area"] == expected and expected.mean < 0.9
    foreign["aggregate"] = "nonsense"
    assert parse_score(foreign, "file") == score


def places(value: Any, path: tuple = ()) -> Iterator[tuple]:
    """Where every value of a JSON tree is."""
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield (*path, key)
        yield from places(value[key], (*path, key))


def changed(value: Any, path: tuple, new: Any) -> Any:
    """A copy with another value at one place, or without it."""
    value = copy.deepcopy(value)
    at = value
    for key in path[:-1]:
        at = at[key]
    if new is None:
        del at[path[-1]]
    else:
        at[path[-1]] = new
    return value


STRANGE = (None, True, "x", -1, 2.5, 1e300, 10**400, [], {}, [[]], {"a": 1}, float("nan"), float("inf"), "x" * 5000, 0)


def test_every_change_of_every_field_is_refused_or_harmless(foreign: Any) -> None:
    """Whatever stands wherever: one line, or a score all of whose figures are what they can be."""
    # The aggregate is not looked at; a curve stands for its values.
    spots = [
        p for p in places(foreign) if p[0] != "aggregate" and not (len(p) == 4 and p[2].endswith("_curve") and p[3] > 1)
    ]
    assert len(spots) > 150
    refusals = 0
    for path in spots:
        for new in STRANGE:
            try:
                score = parse_score(changed(foreign, path, new), "file")
            except InvalidInputError as error:
                assert "\n" not in str(error) and str(error).startswith("file: "), (path, new, error)
                refusals += 1
                continue
            assert not score.verified
            for estimates in score.aggregate.values():
                assert all(0 <= estimate.mean <= 3 for estimate in estimates.values()), (path, new)
    assert refusals > 0.8 * len(STRANGE) * len(spots)


def result(value: Any, number: int = 0) -> Any:
    return value["results"][number]


@pytest.mark.parametrize(
    ("path", "new", "fragment"),
    [
        (("results", 0, "poses", "8", "iou"), 2.0, "after 8 poses: iou is 2.0; expected a number from 0 to 1"),
        (("results", 0, "poses", "8", "iou"), float("nan"), "iou is nan"),
        (("results", 0, "poses", "8", "chamfer_l2"), 3.1, "expected a number from 0 to 3"),
        (("results", 0, "poses", "8", "surface_iou"), "0.5", "surface_iou is '0.5'"),
        (("results", 0, "poses", "16"), {}, "unknown field '16'"),
        (("results", 0, "poses", "1"), None, "1 is missing"),
        (("results", 0, "recall_curve"), [0.0, 1.0], "a curve has not 161 values"),
        (("results", 0, "recall_curve"), [], "a curve has not 161 values"),
        (("results", 0, "object"), "hammer", "of another object or seed"),
        (("results", 1, "seed"), 7, "of another object or seed"),
        (("results", 0), None, "1 results; expected one for each of 2 objects and 1 seeds"),
        (("results",), [], "0 results"),
        (("objects",), ["mug", "mug"], "not different objects of the test split"),
        (("objects",), ["mug", "../mug"], "not different objects of the test split"),
        (("objects",), [], "not different objects"),
        (("content_hash",), "abc", "content_hash is no SHA-256"),
        (("verified",), "yes", "verified is neither true nor false"),
        (("notes",), "a note", "notes: no list"),
        (("notes",), ["x" * 10_000], "notes: no text of at most"),
        (("submission", "method"), 3, "method is 3; expected text"),
        (("submission", "privileged"), None, "field privileged is missing"),
        (("score_version",), 1, "of another version"),
        (("protocol_version",), None, "of another version"),
        (("more",), 1, "unknown field 'more'"),
    ],
)
def test_what_lies_is_named(foreign: Any, path: tuple, new: Any, fragment: str) -> None:
    refused(changed(foreign, path, new) if path != ("more",) else {**foreign, "more": 1}, fragment)


@pytest.mark.parametrize("value", [None, [], {}, "text", 3, {"score_version": 3}])
def test_what_is_no_score_is_refused(value: Any) -> None:
    refused(value)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b"", "Expecting value"),
        (b"{", "Expecting property name"),
        (b"[" * 100_000, "nested too deeply"),
        (b'{"score_version": 2, "score_version": 2}', "the key 'score_version' is there twice"),
        (b'{"score_version": NaN}', "NaN is not a JSON number"),
        (b'{"score_version": 1e999}', "1e999 is beyond all numbers"),
        (b'{"score_version": ' + b"1" * 5000 + b"}", "a number of 5000 digits"),
        (b'{"score_version": "\\ud800"}', "half a character"),
        (b'\xff\xfe{"a": 1}', "codec can't decode"),
    ],
)
def test_texts_with_no_meaning_or_two_are_refused_in_one_line(text: bytes, reason: str, tmp_path: Path) -> None:
    (tmp_path / "score.json").write_bytes(text)
    with pytest.raises(InvalidInputError, match=reason) as caught:
        read_score(tmp_path / "score.json")
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)


def test_a_byte_order_mark_is_no_fault(run: Path, tmp_path: Path) -> None:
    text = (run / "scores" / "random-grid.json").read_bytes()
    (tmp_path / "score.json").write_bytes(b"\xef\xbb\xbf" + text)
    assert read_score(tmp_path / "score.json").objects == NAMES


def test_large_files_folders_and_missing_ones_are_refused(run: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(untrusted_scores, "MAX_SCORE_SIZE", 1000)
    for path, reason in (
        (run / "scores" / "random-grid.json", "more than 1000 bytes"),
        (tmp_path, "Is a directory"),
        (tmp_path / "none.json", "no such file"),
    ):
        with pytest.raises(InvalidInputError, match=reason):
            read_score(path)


def test_a_key_that_anybody_knows_seals_nothing(tmp_path: Path, monkeypatch) -> None:
    """An empty key file, as a crash might have left one."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    (tmp_path / KEY_FILE).write_bytes(b"")
    with pytest.raises(AssetError, match="damaged; delete it"):
        sealed_here({"a": 1}, "0" * 64)
    with pytest.raises(AssetError, match="damaged; delete it"):
        seal({"a": 1})
    (tmp_path / KEY_FILE).unlink()
    made = seal({"a": 1})
    assert (tmp_path / KEY_FILE).stat().st_mode & 0o777 == 0o600 and len((tmp_path / KEY_FILE).read_bytes()) == 32
    assert sealed_here({"a": 1}, made) and not sealed_here({"a": 2}, made) and seal({"a": 1}) == made
    assert [path.name for path in tmp_path.iterdir()] == [KEY_FILE]
