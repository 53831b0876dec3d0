"""The GPU path from ``make_vec`` to ``gpu-check``, whole, with CPU physics behind PhysX's GPU interface (benchmarks/gpu)."""

from __future__ import annotations

import json
import sys
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sapien import physx

from tslam_bench.cli import main
from tslam_bench.constants import ENVIRONMENT_ID, HORIZON, NUM_JOINTS, TABLETOP_ID
from tslam_bench.engine import gpu_physics
from tslam_bench.engine.physics import pose_quaternion, table_pose
from tslam_bench.errors import InvalidInputError
from tslam_bench.objects.store import load_object
from tslam_bench.registration import make_vec
from tslam_bench.tasks.tactile_slam import TactileSLAMEnv

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / "gpu"))
from emulated_gpu import emulated_gpu

ENVS = 3
SEEDS = [11, 12, 13]


def make(environment_id: str = ENVIRONMENT_ID, **kwargs: Any) -> Any:
    return make_vec(environment_id, ENVS, "cuda", objects=("mug", "hammer"), **kwargs)


@pytest.fixture(scope="module")
def free():
    with emulated_gpu():
        envs = make()
        yield envs
        envs.close()


@pytest.fixture(scope="module")
def tabletop():
    with emulated_gpu():
        envs = make(TABLETOP_ID)
        yield envs
        envs.close()


@pytest.fixture(scope="module")
def host():
    envs = make_vec(num_envs=ENVS, device="cpu", objects=("mug", "hammer"), processes=0)
    yield envs
    envs.close()


def rows_of(envs: Any, name: str) -> np.ndarray:
    """(E, 7) poses of a named body as PhysX has them, found by name, not by ManiSkill's index."""
    scenes = envs.environment.unwrapped.scene.sub_scenes
    poses = [e.pose for scene in scenes for e in scene.entities if e.name.endswith(f"_{name}")]
    return np.array([[*pose.p, *pose.q] for pose in poses])


@pytest.mark.parametrize("which", ["free", "tabletop"])
def test_everything_with_a_body_is_an_actor_or_a_hand(which, request):
    scene = request.getfixturevalue(which).environment.unwrapped.scene
    known = [body for actor in scene.actors.values() for body in actor._objs]
    known += [link.entity for hand in scene.articulations.values() for obj in hand._objs for link in obj.links]
    found = 0
    for sub_scene in scene.sub_scenes:
        for entity in sub_scene.entities:
            if entity.find_component_by_type(physx.PhysxRigidBaseComponent) is not None:
                assert entity in known, entity.name
                found += 1
    assert found == len(known)


@pytest.mark.parametrize("which", ["free", "tabletop"])
def test_nothing_touches_while_the_scene_is_set_up(which, request):
    """PhysX simulates a step then: every joint at zero, which is inside an object in the middle of the workspace."""
    contacts = request.getfixturevalue(which).environment.unwrapped.scene.px.after_init
    assert len(contacts) == ENVS and not any(contacts)


def test_a_reset_puts_table_and_object_where_they_belong_and_applying_leaves_them_there(tabletop):
    tabletop.reset(seed=SEEDS, options={"pose": [1, 3, 0]})
    base = tabletop.environment.unwrapped
    for _ in range(2):
        for env, name in enumerate(base.object_name):
            expected = table_pose(load_object(name))
            np.testing.assert_allclose(rows_of(tabletop, "table")[env, :3], expected.p, atol=1e-6)
            np.testing.assert_allclose(
                rows_of(tabletop, "object")[env], [0, 0, 0, *pose_quaternion([1, 3, 0][env])], atol=1e-6
            )
        tabletop.step(np.zeros((ENVS, NUM_JOINTS), dtype=np.float32))
        base.scene._gpu_apply_all()
        base.scene._gpu_fetch_all()


REQUESTS: dict[str, list[dict[str, Any]]] = {
    "all seeds": [{"seed": SEEDS}],
    "one seed": [{"seed": 5}],
    "None among seeds": [{"seed": [4, None, 6]}],
    "numpy seeds": [{"seed": np.array([7, 8, 9])}],
    "no seed": [{}],
    "a part": [{"options": {"reset_mask": np.array([True, False, True])}}],
    "a part with seeds": [{"seed": [1, 2, 3], "options": {"reset_mask": np.array([False, True, False])}}, {}],
    "nobody": [{"options": {"reset_mask": np.zeros(ENVS, dtype=bool)}}, {}],
    "mask as a tensor": [{"options": {"reset_mask": torch.tensor([True, True, False])}}],
    "poses as an array": [{"options": {"pose": np.array([3, 1, 2])}}],
    "options of None": [{"options": {"pose": None, "object": None, "reset_mask": None}}],
    "a None among poses": [{"options": {"pose": [3, None, 2]}}],
    "numbers in any order": [{"options": {"env_idx": [2, 0, 2], "pose": [3, 5, 7]}}],
}


