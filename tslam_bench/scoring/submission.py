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
import json
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Final

import numpy as np
import trimesh

from tslam_bench.constants import PROTOCOL_POSES
from tslam_bench.episodes import Episode
from tslam_bench.errors import InvalidInputError
from tslam_bench.files import atomic_file, ensure_writable_directory, link_or_copy, write_json
from tslam_bench.geometry.ply import MAX_MESH_ELEMENTS, read_ply
from tslam_bench.objects.splits import ALIASES, check_split, known_names
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring.info import OBJECT_SETS, SubmissionInfo, parse_info
from tslam_bench.scoring.rollout import OBJECT_NAME, Rollout, parse_rollout_file, rollout_file
from tslam_bench.scoring.untrusted_arrays import Expected, read_npz
from tslam_bench.scoring.untrusted_files import FileSource, open_source
from tslam_bench.text import visible

INFO_FILE: Final = "submission.json"
ROLLOUTS: Final = "rollouts/"
MAX_INFO_SIZE: Final = 64 * 2**10
"""Bytes of submission.json."""
MAX_RESOLUTION: Final = 256
"""Largest R of a probability grid (R, R, R)."""

EXPLORATION_ORDER: Final = PROTOCOL_POSES[4] + tuple(k for k in PROTOCOL_POSES[8] if k not in PROTOCOL_POSES[4])
"""Poses in the order of the exploration curve: its first four are the 4-pose protocol."""
RECONSTRUCTED_POSES: Final[dict[int, tuple[int, ...]]] = {n: EXPLORATION_ORDER[:n] for n in (1, 2, 4, 8)}
"""Poses merged in each reconstruction, by their number; all four are required."""

_RECONSTRUCTION_ARRAYS: Final = {
    "probability": Expected("float16", (None,) * 3, MAX_RESOLUTION),
    "interpolation": Expected("U", ()),
}
_RECONSTRUCTION_NAME: Final = re.compile(
    rf"reconstructions/({OBJECT_NAME})_([1248])_seed(0|[1-9][0-9]{{0,9}})\.(npz|ply)"
)

Reconstruction = Volume | trimesh.Trimesh


class Submission:
    """A submission whose files were all read, hashed and checked once. Can be sent to another process.

    Files are read again when asked for, so that large submissions need little memory; one whose bytes are not those that
    were hashed is refused.

    Attributes:
        info: contents of ``submission.json``.
        location: the path it was read from.
        content_hash: SHA-256 over the names and bytes of all its files; the same for a folder and a zip of it.
        split: of its objects.
    """

    def __init__(
        self,
        source: FileSource,
        info: SubmissionInfo,
        digests: Mapping[str, str],
        content_hash: str,
        split: str = "test",
    ) -> None:
        """Args: digests: name -> SHA-256 of each of the files that were checked."""
        self.info = info
        self.location = source.location
        self.content_hash = content_hash
        self.split = split
        self._source = source
        self._digests = digests

    def episodes(self) -> list[Episode]:
        """The episodes whose rollouts it holds, sorted."""
        return sorted(episode for name in self._digests if (episode := _episode(name)) is not None)

    def objects(self) -> tuple[str, ...]:
        """Names of the objects that it holds anything of, sorted."""
        return tuple(sorted({name for file in self._digests if (name := _object_of(file)) is not None}))

    def of_object(self, object_name: str) -> Submission:
        """The same submission with the files of one object only: less to send to another process."""
        own = {name: digest for name, digest in self._digests.items() if _object_of(name) == object_name}
        return Submission(self._source.only(own), self.info, own, self.content_hash, self.split)

    def rollout(self, object_name: str, pose: int, seed: int) -> Rollout | None:
        """One episode, or None if the submission does not hold it."""
        name = rollout_name(object_name, pose, seed)
        if name not in self._digests:
            return None
        return Rollout.from_bytes(self._read(name), (object_name, pose, seed), f"{self.location}: {name}")

    def reconstruction(self, object_name: str, count: int, seed: int) -> Reconstruction | None:
        """One reconstruction in the object frame, or None if the submission does not hold it."""
        for suffix in ("npz", "ply"):
            name = reconstruction_name(object_name, count, seed, suffix)
            if name in self._digests:
                return _reconstruction(self._read(name), name, self.location)
        return None

    def digest(self, name: str) -> str:
        """SHA-256 of one of its files; empty if it does not hold it."""
        return self._digests.get(name, "")

    def rollouts_hash(self, object_name: str, seed: int) -> str:
        """SHA-256 over an object's rollouts, the same in every submission of one exploration; empty if there are none."""
        names = [rollout_name(object_name, pose, seed) for pose in EXPLORATION_ORDER]
        own = {name: self._digests[name] for name in names if name in self._digests}
        return _combined(own) if own else ""

    def _read(self, name: str) -> bytes:
        data = self._source.read(name)
        if hashlib.sha256(data).hexdigest() != self._digests[name]:
            raise self._source.changed(name)
        return data


