"""The stable-baselines3 adapter: ends of episodes, copies, kinds and seeds, on counters and on the real environment."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch
from counting_environment import Counter
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes

import tslam_bench
from tslam_bench.baselines.sb3_adapter import TactileVecEnv
from tslam_bench.constants import ENVIRONMENT_ID, HORIZON, NUM_JOINTS
from tslam_bench.errors import InvalidInputError


def act(vec: TactileVecEnv, value: float = 0.0):
    return vec.step(np.full((vec.num_envs, 3), value, dtype=np.float32))


def test_terminal_observation_is_the_last_one_and_a_copy() -> None:
    for tensors in (True, False):
        vec = TactileVecEnv(Counter((2, 3), tensors=tensors))
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


def test_tensors_come_to_the_host_as_a_whole() -> None:
    """Number by number, each of them would make the host wait for a GPU."""

    class NoSingleNumbers(TorchDispatchMode):
        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            assert "_local_scalar_dense" not in str(func)
            return func(*args, **(kwargs or {}))

    class Own(Counter):
        """What the environment itself does is none of the adapter's business."""

        def reset(self, **asked):
            with _disable_current_modes():
                return super().reset(**asked)

        def step(self, actions):
            with _disable_current_modes():
                return super().step(actions)

    vec = TactileVecEnv(Own((2, 2, 3), tensors=True))
    with NoSingleNumbers():
        vec.reset()
        act(vec)
        _, _, dones, infos = act(vec)
    assert dones.tolist() == [True, True, False]
    assert [info.get("elapsed") for info in infos] == [2, 2, None]
    assert all(isinstance(info["elapsed"], int) for info in infos[:2])


def test_episodes_go_on_where_others_end() -> None:
    vec = TactileVecEnv(Counter((2, 5)), seed=7)
    assert vec.reset()["qpos"][:, 0].tolist() == [7, 8]
    seen = [act(vec)[0]["qpos"][:, 1].tolist() for _ in range(5)]
    assert seen == [[1, 1], [0, 2], [1, 3], [0, 4], [1, 0]]


@pytest.mark.parametrize("terminates", [False, True])
def test_time_limit_is_marked_unless_terminated(terminates: bool) -> None:
    vec = TactileVecEnv(Counter((1,), terminates))
    vec.reset()
    _, _, dones, infos = act(vec)
    assert dones[0] and infos[0]["TimeLimit.truncated"] is (not terminates)
    assert infos[0]["elapsed"] == 1


@pytest.mark.parametrize("terminates", [False, True])
def test_the_learner_bootstraps_at_the_time_limit_and_only_there(terminates: bool) -> None:
    """stable-baselines3 adds gamma V(terminal observation) to the last reward of an episode that the clock ended."""
    vec = TactileVecEnv(Counter((4,), terminates))
    model = PPO("MultiInputPolicy", vec, n_steps=4, batch_size=4, n_epochs=1, gamma=0.5, seed=0, device="cpu")
    values = []
    predict = model.policy.predict_values

    def record(observation):
        values.append((float(observation["qpos"][0, 1]), float(predict(observation)[0, 0])))
        return predict(observation)

    model.policy.predict_values = record  # type: ignore[method-assign]
    model.learn(4)
    rewards = model.rollout_buffer.rewards[:, 0]
    assert rewards[:3].tolist() == [1, 2, 3]
    bootstrapped = [value for step, value in values if step == 4]  # the counter's true last observation
    assert len(bootstrapped) == (0 if terminates else 1)
    assert rewards[3] == pytest.approx(4 + (0 if terminates else 0.5 * bootstrapped[0]))


def test_kinds() -> None:
    vec = TactileVecEnv(Counter((4, 4)))
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
    counter = Counter((9, 9, 9))
    vec = TactileVecEnv(counter)
    vec.reset()
    actions = np.arange(9, dtype=np.float32).reshape(3, 3)
    vec.step(actions)
    assert counter.last_actions is not None and counter.last_actions.tolist() == actions.tolist()


