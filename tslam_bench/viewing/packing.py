"""Arrays as small JavaScript files that a page opened from a folder can load: deflated bytes in base64.

A page on ``file://`` may not fetch files, but it may run scripts. So a data file is a script of one call, with a header in
JSON that says where each array begins. Integers are stored as differences of rows, low and high bytes apart: they deflate
to a third.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

_TYPES: Final = ("u1", "i1", "u2", "i2", "u4")
_LEVEL: Final = 9


def pack(name: str, header: Mapping[str, Any], arrays: Mapping[str, NDArray]) -> str:
    """A script that hands ``header`` and ``arrays`` to the page under ``name``.

    Args:
        header: JSON values; texts of strangers are made harmless for scripts here, and the page writes them as text.
        arrays: integers of at most 32 bits, one or two axes; differences are taken along the first.

    Raises:
        ValueError: an array of another type.
    """
    parts, table, start = [], {}, 0
    for key, array in arrays.items():
        array = np.ascontiguousarray(array)
        kind = array.dtype.str.lstrip("<|=")
        if kind not in _TYPES or array.ndim not in (1, 2):
            raise ValueError(f"pack: {key} is {array.dtype} {array.shape}; give integers with one or two axes")
        data = _bytes(array)
        table[key] = {"type": kind, "shape": list(array.shape), "start": start}
        parts.append(data)
        start += len(data)
    body = base64.b64encode(zlib.compress(b"".join(parts), _LEVEL)).decode("ascii")
    return f'tslam.data({script_json(name)},{script_json({**header, "arrays": table})},"{body}");\n'


def script_json(value: Any) -> str:
    """JSON that is also harmless inside a script element: no ``<``, no line separators."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("/", "\\/") if "<" in text else text


def unpack(script: str) -> tuple[str, dict[str, Any], dict[str, NDArray]]:
    """Name, header and arrays of a script that :func:`pack` made."""
    inner = script.strip().removeprefix("tslam.data(").removesuffix(");")
    decoder = json.JSONDecoder()
    name, end = decoder.raw_decode(inner)
    header, end = decoder.raw_decode(inner, end + 1)
    data = zlib.decompress(base64.b64decode(json.loads(inner[end + 1 :])))
    arrays = {}
    for key, entry in header.pop("arrays").items():
        dtype = np.dtype("<" + entry["type"])
        count = int(np.prod(entry["shape"]))
        planes = np.frombuffer(data, np.uint8, count * dtype.itemsize, entry["start"]).reshape(dtype.itemsize, count)
        steps = np.ascontiguousarray(planes.T).view(dtype).reshape(entry["shape"])
        arrays[key] = np.cumsum(steps, axis=0, dtype=dtype)
    return name, header, arrays


def _bytes(array: NDArray) -> bytes:
    steps = array.copy()
    with np.errstate(over="ignore"):
        steps[1:] -= array[:-1]
    flat = steps.astype(steps.dtype.newbyteorder("<")).reshape(-1)
    return flat.view(np.uint8).reshape(len(flat), -1).T.tobytes() if len(flat) else b""
