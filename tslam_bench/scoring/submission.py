"""Submissions: rollouts and reconstructions of one method, written and read (protocol section 12).

Layout (``docs/submission.md``)::

    submission.json
    rollouts/<object>/pose<k>_seed<s>.npz
    reconstructions/<object>_<n>_seed<s>.npz or .ply

``n`` is 1, 2, 4 or 8: the reconstruction after so many poses of the exploration order. All four are required.
"""

from __future__ import annotations

import difflib
import hashlib
import io
import json
import re
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import trimesh
from numpy.typing import NDArray

from tslam_bench import grids
from tslam_bench.constants import GRID_SIZE, HORIZON, NUM_JOINTS, PROTOCOL_POSES
from tslam_bench.errors import InvalidInputError
from tslam_bench.files import atomic_file, ensure_writable_directory, write_json
from tslam_bench.objects.splits import ALIASES, OBJECTS
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring.info import SubmissionInfo, parse_info
from tslam_bench.scoring.untrusted_arrays import Expected, read_npz
from tslam_bench.scoring.untrusted_files import FileSource, open_source

INFO_FILE: Final = "submission.json"
MAX_INFO_SIZE: Final = 64 * 2**10
"""Bytes of submission.json."""
MAX_RESOLUTION: Final = 256
"""Largest R of a probability grid (R, R, R)."""
MAX_MESH_ELEMENTS: Final = 1_000_000
"""Most vertices, and most faces, of a ``.ply`` reconstruction."""

EXPLORATION_ORDER: Final = PROTOCOL_POSES[4] + tuple(k for k in PROTOCOL_POSES[8] if k not in PROTOCOL_POSES[4])
"""Poses in the order of the exploration curve: its first four are the 4-pose protocol."""
RECONSTRUCTED_POSES: Final[dict[int, tuple[int, ...]]] = {n: EXPLORATION_ORDER[:n] for n in (1, 2, 4, 8)}
"""Poses merged in each reconstruction, by their number; all four are required."""

