"""Flags: right where nothing was felt, and copies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from prepared_shapes import surface_grid
from scored_run import info

from tslam_bench import grids
from tslam_bench.constants import VOXEL_EDGE
from tslam_bench.reconstruction.hull import HullReconstructor
from tslam_bench.scoring.flags import copy_flags, right_where_unfelt, unfelt_flags, unfelt_surface
from tslam_bench.scoring.measure import Truth, score_object, score_seeds
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.scoring.submission import (
    EXPLORATION_ORDER,
    RECONSTRUCTED_POSES,
    Submission,
    SubmissionWriter,
    read_submission,
)


def half_explored(box, pose: int, seed: int) -> Rollout:
    """Touches a random third of the surface voxels of the object's lower x half."""
    generator = np.random.default_rng([pose, seed])
    lower = surface_grid(box) & (grids.voxel_centres()[..., 0] < 0)
    touched = grids.object_to_world(lower & (generator.random(lower.shape) < 0.3), pose)
    steps = np.where(touched, generator.integers(0, 200, touched.shape), -1).astype(np.int16)
    actions = generator.uniform(-1, 1, (200, 28)).astype(np.float32)
    return Rollout(box.name, pose, seed, actions, touched, ~touched, steps, np.zeros((21, 28), np.float32))


def entry(folder: Path, box, honest: bool, copied: bool = False) -> Submission:
    """Two seeds: hulls of what was touched, or the true mesh; ``copied``: the second seed is the first."""
    truth = trimesh.Trimesh(box.vertices, box.faces, process=False)
    with SubmissionWriter(folder, info("mine", "mine", seeds=(0, 1))) as writer:
        for seed in (0, 1):
            own = {pose: half_explored(box, pose, 0 if copied else seed) for pose in EXPLORATION_ORDER}
            for rollout in own.values():
                writer.add_rollout(replace(rollout, seed=seed))
            for count, poses in RECONSTRUCTED_POSES.items():
                touched = grids.merge(grids.world_to_object(own[pose].touched, pose) for pose in poses)
                shape = HullReconstructor(32).reconstruct(touched, ~touched) if honest else truth
                writer.add_reconstruction(box.name, count, seed, shape)
    return read_submission(folder, objects=[box.name])


def test_unfelt_surface_by_brute_force(box) -> None:
    touched = np.zeros((32, 32, 32), dtype=bool)
    touched[4:28, 12, 20] = True
    points = box.surface_points[:500]
    index = np.floor((points + 0.125) / VOXEL_EDGE).astype(int)
    apart = np.linalg.norm(index[:, None] - np.argwhere(touched)[None], axis=-1).min(axis=1)
    assert np.array_equal(unfelt_surface(touched, points), apart > 3)
    assert unfelt_surface(np.zeros_like(touched), points).all()


def test_shares_of_the_unfelt_surface() -> None:
    unfelt = np.arange(100) < 40
    near = np.where(np.arange(100) < 10, 0.0099, 0.0101)
    assert right_where_unfelt(unfelt, near) == pytest.approx(0.25)
    assert right_where_unfelt(np.arange(100) < 9, near) is None, "nearly all was felt: no figure"
    assert unfelt_flags([]) == unfelt_flags([None]) == unfelt_flags([0.1, None, 0.2]) == []
    assert len(unfelt_flags([0.9, None, 0.8])) == 1


def test_the_true_shape_from_half_of_the_touches_is_flagged_and_an_honest_hull_is_not(tmp_path: Path, box) -> None:
    truth = Truth.of(box)
    for honest in (True, False):
        shares = [share for _, share in score_seeds(entry(tmp_path / str(honest), box, honest), truth)]
        assert all(share is not None for share in shares)
        assert bool(unfelt_flags(shares)) is not honest, shares


def test_copies_are_flagged(tmp_path: Path, box) -> None:
    truth = Truth.of(box)
    found = {}
    for name, honest, copied in (("good", True, False), ("same shape", False, False), ("copied", True, True)):
        submission = entry(tmp_path / name, box, honest, copied)
        found[name] = copy_flags(submission, score_object(submission, truth))
    assert found["good"] == []
    assert found["same shape"] == ["flag: one shape after 8 poses of different rollouts: box, seed 0; box, seed 1"]
    assert (
        len(found["copied"]) == 9
        and "flag: one rollout under several names: box, seed 0, pose 0; box, seed 1, pose 0" in found["copied"]
    )