def read_submission(path: Path | str, objects: Collection[str] | None = None, split: str = "test") -> Submission:
    """Reads, hashes and checks every file of a submission, folder or zip archive, without trusting it.

    Args:
        path: folder or zip archive.
        objects: names that may occur; those of the split by default.
        split: that the submission is of.

    Raises:
        InvalidInputError: one line that names the submission, the file in it, what is wrong and the remedy.
    """
    split = check_split(split)
    source = open_source(Path(path))
    if INFO_FILE not in source.sizes:
        raise InvalidInputError(f"{source.location}: {INFO_FILE} is missing; {_where_else(source)}")
    if source.sizes[INFO_FILE] > MAX_INFO_SIZE:
        raise InvalidInputError(f"{source.location}: {INFO_FILE} has more than {MAX_INFO_SIZE} bytes; shorten it")
    data = source.read(INFO_FILE)
    try:
        info = parse_info(data)
    except InvalidInputError as error:
        raise InvalidInputError(f"{source.location}: {INFO_FILE}: {error}") from error
    if info.split != split:
        raise InvalidInputError(
            f"{source.location}: {INFO_FILE}: object_set {info.object_set!r} is not of split {split!r}; choose one of "
            f"{', '.join(OBJECT_SETS) if split == 'test' else split}, or say --split {info.split}"
        )
    _check_names(source, info, known_names(split) if objects is None else objects)
    digests = {INFO_FILE: hashlib.sha256(data).hexdigest()}
    for name in source.sizes:
        if name != INFO_FILE:
            data = source.read(name)
            digests[name] = hashlib.sha256(data).hexdigest()
            if (episode := _episode(name)) is not None:
                Rollout.from_bytes(data, episode, f"{source.location}: {name}")
            else:
                _reconstruction(data, name, source.location)
    return Submission(source, info, digests, _combined(digests), split)


def _where_else(source: FileSource) -> str:
    """What to do about a submission without a submission.json."""
    found = sorted(name for name in source.sizes if name.endswith(f"/{INFO_FILE}"))
    if len(found) > 1:
        folders = " and ".join(visible(name.rpartition("/")[0])[:60] for name in found[:2])
        return f"{folders} hold one each, so give them one by one"
    if found:
        return f"it is in the folder {visible(found[0].rpartition('/')[0])[:100]}, so give (or pack) that folder alone"
    return "an unfinished run writes it last, so resume it"


def _check_names(source: FileSource, info: SubmissionInfo, objects: Collection[str]) -> None:
    """Raises InvalidInputError at the first name that a submission does not hold."""
    reconstructions: set[str] = set()
    for name in sorted(source.sizes):
        if name == INFO_FILE:
            continue
        where = f"{source.location}: {visible(name)[:100]}"
        episode, match = _episode(name), _RECONSTRUCTION_NAME.fullmatch(name)
        if episode is not None:
            object_name, seed = episode[0], episode[2]
        elif match is not None:
            object_name, seed = match[1], int(match[3])
            if name[:-4] in reconstructions:
                raise InvalidInputError(f"{where}: there is an .npz and a .ply of the same reconstruction; keep one")
            reconstructions.add(name[:-4])
        else:
            raise InvalidInputError(f"{where}: not a file of a submission; see docs/submission.md for the names")
        if object_name not in objects:
            if object_name in ALIASES:
                reason = f"{object_name!r} is another name of {ALIASES[object_name]!r}; use that"
            else:
                near = difflib.get_close_matches(object_name, objects, n=1)
                remedy = f"did you mean {near[0]!r}?" if near else "tslam-bench assets list names them"
                reason = f"unknown object {object_name!r}; {remedy}"
            raise InvalidInputError(f"{where}: {reason}")
        if seed not in info.seeds:
            raise InvalidInputError(f"{where}: seed {seed} is not among the seeds in {INFO_FILE}; list it or remove it")


