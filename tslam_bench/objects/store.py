"""Prepared objects on disk: the one format that tasks, reconstruction and scoring read.

An object is a directory ``<cache>/objects/<split>/<name>/`` of plain ``.npy`` files and a ``record.json`` that lists them with
shape, type and SHA-256. All geometry is in the object frame (canonical orientation, origin at the bounding-box centre), in
metres. numpy only.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import SURFACE_SAMPLES
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import atomic_directory, sha256_file, write_json
from tslam_bench.geometry.sampling import IouPoints, iou_points
from tslam_bench.geometry.triangles import face_normals
from tslam_bench.grids import pack, unpack
from tslam_bench.objects import splits
from tslam_bench.objects.hulls import Hull, pack_hulls, unpack_hulls
from tslam_bench.objects.splits import check_split, prepared_names, resolve_name, split_directory

FORMAT = 2
"""Version of the directory layout."""
ARRAYS = (
    "vertices",
    "faces",
    "hull_vertices",
    "hull_faces",
    "hull_offsets",
    "field",
    "grids",
    "surface_points",
    "surface_faces",
    "iou_bits",
)
"""The files of an object, without ``.npy``."""


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
        iou_cells: per axis of the lattice that decides the IoU points (:meth:`iou_points`).
        solid_at_iou_points: (N,) bool, ground truth at the N points of :meth:`iou_points`.
        raw_solid_at_iou_points: the same for the mesh whose inner voids are not filled.
        record: the manifest record: source, licence, hashes, extents, volume, hull count, gate figures.
    """

    name: str
    split: str
    category: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    hulls: tuple[Hull, ...]
    field: SignedDistanceField
    solid: NDArray[np.bool_]
    surface: NDArray[np.bool_]
    surface_points: NDArray[np.float32]
    surface_normals: NDArray[np.float32]
    iou_cells: tuple[int, int, int]
    solid_at_iou_points: NDArray[np.bool_]
    raw_solid_at_iou_points: NDArray[np.bool_]
    record: dict[str, Any]

    def iou_points(self) -> IouPoints:
        """Where the IoU is measured, in the object frame; computed at each call (a few hundredths of a second)."""
        return iou_points(self.vertices.min(axis=0), self.vertices.max(axis=0), self.iou_cells)


def object_directory(name: str, split: str, cache: Path | None = None) -> Path:
    """Directory of one object (may not exist)."""
    return split_directory(split, cache) / name


def rebuild_command(name: str, split: str) -> str:
    """The command that prepares one object."""
    command = "tslam-bench assets prepare" + ("" if split == "test" else f" --split {split}")
    return f"{command} --objects {name}"


def read_record(name: str, split: str, cache: Path | None = None) -> dict[str, Any]:
    """Manifest record of one prepared object (canonical name and split).

    Raises:
        AssetError: not prepared, or the record is corrupt or of another version.
    """
    path = object_directory(name, split, cache) / "record.json"
    if not path.exists():
        raise AssetError(f"object {name!r} of split {split} is not prepared; run: {rebuild_command(name, split)}")
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if record["name"] != name or not isinstance(record["products"], dict):
            raise ValueError("not the record of this object")
        if record["format"] != FORMAT:
            raise ValueError(f"format {record['format']}, expected {FORMAT}")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise AssetError(
            f"{path}: corrupt or outdated ({error}); rebuild it with: {rebuild_command(name, split)}"
        ) from error
    return record


def _read_array(directory: Path, product: str, record: dict[str, Any]) -> NDArray[Any]:
    """One array, compared with the shape and type that the record states."""
    path = directory / f"{product}.npy"
    try:
        array = np.load(path)
        stated = record["products"][path.name]
        if list(array.shape) != stated["shape"] or str(array.dtype) != stated["dtype"]:
            raise ValueError(f"holds {array.dtype} {array.shape}, expected {stated['dtype']} {tuple(stated['shape'])}")
    except FileNotFoundError as error:
        command = rebuild_command(record["name"], record["split"])
        raise AssetError(f"{path}: missing; rebuild it with: {command}") from error
    except (OSError, ValueError, KeyError, TypeError, EOFError) as error:
        command = rebuild_command(record["name"], record["split"])
        raise AssetError(f"{path}: corrupt ({error}); rebuild it with: {command}") from error
    return array


def load_object(name: str, split: str = "test", cache: Path | None = None) -> PreparedObject:
    """Loads one prepared object (aliases of section 8 resolve to their object).

    Shapes and types are checked; contents are hashed by ``tslam-bench assets verify`` only.

    Raises:
        InvalidInputError: the name is unknown in the split (the message lists near matches).
        AssetError: the object is known but not prepared, or a product is missing or corrupt (names the file and the command
            that rebuilds it).
    """
    split = check_split(split, cache)
    name = resolve_name(name, split, cache)
    directory = object_directory(name, split, cache)
    record = read_record(name, split, cache)
    arrays = {product: _read_array(directory, product, record) for product in ARRAYS}
    try:
        faces = arrays["faces"].astype(np.int64)
        normals = face_normals(arrays["vertices"][faces])
        packed = arrays["hull_vertices"], arrays["hull_faces"].astype(np.int64), arrays["hull_offsets"]
        field = SignedDistanceField(
            origin=np.array(record["field"]["origin"], dtype=np.float64),
            spacing=float(record["field"]["spacing"]),
            values=arrays["field"].astype(np.float32),
            surface_error=float(record["field"]["surface_error"]),
        )
        iou_bits = np.unpackbits(arrays["iou_bits"], axis=1, count=record["iou"]["points"]).astype(bool)
        x, y, z = record["iou"]["cells"]
        return PreparedObject(
            name=name,
            split=split,
            category=record["category"],
            vertices=arrays["vertices"],
            faces=faces,
            hulls=tuple(unpack_hulls(*packed)),
            field=field,
            solid=unpack(arrays["grids"][0]),
            surface=unpack(arrays["grids"][1]),
            surface_points=arrays["surface_points"],
            surface_normals=normals.astype(np.float32)[arrays["surface_faces"]],
            iou_cells=(x, y, z),
            solid_at_iou_points=iou_bits[0],
            raw_solid_at_iou_points=iou_bits[1],
            record=record,
        )
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise AssetError(
            f"{directory}: products do not fit together ({error}); rebuild them with: {rebuild_command(name, split)}"
        ) from error


