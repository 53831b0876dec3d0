"""Reading ``.npz`` files of known layout from bytes that nobody vouches for.

Headers are compared with what is expected before any data is decompressed, so that a small file cannot unpack into a
large array; pickled objects are never loaded.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import IO, Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.errors import InvalidInputError
from tslam_bench.scoring.untrusted_zip import COMPRESSIONS, open_zip

MAX_DIRECTORY: Final = 16 * 2**10
"""Bytes of the list of arrays in an ``.npz`` file."""
MAX_HEADER: Final = 4 * 2**10
"""Bytes of an array's header; numpy writes 128."""


@dataclass(frozen=True)
class Expected:
    """Layout of one array.

    Attributes:
        dtype: the exact data type, or ``"U"`` for short text.
        shape: sizes; None stands for a size from 1 to ``largest`` that is the same wherever it occurs.
        largest: upper bound of the free size.
    """

    dtype: str
    shape: tuple[int | None, ...]
    largest: int = 0

    def matches(self, dtype: np.dtype, shape: tuple[int, ...]) -> bool:
        """Whether a header fits."""
        if self.dtype == "U":
            return dtype.kind == "U" and dtype.itemsize <= 4 * 32 and shape == ()
        if dtype != np.dtype(self.dtype) or len(shape) != len(self.shape):
            return False
        free = {size for size, own in zip(shape, self.shape, strict=True) if own is None}
        fixed = all(own is None or own == size for size, own in zip(shape, self.shape, strict=True))
        return fixed and len(free) <= 1 and all(1 <= size <= self.largest for size in free)

    def __str__(self) -> str:
        shape = ", ".join("R" if size is None else str(size) for size in self.shape)
        limit = f" with R at most {self.largest}" if None in self.shape else ""
        return f"({shape}) {'text' if self.dtype == 'U' else self.dtype}{limit}"


def read_npz(
    data: bytes,
    expected: Mapping[str, Expected],
    where: str,
    known: Mapping[tuple[str, ...], str] = MappingProxyType({}),
) -> dict[str, NDArray]:
    """Arrays of an ``.npz`` file that holds exactly the ``expected`` ones.

    Args:
        data: the file's bytes.
        where: the file's name for messages.
        known: sorted names of other arrays that a file may hold -> what to say of such a file.

    Raises:
        InvalidInputError: truncated, pickled, arrays missing or unknown, wrong data type or shape.
    """
    try:
        with open_zip(io.BytesIO(data), MAX_DIRECTORY) as archive:
            names = archive.namelist()
            wanted = {f"{name}.npy": name for name in expected}
            if sorted(names) != sorted(wanted):
                held = tuple(sorted(n.removesuffix(".npy") for n in names[:8]))
                if held in known:
                    raise InvalidInputError(f"{where}: {known[held]}")
                found = ", ".join(held) or "nothing"
                raise InvalidInputError(f"{where}: holds {found[:120]!r}; expected the arrays {', '.join(expected)}")
            return {wanted[name]: _read_array(archive, name, expected[wanted[name]], where) for name in names}
    except InvalidInputError:
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, NotImplementedError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:100]
        raise InvalidInputError(f"{where}: truncated or not an .npz file ({reason}); write it again") from error


def _read_array(archive: zipfile.ZipFile, name: str, expected: Expected, where: str) -> NDArray:
    label = name.removesuffix(".npy")
    if archive.getinfo(name).compress_type not in COMPRESSIONS:
        raise InvalidInputError(f"{where}: {label} uses an unusual compression; save it with numpy.savez_compressed")
    with archive.open(name) as stream:
        shape, fortran, dtype = _read_header(stream, f"{where}: {label}")
        if dtype.hasobject:
            raise InvalidInputError(
                f"{where}: {label} holds pickled objects, which are never loaded; save plain arrays"
            )
        if not expected.matches(dtype, shape):
            raise InvalidInputError(f"{where}: {label} is {shape} {dtype}; expected {expected}")
        size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
        data = stream.read(size + 1)
        if len(data) != size:
            raise InvalidInputError(f"{where}: {label} is truncated or too long; write it again")
    return np.frombuffer(data, dtype=dtype).reshape(shape, order="F" if fortran else "C").copy()


def _read_header(stream: IO[bytes], where: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, Fortran order and data type of the array that follows in ``stream``."""
    try:
        magic = stream.read(8)
        version = np.lib.format.read_magic(io.BytesIO(magic))
        length, read = {
            (1, 0): (2, np.lib.format.read_array_header_1_0),
            (2, 0): (4, np.lib.format.read_array_header_2_0),
        }[version]
        size = stream.read(length)
        if int.from_bytes(size, "little") > MAX_HEADER:
            raise ValueError("too long")
        return read(io.BytesIO(size + stream.read(int.from_bytes(size, "little"))))
    except Exception as error:  # numpy parses the header as Python source: damage raises nearly anything
        raise InvalidInputError(f"{where} has a damaged header; save it with numpy.savez_compressed") from error
