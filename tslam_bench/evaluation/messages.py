"""Messages between an organiser's process and one that runs a stranger's code: a JSON header and plain arrays, never a pickle."""

from __future__ import annotations

import json
import math
import os
import select
import struct
import time
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

MAX_HEADER: Final = 64 * 2**10
"""Bytes of a header."""
MAX_ARRAYS: Final = 128 * 2**20
"""Bytes of a message's arrays."""
_TYPES: Final = ("<f4", "<f2", "|u1", "|b1")
Message = tuple[dict[str, Any], dict[str, NDArray]]


class Garbled(Exception):
    """What came is no message."""


def encode(header: Mapping[str, Any], arrays: Mapping[str, NDArray] | None = None) -> bytes:
    """The bytes of a message."""
    contents = {name: np.ascontiguousarray(array) for name, array in (arrays or {}).items()}
    shapes = [[name, array.dtype.str, list(array.shape)] for name, array in contents.items()]
    text = json.dumps({**header, "arrays": shapes}).encode()
    return b"".join([struct.pack("<I", len(text)), text, *(array.tobytes() for array in contents.values())])


def decode(read: Callable[[int], bytes]) -> Message:
    """Reads one message.

    Args:
        read: returns exactly so many bytes.

    Raises:
        Garbled: the header is too long, no JSON object, or names arrays that are too large or of another type.
    """
    (length,) = struct.unpack("<I", read(4))
    if length > MAX_HEADER:
        raise Garbled(f"a header of {length} bytes")
    try:
        header = json.loads(read(length))
        stated = [(str(name), str(kind), [int(n) for n in shape]) for name, kind, shape in header.pop("arrays")]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise Garbled("a header that cannot be read") from error
    if any(kind not in _TYPES or len(shape) > 8 or min(shape, default=0) < 0 for _, kind, shape in stated):
        raise Garbled("an array of an unknown type or shape")
    sizes = [np.dtype(kind).itemsize * math.prod(shape) for _, kind, shape in stated]
    if sum(sizes) > MAX_ARRAYS:
        raise Garbled(f"arrays of {sum(sizes)} bytes")
    arrays = {
        name: np.frombuffer(read(size), kind).reshape(shape)
        for (name, kind, shape), size in zip(stated, sizes, strict=True)
    }
    return header, arrays


def read_until(descriptor: int, deadline: float) -> Callable[[int], bytes]:
    """A reader of exactly so many bytes from a pipe.

    Raises (when called):
        TimeoutError: ``deadline`` (of ``time.monotonic``) has passed.
        EOFError: the other side has gone.
    """

    def read(count: int) -> bytes:
        data = bytearray()
        while len(data) < count:
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([descriptor], [], [], left)[0]:
                raise TimeoutError
            part = os.read(descriptor, min(count - len(data), 1 << 20))
            if not part:
                raise EOFError
            data += part
        return bytes(data)

    return read


def write_until(descriptor: int, data: bytes, deadline: float) -> None:
    """Writes to a pipe that does not block. Raises TimeoutError or BrokenPipeError."""
    rest = memoryview(data)
    while rest:
        left = deadline - time.monotonic()
        if left <= 0 or not select.select([], [descriptor], [], left)[1]:
            raise TimeoutError
        try:
            rest = rest[os.write(descriptor, rest) :]
        except BlockingIOError:
            continue
