"""``gymnasium.make_vec``, and results in the form that Gymnasium's own vector environments give, so that its wrappers work."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import ClipReward, DictInfoToList, RecordEpisodeStatistics

import tslam_bench
from tslam_bench.constants import ENVIRONMENT_ID, HORIZON, NUM_JOINTS, TABLETOP_ID
from tslam_bench.engine.spaces import action_space, observation_space

ARGUMENTS: dict[str, Any] = {"objects": ("mug", "hammer"), "processes": 0}


def actions_of(seed: int, steps: int, num_envs: int) -> np.ndarray:
    generator = np.random.Generator(np.random.PCG64(seed))
    actions = generator.uniform(-1, 1, (steps, num_envs, NUM_JOINTS)).astype(np.float32)
    actions[:40, :, 1] = -1.0
    return actions


def assert_same(ours: Any, theirs: Any, where: str) -> None:
    """Equal structure, types and bits."""
    assert type(ours) is type(theirs), where
    if isinstance(ours, dict):
        assert set(ours) == set(theirs), where
        for key in ours:
            assert_same(ours[key], theirs[key], f"{where}, {key}")
    elif isinstance(ours, tuple):
        for index, (one, other) in enumerate(zip(ours, theirs, strict=True)):
            assert_same(one, other, f"{where}, {index}")
    elif isinstance(ours, np.ndarray):
        assert ours.dtype == theirs.dtype and ours.shape == theirs.shape, where
        if ours.dtype == object:
            assert_same(tuple(ours), tuple(theirs), where)
        else:
            np.testing.assert_array_equal(ours, theirs, err_msg=where)
    else:
        assert ours == theirs, where


@pytest.mark.parametrize(
    ("environment_id", "mode"),
    [(ENVIRONMENT_ID, "vector_entry_point"), (f"tslam_bench:{ENVIRONMENT_ID}", None), (TABLETOP_ID, None)],
)
def test_gymnasium_s_make_vec_reaches_the_engine(environment_id: str, mode: str | None) -> None:
    envs = gym.make_vec(environment_id, num_envs=3, vectorization_mode=mode, device="cpu", pose=1, **ARGUMENTS)
    own = tslam_bench.make_vec(environment_id.rpartition(":")[2], 3, "cpu", pose=1, **ARGUMENTS)
    again = gym.make_vec(envs.spec)  # a spec remembers all arguments
    every = (envs, own, again)
    for made in every:
        assert type(made) is type(own) and made.num_envs == 3
        assert made.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
        assert made.single_observation_space == observation_space() and made.single_action_space == action_space()
        assert {key: space.shape for key, space in made.observation_space.spaces.items()} == {
            key: (3, *space.shape) for key, space in observation_space().spaces.items()
        }
        assert made.action_space.shape == (3, NUM_JOINTS)
    results = [made.reset(seed=9) for made in every]
    for step, action in enumerate(actions_of(0, 60, 3)):
        assert_same(results[0], results[1], f"step {step}")
        assert_same(results[2], results[1], f"step {step}")
        results = [made.step(action) for made in every]
    assert results[1][0]["occupancy"][:, 0].any(), "the comparison has to include contact"
    for made in every:
        made.close()


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"wrappers": [gym.wrappers.RecordEpisodeStatistics]}, gym.error.Error, "wrappers argument"),
        ({"vector_kwargs": {"copy": False}}, gym.error.Error, "`vector_kwargs` is not empty"),
        ({"render_mode": "human"}, TypeError, "unexpected keyword argument 'render_mode'"),
        ({"num_envs": 0}, tslam_bench.errors.InvalidInputError, "num_envs 0: must be a whole number"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(arguments: dict, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message) as caught:
        gym.make_vec(ENVIRONMENT_ID, **arguments)
    assert "\n" not in str(caught.value)


class Unbatched(gym.Env):
    """The ManiSkill task as an ordinary Gymnasium environment: one hand, numpy arrays, numbers in ``info``."""

    def __init__(self) -> None:
        self.task = gym.make(ENVIRONMENT_ID, objects=ARGUMENTS["objects"])
        self.observation_space, self.action_space = observation_space(), action_space()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        observation, info = self.task.reset(seed=seed, options=options)
        return self._alone(observation), self._numbers(info)

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        observation, reward, terminated, truncated, info = self.task.step(action)
        return self._alone(observation), float(reward), bool(terminated), bool(truncated), self._numbers(info)

    def close(self) -> None:
        self.task.close()

    def _alone(self, observation: dict) -> dict[str, np.ndarray]:
        return {
            key: np.asarray(observation[key]).reshape(space.shape or ()) for key, space in observation_space().items()
        }

    @staticmethod
    def _numbers(info: dict) -> dict[str, Any]:
        return {name: np.asarray(info[name]).reshape(-1)[0] for name in ("elapsed_steps", "new_touched", "new_visited")}


def test_results_are_those_of_gymnasium_s_own_vector_environment() -> None:
    """``SyncVectorEnv`` builds infos from the ManiSkill tasks; episodes end together, and each by itself."""
    ours = tslam_bench.make_vec(ENVIRONMENT_ID, 2, "cpu", **ARGUMENTS)
    theirs = SyncVectorEnv([Unbatched, Unbatched], autoreset_mode=AutoresetMode.SAME_STEP)
    assert ours.observation_space == theirs.observation_space and ours.action_space == theirs.action_space
    assert ours.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"]
    assert_same(ours.reset(seed=2), theirs.reset(seed=2), "reset")
    steps, ends = 2 * HORIZON + 20, []
    for step, action in enumerate(actions_of(5, steps, 2)):
        if step == HORIZON + 30:
            mask = np.array([False, True])
            one, other = (envs.reset(options={"reset_mask": mask.copy(), "pose": 3}) for envs in (ours, theirs))
            assert_same(one[0], other[0], "partial reset")
            for name, value in other[1].items():
                np.testing.assert_array_equal(one[1][name][mask], value[mask], err_msg=name)
        one, other = ours.step(action), theirs.step(action)
        np.testing.assert_array_equal(one[1], other[1].astype(np.float32))
        for index in (0, 2, 3, 4):
            assert_same(one[index], other[index], f"step {step}, result {index}")
        if one[3].any():
            ends.append(one[3].tolist())
            assert one[4]["final_obs"][0]["occupancy"].any()
    assert ends == [[True, True], [True, False]]
    ours.close()
    theirs.close()


def test_gymnasium_s_vector_wrappers_work() -> None:
    arguments = {**ARGUMENTS, "processes": 1, "action_repeat": 10}
    plain = tslam_bench.make_vec(ENVIRONMENT_ID, 3, "cpu", **arguments)
    statistics = RecordEpisodeStatistics(tslam_bench.make_vec(ENVIRONMENT_ID, 3, "cpu", **arguments))
    wrapped = DictInfoToList(ClipReward(statistics, -1.0, 1.0))
    plain.reset(seed=1)
    observation, _ = wrapped.reset(seed=1)
    rewards = np.zeros(3)
    for action in actions_of(1, HORIZON // 10, 3):
        _, reward, _, truncated, info = plain.step(action)
        observation, clipped, _, _, infos = wrapped.step(action)
        assert (clipped == np.clip(reward, -1, 1)).all() and wrapped.observation_space.contains(observation)
        rewards += reward
    assert truncated.all()
    assert list(statistics.return_queue) == rewards.tolist()
    assert list(statistics.length_queue) == [HORIZON // 10] * 3
    for env in range(3):
        assert infos[env]["episode"]["r"] == rewards[env]
        assert infos[env]["final_info"]["new_visited"] == info["final_info"]["new_visited"][env]
        assert_same(infos[env]["final_obs"], info["final_obs"][env], f"environment {env}")
    plain.close()
    wrapped.close()
