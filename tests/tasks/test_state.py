"""A restored episode goes on bit for bit: in the same environment, in another one, and from a file."""

from __future__ import annotations

import hashlib
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.utils import common

from tslam_bench.constants import ENVIRONMENT_ID, HORIZON, NUM_JOINTS
from tslam_bench.errors import InvalidInputError

STEPS = 60
OBJECTS = ("mug", "hammer")


def actions() -> np.ndarray:
    values = np.random.default_rng(5).uniform(-1, 1, (2 * STEPS, NUM_JOINTS)).astype(np.float32)
    values[:80, 1] = -1.0  # down onto the object
    return values


def play(env: gym.Env, chosen: np.ndarray) -> str:
    """Hash of all that these steps return, and of the next two episodes' starts."""
    digest = hashlib.sha256()
    for action in chosen:
        observation, reward, terminated, truncated, info = env.step(action)
        for value in (*observation.values(), reward, terminated, truncated, *info.values()):
            digest.update(np.asarray(value).tobytes())
    digest.update(env.unwrapped.touched_step.tobytes())
    for _ in range(2):
        observation, _ = env.reset()
        digest.update(observation["qpos"].numpy().tobytes() + str(env.unwrapped.object_name).encode())
    return digest.hexdigest()


def make(reward_mode: str, control_mode: str = "pd_joint_delta_pos") -> gym.Env:
    return gym.make(ENVIRONMENT_ID, objects=OBJECTS, reward_mode=reward_mode, control_mode=control_mode)


def leaves(state: dict[str, Any]) -> list[torch.Tensor]:
    return [leaf for value in state.values() for leaf in (leaves(value) if isinstance(value, dict) else [value])]


@pytest.mark.parametrize(
    ("reward_mode", "control_mode"),
    [
        ("tslam", "pd_joint_delta_pos"),
        ("knn", "pd_joint_pos"),
        ("disagreement", "pd_joint_delta_pos"),
        ("chamfer", "pd_joint_delta_pos"),
    ],
)
def test_a_restored_episode_goes_on_bit_for_bit(reward_mode, control_mode, tmp_path):
    env = make(reward_mode, control_mode)
    env.reset(seed=3, options={"object": "mug", "pose": 5})
    for action in actions()[:STEPS]:
        observation, *_ = env.step(action)
    assert observation["touch"].any() and observation["occupancy"][0, 0].sum() > 10, "saved in the middle of a touch"
    state = env.unwrapped.get_state_dict()
    first = play(env, actions()[STEPS:])  # ends with an object or pose of its own
    env.step(actions()[0])
    env.unwrapped.set_state_dict(state)
    assert env.unwrapped.object_name == ["mug"] and env.unwrapped.pose == [5]
    for key, value in env.unwrapped.get_obs().items():
        np.testing.assert_array_equal(value, observation[key], err_msg=key)
    assert play(env, actions()[STEPS:]) == first, "in the same environment"
    env.close()

    torch.save(common.to_numpy(state), tmp_path / "state.pt")
    other = make(reward_mode, control_mode)
    other.reset(seed=8)
    loaded = torch.load(tmp_path / "state.pt", weights_only=False)
    observation, _ = other.reset(options={"reset_to_env_states": {"env_states": loaded}})
    np.testing.assert_array_equal(observation["occupancy"], state["sensing"]["occupancy"])
    assert play(other, actions()[STEPS:]) == first, "in a new environment, from a file"
    other.close()


def test_states_are_tensors_of_one_shape_and_copies():
    env = make("knn")
    env.reset(seed=0)
    before = env.unwrapped.get_state_dict()
    kept = [leaf.clone() for leaf in leaves(before)]
    for action in actions()[:30]:
        env.step(action)
    after = leaves(env.unwrapped.get_state_dict())
    for saved, copy, later in zip(leaves(before), kept, after, strict=True):
        assert isinstance(saved, torch.Tensor) and saved.shape == later.shape and len(saved) == 1
        assert torch.equal(saved, copy), "a state does not change with the episode"
    assert env.unwrapped.get_state().shape == (1, 13 + 2 * NUM_JOINTS), "the flat vector is of the simulation"
    env.close()


def test_a_hand_that_was_moved_is_set_where_it_is():
    env = make("none")
    env.reset(seed=0)
    for action in actions()[:5]:
        env.step(action)
    state = env.unwrapped.get_state_dict()
    moved = state["articulations"]["adroit28"].clone()
    moved[0, 13] += 0.01
    env.unwrapped.set_state_dict({**state, "articulations": {"adroit28": moved}})
    assert torch.equal(env.unwrapped.get_state_dict()["articulations"]["adroit28"][0, 13], moved[0, 13])
    assert int(env.unwrapped.elapsed_steps) == 5
    env.close()


def test_states_of_other_reward_modes_are_refused_in_one_line():
    env, other = make("knn"), make("tslam")
    env.reset(seed=0)
    other.reset(seed=0)
    with pytest.raises(InvalidInputError, match="state: of another reward mode than this environment's 'tslam'"):
        other.unwrapped.set_state_dict(env.unwrapped.get_state_dict())
    for _ in range(HORIZON + 1):  # past the end is no error either
        other.step(np.zeros(NUM_JOINTS, np.float32))
    other.unwrapped.get_state_dict()
    env.close()
    other.close()
