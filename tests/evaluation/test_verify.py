"""Replays: honest episodes reproduce bit for bit, lies are found and named, and scores believe records of this machine only."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from baseline_assets import primitive_cache

from tslam_bench.cli import main
from tslam_bench.errors import BenchmarkError, InvalidInputError
from tslam_bench.evaluation.evaluate import EvaluationConfig, evaluate, make_reconstructors
from tslam_bench.evaluation.verify import verify
from tslam_bench.files import CACHE_VARIABLE
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.scoring.scoring import score_submission
from tslam_bench.scoring.seal import KEY_FILE
from tslam_bench.scoring.submission import ROLLOUTS, Submission, SubmissionWriter, read_submission, rollout_name
from tslam_bench.scoring.verification import (
    Tolerances,
    VerificationRecord,
    pack_steps,
    record_path,
    unpack_steps,
)

NAMES = ("cubelarge", "phone")
EXPLORERS = {"heuristic": "pd_joint_delta_pos", "random_targets": "pd_joint_pos"}


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        folder = primitive_cache(tmp_path_factory.mktemp("cache"))
        patch.setenv(CACHE_VARIABLE, str(folder))
        yield folder


@pytest.fixture(scope="module")
def submissions(cache, tmp_path_factory) -> dict[str, Path]:
    """Explorer -> its submission: two seeds of the heuristic, one of random targets."""
    made = {}
    for explorer in EXPLORERS:
        seeds = (0, 1) if explorer == "heuristic" else (0,)
        config = EvaluationConfig(explorer, NAMES, seeds, object_set="quick", policy_salt="5a17", processes=1)
        (made[explorer],) = evaluate(config, make_reconstructors(("hull",)), tmp_path_factory.mktemp(explorer))
    return made


@pytest.fixture(scope="module")
def records(submissions, tmp_path_factory) -> dict[str, VerificationRecord]:
    folder = tmp_path_factory.mktemp("records")
    return {explorer: verify(path, folder / f"{explorer}.json") for explorer, path in submissions.items()}


@pytest.fixture
def honest(submissions, tmp_path: Path) -> Path:
    """A copy of the heuristic's submission that a test may change."""
    return shutil.copytree(submissions["heuristic"], tmp_path / "entry")


def stored(submission: Submission, name: str, pose: int, seed: int = 0) -> Rollout:
    rollout = submission.rollout(name, pose, seed)
    assert rollout is not None
    return rollout


def put(folder: Path, rollout: Rollout) -> None:
    rollout.save(folder / ROLLOUTS)


# --- Honest episodes -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("explorer", EXPLORERS)
def test_honest_episodes_reproduce_bit_for_bit(explorer: str, submissions, records) -> None:
    record, submission = records[explorer], read_submission(submissions[explorer])
    assert submission.info.control_mode == EXPLORERS[explorer]
    assert len(record.verdicts) == len(submission.episodes()) == 16 * len(submission.info.seeds)
    assert record.departed == () and record.mode == "bits" and record.content_hash == submission.content_hash
    assert "all" in record.summary()
    touched = 0
    for verdict in record.verdicts:
        rollout = stored(submission, *verdict.episode)
        assert np.array_equal(unpack_steps(verdict.touched), rollout.touched_step)
        touched += int(rollout.touched.sum())
    assert touched > 1000, "episodes without touches would prove little"


@pytest.mark.slow
def test_processes_do_not_change_the_verdicts(submissions, records, tmp_path: Path) -> None:
    assert verify(submissions["heuristic"], tmp_path / "r.json", processes=2) == records["heuristic"]


def test_honest_segments_are_within_tolerances(submissions, tmp_path: Path) -> None:
    for explorer, path in submissions.items():
        record = verify(path, tmp_path / f"{explorer}.json", Tolerances())
        assert record.departed == () and record.mode == "segments" and "tolerances" in record.summary()
        submission = read_submission(path)
        for verdict in record.verdicts:  # figures are the replay's, and near what was claimed
            claimed, felt = (
                stored(submission, *verdict.episode).touched.sum(),
                (unpack_steps(verdict.touched) >= 0).sum(),
            )
            assert abs(int(claimed) - int(felt)) <= max(0.4 * claimed, 5)


# --- Lies ------------------------------------------------------------------------------------------------------


