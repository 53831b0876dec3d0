"""Scoring end to end on objects made from primitives: known answers, missing pieces, frames."""

from __future__ import annotations

import shutil
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from prepared_shapes import surface_grid

from tslam_bench import __version__, grids
from tslam_bench.constants import HORIZON, WORKSPACE_EDGE
from tslam_bench.errors import InvalidInputError
from tslam_bench.objects import store
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring import metrics
from tslam_bench.scoring.info import SubmissionInfo
from tslam_bench.scoring.measure import (
    SHAPE_METRICS,
    Truth,
    implausible_touches,
    merge_touched_steps,
    score_object,
    score_reconstruction,
)
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.scoring.score_file import aggregate
from tslam_bench.scoring.submission import (
    EXPLORATION_ORDER,
    RECONSTRUCTED_POSES,
    Submission,
    SubmissionWriter,
    read_submission,
)

INFO = SubmissionInfo(
    method="Test",
    explorer="test",
    reconstructor="truth",
    authors=("A",),
    asset_manifest_sha256="0" * 64,
    seeds=(0, 1),
    object_set="quick",
    privileged=False,
    package_version=__version__,
)


ALL_MESHES = tuple(f"reconstructions/box_{count}_seed0.ply" for count in RECONSTRUCTED_POSES)


@pytest.fixture(scope="module")
def truth(box) -> Truth:
    return Truth.of(box)


def explored(box, pose: int, share: float, seed: int) -> Rollout:
    """A random share of the surface voxels."""
    generator = np.random.default_rng([pose, seed])
    world = grids.object_to_world(surface_grid(box), pose)
    touched = world & (generator.random(world.shape) < share)
    actions = generator.uniform(-1, 1, (200, 28)).astype(np.float32)
    steps = np.where(touched, generator.integers(0, 200, world.shape), -1).astype(np.int16)
    return Rollout(box.name, pose, seed, actions, touched, ~world, steps, np.zeros((21, 28), np.float32))


def submission(folder: Path, box, info: SubmissionInfo = INFO, skip: tuple[str, ...] = ()) -> Submission:
    """All of one object; ``skip`` names files to leave out."""
    mesh = trimesh.Trimesh(box.vertices, box.faces)
    with SubmissionWriter(folder, info) as writer:
        for seed in info.seeds:
            for pose in range(8):
                writer.add_rollout(explored(box, pose, 0.1, seed))
            for protocol in RECONSTRUCTED_POSES:
                writer.add_reconstruction(box.name, protocol, seed, mesh)
    for name in skip:
        (folder / name).unlink()
    return read_submission(folder, objects=[box.name])


# --- One reconstruction ----------------------------------------------------------------------------------------


def test_the_truth_scores_full_marks(truth: Truth, box) -> None:
    values, reason = score_reconstruction(trimesh.Trimesh(box.vertices, box.faces), truth)
    assert reason is None
    assert values["calibration_error"] is values["brier"] is None  # a mesh claims no probability
    assert values["iou"] == values["iou_raw"] == values["f_score_1"] == values["f_score_2"] == 1
    area = trimesh.Trimesh(box.vertices, box.faces).area / WORKSPACE_EDGE**2
    assert values["chamfer_l2"] == pytest.approx(area / (np.pi * 100_000), rel=0.05)
    assert values["normal_consistency"] > 0.99


def test_a_translated_box(truth: Truth, box) -> None:
    """IoU = (l - d) / (l + d). The faces that slide in their own plane stay where they are but for a rim; the two faces
    across the shift are d away: bounds on Chamfer-L1."""
    shift = 0.01
    mesh = trimesh.Trimesh(box.vertices + np.array([shift, 0, 0]), box.faces)
    values, _ = score_reconstruction(mesh, truth)
    length, width, height = np.ptp(box.vertices, axis=0)
    assert values["iou"] == pytest.approx((length - shift) / (length + shift), abs=0.01)  # two deviations
    share_across = 2 * width * height / mesh.area
    assert share_across * shift / WORKSPACE_EDGE < values["chamfer_l1"] < shift / WORKSPACE_EDGE


