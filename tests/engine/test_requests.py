"""What callers of other habits ask for, in one line: names, options, seeds and pictures, through both doors."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import tslam_bench
from tslam_bench.constants import ENVIRONMENT_ID
from tslam_bench.engine.rendering import vulkan_device_available
from tslam_bench.errors import AssetError, InvalidInputError

OBJECTS = ("mug", "hammer")


@pytest.fixture(scope="module")
def doors():
    """One environment of each door, with the same objects."""
    single, batch = (
        gym.make(ENVIRONMENT_ID, objects=OBJECTS),
        tslam_bench.make_vec(num_envs=1, objects=OBJECTS, processes=0),
    )
    yield single, batch
    single.close()
    batch.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"objects": "mug"}, "objects 'mug': must be a list of names; object='mug' is one"),
        ({"objects": {"mug", "hammer"}}, "must be a list of names"),
        ({"objects": ("mug", 7)}, "object 7: must be a name, a text"),
        ({"objects": ("mug", "hamer")}, r"object 'hamer': unknown .*did you mean hammer"),
        ({"object": ["mug"]}, r"object \['mug'\]: must be a name"),
        ({"object": "mug", "split": 2}, "split 2: must be a name"),
        ({"object": "mug", "pose": [1]}, r"pose \[1\]: unknown"),
    ],
)
def test_names_that_are_none(arguments, message):
    for make in (lambda: gym.make(ENVIRONMENT_ID, **arguments), lambda: tslam_bench.make_vec(processes=0, **arguments)):
        with pytest.raises(InvalidInputError, match=message) as caught:
            make()
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "options",
    [
        {"object": np.array(["hammer"]), "pose": np.array([5])},
        {"object": np.array("hammer"), "pose": np.int16(5)},
        {"object": ("hammer",), "pose": range(5, 6), "reset_mask": None, "env_idx": None},
        {"object": [None], "pose": [5]},
        {"object": "hammer", "pose": None, "reset_mask": [True], "colour": "red"},
    ],
)
def test_arrays_and_none_are_options_at_both_doors(doors, options):
    single, batch = doors
    (one, _), (other, _) = (door.reset(seed=11, options=options) for door in doors)
    for name, value in one.items():
        np.testing.assert_array_equal(value.numpy(), other[name])
    state = batch.state()
    assert state["object_name"] == single.unwrapped.object_name and state["pose"] == single.unwrapped.pose
    assert options["object"] == [None] or state["object_name"] == ["hammer"]
    assert options["pose"] is None or state["pose"] == [5]


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"seed": 2**32}, "seed 4294967296: must be a whole number from 0 to 4294967295"),
        ({"seed": np.int64(-5)}, "seed -5"),
        ({"seed": [2**40]}, "seed 1099511627776"),
        ({"options": "pose"}, "options 'pose': must be a dictionary"),
        ({"options": {"object": 7}}, "object 7: must be a name"),
        ({"options": {"object": {"name": "mug"}}}, "must be a name"),
        ({"options": {"reset_mask": [[True], [True, False]]}}, r"options\['reset_mask'\].*give \(1,\) bool"),
        ({"options": {"pose": np.array([2.5])}}, "pose 2.5: unknown"),
    ],
)
def test_what_is_asked_wrongly_harms_nothing(doors, asked, message):
    for door in doors:
        door.reset(seed=3)
        with pytest.raises(InvalidInputError, match=message) as caught:
            door.reset(**asked)
        assert "\n" not in str(caught.value)
        observation, *_ = door.step(np.zeros((1, 28), np.float32))
        assert float(observation["time"][0, 0]) == pytest.approx(1 / 200)


def test_the_largest_seeds_are_seeds():
    envs = tslam_bench.make_vec(num_envs=2, object="mug", processes=0)
    envs.reset(seed=2**32 - 2)
    with pytest.raises(InvalidInputError, match="seed 4294967295: must be a whole number from 0 to 4294967294"):
        envs.reset(seed=2**32 - 1)
    envs.reset(seed=[2**32 - 1, 2**32 - 1])
    envs.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"render_mode": "video"}, "render_mode 'video': unknown; choose one of rgb_array"),
        ({"obs_mode": "rgb+xyz"}, r"obs_mode 'rgb\+xyz': unknown"),
        ({"obs_mode": 3}, "obs_mode 3: unknown"),
    ],
)
def test_unknown_pictures(arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        gym.make(ENVIRONMENT_ID, object="mug", **arguments)


@pytest.mark.skipif(vulkan_device_available(), reason="there is Vulkan, so this is no error")
def test_pictures_without_vulkan():
    """The line of ``tslam-bench env video``, at once where pictures are part of the observation, else by ``render``."""
    for arguments in (
        {"obs_mode": "rgbd"},
        {"obs_mode": "state_dict+depth"},
        {"render_mode": "human"},
        {"render_backend": "cpu"},
    ):
        ((name, value),) = arguments.items()
        with pytest.raises(AssetError) as caught:
            gym.make(ENVIRONMENT_ID, object="mug", **arguments)
        assert str(caught.value).startswith(f"{name} {value!r}: no Vulkan device; install a GPU driver")
    for mode in ("rgb_array", "sensors", "all"):
        env = gym.make(ENVIRONMENT_ID, object="mug", render_mode=mode)
        env.reset(seed=0)
        with pytest.raises(AssetError, match="render: no Vulkan device; install a GPU driver"):
            env.render()
        env.close()


def test_render_without_a_mode(doors):
    with pytest.raises(InvalidInputError, match="render: no render_mode was given"):
        doors[0].unwrapped.render()
