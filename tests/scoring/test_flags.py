"""Flags: right where nothing was felt, and copies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from prepared_shapes import prepared_box, surface_grid
from scored_run import info

from tslam_bench import grids
from tslam_bench.constants import VOXEL_EDGE
from tslam_bench.reconstruction.hull import HullReconstructor
from tslam_bench.scoring.flags import (
    ceiling_flags,
    copy_flags,
    grid_ceiling,
    right_where_unfelt,
    unfelt_flags,
    unfelt_surface,
)
from tslam_bench.scoring.measure import Truth, score_seeds
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
        evidence = [e for _, e in score_seeds(entry(tmp_path / str(honest), box, honest), truth)]
        shares = [e.right for e in evidence]
        assert all(share is not None for share in shares)
        assert bool(unfelt_flags(shares)) is not honest, shares
        assert bool(ceiling_flags(evidence)) is not honest, [e.excess for e in evidence]


def retouched(folder: Path, box) -> Submission:
    """The second seed is the first with other last digits, in files of other bytes: actions and shapes alike."""
    submission = entry(folder, box, honest=True)
    generator = np.random.default_rng(1)
    for pose in EXPLORATION_ORDER:
        own = submission.rollout(box.name, pose, 0)
        assert own is not None
        noise = generator.uniform(-1e-3, 1e-3, own.actions.shape).astype(np.float32)
        replace(own, seed=1, actions=np.clip(own.actions + noise, -1, 1)).save(folder / "rollouts")
    for count in RECONSTRUCTED_POSES:
        first, second = (folder / f"reconstructions/{box.name}_{count}_seed{seed}.npz" for seed in (0, 1))
        np.savez(second, **dict(np.load(first)))  # not compressed
    return read_submission(folder, objects=[box.name])


def test_copies_are_flagged(tmp_path: Path, box) -> None:
    truth = Truth.of(box)

    def found(submission: Submission) -> list[str]:
        scored = score_seeds(submission, truth)
        return copy_flags([score for score, _ in scored], [e for _, e in scored])

    assert found(entry(tmp_path / "good", box, True)) == []
    same_shape = "flag: one shape after 8 poses of different rollouts: box, seed 0; box, seed 1"
    assert found(entry(tmp_path / "same shape", box, False)) == [same_shape]
    for lines in (found(entry(tmp_path / "copied", box, True, True)), found(retouched(tmp_path / "retouched", box))):
        assert len(lines) == 17 and lines[-1] == same_shape
        assert "flag: the same actions in several episodes: box, seed 0, pose 0; box, seed 1, pose 0" in lines
        assert "flag: the same touches in several episodes: box, seed 0, pose 0; box, seed 1, pose 0" in lines


def test_what_a_grid_holds(box, sphere) -> None:
    """A box whose faces lie on cell faces is held exactly; a ball nearly; a wall much thinner than a cell is not."""
    exact = prepared_box((0.125, 0.0625, 0.0625))
    assert grid_ceiling(exact.solid_at_iou_points, exact.iou_points()) > 0.99
    assert 0.9 < grid_ceiling(sphere.solid_at_iou_points, sphere.iou_points()) < 0.99
    points = sphere.iou_points()
    radius = np.linalg.norm(points.points, axis=1)
    shell = sphere.solid_at_iou_points & (radius > 0.048)
    assert grid_ceiling(shell, points) < 0.5 < grid_ceiling(shell, points, 128)
