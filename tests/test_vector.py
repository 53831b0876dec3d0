"""The adapter to stable-baselines3, on a small batched environment whose observations say where they come from."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from counting_environment import Counter
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecMonitor

from tslam_bench.baselines.vector import TactileVecEnv
from tslam_bench.errors import InvalidInputError


def act(vec: TactileVecEnv, value: float = 0.0):
    return vec.step(np.full((vec.num_envs, 3), value, dtype=np.float32))


@pytest.mark.parametrize("layout", [[(3,), (3,), (3,)], [(3, 3, 3)], [(3, 3), (3,)]])
def test_layouts_agree(layout) -> None:
    """Single environments, one batch, and a mixture are the same to the learner."""
    vec = TactileVecEnv([Counter(lengths) for lengths in layout], seed=7)
    first = vec.reset()
    assert first["qpos"][:, 0].tolist() == [7, 8, 9]
    for step in (1, 2, 3, 1):
        observation, rewards, dones, infos = act(vec)
        assert rewards.tolist() == [step] * 3
        assert dones.tolist() == [step == 3] * 3
        shown = 0 if step == 3 else step  # after the end comes the next episode's first observation
        assert observation["qpos"][:, 1].tolist() == [shown] * 3
        assert len(infos) == 3


def test_terminal_observation_is_the_last_one_and_a_copy() -> None:
    vec = TactileVecEnv([Counter((2, 3))])
    vec.reset()
    act(vec)
    observation, _, dones, infos = act(vec)
    assert dones.tolist() == [True, False]
    assert "terminal_observation" not in infos[1]
    terminal = infos[0]["terminal_observation"]
    assert terminal["qpos"][1] == 2 and observation["qpos"][:, 1].tolist() == [0, 2]
    assert terminal["occupancy"].shape == (1, 2, 2, 2)
    for _ in range(3):
        act(vec)
    assert terminal["qpos"][1] == 2 and (terminal["occupancy"] == 0).all()
    assert observation["qpos"][:, 1].tolist() == [0, 2]  # the learner stores an observation after the next step


def test_finished_rows_only_are_reset() -> None:
    vec = TactileVecEnv([Counter((2, 5))])
    vec.reset()
    seen = [act(vec)[0]["qpos"][:, 1].tolist() for _ in range(5)]
    assert seen == [[1, 1], [0, 2], [1, 3], [0, 4], [1, 0]]


@pytest.mark.parametrize("terminates", [False, True])
def test_time_limit_is_marked_unless_terminated(terminates: bool) -> None:
    vec = TactileVecEnv([Counter((1,), terminates)])
    vec.reset()
    _, _, dones, infos = act(vec)
    assert dones[0] and infos[0]["TimeLimit.truncated"] is (not terminates)
    assert infos[0]["elapsed"] == 1


def test_kinds() -> None:
    vec = TactileVecEnv([Counter((4,)), Counter((4,))])
    observation = vec.reset()
    for _ in range(2):
        assert {key: value.dtype for key, value in observation.items()} == {
            "qpos": np.float32,
            "occupancy": np.uint8,
            "touch": np.uint8,
        }
        assert all(
            value.shape[0] == 2 and vec.observation_space[key].contains(value[0]) for key, value in observation.items()
        )
        observation, rewards, dones, _ = act(vec)
    assert rewards.dtype == np.float32 and rewards.shape == (2,)
    assert dones.dtype == np.bool_ and isinstance(rewards, np.ndarray)


def test_actions_reach_their_environment() -> None:
    parts = [Counter((9, 9)), Counter((9,))]
    vec = TactileVecEnv(parts)
    vec.reset()
    actions = np.arange(9, dtype=np.float32).reshape(3, 3)
    vec.step(actions)
    assert parts[0].last_actions.tolist() == actions[:2].tolist()
    assert parts[1].last_actions.tolist() == actions[2:].tolist()


def test_episode_returns_under_a_monitor_are_numbers() -> None:
    vec = VecMonitor(TactileVecEnv([Counter((2, 4))]))
    vec.reset()
    returns = []
    for _ in range(4):
        _, _, _, infos = vec.step(np.zeros((2, 3), dtype=np.float32))
        returns += [(info["episode"]["r"], info["episode"]["l"]) for info in infos if "episode" in info]
    assert [(float(r), int(length)) for r, length in returns] == [(3, 2), (3, 2), (10, 4)]
    assert all(np.ndim(r) == 0 for r, _ in returns)


def test_seeds_are_used_once() -> None:
    vec = TactileVecEnv([Counter((9,)), Counter((9,))])
    vec.seed(40)
    assert vec.reset()["qpos"][:, 0].tolist() == [40, 41]
    vec.environments[0].seeds[:] = 5
    assert vec.reset()["qpos"][:, 0].tolist() == [5, 41]


def test_methods_attributes_and_close() -> None:
    parts = [Counter((9, 9)), Counter((9,))]
    vec = TactileVecEnv(parts)
    assert vec.env_method("double", 4) == [8, 8, 8]
    assert vec.env_method("double", 4, indices=[2]) == [8]
    assert vec.get_attr("num_envs") == [2, 2, 1]
    vec.set_attr("terminates", True, indices=2)
    assert [part.terminates for part in parts] == [False, True]
    assert vec.env_is_wrapped(gym.Wrapper) == [False] * 3
    vec.close()
    assert all(part.closed for part in parts)


def test_refusals() -> None:
    with pytest.raises(InvalidInputError, match="none given"):
        TactileVecEnv([])
    other = Counter((3,))
    other.single_action_space = spaces.Box(-1, 1, (4,), np.float32)
    with pytest.raises(InvalidInputError, match="action spaces differ"):
        TactileVecEnv([Counter((3,)), other])
    nested = Counter((3,))
    nested.single_observation_space = spaces.Dict({"agent": spaces.Dict({"qpos": spaces.Box(-1, 1, (2,))})})
    with pytest.raises(InvalidInputError, match="flat dict"):
        TactileVecEnv([nested])
    vec = TactileVecEnv([Counter((3,))])
    vec.reset()
    with pytest.raises(InvalidInputError, match="step_async"):
        vec.step_wait()
