"""Hundreds of wrong and hostile submissions, score files and meshes: none crashes, hangs, or is taken for what it is not.

The longer run and its figures: ``benchmarks/fuzz_inputs.py``, ``docs/security.md``.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import fuzz_inputs
import hostile_inputs
from fuzz_inputs import Config, Outcome

CONFIG = Config(count=60, seed=7, costly=False)


@pytest.fixture(scope="module")
def cases(primitive_cache: Path) -> list[hostile_inputs.Case]:
    return fuzz_inputs.corpus(primitive_cache, CONFIG)


@pytest.fixture(scope="module")
def outcomes(cases: list[hostile_inputs.Case], primitive_cache: Path) -> list[Outcome]:
    return fuzz_inputs.run(cases, primitive_cache, CONFIG)


def test_every_input_is_refused_in_one_line_counted_as_empty_or_rightly_accepted(cases, outcomes) -> None:
    assert len(cases) >= 300
    assert fuzz_inputs.faults(cases, outcomes) == []
    counts = Counter((case.family, outcome.status) for case, outcome in zip(cases, outcomes, strict=True))
    print(counts)
    # The corpus holds enough of each: readers that refuse all, or nothing, would not pass.
    for family, status, least in (
        ("submission", "refused", 80),
        ("submission", "empty", 10),
        ("submission", "accepted", 20),
        ("score file", "refused", 80),
        ("score file", "accepted", 8),
        ("mesh", "refused", 90),
        ("mesh", "accepted", 15),
    ):
        assert counts[family, status] >= least, counts


def test_the_same_seed_makes_the_same_inputs(cases, primitive_cache: Path) -> None:
    again = fuzz_inputs.corpus(primitive_cache, CONFIG)
    assert [case.kind for case in cases] == [case.kind for case in again]
    for case, same in list(zip(cases, again, strict=True))[::17]:
        files = case.files()
        if not any(name.endswith((".dae", ".zae", ".kmz")) for name in files):  # trimesh writes dates and random ids
            assert files == same.files(), case.kind


def test_the_check_finds_what_must_not_happen(tmp_path: Path) -> None:
    """It is no test that cannot fail."""
    unexpected = fuzz_inputs.read("mesh", tmp_path, tmp_path, False)  # there is no file: no reader says so
    assert unexpected.status == "another exception"
    case = hostile_inputs.Case("mesh", "kind", "refused", lambda: {})
    good = Outcome("refused", "a reason", 1.0, 2**20)
    assert fuzz_inputs.faults(
        [case] * 4, [good, good._replace(status="hang"), good._replace(status="accepted"), unexpected]
    ) == [
        "mesh, kind: hang, not refused (a reason)",
        "mesh, kind: accepted, not refused (a reason)",
        f"mesh, kind: another exception, not refused ({unexpected.reason})",
    ]
    for text, is_line in (
        ("bad.ply: truncated", True),
        ("two\nlines", False),
        ("\x1b[2J", False),
        ("", False),
        ("x" * 2000, False),
    ):
        assert fuzz_inputs._is_one_line(text) is is_line
