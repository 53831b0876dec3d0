"""The MuJoCo peer of the benchmarks simulates the engine's hand: two independent engines agree on it."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from mujoco_peer import EQUAL_PENETRATION, MujocoSettings, build_model, with_mujoco
from rollouts import Hands, PressingHands, run_episode
from separation import REACH, SeparationRuler

from tslam_bench.constants import NUM_JOINTS
from tslam_bench.engine.hand_batch import BatchSettings
from tslam_bench.engine.worker_vector_env import TactileVectorEnv
from tslam_bench.objects.hand import load_hand
from tslam_bench.objects.store import load_object

SETTINGS = BatchSettings(object="mug", pose=0, control_mode="pd_joint_pos")


def test_hulls_reach_mujoco_unmoved():
    prepared = load_object("mug")
    model = build_model(load_hand().urdf, MujocoSettings(), prepared)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    (geoms,) = np.nonzero(model.geom_bodyid == model.body("object").id)
    assert len(geoms) == len(prepared.hulls)
    for geom, (vertices, _) in zip(geoms, prepared.hulls, strict=True):
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        placed = model.mesh_vert[first : first + count] @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        distance = np.linalg.norm(placed[:, None] - vertices[None], axis=2)
        assert distance.min(axis=0).max() < 1e-7 and distance.min(axis=1).max() < 1e-7


def test_both_engines_settle_at_the_same_joint_positions():
    """Free space, far above the object: one second is enough for the slowest joint to arrive."""
    generator = np.random.default_rng(0)
    actions = generator.uniform(-0.8, 0.8, (4, NUM_JOINTS))
    actions[:, 1] = 1.0  # as high as the arm goes
    ends = []
    for settings in (SETTINGS, with_mujoco(SETTINGS, MujocoSettings())):
        hands = Hands(4, settings)
        hands.reset(0)
        for _ in range(60):
            hands.step(actions)
        assert not hands.arrays["touch"].any()
        ends.append(hands.arrays["qpos"].copy())
    assert np.abs(ends[0] - hands.batch._targets(actions.astype(np.float32), ends[0])).max() < 5e-3
    np.testing.assert_allclose(ends[0], ends[1], atol=2e-3)


def test_peer_feels_the_object_and_stays_out_of_it():
    hands = Hands(2, with_mujoco(BatchSettings(object="mug"), EQUAL_PENETRATION))
    ruler, felt, depths = SeparationRuler("mug", 0), [], []

    def look(_):
        for env in range(2):
            links, _ = ruler.measure(hands.arrays["qpos"][env])
            felt.append((hands.arrays["touch"][env].astype(bool), links < 0.5e-3))
            depths.append(-min(0.0, links.min()))

    run_episode(hands, 0, PressingHands(2, 0), look, poses=[0, 0])
    on, truth = (np.array(part) for part in zip(*felt, strict=True))
    assert truth.sum() > 50
    assert (on & truth).sum() / truth.sum() > 0.9, "skin and MuJoCo's contacts agree"
    assert np.percentile(depths, 99) < 2e-3


def test_ruler_measures_a_known_distance():
    """The hand comes down on a cube by a given height: the distance changes by as much."""
    ruler = SeparationRuler("cubemedium", 0)
    qpos = np.zeros(NUM_JOINTS)
    heights = np.linspace(0.25, -0.05, 301)
    nearest = []
    for height in heights:
        qpos[1] = height
        nearest.append(ruler.measure(qpos)[1])
    distance = np.array(nearest)
    assert np.isinf(distance[0]), "nothing is near at the top"
    first = int(np.flatnonzero(np.isfinite(distance))[0])
    assert distance[first] == pytest.approx(REACH, abs=1.1e-3)
    np.testing.assert_allclose(np.diff(distance[first : first + 4]), -1e-3, atol=2e-5)


@pytest.mark.slow
def test_peer_runs_in_worker_processes():
    envs = TactileVectorEnv(2, with_mujoco(BatchSettings(object="mug"), MujocoSettings()), processes=2)
    observation, _ = envs.reset(seed=0)
    start = observation["qpos"].copy()
    for _ in range(5):
        observation, reward, *_ = envs.step(np.full((2, NUM_JOINTS), 0.5, np.float32))
    assert np.isfinite(reward).all() and np.abs(observation["qpos"] - start).max() > 0.01
    envs.close()
