"""``TactileSLAM-Tabletop-v0``: where the table stands, that it stops the hand, and that only the object is felt."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import tslam_bench
from tslam_bench import grids
from tslam_bench.constants import ENVIRONMENT_ID, NUM_JOINTS, QUICK_OBJECTS, TABLE_SIZE, TABLETOP_ID, VOXEL_EDGE
from tslam_bench.engine.skin import build_skin, dense_volume_points
from tslam_bench.errors import InvalidInputError
from tslam_bench.objects.hand import load_hand
from tslam_bench.objects.store import load_object


@pytest.fixture(scope="module")
def environment():
    env = gym.make(TABLETOP_ID, objects=QUICK_OBJECTS)
    yield env
    env.close()


@pytest.fixture(scope="module")
def skin_points():
    """Points in and on the hand's skin-bearing shapes, closer together than the tolerances below."""
    return dense_volume_points(load_hand().shapes, 2e-3)


def placed(env: gym.Env, points) -> np.ndarray:
    """(P, 3) where the hand's points are in the world (m)."""
    matrices = env.unwrapped.hand.skin_matrices()[0, points.link]
    return np.einsum("pij,pj->pi", matrices[:, :, :3], points.position) + matrices[:, :, 3]


def table_and_object(env: gym.Env):
    entities = {entity.name: entity for entity in env.unwrapped.scene.sub_scenes[0].entities}
    return entities.get("table"), entities["object"]


def pressing(seed: int, steps: int) -> np.ndarray:
    """Actions that press the hand down while its fingers move at random."""
    actions = np.random.default_rng(seed).uniform(-1, 1, (steps, NUM_JOINTS)).astype(np.float32)
    actions[:, 1] = -1.0
    return actions


@pytest.mark.parametrize("name", QUICK_OBJECTS)
def test_the_object_stands_on_the_table(environment, name):
    for pose in range(4):
        environment.reset(seed=pose, options={"object": name, "pose": pose})
        table, body = table_and_object(environment)
        shape = table.components[0].collision_shapes[0]
        top = table.pose.p[2] + shape.half_size[2]
        lowest = (load_object(name).vertices @ grids.pose_rotation(pose).T)[:, 2].min()
        assert top == pytest.approx(lowest, abs=1e-6)
        assert np.allclose(body.pose.p, 0) and np.allclose(table.pose.q, [1, 0, 0, 0])
        covered = np.abs(load_object(name).vertices @ grids.pose_rotation(pose).T)[:, :2].max(axis=0)
        assert (covered < shape.half_size[:2]).all(), "the object stands on it, not over its edge"


@pytest.mark.parametrize("name", QUICK_OBJECTS)
def test_the_hand_starts_above_the_table(environment, name):
    forearm = next(shape for shape in load_hand().shapes if shape.link == "forearm")
    arm = environment.unwrapped.agent.robot.links_map["forearm"]._objs[0]
    points = build_skin(load_hand().shapes).volume
    for seed in range(12):
        environment.reset(seed=seed, options={"object": name})
        table, _ = table_and_object(environment)
        half = table.components[0].collision_shapes[0].half_size
        top = table.pose.p[2] + half[2]
        assert placed(environment, points)[:, 2].min() > top + 0.01
        matrix = arm.entity_pose.to_transformation_matrix()
        axis = matrix[:3, :3] @ np.array([0, 0, 1.0])  # the capsule lies along the link's z
        centre = matrix[:3, :3] @ np.array(forearm.position) + matrix[:3, 3]
        along = centre + np.linspace(-1, 1, 21)[:, None] * forearm.size[1] * axis
        gap = np.abs(along - np.array(table.pose.p)) - half
        assert np.linalg.norm(np.maximum(gap, 0), axis=1).min() > forearm.size[0] + 0.001, "the forearm is clear"


def test_the_table_stops_the_hand_and_is_not_felt(environment, skin_points):
    """A hand that presses down on the flat hammer: it meets the table, sinks in no further than into the object, and
    every voxel that it touches is at the hammer's surface."""
    free = gym.make(ENVIRONMENT_ID, object="hammer")
    options = {"object": "hammer", "pose": 0}
    environment.reset(seed=2, options=options)
    free.reset(seed=2, options=options)
    top = float(load_object("hammer").vertices[:, 2].min())
    centre, half = np.array([0, 0, top - TABLE_SIZE[2] / 2]), np.array(TABLE_SIZE) / 2
    depths, free_depths, met = [], [], 0
    for action in pressing(0, 120):
        environment.step(action)
        free.step(action)
        for env, found in ((environment, depths), (free, free_depths)):  # of the deepest point in the table
            found.append(float((half - np.abs(placed(env, skin_points) - centre)).min(axis=1).max()))
        for contact in environment.unwrapped.scene.px.get_contacts():
            names = {body.entity.name for body in contact.bodies}
            met += "table" in names and any(point.separation < 0.5e-3 for point in contact.points)
    assert met > 100 and max(depths) < 4e-3, "the hand rests on the table"
    assert max(free_depths) > 0.02, "without a table it would have gone into it"
    touched = environment.unwrapped.touched[0]
    assert touched.sum() >= 5
    surface = load_object("hammer").surface_points
    distance = np.linalg.norm(grids.voxel_centres()[touched][:, None] - surface[None, ::20], axis=2).min(axis=1)
    assert np.percentile(distance, 95) < VOXEL_EDGE, "touched voxels are at the object, not on the table"
    free.close()


def test_other_poses_are_refused_in_one_line(environment):
    message = r"pose 5: not in TactileSLAM-Tabletop-v0.*choose one of 0, 1, 2, 3"
    for refused in (
        lambda: gym.make(TABLETOP_ID, object="mug", pose=5),
        lambda: tslam_bench.make_vec(TABLETOP_ID, 2, "cpu", object="mug", pose=5),
        lambda: environment.reset(options={"pose": 5}),
    ):
        with pytest.raises(InvalidInputError, match=message) as caught:
            refused()
        assert "\n" not in str(caught.value)
    for odd in ("up", np.nan, 1.5, True, -1):
        with pytest.raises(InvalidInputError, match="unknown; choose an integer from 0 to 7"):
            environment.reset(options={"pose": odd})


def test_vector_environment_refuses_and_accepts_poses_of_the_variant():
    envs = tslam_bench.make_vec(TABLETOP_ID, 2, "cpu", object="mug", processes=1)
    with pytest.raises(InvalidInputError, match="pose 4: not in TactileSLAM-Tabletop-v0"):
        envs.reset(seed=0, options={"pose": [0, 4]})
    envs.reset(seed=0, options={"pose": [0, 3]})  # a refusal harms nothing
    assert envs.state()["pose"] == [0, 3]
    envs.close()
