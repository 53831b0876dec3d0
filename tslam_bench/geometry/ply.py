"""Reading a triangle mesh from the bytes of a PLY file that nobody vouches for.

Every count is compared with the limit, and with the bytes that are there, before anything is allocated for it. All three
encodings, any scalar types and further properties are read; polygons are cut into triangles as trimesh cuts them, so that a
mesh is the same by either reader.
"""

from __future__ import annotations

import re
import struct
import warnings
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import trimesh
from numpy.typing import NDArray

from tslam_bench.errors import InvalidInputError

MAX_MESH_ELEMENTS: Final = 1_000_000
"""Most vertices, and most triangles, unless a caller says otherwise."""
MAX_PROPERTIES: Final = 64
"""Most properties of all elements together."""
MAX_HEADER: Final = 16 * 2**10
"""Bytes of a header, comments included."""
_TYPES: Final = {
    name: code
    for names, code in (
        (("char", "int8"), "i1"),
        (("uchar", "uint8"), "u1"),
        (("short", "int16"), "i2"),
        (("ushort", "uint16"), "u2"),
        (("int", "int32"), "i4"),
        (("uint", "uint32"), "u4"),
        (("float", "float32"), "f4"),
        (("double", "float64"), "f8"),
    )
    for name in names
}
_ENDIAN: Final = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_NUMBER: Final = np.dtype(np.float64)
_INDEX_NAMES: Final = ("vertex_index", "vertex_indices")


class _Damaged(Exception):
    """Why the file is no PLY mesh."""


@dataclass(frozen=True)
class _Property:
    """A property as it lies in the body.

    Attributes:
        stated: type that the header states.
        stored: type of the bytes: the stated one, or float64 for a text that was read into numbers.
        length: type of the bytes of a list's length; None for a scalar.
    """

    name: str
    stated: np.dtype
    stored: np.dtype
    length: np.dtype | None


@dataclass(frozen=True)
class _Element:
    """``index`` names the property that holds the corners, if it is the element ``face``."""

    name: str
    count: int
    properties: tuple[_Property, ...]
    index: str = ""


def read_ply(data: bytes, where: str, most: int = MAX_MESH_ELEMENTS) -> trimesh.Trimesh:
    """The mesh in a PLY file.

    Args:
        data: the file's bytes.
        where: the file's name for messages.
        most: largest number of vertices, and of triangles.

    Raises:
        InvalidInputError: damaged, truncated, of another kind, or above a limit.
    """
    try:
        text, elements, begin = _read_header(data, most)
        body = _numbers(data[begin:]) if text else memoryview(data)[begin:]
        columns: dict[str, NDArray] = {}
        for element in elements:
            body = _read_element(body, element, columns, most)
        if len(body):
            raise _Damaged("more follows its last element")
        vertices = np.column_stack([columns[axis] for axis in "xyz"]).astype(np.float64)
        faces = _triangles(columns["corners"], columns["lengths"], most)
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise _Damaged("truncated, or faces refer to missing vertices")
    except _Damaged as error:
        raise InvalidInputError(f"{where}: not a PLY mesh that can be read ({error}); export it again") from error
    return trimesh.Trimesh(vertices, faces, process=False)