def test_an_empty_reconstruction_scores_the_worst(truth: Truth, box) -> None:
    share = np.ptp(box.vertices, axis=0).prod() / WORKSPACE_EDGE**3
    calibrations = {
        "missing": (1, 1),
        "nothing is solid": (pytest.approx(share, rel=0.02), pytest.approx(share, rel=0.02)),
        "outside the workspace": (None, None),
    }
    for nothing, reason in zip(
        (None, Volume(np.zeros((4, 4, 4))), trimesh.creation.box(extents=[2, 2, 2])), calibrations, strict=True
    ):
        values, found = score_reconstruction(nothing, truth)
        assert {name: values[name] for name in SHAPE_METRICS} == SHAPE_METRICS
        assert (values["calibration_error"], values["brier"]) == calibrations[reason]
        assert reason in (found or "")
    assert SHAPE_METRICS["chamfer_l2"] == pytest.approx(3) and SHAPE_METRICS["chamfer_l1"] == pytest.approx(3**0.5)


def test_calibration_of_a_volume(truth: Truth, box) -> None:
    """The true voxels at probability 0.8, the rest at 0.1: Brier score and calibration error by hand."""
    solid = Volume(box.solid.astype(np.float32), "nearest")
    values, _ = score_reconstruction(Volume(np.where(box.solid, 0.8, 0.1), "nearest"), truth)
    weights, true = truth.iou_points.weights, box.solid_at_iou_points
    claimed = solid.query(truth.iou_points.points) == 1
    share = [weights[claimed == side] @ true[claimed == side] / weights[claimed == side].sum() for side in (0, 1)]
    volume = weights[claimed].sum() / weights.sum()
    assert 0.01 < volume < 1 / 15  # so the claimed points are in the last bin, together with some of the others
    last = 1 / 15
    expected = (1 - last) * abs(0.1 - share[0]) + abs(volume * (0.8 - share[1]) + (last - volume) * (0.1 - share[0]))
    assert values["calibration_error"] == pytest.approx(expected, rel=1e-4)
    brier = volume * (share[1] * 0.04 + (1 - share[1]) * 0.64) + (1 - volume) * (
        share[0] * 0.81 + (1 - share[0]) * 0.01
    )
    assert values["brier"] == pytest.approx(brier, rel=1e-4)


def test_worse_shapes_score_worse(truth: Truth, box) -> None:
    scores = []
    for factor in (1.0, 1.1, 1.3, 1.6):
        values, _ = score_reconstruction(trimesh.Trimesh(box.vertices * factor, box.faces), truth)
        scores.append(values)
    assert np.all(np.diff([s["iou"] for s in scores]) < 0)
    assert np.all(np.diff([s["chamfer_l2"] for s in scores]) > 0)
    assert np.all(np.diff([s["f_score_2"] for s in scores]) <= 0)
    assert scores[2]["iou"] == pytest.approx(1 / 1.3**3, abs=0.01)


# --- One object of a submission --------------------------------------------------------------------------------


def test_complete_submission(tmp_path: Path, truth: Truth, box) -> None:
    results = score_object(submission(tmp_path / "s", box), truth)
    assert [r.seed for r in results] == [0, 1]
    for result in results:
        assert result.missing == [] and result.implausible_touches == 0
        assert set(result.reasons.values()) == {None}
        assert result.areas["iou_area"] == 1
        assert [result.poses[n]["iou"] for n in ("1", "2", "4", "8")] == [1, 1, 1, 1]
        recalls = [result.poses[n]["touched_surface_recall"] for n in ("1", "2", "4", "8")]
        assert np.all(np.diff(np.array(recalls, dtype=float)) > 0)
        # The curve every 10 steps passes through the values after 1, 2, 4 and 8 poses.
        assert len(result.recall_curve) == len(result.surface_iou_curve) == 161
        assert np.array(result.recall_curve)[[20, 40, 80, 160]] == pytest.approx(recalls, abs=1e-5)
        surface = [result.poses[n]["surface_iou"] for n in ("1", "2", "4", "8")]
        assert np.array(result.surface_iou_curve)[[20, 40, 80, 160]] == pytest.approx(surface, abs=1e-5)
        assert result.areas["exploration_area"] == pytest.approx(np.mean(result.recall_curve), abs=0.01)