def _episode(name: str) -> Episode | None:
    """The episode whose rollout the file ``name`` holds, or None."""
    return parse_rollout_file(name.removeprefix(ROLLOUTS)) if name.startswith(ROLLOUTS) else None


def _object_of(name: str) -> str | None:
    """The object that the file ``name`` is of, or None."""
    match = _RECONSTRUCTION_NAME.fullmatch(name)
    return match[1] if match else (_episode(name) or (None,))[0]


def _combined(digests: Mapping[str, str]) -> str:
    """SHA-256 over names and the SHA-256 of what they name."""
    whole = hashlib.sha256()
    for name in sorted(digests):
        whole.update(json.dumps([name, digests[name]]).encode())
    return whole.hexdigest()


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

    def add_rollout(self, rollout: Rollout, stored: Path | None = None) -> None:
        """Adds one episode.

        Args:
            stored: the file that it was saved to or loaded from, if any. It is not written again: the submission gets
                a hard link to it, or a copy where the file system has no links.
        """
        name = rollout_name(rollout.object, rollout.pose, rollout.seed)
        self._check_seed(name, rollout.seed)
        if stored is not None:
            link_or_copy(stored, self.directory / name)
        else:
            rollout.save(self.directory / ROLLOUTS)

    def add_reconstruction(self, object_name: str, count: int, seed: int, reconstruction: Reconstruction) -> None:
        """Writes one reconstruction in the object frame: a volume as float16, or a watertight mesh in metres.

        Args:
            count: number of merged poses: 1, 2, 4 or 8.
        """
        suffix = "npz" if isinstance(reconstruction, Volume) else "ply"
        name = reconstruction_name(object_name, count, seed, suffix)
        if not _RECONSTRUCTION_NAME.fullmatch(name):
            raise InvalidInputError(f"{name}: not a file of a submission; check object, number of poses, and seed")
        self._check_seed(name, seed)
        if isinstance(reconstruction, Volume):
            if reconstruction.resolution > MAX_RESOLUTION:
                raise InvalidInputError(f"{name}: resolution {reconstruction.resolution}; at most {MAX_RESOLUTION}")
            half = reconstruction.probability.astype(np.float16)
            with atomic_file(self.directory / name) as temporary, temporary.open("wb") as stream:
                np.savez_compressed(stream, probability=half, interpolation=np.array(reconstruction.interpolation))
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

    def _check_seed(self, name: str, seed: int) -> None:
        if seed not in self.info.seeds:
            raise InvalidInputError(f"{name}: seed {seed} is not among the submission's seeds {list(self.info.seeds)}")


def rollout_name(object_name: str, pose: int, seed: int) -> str:
    """Name of a rollout inside a submission."""
    return ROLLOUTS + rollout_file(object_name, pose, seed)


def reconstruction_name(object_name: str, count: int, seed: int, suffix: str) -> str:
    """Name of a reconstruction inside a submission; ``suffix`` is ``npz`` or ``ply``."""
    return f"reconstructions/{object_name}_{count}_seed{seed}.{suffix}"


def _reconstruction(data: bytes, name: str, location: str) -> Reconstruction:
    where = f"{location}: {name}"
    if name.endswith(".ply"):
        return read_ply(data, where)
    arrays = read_npz(data, _RECONSTRUCTION_ARRAYS, where)
    try:
        return Volume(arrays["probability"].astype(np.float32), str(arrays["interpolation"]))  # type: ignore[arg-type]
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from error