_ROLLOUT_ARRAYS: Final = {
    "actions": Expected("float32", (HORIZON, NUM_JOINTS)),
    "touched": Expected("uint8", (GRID_SIZE**3 // 8,)),
    "visited": Expected("uint8", (GRID_SIZE**3 // 8,)),
    "touched_step": Expected("int16", (GRID_SIZE,) * 3),
}
_RECONSTRUCTION_ARRAYS: Final = {
    "probability": Expected("float16", (None,) * 3, MAX_RESOLUTION),
    "interpolation": Expected("U", ()),
}
_ROLLOUT_NAME = re.compile(r"rollouts/([a-z0-9_]{1,64})/pose([0-7])_seed(0|[1-9][0-9]{0,9})\.npz")
_RECONSTRUCTION_NAME = re.compile(r"reconstructions/([a-z0-9_]{1,64})_([1248])_seed(0|[1-9][0-9]{0,9})\.(npz|ply)")

Reconstruction = Volume | trimesh.Trimesh


@dataclass(frozen=True, eq=False)
class Rollout:
    """One episode: one object, one pose, one seed. Grids are in the world frame of that pose.

    Attributes:
        actions: (200, 28) float32 in [-1, 1], one row per control step.
        touched: (32, 32, 32) bool, voxels touched by the end.
        visited: (32, 32, 32) bool, voxels visited by the end.
        touched_step: (32, 32, 32) int16, control step (from 0) at which a voxel was first touched, -1 for never.

    Raises:
        InvalidInputError: shapes, data types or values are wrong, or ``touched_step`` and ``touched`` disagree.
    """

    actions: NDArray[np.float32]
    touched: NDArray[np.bool_]
    visited: NDArray[np.bool_]
    touched_step: NDArray[np.int16]

    def __post_init__(self) -> None:
        grid = (GRID_SIZE,) * 3
        for name, dtype, shape in (
            ("actions", np.float32, (HORIZON, NUM_JOINTS)),
            ("touched", np.bool_, grid),
            ("visited", np.bool_, grid),
            ("touched_step", np.int16, grid),
        ):
            value = np.asarray(getattr(self, name))
            if value.shape != shape or value.dtype != dtype:
                wanted = f"{shape} {np.dtype(dtype)}"
                raise InvalidInputError(f"{name} is {value.shape} {value.dtype}; expected {wanted}")
        if not np.isfinite(self.actions).all():
            raise InvalidInputError("actions hold NaN or infinite values; store the actions that were executed")
        if np.abs(self.actions).max() > 1:
            raise InvalidInputError("actions leave [-1, 1]; clip them before they are executed and stored")
        if ((self.touched_step < -1) | (self.touched_step >= HORIZON)).any():
            raise InvalidInputError(f"touched_step holds values outside -1..{HORIZON - 1}")
        if not np.array_equal(self.touched_step >= 0, self.touched):
            raise InvalidInputError("touched_step and touched disagree; a voxel is touched iff its step is 0 or more")


class Submission:
    """A submission that was read and checked. Files are loaded when asked for.

    Attributes:
        info: contents of ``submission.json``.
        location: the path it was read from.
        content_hash: SHA-256 over the names and bytes of all its files; the same for a folder and a zip of it; empty if
            they were not checked.
    """

    def __init__(self, source: FileSource, info: SubmissionInfo, content_hash: str) -> None:
        self.info = info
        self.location = source.location
        self.content_hash = content_hash
        self._source = source

    def rollout(self, object_name: str, pose: int, seed: int) -> Rollout | None:
        """One episode, or None if the submission does not hold it."""
        name = rollout_name(object_name, pose, seed)
        return self._read_rollout(name) if name in self._source.sizes else None

    def reconstruction(self, object_name: str, count: int, seed: int) -> Reconstruction | None:
        """One reconstruction in the object frame, or None if the submission does not hold it."""
        for suffix in ("npz", "ply"):
            name = reconstruction_name(object_name, count, seed, suffix)
            if name in self._source.sizes:
                return self._read_reconstruction(name)
        return None

    def check(self, objects: Collection[str]) -> None:
        """Reads every file once. Raises InvalidInputError at the first that is not what it has to be."""
        reconstructions: set[str] = set()
        for name in sorted(self._source.sizes):
            if name == INFO_FILE:
                continue
            rollout, reconstruction = _ROLLOUT_NAME.fullmatch(name), _RECONSTRUCTION_NAME.fullmatch(name)
            match = rollout or reconstruction
            if match is None:
                raise self._refusal(name[:100], "not a file of a submission; see docs/submission.md for the names")
            self._check_object(name, match[1], objects)
            if int(match[3]) not in self.info.seeds:
                raise self._refusal(
                    name, f"seed {match[3]} is not among the seeds in {INFO_FILE}; list it or remove it"
                )
            if rollout:
                self._read_rollout(name)
            else:
                if name[:-4] in reconstructions:
                    raise self._refusal(name, "there is an .npz and a .ply of the same reconstruction; keep one")
                reconstructions.add(name[:-4])
                self._read_reconstruction(name)

    def _check_object(self, name: str, object_name: str, objects: Collection[str]) -> None:
        if object_name in objects:
            return
        if object_name in ALIASES:
            raise self._refusal(name, f"{object_name!r} is another name of {ALIASES[object_name]!r}; use that")
        near = difflib.get_close_matches(object_name, objects, n=1)
        remedy = f"did you mean {near[0]!r}?" if near else "tslam-bench assets list names them"
        raise self._refusal(name, f"unknown object {object_name!r}; {remedy}")

    def _read_rollout(self, name: str) -> Rollout:
        arrays = read_npz(self._source.read(name), _ROLLOUT_ARRAYS, f"{self.location}: {name}")
        try:
            return Rollout(
                actions=arrays["actions"],
                touched=grids.unpack(arrays["touched"]),
                visited=grids.unpack(arrays["visited"]),
                touched_step=arrays["touched_step"],
            )
        except InvalidInputError as error:
            raise self._refusal(name, str(error)) from error

    def _read_reconstruction(self, name: str) -> Reconstruction:
        data = self._source.read(name)
        if name.endswith(".ply"):
            return _read_ply(data, f"{self.location}: {name}")
        arrays = read_npz(data, _RECONSTRUCTION_ARRAYS, f"{self.location}: {name}")
        try:
            return Volume(arrays["probability"].astype(np.float32), str(arrays["interpolation"]))  # type: ignore[arg-type]
        except InvalidInputError as error:
            raise self._refusal(name, str(error)) from error

    def _refusal(self, name: str, reason: str) -> InvalidInputError:
        return InvalidInputError(f"{self.location}: {name}: {reason}")


def read_submission(path: Path | str, objects: Collection[str] | None = None, check: bool = True) -> Submission:
    """Reads and checks a submission, folder or zip archive, without trusting it.

    Args:
        path: folder or zip archive.
        objects: names that may occur; the test split by default.
        check: read every file now; without it a damaged file is refused when it is asked for.

    Raises:
        InvalidInputError: one line that names the submission, the file in it, what is wrong and the remedy.
    """
    source = open_source(Path(path))
    if INFO_FILE not in source.sizes:
        raise InvalidInputError(
            f"{source.location}: {INFO_FILE} is missing; an unfinished run writes it last, so resume it"
        )
    if source.sizes[INFO_FILE] > MAX_INFO_SIZE:
        raise InvalidInputError(f"{source.location}: {INFO_FILE} has more than {MAX_INFO_SIZE} bytes; shorten it")
    try:
        info = parse_info(source.read(INFO_FILE))
    except InvalidInputError as error:
        raise InvalidInputError(f"{source.location}: {INFO_FILE}: {error}") from error
    submission = Submission(source, info, _content_hash(source) if check else "")
    if check:
        submission.check(OBJECTS.keys() if objects is None else objects)
    return submission


class SubmissionWriter:
    """Writes a submission file by file. Killed at any time, it leaves whole files only, and a new writer goes on.

    ``submission.json`` is written by :meth:`close`: a folder without it is unfinished and is refused by scoring. As a
    context manager it closes when the block ends without an exception.

    Args:
        directory: the submission's folder; created, or the folder of an earlier writer of the same submission.
        info: contents of ``submission.json``.

    Raises:
        InvalidInputError: the folder holds another submission.
        AssetError: the folder cannot be written.
    """

    def __init__(self, directory: Path | str, info: SubmissionInfo) -> None:
        self.directory = Path(directory)
        self.info = info
        self._unfinished = self.directory / f".{INFO_FILE}.unfinished"
        ensure_writable_directory(self.directory)
        for earlier in (self._unfinished, self.directory / INFO_FILE):
            if not earlier.is_file():
                continue
            try:
                same = parse_info(earlier.read_bytes()).identity() == info.identity()
            except InvalidInputError:
                same = False
            if not same:
                raise InvalidInputError(
                    f"{self.directory}: holds another submission; remove it or choose another folder"
                )
        write_json(self._unfinished, info.to_json())

    def has_rollout(self, object_name: str, pose: int, seed: int) -> bool:
        """Whether the rollout was written, now or by an earlier writer."""
        return (self.directory / rollout_name(object_name, pose, seed)).is_file()

    def has_reconstruction(self, object_name: str, count: int, seed: int) -> bool:
        """Whether the reconstruction was written, now or by an earlier writer."""
        names = (reconstruction_name(object_name, count, seed, suffix) for suffix in ("npz", "ply"))
        return any((self.directory / name).is_file() for name in names)

    def add_rollout(
        self,
        object_name: str,
        pose: int,
        seed: int,
        actions: NDArray[np.float32],
        touched: NDArray[np.bool_],
        visited: NDArray[np.bool_],
        touched_step: NDArray[np.int16],
    ) -> None:
        """Writes one episode; arguments as in :class:`Rollout`, grids in the world frame of ``pose``."""
        name = self._checked(rollout_name(object_name, pose, seed), _ROLLOUT_NAME, seed)
        try:
            rollout = Rollout(np.asarray(actions), np.asarray(touched), np.asarray(visited), np.asarray(touched_step))
        except InvalidInputError as error:
            raise InvalidInputError(f"{name}: {error}") from error
        self._write_npz(
            name,
            actions=rollout.actions,
            touched=grids.pack(rollout.touched),
            visited=grids.pack(rollout.visited),
            touched_step=rollout.touched_step,
        )

    def add_reconstruction(self, object_name: str, count: int, seed: int, reconstruction: Reconstruction) -> None:
        """Writes one reconstruction in the object frame: a volume as float16, or a watertight mesh in metres.

        Args:
            count: number of merged poses: 1, 2, 4 or 8.
        """
        suffix = "npz" if isinstance(reconstruction, Volume) else "ply"
        name = self._checked(reconstruction_name(object_name, count, seed, suffix), _RECONSTRUCTION_NAME, seed)
        if isinstance(reconstruction, Volume):
            if reconstruction.resolution > MAX_RESOLUTION:
                raise InvalidInputError(f"{name}: resolution {reconstruction.resolution}; at most {MAX_RESOLUTION}")
            self._write_npz(
                name,
                probability=reconstruction.probability.astype(np.float16),
                interpolation=np.array(reconstruction.interpolation),
            )
            return
        if not isinstance(reconstruction, trimesh.Trimesh):
            raise InvalidInputError(f"{name}: {type(reconstruction).__name__}; give a Volume or a trimesh.Trimesh")
        if max(len(reconstruction.vertices), len(reconstruction.faces)) > MAX_MESH_ELEMENTS:
            raise InvalidInputError(f"{name}: more than {MAX_MESH_ELEMENTS} vertices or faces; simplify the mesh")
        plain = trimesh.Trimesh(reconstruction.vertices, reconstruction.faces, process=False)
        with atomic_file(self.directory / name) as temporary:
            temporary.write_bytes(bytes(plain.export(file_type="ply")))  # type: ignore[arg-type]

    def close(self) -> None:
        """Writes ``submission.json``: from now on the folder is a submission."""
        write_json(self.directory / INFO_FILE, self.info.to_json())
        self._unfinished.unlink(missing_ok=True)

    def __enter__(self) -> SubmissionWriter:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self.close()

    def _checked(self, name: str, pattern: re.Pattern[str], seed: int) -> str:
        if not pattern.fullmatch(name):
            raise InvalidInputError(
                f"{name}: not a file of a submission; check object, pose or number of poses, and seed"
            )
        if seed not in self.info.seeds:
            raise InvalidInputError(f"{name}: seed {seed} is not among the submission's seeds {list(self.info.seeds)}")
        return name

    def _write_npz(self, name: str, **arrays: NDArray) -> None:
        with atomic_file(self.directory / name) as temporary, temporary.open("wb") as stream:
            np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]


def rollout_name(object_name: str, pose: int, seed: int) -> str:
    """Name of a rollout inside a submission."""
    return f"rollouts/{object_name}/pose{pose}_seed{seed}.npz"


def reconstruction_name(object_name: str, count: int, seed: int, suffix: str) -> str:
    """Name of a reconstruction inside a submission; ``suffix`` is ``npz`` or ``ply``."""
    return f"reconstructions/{object_name}_{count}_seed{seed}.{suffix}"


def _content_hash(source: FileSource) -> str:
    digest = hashlib.sha256()
    for name in sorted(source.sizes):
        digest.update(json.dumps([name, hashlib.sha256(source.read(name)).hexdigest()]).encode())
    return digest.hexdigest()


def _read_ply(data: bytes, where: str) -> trimesh.Trimesh:
    """A triangle mesh from a PLY file: element counts are checked in the header before anything is allocated."""
    header, end, _ = data[:8192].partition(b"end_header")
    counts = dict(re.findall(rb"^element (\w+) (\d{1,18})\s*$", header, re.MULTILINE))
    if not data.startswith(b"ply") or not end or b"vertex" not in counts or b"face" not in counts:
        raise InvalidInputError(f"{where}: not a PLY mesh with vertices and faces; export a triangle mesh")
    for element, count in counts.items():
        if int(count) > MAX_MESH_ELEMENTS:
            raise InvalidInputError(f"{where}: {int(count)} {element.decode()} elements; at most {MAX_MESH_ELEMENTS}")
    try:
        mesh = trimesh.load_mesh(io.BytesIO(data), file_type="ply", process=False)
    except Exception as error:  # the parser raises whatever its libraries raise on damaged input
        reason = " ".join(str(error).split())[:100]
        raise InvalidInputError(f"{where}: damaged PLY file ({reason}); export it again") from error
    if not isinstance(mesh, trimesh.Trimesh):
        raise InvalidInputError(f"{where}: holds no single triangle mesh; export one")
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    faces = np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3)
    if len(vertices) != int(counts[b"vertex"]) or (len(faces) and (faces.min() < 0 or faces.max() >= len(vertices))):
        raise InvalidInputError(f"{where}: truncated, or faces refer to missing vertices; export it again")
    return trimesh.Trimesh(vertices, faces, process=False)