def test_poses_are_turned_back_before_they_are_merged(tmp_path: Path, truth: Truth, box) -> None:
    """Touched voxels of every pose land on the object; merged by hand from the definition of a pose."""
    result = score_object(submission(tmp_path / "s", box), truth)[0]
    touched = np.zeros((32, 32, 32), dtype=bool)
    centres = grids.voxel_centres()
    for pose in EXPLORATION_ORDER[:4]:
        world = explored(box, pose, 0.1, 0).touched
        touched |= grids.points_to_grid(centres[world] @ grids.pose_rotation(pose))  # rows: R^T p
    assert result.poses["4"]["surface_iou"] == pytest.approx(metrics.iou(touched, box.surface))
    assert result.poses["4"]["touched_surface_recall"] == pytest.approx(truth.coverage.recall(touched))


def test_first_touch_counts_and_missing_poses_take_their_time(tmp_path: Path, box) -> None:
    source = submission(tmp_path / "s", box)
    rollouts = {pose: source.rollout(box.name, pose, 0) for pose in EXPLORATION_ORDER}
    merged = merge_touched_steps({**rollouts, EXPLORATION_ORDER[0]: None})
    assert merged[merged >= 0].min() >= HORIZON
    assert merged.max() < 8 * HORIZON
    voxel = np.argwhere(merged >= 0)[0]
    first = None
    for position, pose in enumerate(EXPLORATION_ORDER):
        if position == 0:
            continue
        world = grids.pose_rotation(pose) @ (voxel - 15.5) + 15.5
        step = rollouts[pose].touched_step[tuple(world.round().astype(int))]
        if step >= 0:
            first = position * HORIZON + step
            break
    assert merged[tuple(voxel)] == first


def test_missing_reconstruction_counts_as_empty(tmp_path: Path, truth: Truth, box) -> None:
    results = score_object(submission(tmp_path / "s", box, skip=("reconstructions/box_8_seed1.ply",)), truth)
    assert results[0].poses["8"]["iou"] == 1
    assert results[1].poses["8"]["iou"] == 0
    assert results[1].poses["8"]["chamfer_l2"] == pytest.approx(3)
    assert results[1].reasons == {"1": None, "2": None, "4": None, "8": "missing"}
    assert results[1].missing == ["reconstruction of 8 poses"]
    assert (results[0].areas["iou_area"], results[1].areas["iou_area"]) == (1, 0.75)
    estimates = aggregate(results, 1)
    assert estimates["8"]["iou"].mean == 0.5 and estimates["areas"]["iou_area"].mean == 0.875
    assert "calibration_error" not in estimates["8"]  # the others are meshes


def test_reconstruction_without_its_rollouts_counts_as_empty(tmp_path: Path, truth: Truth, box) -> None:
    """Pose 1 is in the 8-pose protocol only."""
    result = score_object(submission(tmp_path / "s", box, skip=("rollouts/box/pose1_seed0.npz",)), truth)[0]
    assert result.poses["4"]["iou"] == 1
    assert result.poses["8"]["iou"] == 0
    assert result.reasons["8"] == "rollouts of poses 1 are missing"
    assert result.missing == ["rollout of pose 1"]


def test_all_four_reconstructions_are_required(tmp_path: Path, truth: Truth, box) -> None:
    skip = ("reconstructions/box_1_seed0.ply", "reconstructions/box_2_seed0.ply")
    result = score_object(submission(tmp_path / "s", box, skip=skip), truth)[0]
    assert result.missing == ["reconstruction of 1 pose", "reconstruction of 2 poses"]
    assert [result.poses[n]["iou"] for n in ("1", "2", "4", "8")] == [0, 0, 1, 1]
    assert result.areas["iou_area"] == 0.5


