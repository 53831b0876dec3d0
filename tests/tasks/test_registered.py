"""Every registered environment, through the same tests: checker, spaces, determinism, seeding, horizon, info, rewards."""

from __future__ import annotations

import hashlib
import pickle
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import tslam_bench
from tslam_bench.constants import HORIZON, NUM_JOINTS, REWARD_MODES
from tslam_bench.variants import ENVIRONMENT_IDS, get_variant
from tslam_bench.wrappers import NumpyEnv

OBJECTS = ("mug", "hammer")
INFO = {"elapsed_steps", "new_touched", "new_visited"}
"""All that ``info`` may hold: nothing about the object, its pose, or the true surface."""
MASKS = {f"_{name}" for name in INFO}
FINAL_INFO = INFO | MASKS | {"final_obs", "_final_obs", "final_info", "_final_info"}

each_environment = pytest.mark.parametrize("environment_id", ENVIRONMENT_IDS)


def actions_of(seed: int, steps: int) -> np.ndarray:
    generator = np.random.Generator(np.random.PCG64(seed))
    actions = generator.uniform(-1, 1, (steps, NUM_JOINTS)).astype(np.float32)
    actions[:40, 1] = -1.0  # down onto the object
    return actions


def roll(env: gym.Env, seed: int, steps: int, options: dict | None = None) -> str:
    """SHA-256 of all that an episode returns; everything is finite and lies in its space."""
    digest = hashlib.sha256()
    observation, info = env.reset(seed=seed, options=options)
    assert set(info) == INFO | {"reconfigure"}  # ManiSkill's: whether the scene was rebuilt
    for step, action in enumerate([None, *actions_of(seed, steps)]):
        if action is not None:
            observation, reward, terminated, truncated, info = env.step(action)
            assert set(info) == INFO
            assert np.isfinite(np.asarray(reward)).all() and reward.dtype.is_floating_point
            assert not terminated.any() and bool(truncated.all()) == (step == HORIZON)
            assert int(info["elapsed_steps"]) == step
            for value in (reward, terminated, truncated, *(info[key] for key in sorted(info))):
                digest.update(np.asarray(value).tobytes())
        arrays = {key: value.numpy() for key, value in observation.items()}
        assert env.observation_space.contains(arrays)
        assert all(np.isfinite(array).all() for array in arrays.values())
        assert arrays["time"][0, 0] == np.float32(step) / np.float32(HORIZON)
        for key in sorted(arrays):
            digest.update(arrays[key].tobytes())
    return digest.hexdigest()


def make(environment_id: str, **kwargs: Any) -> gym.Env:
    return gym.make(environment_id, **{"objects": OBJECTS, **kwargs})


@each_environment
def test_gymnasium_checker_finds_nothing(environment_id):
    env = NumpyEnv(make(environment_id))
    allowed = ("infinity", "is not wrapped", "is different from the unwrapped version")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env, skip_render_check=True)  # a picture needs a Vulkan device
    found = [str(w.message) for w in caught if not any(text in str(w.message) for text in allowed)]
    assert not found, found
    env.close()


@each_environment
def test_a_whole_episode_stays_in_its_spaces_and_repeats(environment_id):
    env = make(environment_id)
    pose = get_variant(environment_id).poses[-1]
    first = roll(env, 3, HORIZON, {"object": "mug", "pose": pose})
    roll(env, 4, 60, {"object": "hammer"})
    assert roll(env, 3, HORIZON, {"object": "mug", "pose": pose}) == first, "an episode before it left a trace"
    assert roll(env, 5, HORIZON, {"object": "mug", "pose": pose}) != first, "another seed gives the same episode"
    env.close()
    fresh = make(environment_id, objects=None, object="mug")
    assert roll(fresh, 3, HORIZON, {"object": "mug", "pose": pose}) == first, "a new environment gives other bits"
    fresh.close()


