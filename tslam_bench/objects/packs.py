"""Prepared objects in few compact files, to be carried to a machine that cannot prepare them.

A pack is an uncompressed zip of deflated members: ``pack.json`` (format, split, names), and per object its ``record.json`` and an
array per product, without the header that ``numpy.save`` writes. Bytes of equal weight lie together, and fields are differences
along their last axis: a third of what deflating the files gives. Unpacking writes the same bytes and checks their SHA-256.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import atomic_directory, atomic_file
from tslam_bench.objects.hand import hand_directory
from tslam_bench.objects.splits import split_directory
from tslam_bench.objects.store import ARRAYS, object_directory, read_record

PACK_LIMIT: Final = 60_000_000
"""Bytes that a pack stays below."""
_FORMAT: Final = 1
_INDEX: Final = "pack.json"
_NAME: Final = re.compile(r"[A-Za-z0-9_-]+")
_LARGEST: Final = 1 << 28  # bytes of one unpacked member
_HAND: Final = "hand"


def pack_objects(
    names: Sequence[str], split: str, output: Path, limit: int = PACK_LIMIT, cache: Path | None = None
) -> Iterator[tuple[Path, int]]:
    """Writes ``SPLIT-000.zip``, ``SPLIT-001.zip``, ... with the objects ``names`` of a canonical split.

    Yields:
        each file when it is complete, and how many objects it holds.

    Raises:
        AssetError: an object is not prepared or damaged.
        InvalidInputError: one object alone is above ``limit`` bytes.
    """
    waiting: dict[str, dict[str, bytes]] = {}
    size, number = 0, 0
    for name in names:
        members = _object_members(name, split, cache)
        own = sum(len(data) + 200 + 2 * len(member) for member, data in members.items())
        if own + 4096 > limit:
            raise InvalidInputError(f"{name}: takes {own} bytes alone, more than the limit of {limit}; raise it")
        if size + own + 4096 + 80 * len(waiting) > limit:
            yield _write_pack(output / f"{split}-{number:03d}.zip", split, waiting), len(waiting)
            waiting, size, number = {}, 0, number + 1
        waiting[name], size = members, size + own
    if waiting:
        yield _write_pack(output / f"{split}-{number:03d}.zip", split, waiting), len(waiting)


def pack_hand(output: Path, cache: Path | None = None) -> Path:
    """Writes ``hand.zip``. Raises AssetError if the hand is not prepared."""
    folder = hand_directory(cache)
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    if not files:
        raise AssetError(f"{folder}: the hand is not prepared; run 'tslam-bench assets prepare --hand'")
    members = {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}
    digests = {name: hashlib.sha256(data).hexdigest() for name, data in members.items()}
    compressed = {name: zlib.compress(data) for name, data in members.items()}
    index = {"format": _FORMAT, "hand": folder.name, "files": digests}
    return _write_zip(output / f"{_HAND}.zip", index, compressed)


def unpack(path: Path, cache: Path | None = None) -> tuple[int, int]:
    """Puts what a pack holds into the cache; what is there already with the same record is left alone.

    Returns:
        how many objects (the hand counts as one) were written, and how many were there.

    Raises:
        AssetError: the file is no pack or damaged, a hash differs, or another object of the same name is there.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            index = json.loads(_read(archive, _INDEX))
            if index["format"] != _FORMAT:
                raise ValueError(f"format {index['format']}, expected {_FORMAT}")
            if "hand" in index:
                return _unpack_hand(archive, index, cache)
            split = _checked_name(index["split"])
            written = [_unpack_object(archive, _checked_name(name), split, cache) for name in index["objects"]]
    except (OSError, zipfile.BadZipFile, zlib.error, ValueError, KeyError, TypeError) as error:
        raise AssetError(f"{path}: no intact pack ({error}); pack and copy it again") from error
    return sum(written), len(written) - sum(written)


# -- one object ---------------------------------------------------------------------------------------------------
def _object_members(name: str, split: str, cache: Path | None) -> dict[str, bytes]:
    record, folder = read_record(name, split, cache), object_directory(name, split, cache)
    members = {f"{name}/record.json": zlib.compress((folder / "record.json").read_bytes())}
    for product in ARRAYS:
        stated = record["products"][f"{product}.npy"]
        try:
            encoded = encode(np.load(folder / f"{product}.npy"), product == "field")
        except (OSError, ValueError) as error:
            raise AssetError(f"{folder / product}.npy: cannot be read ({error})") from error
        if _digest(_file_bytes(encoded, product, stated)) != stated["sha256"]:
            raise AssetError(
                f"{folder / product}.npy: does not have its recorded SHA-256; see 'tslam-bench assets verify'"
            )
        members[f"{name}/{product}"] = zlib.compress(encoded)
    return members