def test_episode_returns_under_a_monitor_are_numbers() -> None:
    vec = VecMonitor(TactileVecEnv(Counter((2, 4))))
    vec.reset()
    returns = []
    for _ in range(4):
        _, _, _, infos = vec.step(np.zeros((2, 3), dtype=np.float32))
        returns += [(info["episode"]["r"], info["episode"]["l"]) for info in infos if "episode" in info]
    assert [(float(r), int(length)) for r, length in returns] == [(3, 2), (3, 2), (10, 4)]
    assert all(np.ndim(r) == 0 for r, _ in returns)


def test_seeds_and_options_are_used_once() -> None:
    counter = Counter((9, 9))
    vec = TactileVecEnv(counter)
    vec.seed(40)
    assert vec.reset()["qpos"][:, 0].tolist() == [40, 41]
    counter.seeds[0] = 5
    assert vec.reset()["qpos"][:, 0].tolist() == [5, 41]


def test_methods_attributes_and_close() -> None:
    counter = Counter((9, 9, 9))
    vec = TactileVecEnv(counter)
    assert vec.env_method("double", 4) == [8, 8, 8]
    assert vec.env_method("double", 4, indices=[2]) == [8]
    assert vec.get_attr("num_envs") == [3, 3, 3]
    vec.set_attr("terminates", True, indices=2)
    assert counter.terminates
    assert vec.env_is_wrapped(gym.Wrapper) == [False] * 3
    vec.close()
    assert counter.was_closed


def test_refusals() -> None:
    late = Counter((3,))
    late.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}
    with pytest.raises(InvalidInputError, match="expected SAME_STEP"):
        TactileVecEnv(late)
    nested = Counter((3,))
    nested.set_spaces({"agent": spaces.Dict({"qpos": spaces.Box(-1, 1, (2,))})}, 3)
    with pytest.raises(InvalidInputError, match="flat dict"):
        TactileVecEnv(nested)
    vec = TactileVecEnv(Counter((3,)))
    vec.reset()
    with pytest.raises(InvalidInputError, match="step_async"):
        vec.step_wait()


def test_the_real_environment_passes_what_check_env_asks_of_a_vec_env() -> None:
    """stable-baselines3's ``check_env`` is for single environments; the same for a ``VecEnv``, over an episode's end."""
    vec = VecMonitor(TactileVecEnv(tslam_bench.make_vec(ENVIRONMENT_ID, 2, "cpu", object="mug", processes=1), seed=3))
    space = vec.observation_space
    assert isinstance(space, spaces.Dict) and isinstance(vec.action_space, spaces.Box)
    assert vec.action_space.shape == (NUM_JOINTS,) and vec.action_space.dtype == np.float32
    assert (vec.action_space.low == -1).all() and (vec.action_space.high == 1).all()

    def check(observation) -> None:
        assert set(observation) == set(space.spaces)
        for key, entry in space.spaces.items():
            assert isinstance(observation[key], np.ndarray) and observation[key].dtype == entry.dtype, key
            assert observation[key].shape == (2, *(entry.shape or ())) and np.isfinite(observation[key]).all()
            assert all(entry.contains(row) for row in observation[key])

    check(vec.reset())
    generator = np.random.default_rng(0)
    for step in range(1, HORIZON + 3):
        observation, rewards, dones, infos = vec.step(generator.uniform(-1, 1, (2, NUM_JOINTS)).astype(np.float32))
        check(observation)
        assert rewards.shape == dones.shape == (2,) and rewards.dtype == np.float32 and dones.dtype == np.bool_
        assert np.isfinite(rewards).all() and isinstance(infos, list) and len(infos) == 2
        assert dones.all() == dones.any() == (step == HORIZON)
        if step == HORIZON:
            for info in infos:
                assert info["TimeLimit.truncated"] is True
                last = info["terminal_observation"]
                check({key: np.stack([value, value]) for key, value in last.items()})
                assert last["time"] == 1 and last["occupancy"].sum() > 0, "the true last one, not a reset one"
                assert info["episode"]["l"] == HORIZON and isinstance(float(info["episode"]["r"]), float)
                assert set(info) == {"TimeLimit.truncated", "terminal_observation", "episode"} | {
                    "elapsed_steps",
                    "new_touched",
                    "new_visited",
                }
            assert (observation["time"] == 0).all() and (observation["occupancy"] == 0).all()
    vec.close()


