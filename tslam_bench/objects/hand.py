"""The converted Adroit hand on disk: its URDF and collision shapes.

:mod:`tslam_bench.preparation.convert_hand` writes it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from tslam_bench.errors import AssetError
from tslam_bench.files import cache_directory, sha256_file

HAND_VERSION = 2
"""Bumped whenever the conversion writes other files."""
URDF_NAME = "adroit28.urdf"
SHAPES_NAME = "shapes.json"
REBUILD_COMMAND = "tslam-bench assets prepare --hand"


@dataclass(frozen=True)
class CollisionShape:
    """One collision shape in its link's frame.

    Attributes:
        link: name of the link.
        kind: "capsule" (``size`` = radius, half length along local z) or "box" (``size`` = half edges).
        size: metres.
        position: (3,) metres.
        quaternion: (w, x, y, z).
    """

    link: str
    kind: str
    size: tuple[float, ...]
    position: tuple[float, ...]
    quaternion: tuple[float, ...]


@dataclass(frozen=True)
class HandFiles:
    """The converted hand: its URDF, and its collision shapes in link frames."""

    urdf: Path
    shapes: tuple[CollisionShape, ...]


def hand_directory(cache: Path | None = None) -> Path:
    """Where the converted hand lies in the cache."""
    return (cache or cache_directory()) / "hand" / f"adroit28-v{HAND_VERSION}"


def load_hand(cache: Path | None = None) -> HandFiles:
    """Reads the converted hand.

    Raises:
        AssetError: it has not been converted, or a file is damaged; names the command that rebuilds it.
    """
    folder = hand_directory(cache)
    try:
        record = json.loads((folder / "record.json").read_text(encoding="utf-8"))
        shapes = tuple(
            CollisionShape(s["link"], s["kind"], tuple(s["size"]), tuple(s["position"]), tuple(s["quaternion"]))
            for s in json.loads((folder / SHAPES_NAME).read_text(encoding="utf-8"))
        )
        digest = sha256_file(folder / URDF_NAME)
    except FileNotFoundError as error:
        raise AssetError(f"{error.filename}: the hand is not prepared; run '{REBUILD_COMMAND}'") from error
    except (ValueError, KeyError, TypeError) as error:
        raise AssetError(f"{folder}: damaged hand files; run '{REBUILD_COMMAND}'") from error
    if digest != record.get("urdf_sha256"):
        raise AssetError(f"{folder / URDF_NAME}: content differs from its record; run '{REBUILD_COMMAND}'")
    return HandFiles(folder / URDF_NAME, shapes)


def visual_meshes(urdf: Path) -> Iterator[tuple[str, Path, NDArray[np.float64], NDArray[np.float64]]]:
    """Yields (link, mesh file, (4, 4) pose of the mesh in the link frame, (3,) scale) of a converted hand."""
    from scipy.spatial.transform import Rotation

    for link in ElementTree.parse(urdf).getroot().iter("link"):
        for visual in link.iter("visual"):
            origin, mesh = visual.find("origin"), visual.find("geometry/mesh")
            assert origin is not None and mesh is not None
            pose = np.eye(4)
            pose[:3, 3] = [float(v) for v in origin.attrib["xyz"].split()]
            pose[:3, :3] = Rotation.from_euler("xyz", [float(v) for v in origin.attrib["rpy"].split()]).as_matrix()
            scale = np.array([float(v) for v in mesh.attrib["scale"].split()])
            yield link.attrib["name"], urdf.parent / mesh.attrib["filename"], pose, scale