def test_lies_are_found_and_named(honest: Path) -> None:
    """Every episode of seed 0 but two lies in its own way; one replay finds all of them and clears the rest."""
    truth = read_submission(honest)
    far = np.zeros((32, 32, 32), dtype=bool)
    far[2, 2, 2] = True

    def touched(rollout: Rollout, steps: np.ndarray) -> Rollout:
        return replace(rollout, touched=steps >= 0, touched_step=steps.astype(np.int16))

    def moved(rollout: Rollout, row: int, joint: int, by: float) -> Rollout:
        joints = rollout.joint_checkpoints.copy()
        joints[row, joint] += np.float32(by)
        return replace(rollout, joint_checkpoints=joints)

    def one_bit(rollout: Rollout) -> Rollout:
        actions = rollout.actions.copy()
        actions[100, 4] = np.nextafter(actions[100, 4], np.float32(0))
        assert not np.array_equal(actions, rollout.actions)
        return replace(rollout, actions=actions)

    def earlier(rollout: Rollout) -> Rollout:
        return touched(rollout, np.where(rollout.touched, rollout.touched_step // 2, -1))

    def as_named(rollout: Rollout, name: str, pose: int) -> Rollout:
        return replace(rollout, object=name, pose=pose, seed=0)

    own = {(name, pose): stored(truth, name, pose) for name in NAMES for pose in range(8)}
    some = np.argwhere(own["cubelarge", 2].touched)[0]
    shifted = own["cubelarge", 2].touched_step.copy()
    shifted[tuple(some)] += 1 if shifted[tuple(some)] < 199 else -1
    lies: dict[tuple[str, int], tuple[Rollout, str]] = {
        ("cubelarge", 1): (
            touched(own["cubelarge", 1], np.where(far, 50, own["cubelarge", 1].touched_step)),
            "touches",
        ),
        ("cubelarge", 2): (touched(own["cubelarge", 2], shifted), "touches"),
        ("cubelarge", 3): (replace(own["cubelarge", 3], actions=own["cubelarge", 4].actions), "joints"),
        ("cubelarge", 4): (as_named(own["cubelarge", 5], "cubelarge", 4), "start"),  # another pose's
        ("cubelarge", 5): (as_named(own["phone", 5], "cubelarge", 5), "joints|touches"),  # another object's
        ("cubelarge", 6): (moved(own["cubelarge", 6], 7, 12, 1e-3), "joints"),
        ("cubelarge", 7): (replace(own["cubelarge", 7], visited=own["cubelarge", 7].visited | far), "visited"),
        ("phone", 1): (as_named(stored(truth, "phone", 1, 1), "phone", 1), "start"),  # another seed's
        ("phone", 2): (one_bit(own["phone", 2]), "joints|touches"),
        ("phone", 3): (touched(own["phone", 3], np.full((32, 32, 32), -1)), "touches"),
        ("phone", 4): (earlier(own["phone", 4]), "touches"),
        ("phone", 5): (moved(own["phone", 5], 0, 0, 1e-6), "start"),
        ("phone", 6): (replace(own["phone", 6], actions=np.zeros_like(own["phone", 6].actions)), "joints"),
        ("phone", 7): (replace(own["phone", 7], actions=own["phone", 7].actions[::-1].copy()), "joints"),
    }
    for lie, _ in lies.values():
        put(honest, lie)
    record = verify(honest)
    verdicts = {(v.object, v.pose): v for v in record.verdicts if v.seed == 0}
    assert {key for key, verdict in verdicts.items() if verdict.departed} == set(lies)
    assert not any(verdict.departed for verdict in record.verdicts if verdict.seed == 1)
    for key, (_, expected) in lies.items():
        assert verdicts[key].departed in expected.split("|"), (key, verdicts[key])
    steps = {key: verdict.step for key, verdict in verdicts.items()}
    assert steps["cubelarge", 1] == 50 and steps["cubelarge", 3] <= 9 and steps["cubelarge", 6] == 69
    assert steps["cubelarge", 2] == min(shifted[tuple(some)], own["cubelarge", 2].touched_step[tuple(some)])
    assert steps["cubelarge", 4] is None and steps["cubelarge", 7] == 199
    assert 100 <= steps["phone", 2] <= 109, "an action of step 100 shows in the next checkpoint at the latest"
    assert steps["phone", 3] == own["phone", 3].touched_step[own["phone", 3].touched].min()
    # What was felt is the replay's, not the claim.
    assert (unpack_steps(verdicts["cubelarge", 1].touched)[far] == -1).all()
    assert "14 of 32 episodes do not reproduce" in record.summary() and "and 9 more" in record.summary()


def test_lies_beyond_the_tolerances_of_segments_are_found(honest: Path) -> None:
    truth = read_submission(honest)
    own = {pose: stored(truth, "phone", pose) for pose in range(8)}
    invented = np.full((32, 32, 32), -1, dtype=np.int16)
    invented[24:28, 24:28, 24:28] = 30
    invented[own[3].touched] = own[3].touched_step[own[3].touched]
    jumps = own[4].joint_checkpoints.copy()
    jumps[8, 0] += 0.1
    absurd = own[5].joint_checkpoints.copy()
    absurd[3:] = 1e30
    put(honest, replace(own[1], actions=own[2].actions))
    put(honest, replace(own[2], pose=0))
    put(honest, replace(own[3], touched=invented >= 0, touched_step=invented))
    put(honest, replace(own[4], joint_checkpoints=jumps))
    put(honest, replace(own[5], joint_checkpoints=absurd))
    record = verify(honest, segments=Tolerances())
    found = {verdict.episode: verdict.departed for verdict in record.departed}
    assert found == {
        ("phone", 0, 0): "start",
        ("phone", 1, 0): "joints",
        ("phone", 3, 0): "touches",
        ("phone", 4, 0): "joints",
        ("phone", 5, 0): "joints",
    }


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-200])