def load_surface(name: str, split: str, cache: Path | None = None) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Ground-truth mesh alone of one prepared object: vertices (V, 3) in metres and faces (F, 3).

    Raises:
        AssetError: it is not prepared, or a product is missing or corrupt.
    """
    directory, record = object_directory(name, split, cache), read_record(name, split, cache)
    return _read_array(directory, "vertices", record), _read_array(directory, "faces", record).astype(np.int64)


def list_objects(split: str = "test", cache: Path | None = None) -> list[dict[str, Any]]:
    """Manifest records of the prepared objects of a split, sorted by name.

    Raises:
        InvalidInputError: the split is unknown.
        AssetError: a record is corrupt.
    """
    split = check_split(split, cache)
    return [
        read_record(name, split, cache)
        for name in prepared_names(split, cache)
        if split != "test" or name in splits.OBJECTS
    ]


def asset_sha256(names: Iterable[str], split: str = "test", cache: Path | None = None) -> str:
    """SHA-256 over the products of the objects ``names``: what rollouts were made with and scores were computed from.

    Raises:
        InvalidInputError: a name is unknown.
        AssetError: an object is not prepared, or its record is corrupt.
    """
    split = check_split(split, cache)
    products = {}
    for name in sorted({resolve_name(name, split, cache) for name in names}):
        record = read_record(name, split, cache)
        products[name] = {product: stated["sha256"] for product, stated in record["products"].items()}
    return hashlib.sha256(json.dumps(products, sort_keys=True).encode()).hexdigest()


def write(prepared: PreparedObject, surface_faces: NDArray[np.int64], cache: Path | None = None) -> dict[str, Any]:
    """Writes an object's products and its record, atomically.

    Args:
        prepared: the object; ``record`` holds what the manifest says besides the fields that are added here (
            ``format``, ``name``, ``split``, ``category``, ``field``, ``iou``, ``products``).
        surface_faces: (100000,) the face that each surface sample lies on.
        cache: cache directory (default: the user's).

    Returns:
        the full record as written.

    Raises:
        AssetError: the cache cannot be written.
    """
    if prepared.surface_points.shape != (SURFACE_SAMPLES, 3) or surface_faces.shape != (SURFACE_SAMPLES,):
        raise InvalidInputError(f"{prepared.name}: {SURFACE_SAMPLES} surface samples with their faces expected")
    hull_vertices, hull_faces, hull_offsets = pack_hulls(prepared.hulls)
    iou = np.stack([prepared.solid_at_iou_points, prepared.raw_solid_at_iou_points])
    arrays: dict[str, NDArray[Any]] = {
        "vertices": prepared.vertices.astype(np.float64),
        "faces": prepared.faces.astype(np.int32),
        "hull_vertices": hull_vertices.astype(np.float64),
        "hull_faces": hull_faces.astype(np.uint8),
        "hull_offsets": hull_offsets.astype(np.int32),
        "field": prepared.field.values.astype(np.float16),
        "grids": np.stack([pack(prepared.solid), pack(prepared.surface)]),
        "surface_points": prepared.surface_points.astype(np.float32),
        "surface_faces": surface_faces.astype(np.int32),
        "iou_bits": np.packbits(iou, axis=1),
    }
    target = object_directory(prepared.name, prepared.split, cache)
    with atomic_directory(target) as directory:
        products = {}
        for product in ARRAYS:
            path = directory / f"{product}.npy"
            np.save(path, arrays[product])
            products[path.name] = {
                "shape": list(arrays[product].shape),
                "dtype": str(arrays[product].dtype),
                "bytes": path.stat().st_size,
                "sha256": sha256_file(path),
            }
        record = dict(prepared.record) | {
            "format": FORMAT,
            "name": prepared.name,
            "split": prepared.split,
            "category": prepared.category,
            "field": {
                "origin": [float(x) for x in prepared.field.origin],
                "spacing": prepared.field.spacing,
                "shape": list(prepared.field.values.shape),
                "surface_error": prepared.field.surface_error,
            },
            "iou": {
                "cells": list(prepared.iou_cells),
                "points": len(prepared.solid_at_iou_points),
                "inside": int(prepared.solid_at_iou_points.sum()),
            },
            "products": products,
        }
        write_json(directory / "record.json", record)
    return record


def damage(name: str, split: str = "test", cache: Path | None = None) -> list[str]:
    """Reads and hashes every product of one prepared object.

    Returns:
        one line per product that is missing or does not have its recorded SHA-256; empty when all is well.
    """
    directory = object_directory(name, split, cache)
    try:
        record = read_record(name, split, cache)
    except AssetError as error:
        return [str(error)]
    lines = []
    for product, stated in record["products"].items():
        path = directory / product
        if not path.exists():
            lines.append(f"{path}: missing")
        elif sha256_file(path) != stated["sha256"]:
            lines.append(f"{path}: does not have its recorded SHA-256")
    missing = {f"{product}.npy" for product in ARRAYS} - set(record["products"])
    lines += [f"{directory / product}: not in the record" for product in sorted(missing)]
    return lines
