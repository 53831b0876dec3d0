"""Episodes step by step: the same bits as an evaluation's, and honest about what was not simulated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tslam_bench.evaluation.playback import play, replay_motions
from tslam_bench.evaluation.policies import make_baseline
from tslam_bench.evaluation.rollouts import roll_out_batch
from tslam_bench.hand_constants import SKIN_LINKS
from tslam_bench.registration import make_vec
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.viewing.motion import Motion

EPISODES = [("mug", 0, 0), ("mug", 5, 0)]


@pytest.fixture(scope="module")
def played() -> list[tuple[Rollout, Motion]]:
    return play(make_baseline("heuristic"), EPISODES, "ab", "test")


def test_rollouts_are_those_of_an_evaluation(played: list[tuple[Rollout, Motion]]) -> None:
    policy = make_baseline("heuristic")
    envs = make_vec(
        "TactileSLAM-v0", 2, "cpu", objects=["mug"], split="test", control_mode=policy.control_mode, processes=1
    )
    try:
        expected = roll_out_batch(envs, policy, EPISODES, "ab")
    finally:
        envs.close()
    for (rollout, motion), other in zip(played, expected, strict=True):
        assert rollout.to_bytes() == other.to_bytes()
        assert rollout.touched.any() and motion.source == "live"
        assert np.array_equal(motion.joints[::10], rollout.joint_checkpoints)


def test_links_touch_when_voxels_are_touched(played: list[tuple[Rollout, Motion]]) -> None:
    for rollout, motion in played:
        assert motion.touch is not None and motion.touch.shape == (200, len(SKIN_LINKS))
        new = np.unique(rollout.touched_step[rollout.touched])
        assert motion.touch[new].any(axis=1).all()  # a voxel becomes touched only when some link touches
        assert not motion.touch[: new.min()].any()


@pytest.mark.parametrize("told", [True, False])
def test_a_replay_gives_every_step(played: list[tuple[Rollout, Motion]], told: bool) -> None:
    mode = make_baseline("heuristic").control_mode if told else ""
    for (_, live), motion in zip(played, replay_motions([r for r, _ in played], mode, "test"), strict=True):
        assert motion.source == "replayed" and "bit for bit" in motion.note
        assert np.array_equal(motion.joints, live.joints)
        assert live.touch is not None and motion.touch is not None and np.array_equal(motion.touch, live.touch)


def test_what_departs_is_shown_as_its_file_says(played: list[tuple[Rollout, Motion]]) -> None:
    rollout = played[0][0]
    moved = rollout.joint_checkpoints.copy()
    moved[7:, 0] += 0.01
    (motion,) = replay_motions(
        [replace(rollout, joint_checkpoints=moved)], make_baseline("heuristic").control_mode, "test"
    )
    assert motion.source == "interpolated" and "other joint positions, by step 70" in motion.note
    assert np.array_equal(motion.joints[::10], moved) and motion.touch is None
    np.testing.assert_allclose(motion.joints[5], (moved[0] + moved[1]) / 2, atol=1e-6)


def test_an_object_that_is_not_prepared_is_played_from_its_file(
    played: list[tuple[Rollout, Motion]], monkeypatch, tmp_path
):
    monkeypatch.setenv("TSLAM_BENCH_CACHE", str(tmp_path))
    (motion,) = replay_motions([played[0][0]], "", "test")
    assert motion.source == "interpolated" and "not prepared" in motion.note