@pytest.mark.parametrize("name", REQUESTS)
def test_a_reset_does_on_a_gpu_what_it_does_on_a_cpu(name, free, host):
    """Joint positions follow from generators and pose alone, so both sides have to show the same after the same calls."""
    for envs in (free, host):
        envs.reset(seed=[21, 22, 23], options={"pose": [0, 1, 2]})
    action = np.full((ENVS, NUM_JOINTS), 0.3, dtype=np.float32)
    for envs in (free, host):
        envs.step(action)
    for request in REQUESTS[name]:
        on_gpu, gpu_info = free.reset(**request)
        on_cpu, cpu_info = host.reset(**request)
    for key in ("qpos", "time", "touch"):
        np.testing.assert_allclose(on_gpu[key].numpy(), on_cpu[key], atol=1e-6, err_msg=key)
    assert gpu_info["elapsed_steps"].tolist() == cpu_info["elapsed_steps"].tolist()
    assert gpu_info["_elapsed_steps"].tolist() == cpu_info["_elapsed_steps"].tolist()
    poses = host.state()["pose"]
    assert free.environment.unwrapped.pose == poses
    np.testing.assert_allclose(rows_of(free, "object")[:, 3:], [pose_quaternion(pose) for pose in poses], atol=1e-6)


BAD: dict[str, dict[str, Any]] = {
    "number": {"options": {"env_idx": [0, 3]}},
    "both": {"options": {"env_idx": [0], "reset_mask": np.ones(ENVS, dtype=bool)}},
    "mask": {"options": {"reset_mask": np.array([1, 0, 1])}},
    "seed": {"seed": [1, 2.5, 3]},
    "negative": {"seed": -1},
    "seeds": {"seed": [1, 2]},
    "pose": {"options": {"pose": [0, 9, 0]}},
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_reset_is_refused_in_one_line_on_both(name, free, host):
    for envs in (free, host):
        with pytest.raises(InvalidInputError) as caught:
            envs.reset(**BAD[name])
        assert "\n" not in str(caught.value)


def test_a_partial_reset_leaves_the_others_alone(free):
    free.reset(seed=SEEDS)
    for _ in range(3):
        before, *_ = free.step(np.full((ENVS, NUM_JOINTS), -0.5, dtype=np.float32))
    after, info = free.reset(options={"reset_mask": np.array([False, True, False])})
    for key in before:
        assert torch.equal(before[key][[0, 2]], after[key][[0, 2]]), key
    assert not torch.equal(before["qpos"][1], after["qpos"][1]) and info["elapsed_steps"].tolist() == [3, 0, 3]


def test_a_second_reset_loads_nothing(free, monkeypatch):
    def refuse(*_: Any) -> None:
        raise AssertionError("an object was loaded")

    monkeypatch.setattr(free.environment.unwrapped._starts, "load", refuse)
    names = list(free.environment.unwrapped.object_name)
    free.reset(seed=SEEDS)
    free.reset(options={"object": names, "reset_mask": np.array([False, True, True])})


def test_an_action_that_is_not_finite_stays_with_its_hand(free):
    """The others do what they would have done, bit for bit, and it is told who it was."""
    action = np.full((ENVS, NUM_JOINTS), -0.4, dtype=np.float32)
    free.reset(seed=SEEDS)
    expected, *_ = free.step(action)
    free.reset(seed=SEEDS)
    before = free.faults.clone()
    bad = action.copy()
    bad[1, 4], bad[1, 9] = np.nan, np.inf
    found, reward, *_ = free.step(bad)
    assert (free.faults - before).tolist() == [0, 1, 0]
    for key in expected:
        assert torch.equal(found[key][[0, 2]], expected[key][[0, 2]]), key
        assert torch.isfinite(found[key].float()).all()
    assert torch.isfinite(reward).all()


def test_a_simulation_that_broke_stays_in_its_scene_until_its_reset(free, monkeypatch):
    """NaN in one hand's links, positions and velocities, as PhysX leaves it when a solver breaks."""
    action = np.full((ENVS, NUM_JOINTS), -0.4, dtype=np.float32)
    free.reset(seed=SEEDS)
    free.step(action)
    expected, *_ = free.step(action)
    base = free.environment.unwrapped
    system = base.scene.px

    def breaks(name: str) -> None:
        fetch = getattr(system, f"gpu_fetch_articulation_{name}")

        def fetch_then_break() -> None:
            fetch()
            if name == "link_pose":
                system.cuda_rigid_body_data.torch()[base.agent._skin_rows[1]] = torch.nan
            else:
                getattr(system, f"cuda_articulation_{name}").torch()[1] = torch.nan

        monkeypatch.setattr(system, f"gpu_fetch_articulation_{name}", fetch_then_break)

    free.reset(seed=SEEDS)
    for name in ("link_pose", "qpos", "qvel"):
        breaks(name)
    before = free.faults.clone()
    free.step(action)
    found, reward, *_ = free.step(action)
    assert (free.faults - before).tolist() == [0, 2, 0]
    for key in expected:
        assert torch.equal(found[key][[0, 2]], expected[key][[0, 2]]), key
        assert torch.isfinite(found[key].float()).all()
    assert torch.isfinite(reward).all()
    assert torch.isfinite(system.cuda_articulation_target_qpos.torch()).all(), "the drives were handed NaN"
    monkeypatch.undo()
    fresh, _ = free.reset(seed=SEEDS)
    again, *_ = free.step(action)
    assert torch.isfinite(again["qpos"]).all() and again["qpos"][1].abs().max() > 0
    assert (fresh["qpos"][1] != 0).any()


def test_hands_never_sleep_on_a_gpu(free):
    base = free.environment.unwrapped
    assert base.sim_config.scene_config.sleep_threshold == 0
    bodies = [link for hand in base.agent.robot._objs for link in hand.links]
    assert {body.sleep_threshold for body in bodies if hasattr(body, "sleep_threshold")} <= {0.0}
    assert base.sim_config.spacing == 2.5


def test_episodes_start_anew_at_the_horizon(free):
    free.reset(seed=SEEDS)
    for step in range(1, HORIZON + 1):
        observation, _, _, truncated, info = free.step(np.zeros((ENVS, NUM_JOINTS), dtype=np.float32))
        assert bool(truncated.all()) == (step == HORIZON)
    assert info["final_info"]["elapsed_steps"].tolist() == [HORIZON] * ENVS
    assert observation["time"].eq(0).all() and info["final_obs"][2]["time"].item() == 1


@pytest.mark.parametrize("on_gpu", [False, True])
def test_the_old_scene_is_gone_before_a_new_one_is_made(on_gpu):
    alive = []

    class Watched(TactileSLAMEnv):
        watched: Any = None

        def _setup_scene(self) -> None:
            if self.watched is not None:
                alive.append([name for name, ref in self.watched.items() if ref() is not None])
            super()._setup_scene()

        def _after_reconfigure(self, options: dict) -> None:
            self.watched = {"scene": weakref.ref(self.scene), "sensing": weakref.ref(self._sensing)}
            if on_gpu:
                self.watched |= {"system": weakref.ref(self.scene.px), "objects": weakref.ref(self._objects)}

    if on_gpu:
        with emulated_gpu():
            env = Watched(objects=("mug", "hammer"), num_envs=2)
    else:
        env = Watched(objects=("mug", "hammer"))
    with emulated_gpu() if on_gpu else pytest.MonkeyPatch.context():
        env.reset(seed=[1] * (1 + on_gpu))
        env.step(np.zeros((1 + on_gpu, NUM_JOINTS), dtype=np.float32))
        env.reset(options={"reconfigure": True})
        env.close()
    assert alive == [[]]


def test_the_whole_check_runs_and_leaves_its_stamp(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(gpu_physics, "cache_directory", lambda: tmp_path)
    with emulated_gpu():
        assert gpu_physics.simulation_device("auto", ENVIRONMENT_ID) == "cpu"
        main(["gpu-check", "--num-envs", "2", "--objects", "mug", "hammer", "--json"])
        assert gpu_physics.simulation_device("auto", ENVIRONMENT_ID) == "cuda"
    report = json.loads(capsys.readouterr().out)
    assert report["passed"] and report["stamped"] and report["complaints"] == []
    assert {finding["name"] for finding in report["findings"]} > {"touch", "faults", "free_motion"}