def _actions(value: float) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        arrays = dict(np.load(path))
        arrays["actions"][3, 4] = value
        np.savez_compressed(path, **arrays)

    return change


@pytest.mark.parametrize(
    ("lie", "message"),
    [(_truncate, "truncated"), (_actions(np.nan), "NaN"), (_actions(1.0001), "leave"), (_actions(-7), "leave")],
)
def test_files_that_are_no_rollouts_are_refused_in_one_line(lie, message: str, honest: Path, capsys) -> None:
    lie(honest / rollout_name("phone", 3, 0))
    with pytest.raises(SystemExit) as caught:
        main(["verify", str(honest)])
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("tslam-bench:")]
    assert caught.value.code == 2 and len(lines) == 1 and message in lines[0] and "pose3_seed0" in lines[0]
    assert not record_path(honest).exists()


def test_a_submission_without_rollouts_has_nothing_to_verify(honest: Path, tmp_path: Path) -> None:
    with SubmissionWriter(tmp_path / "empty", read_submission(honest).info):
        pass
    with pytest.raises(InvalidInputError, match="nothing to replay"):
        verify(tmp_path / "empty")
    with pytest.raises(InvalidInputError, match="inside the submission"):
        verify(honest, honest / "record.json")
    with pytest.raises(SystemExit) as caught:
        main(["verify", str(honest), "--processes", "0"])
    assert caught.value.code == 2


# --- Going on --------------------------------------------------------------------------------------------------


def test_a_verification_that_was_stopped_goes_on(honest: Path, records, cache: Path) -> None:
    class Stopped(Exception):
        pass

    def stop(done: int, total: int) -> None:
        if done == 16:
            raise Stopped

    with pytest.raises(Stopped):
        verify(honest, on_progress=stop)
    partial = VerificationRecord.read(record_path(honest))
    assert list(partial.assets) == ["cubelarge"]
    score = score_submission(honest, NAMES, cache=cache)
    assert not score.verified and any("phone is not replayed yet" in note for note in score.notes)
    events: list[tuple[int, int]] = []
    assert verify(honest, on_progress=lambda *event: events.append(event)) == records["heuristic"]
    assert events == [(16, 32), (32, 32)]
    put(honest, replace(stored(read_submission(honest), "phone", 3), pose=4))
    events.clear()
    assert len(verify(honest, on_progress=lambda *event: events.append(event)).departed) == 1
    assert events[0] == (0, 32), "a record of other files is not gone on with"


# --- Records and scores ----------------------------------------------------------------------------------------


def test_scores_are_those_of_the_replay(honest: Path, records, cache: Path, tmp_path: Path) -> None:
    before = score_submission(honest, NAMES, cache=cache)
    assert not before.verified and not any("replay" in note for note in before.notes)
    records["heuristic"].write(record_path(honest))
    verified = score_submission(honest, NAMES, cache=cache)
    assert verified.verified and verified.results == before.results and "all 32 episodes" in verified.notes[0]

    grown = stored(read_submission(honest), "phone", 0)
    steps = np.where(grown.touched_step < 0, np.int16(0), grown.touched_step)
    put(honest, replace(grown, touched=steps >= 0, touched_step=steps))  # claims to have touched everything at once
    claimed = score_submission(honest, NAMES, cache=cache)
    assert not claimed.verified and any("made for other files" in note for note in claimed.notes)
    record = verify(honest, tmp_path / "lie.json")
    score = score_submission(honest, NAMES, cache=cache, record=record)
    assert score.verified and "phone, pose 0, seed 0: touches depart by step 0" in score.notes[0]
    phone, honest_phone = score.results[2], before.results[2]
    assert (phone.object, phone.seed) == ("phone", 0)
    assert phone.poses["1"]["touched_surface_recall"] == 0 < honest_phone.poses["1"]["touched_surface_recall"]
    assert phone.poses["8"]["touched_surface_recall"] <= honest_phone.poses["8"]["touched_surface_recall"]
    assert set(phone.reasons.values()) == {"rollouts of poses 0 did not reproduce"} and phone.areas["iou_area"] == 0
    assert [score.results[k] for k in (0, 1, 3)] == [before.results[k] for k in (0, 1, 3)]