def test_reference_without_rollouts_is_scored_by_shape_only(tmp_path: Path, truth: Truth, box) -> None:
    info = replace(INFO, explorer="oracle", privileged=True, seeds=(0,))
    with SubmissionWriter(tmp_path / "s", info) as writer:
        writer.add_reconstruction("box", 8, 0, Volume(box.solid.astype(np.float32), "nearest"))
    result = score_object(read_submission(tmp_path / "s", objects=["box"]), truth)[0]
    assert result.poses["8"]["iou"] == pytest.approx(metrics.iou(box.solid, box.solid), abs=0.2)
    assert result.poses["8"]["surface_iou"] is None
    assert result.areas["exploration_area"] is None
    estimates = aggregate([result], 1)
    assert "surface_iou" not in estimates["8"] and "iou" in estimates["8"] and set(estimates["areas"]) == {"iou_area"}


def test_touches_far_from_the_object_are_found(box) -> None:
    near = surface_grid(box)
    assert implausible_touches(near, box) == 0
    far = np.zeros((32, 32, 32), dtype=bool)
    far[0, 0, 0] = far[31, 16, 16] = True  # outside the field's padding
    far[16, 16, 16] = True  # deep inside the box
    assert implausible_touches(far, box) == 1
    assert implausible_touches(near | far, box) == pytest.approx(3 / (near.sum() + 3))
    assert implausible_touches(np.zeros_like(far), box) == 0
    # One voxel beyond the touching layer is already too far along a face normal.
    shifted = np.zeros_like(near)
    top = np.argwhere(near[16, 16]).max()
    shifted[16, 16, min(top + 3, 31)] = True
    assert implausible_touches(shifted, box) == 1


def test_equal_reconstructions_are_scored_once_and_alike(tmp_path: Path, truth: Truth, box) -> None:
    """Alternating volumes against what each scores alone."""
    other = Volume(np.roll(box.solid, 2, axis=0).astype(np.float32), "nearest")
    volumes = {n: other if n == 2 else Volume(box.solid.astype(np.float32), "nearest") for n in RECONSTRUCTED_POSES}
    source = submission(tmp_path / "s", box, info=replace(INFO, seeds=(0,)), skip=ALL_MESHES)
    with SubmissionWriter(tmp_path / "s", source.info) as writer:
        for count, volume in volumes.items():
            writer.add_reconstruction(box.name, count, 0, volume)
    result = score_object(read_submission(tmp_path / "s", objects=[box.name]), truth)[0]
    for count, volume in volumes.items():
        expected, _ = score_reconstruction(volume, truth)
        assert {name: result.poses[str(count)][name] for name in expected} == expected
    assert result.poses["1"]["iou"] == result.poses["8"]["iou"] != result.poses["2"]["iou"]


def test_scoring_is_deterministic(tmp_path: Path, truth: Truth, box) -> None:
    source = submission(tmp_path / "s", box)
    assert score_object(source, truth) == score_object(source, truth)


# --- What is hashed is what is scored --------------------------------------------------------------------------


def test_a_submission_that_changes_before_it_is_scored_is_refused(tmp_path: Path, truth: Truth, box) -> None:
    """Another good rollout in the place of one that was hashed, between reading and scoring."""
    source = submission(tmp_path / "s", box)
    explored(box, 3, 0.5, 1).save(tmp_path / "s" / "rollouts")
    with pytest.raises(InvalidInputError, match=r"rollouts/box/pose3_seed1\.npz changed while it was read"):
        score_object(source, truth)
    again = read_submission(tmp_path / "s", objects=[box.name])
    assert again.content_hash != source.content_hash and score_object(again, truth)
    shutil.rmtree(tmp_path / "s")
    with pytest.raises(InvalidInputError, match="cannot be read"):
        score_object(again, truth)