def _unpack_object(archive: zipfile.ZipFile, name: str, split: str, cache: Path | None) -> bool:
    text = _read(archive, f"{name}/record.json")
    record = json.loads(text)
    if record["name"] != name or record["split"] != split:
        raise ValueError(f"{name}: the record is another object's")
    target = split_directory(split, cache) / name
    if (target / "record.json").is_file():
        if json.loads((target / "record.json").read_bytes())["products"] == record["products"]:
            return False
        raise AssetError(f"{target}: holds another object of this name; move it away first")
    with atomic_directory(target) as folder:
        for product in ARRAYS:
            stated = record["products"][f"{product}.npy"]
            data = _file_bytes(_read(archive, f"{name}/{product}"), product, stated)
            if _digest(data) != stated["sha256"]:
                raise ValueError(f"{name}/{product}.npy: SHA-256 differs from the record")
            (folder / f"{product}.npy").write_bytes(data)
        (folder / "record.json").write_bytes(text)
    return True


def encode(array: NDArray[Any], differences: bool = False) -> bytes:
    """An array's numbers with bytes of equal weight together; ``differences`` along the last axis of a float16 array first."""
    array = np.ascontiguousarray(array)
    if differences:
        bits = array.view(np.uint16)
        array = bits.copy()
        array[..., 1:] -= bits[..., :-1]
    return array.reshape(-1).view(np.uint8).reshape(-1, array.dtype.itemsize).T.tobytes()


def decode(data: bytes, dtype: str, shape: Sequence[int], differences: bool = False) -> NDArray[Any]:
    """Inverse of :func:`encode`. Raises ValueError if ``data`` is of another length."""
    kind = np.dtype(dtype)
    planes = np.frombuffer(data, dtype=np.uint8).reshape(kind.itemsize, -1)
    array = np.ascontiguousarray(planes.T).reshape(-1).view(np.uint16 if differences else kind).reshape(tuple(shape))
    return np.cumsum(array, axis=-1, dtype=np.uint16).view(kind) if differences else array


def _file_bytes(data: bytes, product: str, stated: dict[str, Any]) -> bytes:
    """The ``.npy`` file of an encoded product."""
    buffer = io.BytesIO()
    np.save(buffer, decode(data, stated["dtype"], stated["shape"], product == "field"))
    return buffer.getvalue()


# -- the hand and the archive -------------------------------------------------------------------------------------
def _unpack_hand(archive: zipfile.ZipFile, index: dict[str, Any], cache: Path | None) -> tuple[int, int]:
    target = hand_directory(cache)
    if index["hand"] != target.name:
        raise ValueError(f"holds {index['hand']}, this version reads {target.name}")
    if (target / "record.json").is_file():
        return 0, 1
    with atomic_directory(target) as folder:
        for name, digest in index["files"].items():
            parts = name.split("/")
            if any(part in ("", ".", "..") or "\\" in part or ":" in part for part in parts):
                raise ValueError(f"{name!r}: not a file of the hand")
            data = _read(archive, name)
            if _digest(data) != digest:
                raise ValueError(f"{name}: SHA-256 differs")
            path = folder.joinpath(*parts)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
    return 1, 0


def _write_pack(path: Path, split: str, objects: dict[str, dict[str, bytes]]) -> Path:
    members = {member: data for one in objects.values() for member, data in one.items()}
    return _write_zip(path, {"format": _FORMAT, "split": split, "objects": list(objects)}, members)


def _write_zip(path: Path, index: dict[str, Any], members: dict[str, bytes]) -> Path:
    """Members are deflated already, so the archive stores them; equal contents make equal bytes."""
    with atomic_file(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        archive.writestr(zipfile.ZipInfo(_INDEX), zlib.compress(json.dumps(index).encode()))
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name), data)
    return path


def _read(archive: zipfile.ZipFile, name: str) -> bytes:
    inflate = zlib.decompressobj()
    data = inflate.decompress(archive.read(name), _LARGEST)
    if not inflate.eof:
        raise ValueError(f"{name}: cut off, or larger than {_LARGEST} bytes")
    return data


def _checked_name(name: Any) -> str:
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ValueError(f"{name!r}: not a name of an object or split")
    return name


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