def _read_header(data: bytes, most: int) -> tuple[bool, list[_Element], int]:
    """Whether the body is text, the elements, and where the body begins."""
    end = re.search(rb"^end_header[ \t]*\r?\n", data[:MAX_HEADER], re.MULTILINE)
    if not re.match(rb"ply[ \t]*[\r\n]", data) or end is None:
        raise _Damaged(f"no header of at most {MAX_HEADER} bytes")
    encoding = ""
    elements: list[tuple[str, int, list[_Property]]] = []
    for line in data[: end.start()].decode("latin-1").splitlines()[1:]:
        words = line.split()
        match words:
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, "1.0"] if name in _ENDIAN and not encoding:
                encoding = name
            case ["element", name, count] if re.fullmatch(r"\d{1,18}", count) and encoding:
                if int(count) > most:
                    raise _Damaged(f"{int(count)} {name[:40]} elements; at most {most}")
                if name in [known for known, _, _ in elements]:
                    raise _Damaged(f"element {name[:40]!r} twice")
                elements.append((name, int(count), []))
            case ["property", dtype, name] if dtype in _TYPES and elements:
                elements[-1][2].append(_property(name, encoding, dtype))
            case ["property", "list", length, dtype, name] if {dtype, length} <= _TYPES.keys() and elements:
                if _TYPES[length][0] == "f":
                    raise _Damaged("a list whose length is no whole number")
                elements[-1][2].append(_property(name, encoding, dtype, length))
            case _:
                raise _Damaged(f"header line {line[:60]!r}")
    found = [_Element(name, count, tuple(properties)) for name, count, properties in elements]
    if sum(len(element.properties) for element in found) > MAX_PROPERTIES:
        raise _Damaged(f"more than {MAX_PROPERTIES} properties")
    named = {element.name: {p.name: p for p in element.properties} for element in found}
    if any(len(named[element.name]) < max(len(element.properties), 1) for element in found):
        raise _Damaged("an element with no property, or with one twice")
    if not all(p in named.get("vertex", {}) and named["vertex"][p].length is None for p in "xyz"):
        raise _Damaged("no vertices with x, y and z")
    face = named.get("face", {})
    index = next((name for name in _INDEX_NAMES if name in face), next(iter(face)) if len(face) == 1 else "")
    if not index or face[index].length is None:
        raise _Damaged("no faces with a list of vertex_indices")
    found = [_Element(e.name, e.count, e.properties, index if e.name == "face" else "") for e in found]
    return encoding == "ascii", found, end.end()


def _property(name: str, encoding: str, stated: str, length: str | None = None) -> _Property:
    code = _ENDIAN[encoding] + _TYPES[stated]
    if encoding == "ascii":
        return _Property(name, np.dtype(code), _NUMBER, None if length is None else _NUMBER)
    counted = None if length is None else np.dtype(_ENDIAN[encoding] + _TYPES[length])
    return _Property(name, np.dtype(code), np.dtype(code), counted)