# --- A core without simulator ----------------------------------------------------------------------------------

SCORE = """
import importlib, pkgutil, sys

class Without:
    def __init__(self, finder):
        self.finder = finder
    def find_spec(self, name, *arguments):
        return None if name.partition(".")[0] in HIDDEN else self.finder.find_spec(name, *arguments)
    def __getattr__(self, name):
        return getattr(self.finder, name)

sys.meta_path[:] = [Without(finder) for finder in sys.meta_path]
import tslam_bench.leaderboard, tslam_bench.scoring
for package in (tslam_bench.leaderboard, tslam_bench.scoring):
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"{package.__name__}.{module.name}")
from pathlib import Path
from tslam_bench.leaderboard.pictures import Picture, draw
from tslam_bench.objects.store import load_object
from tslam_bench.scoring.scoring import score_submission
from tslam_bench.scoring.submission import read_submission
folder, cache = map(Path, sys.argv[1:])
submission = read_submission(folder)
score = score_submission(submission, ["mug"], cache=cache)
if "embreex" not in HIDDEN:
    assert draw(Picture("touched", "mug", submission), load_object("mug", cache=cache))
assert not HIDDEN & {name.partition(".")[0] for name in sys.modules}
print(score.results[0].poses["8"]["iou"])
"""
SIMULATION = {"torch", "sapien", "mani_skill", "stable_baselines3", "tensorboard", "mujoco", "safetensors"}
PREPARATION = {"coacd", "manifold3d", "collada", "lxml", "skimage", "networkx", "rtree"}


@pytest.mark.parametrize("kind", ["volume", "mesh"])
def test_scoring_and_the_page_need_few_packages(tmp_path: Path, box, kind: str) -> None:
    """A fresh interpreter without simulator, networks and preparation; volumes need no libigl and no ray caster either."""
    mug = replace(box, name="mug")
    mesh = trimesh.Trimesh(box.vertices, box.faces, process=False)
    _, _, faces = trimesh.proximity.closest_point(mesh, box.surface_points[:1])
    store.write(mug, np.full(100_000, faces[0]), tmp_path / "cache")
    with SubmissionWriter(tmp_path / "s", replace(INFO, seeds=(0,))) as writer:
        for pose in range(8):
            writer.add_rollout(explored(mug, pose, 0.1, 0))
        for count in RECONSTRUCTED_POSES:
            solid = mesh if kind == "mesh" else Volume(box.solid.astype(np.float32), "nearest")
            writer.add_reconstruction("mug", count, 0, solid)
    hidden = SIMULATION | PREPARATION | ({"igl", "embreex"} if kind == "volume" else set())
    command = [sys.executable, "-c", f"HIDDEN = {hidden}" + SCORE, str(tmp_path / "s"), str(tmp_path / "cache")]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert float(result.stdout) > 0.8


def test_scoring_goes_on_where_the_system_refuses_processes() -> None:
    """A daemonic process of a pool, and a limit on open files: one worker instead of two, said once."""
    code = """
        import multiprocessing, os, resource, warnings
        from tslam_bench.scoring.scoring import worker_pool

        def work(what):
            warnings.simplefilter("always")
            with warnings.catch_warnings(record=True) as caught, worker_pool(2) as pool:
                print(*pool.map(abs, [-1, -2]), *pool.map(pow, [2, 3], [3, 2]), [str(w.message)[:40] for w in caught])

        if __name__ == "__main__":
            child = multiprocessing.get_context("fork").Process(target=work, args=("daemon",), daemon=True)
            child.start()
            child.join()
            used = len(os.listdir("/proc/self/fd"))
            resource.setrlimit(resource.RLIMIT_NOFILE, (used + 1, used + 1))
            work("files")
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=60)
    assert done.stdout.splitlines() == [
        "1 2 8 9 ['this is a daemonic process, which may st']",
        "1 2 8 9 ['the system refuses worker processes ([Er']",
    ], done.stderr
