"""Ranking: order, shared ranks, privileged entries, improvement; and which entries share their rollouts."""

from __future__ import annotations

import numpy as np
import pytest
from scored_run import fake_score

from tslam_bench.leaderboard.explorers import group_explorers
from tslam_bench.leaderboard.ranking import rank
from tslam_bench.scoring.aggregate import interval, resampled_means
from tslam_bench.scoring.score_file import SubmissionScore


def order(scores: list[SubmissionScore]) -> list[tuple[int | None, str]]:
    return [(e["rank"], e["submission"]["explorer"]) for e in rank(scores)["tables"][0]["entries"]]


def test_order_is_by_area_then_iou_at_8_then_chamfer() -> None:
    scores = [
        fake_score("worst", [0.1, 0.1]),
        fake_score("best", [0.6, 0.4], chamfer=0.9),
        fake_score("tie_far", [0.3, 0.3], chamfer=0.2, iou_8=0.4),
        fake_score("tie_near", [0.2, 0.4], chamfer=0.1, iou_8=0.4),
        fake_score("tie_high", [0.4, 0.2], chamfer=0.5, iou_8=0.5),
    ]
    expected = ["best", "tie_high", "tie_near", "tie_far", "worst"]
    assert [name for _, name in order(scores)] == expected
    assert order(scores[::-1]) == order(scores)


def test_entries_whose_paired_difference_may_be_0_share_a_rank() -> None:
    """Objects differ far more than entries: only the paired difference tells them apart."""
    base = np.random.default_rng(0).uniform(0.2, 0.8, (20, 3))
    wobble = np.random.default_rng(1).normal(0, 0.02, (4, 20, 3))
    wobble -= wobble.mean(axis=(1, 2), keepdims=True)
    scores = [
        fake_score("first", base),
        fake_score("near", base + wobble[0] - 0.002),
        fake_score("steady", base - 0.003),  # nearer to the first than "far" but surely behind it
        fake_score("with_steady", base + wobble[1] - 0.004),
        fake_score("last", base + wobble[2] - 0.05),
        fake_score("also_last", base + wobble[3] - 0.051),
    ]
    ranks = [(1, "first"), (1, "near"), (3, "steady"), (3, "with_steady"), (5, "last"), (5, "also_last")]
    assert order(scores) == order(scores[::-1]) == ranks
    entries = rank(scores)["tables"][0]["entries"]
    assert entries[0]["behind_leader"] is None
    near, steady, with_steady = (entry["behind_leader"] for entry in entries[1:4])
    assert near["low"] < 0 < near["high"] and near["mean"] == pytest.approx(0.002)
    assert steady["low"] == pytest.approx(steady["high"]) == pytest.approx(0.003)
    assert with_steady["mean"] == pytest.approx(0.001)  # behind the leader of its own group
    # Without the pairing nothing could be told apart.
    low, high = interval(resampled_means(base))
    assert high - low > 0.1


def test_a_privileged_entry_neither_leads_nor_counts() -> None:
    base = np.random.default_rng(0).uniform(0.2, 0.8, (20, 1))
    wobble = np.random.default_rng(1).normal(0, 0.02, (20, 1))
    scores = [
        fake_score("oracle", base + 0.1, privileged=True),
        fake_score("a", base),
        fake_score("tslam_chamfer", base - 0.0005, privileged=True),
        fake_score("b", base + wobble - wobble.mean() - 0.001),
        fake_score("c", base - 0.1),
    ]
    assert order(scores) == [(None, "oracle"), (1, "a"), (None, "tslam_chamfer"), (1, "b"), (3, "c")]


def test_entries_with_other_numbers_of_seeds_are_paired_by_object() -> None:
    base = np.random.default_rng(0).uniform(0.2, 0.8, (20, 1))
    scores = [fake_score("a", base.repeat(3, axis=1)), fake_score("b", base - 0.01)]
    assert order(scores) == [(1, "a"), (2, "b")]
    difference = rank(scores)["tables"][0]["entries"][1]["behind_leader"]
    assert difference["low"] == pytest.approx(0.01) == pytest.approx(difference["high"])


