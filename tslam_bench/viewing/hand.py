"""The hand for the page: its chain of joints and its meshes, from the converted model in the user's cache."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tslam_bench.hand_constants import BASE_POSITION, BASE_QUATERNION, JOINT_NAMES, SKIN_LINKS
from tslam_bench.objects.hand import load_hand, visual_meshes
from tslam_bench.viewing.packing import pack

LENGTH_STEP: Final = 2e-5
"""Lengths are stored in steps of this (m), in 16 bits."""


def hand_script(name: str, cache: Path | None = None) -> str:
    """The script of the hand, under ``name``.

    Its header has ``links`` in the order parent before child, each with its name, the index of its ``parent`` (-1: the base),
    the ``place`` of its joint in the parent's frame (position, then quaternion x, y, z, w), the joint's ``type``, ``axis`` and
    index in ``JOINT_NAMES``, its index in ``SKIN_LINKS`` (-1: none), and ``visuals``: index of a mesh, position, quaternion.

    Raises:
        AssetError: the hand is not prepared.
    """
    urdf = load_hand(cache).urdf
    meshes: dict[tuple[str, tuple[float, ...]], int] = {}
    arrays: dict[str, NDArray] = {}
    visuals: dict[str, list[Any]] = {}
    for link, file, pose, scale in visual_meshes(urdf):
        key = (file.name, tuple(scale))
        if key not in meshes:
            meshes[key] = len(meshes)
            vertices, faces = _mesh(file, scale)
            arrays[f"v{meshes[key]}"], arrays[f"f{meshes[key]}"] = lengths(vertices), indices(faces)
        place = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        visuals.setdefault(link, []).append({"mesh": meshes[key], "place": _short(place)})
    header = {
        "step": LENGTH_STEP,
        "base": _short([*BASE_POSITION, *BASE_QUATERNION[1:], BASE_QUATERNION[0]]),
        "links": [{**link, "visuals": visuals.get(link["name"], [])} for link in chain(urdf)],
    }
    return pack(name, header, arrays)


def chain(urdf: Path) -> list[dict[str, Any]]:
    """Links of the converted hand with the joints that carry them, parents first: see :func:`hand_script`."""
    root = ElementTree.parse(urdf).getroot()
    joints = {_attribute(joint, "child", "link"): joint for joint in root.iter("joint")}
    waiting = [link.attrib["name"] for link in root.iter("link")]
    links: list[dict[str, Any]] = []
    number: dict[str, int] = {}
    while waiting:
        name = next(n for n in waiting if n not in joints or _attribute(joints[n], "parent", "link") in number)
        waiting.remove(name)
        number[name] = len(links)
        joint = joints.get(name)
        skin = SKIN_LINKS.index(name) if name in SKIN_LINKS else -1
        entry: dict[str, Any] = {"name": name, "parent": -1, "skin": skin, "joint": -1, "type": "fixed"}
        if joint is not None:
            angles = [float(x) for x in _attribute(joint, "origin", "rpy").split()]
            position = [float(x) for x in _attribute(joint, "origin", "xyz").split()]
            entry |= {
                "parent": number[_attribute(joint, "parent", "link")],
                "place": _short([*position, *Rotation.from_euler("xyz", angles).as_quat()]),
                "type": joint.attrib["type"],
            }
            if joint.attrib["type"] != "fixed":
                entry["axis"] = _short([float(x) for x in _attribute(joint, "axis", "xyz").split()])
                entry["joint"] = JOINT_NAMES.index(joint.attrib["name"])
        links.append(entry)
    return links


def lengths(vertices: NDArray) -> NDArray[np.int16]:
    """Coordinates (m) in steps of ``LENGTH_STEP``, up to 0.65 m."""
    return np.clip(np.round(vertices / LENGTH_STEP), -32767, 32767).astype(np.int16)


def indices(faces: NDArray) -> NDArray:
    """Vertex numbers in as few bits as they need."""
    return faces.astype(np.uint16 if faces.size == 0 or faces.max() < 2**16 else np.uint32)


def _mesh(file: Path, scale: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
    """Vertices (m) and faces of a mesh file; a mirroring scale turns the faces."""
    loaded = trimesh.load_mesh(file)
    vertices, inverse = np.unique(lengths(np.asarray(loaded.vertices) * scale), axis=0, return_inverse=True)
    corners = inverse.reshape(-1)[np.asarray(loaded.faces)]
    corners = corners[:, ::-1] if np.prod(scale) < 0 else corners
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    first = np.full(len(vertices), corners.size)
    np.minimum.at(first, corners.reshape(-1), np.arange(corners.size))
    order = np.argsort(first)
    return vertices[order] * LENGTH_STEP, np.argsort(order)[corners]


def _attribute(element: ElementTree.Element, child: str, name: str) -> str:
    found = element.find(child)
    assert found is not None, f"{element.attrib}: no {child}"
    return found.attrib[name]


def _short(values: Any) -> list[float]:
    return [round(float(value), 7) for value in values]