def _numbers(text: bytes) -> memoryview:
    """The numbers of a text, as the bytes of float64."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # what numpy says of something that is no number
        try:
            numbers = np.fromstring(text.decode("latin-1"), dtype=_NUMBER, sep=" ")
        except (DeprecationWarning, ValueError) as error:
            raise _Damaged("something that is no number") from error
    return memoryview(numbers.view(np.uint8)) if len(numbers) else memoryview(b"")  # type: ignore[arg-type]


def _read_element(body: memoryview, element: _Element, columns: dict[str, NDArray], most: int) -> memoryview:
    """Reads the element that ``body`` begins with and returns what is left.

    Args:
        columns: gets x, y, z of vertices, and of faces their corners end to end and how many each has.
    """
    # Nearly always all lists are as long as the first row's: then all rows are of one type.
    fields: list[tuple[Any, ...]] = []
    position = 0
    for number, p in enumerate(element.properties):
        length = 1
        if p.length is not None:
            length = _length(body, position, p.length, most) if element.count else 0
            fields.append((f"length {number}", p.length))
            position += p.length.itemsize
        fields.append((p.name, p.stored) if p.length is None else (p.name, p.stored, (length,)))
        position += length * p.stored.itemsize
    row = np.dtype(fields)
    end = element.count * row.itemsize
    if end > len(body):
        rows = None
    else:
        rows = np.frombuffer(body, row, element.count) if element.count else np.zeros(0, row)
        lists = [name for name in row.names or () if name.startswith("length ")]
        rows = rows if all((rows[name] == rows[name][:1]).all() for name in lists) else None
    for number, p in enumerate(element.properties):
        if element.name == "vertex" and p.name in "xyz":
            if rows is None:
                raise _Damaged("truncated, or vertices with lists of several lengths")
            columns[p.name] = _cast(rows[p.name], p.stated)
        elif p.name == element.index:
            if rows is None:
                corners, lengths, end = _read_rows(body, element, number, most)
            else:
                corners, lengths = rows[p.name].reshape(-1), rows[f"length {number}"]
            columns["corners"], columns["lengths"] = _cast(corners, p.stated), lengths.astype(np.int64)
            return body[end:]
    if rows is None:
        _, _, end = _read_rows(body, element, -1, most)
    return body[end:]


def _length(body: memoryview, position: int, dtype: np.dtype, most: int) -> int:
    """Length of the list that begins at a position."""
    if position + dtype.itemsize > len(body):
        raise _Damaged("truncated")
    stated = np.frombuffer(body, dtype, 1, position)[0]
    if not 0 <= stated <= most or stated != int(stated):
        raise _Damaged(f"a list of {stated:g} values; at most {most}")
    return int(stated)


def _read_rows(body: memoryview, element: _Element, wanted: int, most: int) -> tuple[NDArray, NDArray, int]:
    """Lists of several lengths, row by row: values and lengths of the property ``wanted``, and where the element ends."""
    # Scalars are passed over: (bytes before the list, reader of its length, bytes of a value, whether it is wanted).
    plan: list[tuple[int, struct.Struct, int, bool]] = []
    skip = 0
    for number, p in enumerate(element.properties):
        if p.length is None:
            skip += p.stored.itemsize
        else:
            order = ">" if p.length.str[0] == ">" else "<" if p.length.str[0] == "<" else "="
            plan.append((skip, struct.Struct(order + p.length.char), p.stored.itemsize, number == wanted))
            skip = 0
    pieces: list[memoryview] = []
    lengths: list[int] = []
    position, end = 0, len(body)
    for _ in range(element.count):
        for before, reader, size, keep in plan:
            position += before
            if position + reader.size > end:
                raise _Damaged("truncated")
            length = reader.unpack_from(body, position)[0]
            position += reader.size
            if not 0 <= length <= most or length != int(length):
                raise _Damaged(f"a list of {length:g} values; at most {most}")
            following = position + int(length) * size
            if keep:
                lengths.append(int(length))
                pieces.append(body[position:following])
            position = following
        position += skip
        if position > end:
            raise _Damaged("truncated")
    stored = element.properties[wanted].stored
    return np.frombuffer(b"".join(pieces), stored), np.array(lengths, dtype=np.int64), position


def _cast(values: NDArray, stated: np.dtype) -> NDArray:
    """As the type that the header states."""
    if stated.kind != "f" and values.dtype.kind == "f":
        limits = np.iinfo(stated)
        if not ((values >= limits.min) & (values <= limits.max) & (values == np.floor(values))).all():
            raise _Damaged(f"a number that is no {stated.name}")
    with np.errstate(over="ignore"):
        return values.astype(stated)


def _triangles(corners: NDArray, lengths: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """Polygons cut into triangles: first the triangles, then the halves of quadrangles, then fans.

    Args:
        corners: of all faces, end to end.
        lengths: corners of each face.
    """
    if (lengths < 3).any():
        raise _Damaged("a face of fewer than three corners")
    if corners.dtype.kind == "f" and not (corners == np.floor(corners)).all():
        raise _Damaged("corners of faces that are no whole numbers")
    count = int((lengths - 2).sum())
    if count > most:
        raise _Damaged(f"{count} triangles; at most {most}")
    corners = np.clip(corners, -1, most).astype(np.int64)  # what is out of range stays out of range
    starts = np.cumsum(lengths) - lengths
    three, four, many = starts[lengths == 3], starts[lengths == 4], lengths > 4
    halves = [corners[four[:, None] + half] for half in ([0, 1, 2], [2, 3, 0])]
    first = np.repeat(starts[many], lengths[many] - 2)
    fans = np.cumsum(lengths[many] - 2)
    step = np.arange(len(first)) - np.repeat(fans - (lengths[many] - 2), lengths[many] - 2)
    fan = corners[np.stack([first, first + step + 1, first + step + 2], axis=1)]
    return np.concatenate([corners[three[:, None] + np.arange(3)], *halves, fan])