def test_privileged_entries_hold_no_rank() -> None:
    scores = [
        fake_score("a", [0.2], 0.1, 0.1),
        fake_score("oracle", [0.9], 0.1, 0.1, privileged=True),
        fake_score("b", [0.1], 0.1, 0.1),
    ]
    assert order(scores) == [(None, "oracle"), (1, "a"), (2, "b")]


def test_sets_of_objects_are_not_mixed_and_files_count_once() -> None:
    scores = [fake_score("a", [0.2], 0.1, 0.1), fake_score("b", [0.1, 0.9], 0.1, 0.1), fake_score("a", [0.2], 0.1, 0.1)]
    tables = rank(scores)["tables"]
    assert [len(table["objects"]) for table in tables] == [2, 1]
    assert [len(table["entries"]) for table in tables] == [1, 1]
    assert all(table["object_set"] == "custom" for table in tables)


def test_improvement_is_over_the_heuristic_of_the_same_reconstructor() -> None:
    scores = [
        fake_score("heuristic", [0.2, 0.4], 0.1, 0.1),
        fake_score("heuristic", [0.9, 0.9], 0.1, 0.1, reconstructor="grid"),
        fake_score("a", [0.3, 0.3], 0.1, 0.1),
        fake_score("b", [0.3, 0.5], 0.1, 0.1),
        fake_score("c", [0.3, 0.5], 0.1, 0.1, reconstructor="other"),
    ]
    found = {e["submission"]["method"]: e["improvement"] for e in rank(scores)["tables"][0]["entries"]}
    assert found == {
        "heuristic + hull": None,
        "heuristic + grid": None,
        "a + hull": 0.5,
        "b + hull": 1.0,
        "c + other": None,
    }


def test_who_only_calls_themselves_a_baseline_is_nobody_s_yardstick() -> None:
    scores = [
        fake_score("heuristic", [0.01, 0.01], own_run=False),  # a stranger's, weak on purpose
        fake_score("a", [0.3, 0.3]),
        fake_score("random", [0.5, 0.5], own_run=False),
        fake_score("mine", [0.3, 0.3], own_run=False),  # no id of the benchmark's: nothing to bear out
    ]
    entries = rank(scores)["tables"][0]["entries"]
    assert all(entry["improvement"] is None for entry in entries)
    assert {e["submission"]["explorer"] for e in entries if e["claimed"]} == {"heuristic", "random"}
    honest = fake_score("heuristic", [0.4, 0.2])
    for order in ([*scores, honest], [honest, *scores]):
        found = {
            (e["submission"]["explorer"], e["claimed"]): e["improvement"] for e in rank(order)["tables"][0]["entries"]
        }
        assert found == {
            ("heuristic", False): None,
            ("heuristic", True): 0.0,
            ("a", False): 0.5,
            ("random", True): 1.0,
            ("mine", False): 0.5,
        }


def test_a_claimed_baseline_stands_apart_from_the_real_one() -> None:
    """Even with the very curve of the real one, as who copies it would have."""
    board = rank([fake_score("heuristic", [0.2]), fake_score("heuristic", [0.3], own_run=False, method="Copy")])
    groups = group_explorers(board["tables"][0]["entries"])
    assert sorted((g.label, len(g.entries)) for g in groups) == [("heuristic", 1), ("heuristic (Copy)", 1)]


def test_explorers_are_grouped_by_their_rollouts() -> None:
    entries = rank([fake_score("a", [0.2], 0.1, 0.3), fake_score("a", [0.1], 0.1, 0.3, reconstructor="grid")])
    other = rank([fake_score("a", [0.2], 0.1, 0.4, method="Other")])
    groups = group_explorers([*entries["tables"][0]["entries"], *other["tables"][0]["entries"]])
    assert [(g.label, len(g.entries)) for g in groups] == [("a", 2), ("a (Other)", 1)]
