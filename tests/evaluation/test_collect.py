"""Collected episodes are those that a policy plays."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import tslam_bench
from tslam_bench.constants import ENVIRONMENT_ID
from tslam_bench.evaluation.collect import COLLECTION_SALT, FIRST_SEED, collect_episodes
from tslam_bench.evaluation.policies import make_baseline
from tslam_bench.evaluation.rollouts import roll_out_batch
from tslam_bench.grids import world_to_object
from tslam_bench.objects.splits import prepared_names
from tslam_bench.reconstruction.touch_data import NEVER, ExploredObject


def test_collected_episodes_are_those_that_the_policy_plays(tmp_path: Path) -> None:
    names = prepared_names("train")[:1]
    collect_episodes("random_targets", names, "train", tmp_path, processes=0)
    found = ExploredObject.load(tmp_path, names[0])
    assert found.poses.tolist() == list(range(8))

    envs = tslam_bench.make_vec(
        ENVIRONMENT_ID, 1, "cpu", objects=names, split="train", control_mode="pd_joint_pos", processes=0
    )
    (rollout,) = roll_out_batch(envs, make_baseline("random_targets"), [(names[0], 5, FIRST_SEED)], COLLECTION_SALT)
    envs.close()
    first = found.first[5]
    assert rollout.touched.any()
    assert np.array_equal(first[0] != NEVER, world_to_object(rollout.touched, 5))
    assert np.array_equal(first[1] != NEVER, world_to_object(rollout.visited, 5))
    steps = world_to_object(rollout.touched_step, 5)
    assert np.array_equal(first[0][steps >= 0], steps[steps >= 0])

    before = (tmp_path / f"{names[0]}.npz").read_bytes()
    collect_episodes("random_targets", names, "train", tmp_path, processes=0)  # nothing is missing
    assert (tmp_path / f"{names[0]}.npz").read_bytes() == before
