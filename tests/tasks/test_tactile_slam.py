"""TactileSLAM-v0 on real objects: start, touch audit, drives, bad input. What holds for every id is in test_environments."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

import tslam_bench
from tslam_bench import grids
from tslam_bench.constants import ENVIRONMENT_ID, HORIZON, NUM_JOINTS, QUICK_TRAIN_OBJECTS, TRAIN_OBJECTS, VOXEL_EDGE
from tslam_bench.engine.arrays import NumpyBackend
from tslam_bench.engine.control import END, MIDDLE, DriveTargets
from tslam_bench.engine.hand_batch import BatchSettings
from tslam_bench.engine.rendering import vulkan_device_available
from tslam_bench.errors import InvalidInputError
from tslam_bench.files import package_data
from tslam_bench.hand_constants import (
    COUPLING_END,
    COUPLING_MIDDLE,
    COUPLING_SLACK,
    DELTA_STEP,
    JOINT_LIMITS,
    SKIN_LINKS,
)
from tslam_bench.objects.splits import OBJECTS, prepared_names
from tslam_bench.objects.store import load_object

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from penetration import pressing_audits


def pressing_actions(seed: int, steps: int = HORIZON) -> np.ndarray:
    generator = np.random.Generator(np.random.PCG64(seed))
    actions = generator.uniform(-1, 1, (steps, NUM_JOINTS)).astype(np.float32)
    actions[:60, 1] = -1.0  # down onto the object
    return actions


def roll(environment: gym.Env, seed: int, options: dict | None = None, steps: int = HORIZON) -> str:
    """SHA-256 of everything an episode returns."""
    digest = hashlib.sha256()
    observation, _ = environment.reset(seed=seed, options=options)
    for action in [None, *pressing_actions(seed, steps)]:
        if action is not None:
            observation, reward, terminated, truncated, info = environment.step(action)
            for value in (reward, terminated, truncated, *(info[key] for key in sorted(info))):
                digest.update(np.asarray(value).tobytes())
        for key in sorted(observation):
            assert torch.isfinite(observation[key].float()).all()
            digest.update(observation[key].numpy().tobytes())
    return digest.hexdigest()


@pytest.fixture(scope="module")
def environment():
    env = gym.make(ENVIRONMENT_ID, objects=("mug", "hammer"))
    yield env
    env.close()


def test_spaces_and_horizon(environment):
    assert environment.action_space == gym.spaces.Box(-1, 1, (NUM_JOINTS,), np.float32)
    observation, info = environment.reset(seed=0)
    assert set(observation) == {"qpos", "qvel", "touch", "occupancy", "time"}
    assert environment.observation_space.contains({k: v.numpy() for k, v in observation.items()})
    assert observation["touch"].shape == (1, len(SKIN_LINKS))
    assert observation["occupancy"].sum() == 0 and observation["touch"].sum() == 0
    for step in range(1, HORIZON + 1):
        observation, _, terminated, truncated, info = environment.step(environment.action_space.sample() * 0)
        assert not terminated.any() and bool(truncated.all()) == (step == HORIZON)
        assert float(observation["time"]) == pytest.approx(step / HORIZON)
    allowed = {"elapsed_steps", "new_touched", "new_visited"}
    assert set(info) == allowed, "nothing privileged is in info"


def test_touched_voxels_lie_on_the_true_surface(environment):
    roll(environment, 2, {"object": "mug", "pose": 0})
    base = environment.unwrapped
    touched = grids.world_to_object(base.touched[0], 0)
    assert touched.sum() >= 5
    centres = grids.voxel_centres()[touched]
    surface = load_object("mug").surface_points
    distance = np.linalg.norm(centres[:, None] - surface[None, ::20], axis=2).min(axis=1)
    assert np.percentile(distance, 95) < VOXEL_EDGE, "touched voxels are within a voxel of the surface"
    np.testing.assert_array_equal(base.touched, base.touched_step >= 0)
    assert not (base.touched & ~base.visited)[0].all(), "the hand has been where it touched"


def test_touch_agrees_with_an_independent_ruler():
    """MuJoCo's distances, which were checked against exact ones; PhysX's own are off by a millimetre (docs/fidelity.md)."""
    results = list(pressing_audits(QUICK_TRAIN_OBJECTS, 1, BatchSettings(split="train")).values())
    both, skin, ruler = (sum(getattr(r, name) for r in results) for name in ("both", "probes_only", "oracle_only"))
    assert both > 1000
    assert both / (both + skin) >= 0.8 and both / (both + ruler) >= 0.8
    depths = np.concatenate([r.depths for r in results])
    assert np.percentile(depths, 95) < 1e-3, "pressing hands penetrate less than 1 mm at the 95th percentile"


def test_flat_observations():
    env = gym.make(ENVIRONMENT_ID, object="mug", obs_mode="state", control_mode="pd_joint_pos")
    observation, _ = env.reset(seed=0)
    assert observation.shape == (1, 28 + 28 + len(SKIN_LINKS) + 2 * 32**3 + 1) == env.observation_space.shape
    env.close()


def test_drive_targets_respect_limits_and_tendons():
    generator = np.random.default_rng(0)
    for mode in ("pd_joint_delta_pos", "pd_joint_pos"):
        targets = DriveTargets(mode, NumpyBackend())
        qpos = generator.uniform(JOINT_LIMITS[:, 0], JOINT_LIMITS[:, 1], (200, NUM_JOINTS)).astype(np.float32)
        target = targets(generator.uniform(-2, 2, (200, NUM_JOINTS)).astype(np.float32), qpos)
        assert (target >= JOINT_LIMITS[:, 0] - 1e-6).all() and (target <= JOINT_LIMITS[:, 1] + 1e-6).all()
        stretch = COUPLING_END * target[:, END] - COUPLING_MIDDLE * target[:, MIDDLE]
        assert np.abs(stretch).max() <= COUPLING_SLACK + 1e-6


def test_absolute_targets_move_no_faster_than_relative_ones():
    """An absolute action is the relative one that goes straight to its goal: clip((goal - qpos) / step limit)."""
    generator = np.random.default_rng(1)
    middle, half = JOINT_LIMITS.mean(axis=1), np.ptp(JOINT_LIMITS, axis=1) / 2
    qpos = generator.uniform(*JOINT_LIMITS.T, (200, NUM_JOINTS)).astype(np.float32)
    action = generator.uniform(-1, 1, (200, NUM_JOINTS)).astype(np.float32)
    toward = np.clip((middle + action * half - qpos) / DELTA_STEP, -1, 1).astype(np.float32)
    absolute = DriveTargets("pd_joint_pos", NumpyBackend())(action, qpos)
    relative = DriveTargets("pd_joint_delta_pos", NumpyBackend())(toward, qpos)
    np.testing.assert_allclose(absolute, relative, atol=1e-6)
    near = (
        np.abs(middle + action * half - qpos) < DELTA_STEP
    )  # there, the goal is the target (tendons and limits aside)
    free = [0, 1, 2, 3, 4, 5]
    np.testing.assert_allclose(
        absolute[:, free][near[:, free]], (middle + action * half)[:, free][near[:, free]], atol=1e-6
    )


def test_joints_reach_their_targets():
    env = gym.make(ENVIRONMENT_ID, object="hammer", pose=0, control_mode="pd_joint_pos")
    env.reset(seed=0)
    action = np.zeros(NUM_JOINTS, dtype=np.float32)
    action[1] = 1.0  # up and away from the object
    for _ in range(120):
        observation, *_ = env.step(action)
    goal = (JOINT_LIMITS.mean(axis=1) + action * np.ptp(JOINT_LIMITS, axis=1) / 2).astype(np.float32)
    expected = DriveTargets("pd_joint_pos", NumpyBackend())(action[None], goal[None])
    np.testing.assert_allclose(observation["qpos"].numpy(), expected, atol=5e-3)
    assert np.abs(observation["qvel"].numpy()).max() < 0.05
    env.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"object": "mugg"}, "mugg"),
        ({"object": "mug", "pose": 8}, "pose 8: unknown; choose an integer from 0 to 7"),
        ({"object": "mug", "reward_mode": "dense"}, "reward_mode 'dense': unknown; choose one of tslam"),
        ({"object": "mug", "control_mode": "pd_ee_pose"}, "control_mode 'pd_ee_pose': unknown"),
        ({"object": "mug", "objects": ("mug",)}, "one or the other"),
        ({"object": "mug", "num_envs": 0}, "num_envs 0"),
        pytest.param(
            {"object": "mug", "num_envs": 2},
            "needs a GPU and there is none",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU, so this is no error"),
        ),
    ],
)
def test_bad_arguments_get_one_line(arguments, message):
    with pytest.raises(InvalidInputError, match=message) as caught:
        gym.make(ENVIRONMENT_ID, **arguments)
    assert "\n" not in str(caught.value)


def test_a_default_environment_draws_from_train(recwarn):
    env = gym.make(ENVIRONMENT_ID)
    names = set(env.unwrapped._starts.names)
    assert names == set(prepared_names("train")) and not names & set(OBJECTS)
    said = [str(warning.message) for warning in recwarn if "episodes draw from" in str(warning.message)]
    if len(names) < TRAIN_OBJECTS:
        assert len(said) == 1 and "tslam-bench assets prepare --split train" in said[0]
    else:
        assert not said
    env.reset(seed=0)
    assert env.unwrapped.object_name[0] in names
    env.reset(seed=0, options={"object": "mug"})  # a named object is found where it is
    assert env.unwrapped.object_name == ["mug"]
    env.close()


def test_the_default_set_has_as_many_objects_as_its_manifest():
    manifest = json.loads((package_data("assets", "manifest_train.json")).read_text(encoding="utf-8"))
    assert len(manifest["objects"]) == TRAIN_OBJECTS


def test_bad_actions_get_one_line(environment):
    environment.reset(seed=0)
    for action, message in (
        (np.zeros(27, np.float32), r"shape \(27,\), expected \(1, 28\)"),
        (np.full(28, np.nan, np.float32), "not finite for joint ARTx"),
        ("up", "not an array of numbers"),
    ):
        with pytest.raises(InvalidInputError, match=message) as caught:
            environment.step(action)
        assert "\n" not in str(caught.value)
    with pytest.raises(InvalidInputError, match=r"options\['pose'\]: 2 values for 1 environments"):
        environment.reset(options={"pose": [1, 2]})
    with pytest.raises(InvalidInputError, match="pose 9"):
        environment.reset(options={"pose": 9})


@pytest.mark.skipif(
    not vulkan_device_available(), reason="no Vulkan device: rendering cannot be tested on this machine"
)
def test_renders_pictures():
    env = gym.make(ENVIRONMENT_ID, object="mug", pose=0, render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (1, 512, 512, 3) and picture.float().std() > 5
    env.close()


def test_import_registers_without_the_simulator():
    code = "import sys, tslam_bench, gymnasium; assert 'TactileSLAM-v0' in gymnasium.registry\n" + (
        "print(any(m in sys.modules for m in ('sapien', 'mani_skill', 'torch')))"
    )
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
        == "False"
    )
    assert tslam_bench.__version__