def test_records_that_were_not_made_here_of_these_files_are_not_believed(
    honest: Path, submissions, records, cache: Path, tmp_path: Path, capsys
) -> None:
    good, path = records["heuristic"], record_path(honest)
    good.write(path)
    content = json.loads(path.read_text())
    product = {**good.assets, "phone": "0" * 64}

    def forged(**changes: object) -> str:
        return json.dumps(content | changes)

    liars: dict[str, tuple[str | VerificationRecord, str]] = {
        "changed by hand": (forged(verdicts=content["verdicts"][:-1]), "not made here, or changed since"),
        "of other files by hand": (forged(content_hash="1" * 64), "not made here"),
        "without a seal": (json.dumps({k: v for k, v in content.items() if k != "seal"}), "not a verification record"),
        "with a seal of its own": (forged(seal="0" * 64), "not made here"),
        "of another version": (forged(record_version=0), "another version"),
        "no record": ("[1, 2]", "not a verification record"),
        "no JSON": ("{", "not a verification record"),
        "too deep": ("[" * 100_000, "not a verification record"),
        "of other assets": (replace(good, assets=product), "other assets"),
        "with an episode less": (replace(good, verdicts=good.verdicts[:-1]), "not one verdict for each rollout"),
        "with an episode twice": (replace(good, verdicts=(*good.verdicts, good.verdicts[-1])), "not one verdict"),
        "of another submission": (records["random_targets"], "made for other files"),
    }
    for name, (liar, message) in liars.items():
        if isinstance(liar, str):
            path.write_text(liar)
        else:
            liar.write(path)
        score = score_submission(honest, NAMES, cache=cache)
        assert not score.verified and message in score.notes[0], (name, score.notes)
        named = path.rename(tmp_path / "named.json")  # given by name, it is refused
        with pytest.raises(SystemExit) as caught:
            main(["score", str(honest), "--objects", *NAMES, "--verification", str(named)])
        assert caught.value.code == 2 and "\n" not in capsys.readouterr().err.strip().splitlines()[-1], name
    good.write(tmp_path / "named.json")
    main(["score", str(honest), "--objects", *NAMES, "--verification", str(tmp_path / "named.json"), "--json"])
    assert json.loads(capsys.readouterr().out)["verified"] is True
    (cache / KEY_FILE).rename(cache / "away")  # another machine, or another user
    try:
        with pytest.raises(InvalidInputError, match="not made here"):
            VerificationRecord.read(tmp_path / "named.json")
    finally:
        (cache / "away").rename(cache / KEY_FILE)


def test_the_key_is_the_user_s_alone(records, cache: Path) -> None:
    assert (cache / KEY_FILE).stat().st_mode & 0o777 == 0o600 and len((cache / KEY_FILE).read_bytes()) == 32


def test_the_command_names_what_departs(honest: Path, capsys) -> None:
    main(["verify", str(honest)])
    assert f"{record_path(honest)}: 32 of 32 episodes reproduce" in capsys.readouterr().out
    put(honest, replace(stored(read_submission(honest), "phone", 3), pose=4))
    with pytest.raises(SystemExit) as caught:
        main(["verify", str(honest), "--json"])
    verdicts = json.loads(capsys.readouterr().out)["episodes"]
    assert caught.value.code == 1
    assert [v for v in verdicts if v["departed"]] == [
        {"object": "phone", "pose": 4, "seed": 0, "departed": "start", "step": None}
    ]


def test_touches_are_packed_and_come_back() -> None:
    generator = np.random.default_rng(0)
    for share in (0.0, 0.01, 1.0):
        chosen = generator.random((32, 32, 32)) < share
        steps = np.where(chosen, generator.integers(0, 200, (32, 32, 32)), -1).astype(np.int16)
        assert np.array_equal(unpack_steps(pack_steps(steps)), steps)
    for broken in ("?", "", pack_steps(steps)[:-8], pack_steps(np.full((32, 32, 32), 250, np.int16))):
        with pytest.raises(BenchmarkError, match="run verify again"):
            unpack_steps(broken)