def test_stable_baselines3_trains_in_the_real_environment_with_held_actions() -> None:
    """The example of the documentation: its own PPO through the adapter."""
    envs = tslam_bench.make_vec(
        ENVIRONMENT_ID, 2, "cpu", object="mug", control_mode="pd_joint_pos", action_repeat=20, processes=1
    )
    vec = VecMonitor(TactileVecEnv(envs, seed=0))
    model = PPO("MultiInputPolicy", vec, n_steps=10, batch_size=10, n_epochs=1, seed=0, device="cpu")
    before = [weight.clone() for weight in model.policy.action_net.parameters()]
    model.learn(40)
    assert model.num_timesteps == 40 and len(model.ep_info_buffer or ()) == 4
    assert all(episode["l"] == HORIZON // 20 and episode["r"] > 0 for episode in model.ep_info_buffer or ())
    assert not any(torch.equal(a, b) for a, b in zip(before, model.policy.action_net.parameters(), strict=True))
    vec.close()


@pytest.mark.parametrize("repeat", [1, 4])
def test_a_batched_maniskill_task_is_the_same_vector_environment(repeat: int) -> None:
    """What CUDA uses, on the CPU with one environment: observations, rewards and ends as ``make_vec``'s, bit for bit."""
    from tslam_bench.engine.maniskill_vector_env import BatchedVectorEnv

    arguments = {"objects": ("mug", "hammer")}
    batched = BatchedVectorEnv(gym.make(ENVIRONMENT_ID, **arguments), repeat)
    envs = tslam_bench.make_vec(ENVIRONMENT_ID, 1, "cpu", processes=1, action_repeat=repeat, **arguments)
    assert batched.metadata["autoreset_mode"] == envs.metadata["autoreset_mode"]
    assert batched.observation_space == envs.observation_space and batched.action_space == envs.action_space
    first, second = batched.reset(seed=5), envs.reset(seed=5)
    generator = np.random.default_rng(1)
    for step in range(HORIZON // repeat + 20):
        compare(first, second, f"step {step}")
        if step == HORIZON // repeat + 10:
            compare(
                batched.reset(options={"reset_mask": np.array([True]), "pose": 6}),
                envs.reset(options={"reset_mask": np.array([True]), "pose": 6}),
                "partial reset",
            )
        action = generator.uniform(-1, 1, (1, NUM_JOINTS)).astype(np.float32)
        first, second = batched.step(action), envs.step(action)
    with pytest.raises(InvalidInputError, match="reset_mask"):
        batched.reset(options={"reset_mask": np.ones(3, dtype=bool)})
    batched.close()
    envs.close()


def compare(a, b, where: str) -> None:
    """Equal structure and bits, whatever the library."""
    if isinstance(a, dict):
        assert set(a) == set(b), where
        for key in a:
            compare(a[key], b[key], f"{where}, {key}")
    elif isinstance(a, tuple):
        for one, other in zip(a, b, strict=True):
            compare(one, other, where)
    elif isinstance(a, np.ndarray):  # final_obs: an observation or None per environment
        assert a.dtype == b.dtype == object and a.shape == b.shape, where
        compare(tuple(a), tuple(b), where)
    elif a is None:
        assert b is None, where
    else:
        assert isinstance(a, torch.Tensor), where
        np.testing.assert_array_equal(a.numpy(), b, err_msg=where)
