"""Prepared objects on disk: the one format that tasks, reconstruction and scoring read.

An object is a directory ``<cache>/objects/<split>/<name>/``. All geometry is in the object frame (canonical orientation,
origin at the bounding-box centre), in metres. numpy only.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class SignedDistanceField:
    """Signed distance (m, negative inside) to the union of the collision hulls, sampled on a regular grid.

    The grid covers the object's bounding box with padding; no probe further out than the padding can be on.

    Attributes:
        origin: (3,) position of sample [0, 0, 0] in the object frame.
        spacing: distance between neighbouring samples.
        values: (nx, ny, nz) float32 signed distances.
        surface_error: largest |trilinear - exact| found on and near the surface when it was built.
    """

    origin: NDArray[np.float64]
    spacing: float
    values: NDArray[np.float32]
    surface_error: float


@dataclass(frozen=True)
class PreparedObject:
    """Everything the benchmark knows about one object.

    Attributes:
        name, split, category: identifiers.
        vertices, faces: watertight ground-truth mesh, (V, 3) float64 and (F, 3) int64 (inner voids filled, section 8).
        hulls: collision hulls, a tuple of (vertices (v, 3) float64, faces (f, 3) int64), at most 64 of each.
        field: signed distance to the hulls.
        solid: (32, 32, 32) bool, voxel centre inside the ground truth.
        surface: (32, 32, 32) bool, voxels that the true surface crosses.
        surface_points, surface_normals: (100000, 3) float32 area-uniform samples and their face normals.
        solid_at_iou_points: (100000,) bool, ground truth at ``tslam_bench.sampling.iou_points()``.
        raw_solid_at_iou_points: the same for the mesh whose inner voids are not filled.
        record: the manifest record: source, licence, hashes, extents, volume, hull count, gate figures.
    """

    name: str
    split: str
    category: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    hulls: tuple[tuple[NDArray[np.float64], NDArray[np.int64]], ...]
    field: SignedDistanceField
    solid: NDArray[np.bool_]
    surface: NDArray[np.bool_]
    surface_points: NDArray[np.float32]
    surface_normals: NDArray[np.float32]
    solid_at_iou_points: NDArray[np.bool_]
    raw_solid_at_iou_points: NDArray[np.bool_]
    record: dict[str, Any]


def load_object(name: str, split: str = "test", cache: Path | None = None) -> PreparedObject:
    """Loads one prepared object (aliases of section 8 resolve to their object).

    Raises:
        InvalidInputError: the name is unknown in the split (the message lists near matches).
        AssetError: the object is known but not prepared, or a product is missing or corrupt (names the file and the command
            that rebuilds it).
    """
    raise AssetError("not written")


def list_objects(split: str = "test", cache: Path | None = None) -> list[dict[str, Any]]:
    """Manifest records of the prepared objects of a split, sorted by name."""
    raise AssetError("not written")