def test_bits_are_the_same_in_another_process():
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from test_registered import ENVIRONMENT_IDS, make, roll\n"
        "print(*(roll(make('tslam_bench:' + name), 6, 80) for name in ENVIRONMENT_IDS))"
    )
    command = [sys.executable, "-c", code, str(Path(__file__).parent)]
    other = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    here = []
    for name in ENVIRONMENT_IDS:
        env = make(name)
        here.append(roll(env, 6, 80))
        env.close()
    assert other[-len(here) :] == here and len(set(here)) == len(here)


@each_environment
def test_spec_survives_pickling(environment_id):
    env = make(environment_id, control_mode="pd_joint_pos", pose=2)
    spec = pickle.loads(pickle.dumps(env.spec))
    again = gym.make(spec)
    assert spec.id == environment_id and again.unwrapped.control_mode == "pd_joint_pos"
    assert again.unwrapped.VARIANT.id == environment_id
    assert roll(env, 1, 5) == roll(again, 1, 5)
    env.close()
    again.close()


@each_environment
def test_seeds_draw_objects_and_the_environments_poses(environment_id):
    env = make(environment_id)
    drawn = []
    for _ in range(2):
        episodes = []
        for seed in range(20):
            env.reset(seed=seed)
            episodes.append((env.unwrapped.object_name[0], env.unwrapped.pose[0]))
        drawn.append(episodes)
    env.close()
    assert drawn[0] == drawn[1] and {name for name, _ in drawn[0]} == set(OBJECTS)
    poses = {pose for _, pose in drawn[0]}
    assert poses <= set(get_variant(environment_id).poses) and len(poses) > len(get_variant(environment_id).poses) / 2


@each_environment
@pytest.mark.parametrize("reward_mode", [*REWARD_MODES, "none"])
def test_every_reward_mode_steps_and_repeats(environment_id, reward_mode):
    env = make(environment_id, objects=None, object="mug", pose=0, reward_mode=reward_mode)
    totals = []
    for _ in range(2):
        env.reset(seed=1)
        rewards = [float(env.step(action)[1]) for action in actions_of(1, 60)]
        totals.append(rewards)
        assert np.isfinite(rewards).all()
    assert totals[0] == totals[1]
    assert (np.sum(totals[0]) > 0) == (reward_mode != "none")
    env.close()


@each_environment
def test_vector_environment_keeps_its_promises(environment_id):
    """Spaces, dtypes, the allow-list of info, truncation at the horizon, and the same bits twice."""
    digests = []
    for processes in (0, 2):
        envs = tslam_bench.make_vec(environment_id, 2, "cpu", objects=OBJECTS, processes=processes)
        digest = hashlib.sha256()
        observation, info = envs.reset(seed=11)
        assert set(info) == INFO | MASKS
        for step, action in enumerate(actions_of(2, HORIZON + 5), start=1):
            observation, reward, terminated, truncated, info = envs.step(np.stack([action, -action]))
            assert envs.observation_space.contains(observation)
            assert reward.shape == (2,) and reward.dtype == np.float32 and np.isfinite(reward).all()
            assert terminated.dtype == truncated.dtype == np.bool_ and not terminated.any()
            assert truncated.all() == truncated.any() == (step == HORIZON)
            assert set(info) == (FINAL_INFO if step == HORIZON else INFO | MASKS)
            if step == HORIZON:
                assert set(info["final_info"]) == INFO | MASKS
                assert all(envs.single_observation_space.contains(last) for last in info["final_obs"])
                assert all(last["time"] == 1 for last in info["final_obs"]) and (observation["time"] == 0).all()
            for value in (*(observation[key] for key in sorted(observation)), reward, truncated):
                digest.update(value.tobytes())
        assert set(envs.state()["pose"]) <= set(get_variant(environment_id).poses)
        envs.close()
        digests.append(digest.hexdigest())
    assert digests[0] == digests[1]
