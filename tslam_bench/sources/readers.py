"""Readers for what trimesh reads in part, or takes the wrong way: rare but legal spellings of OBJ, and OFF and STL.

trimesh reads OBJ fast as most programs write it. Of other spellings it loses lines without a word, so those are rewritten first,
and faces are counted. Its readers of OFF and STL want one layout each; here every legal one is read whole, or refused.
"""

from __future__ import annotations

import itertools
import re
import warnings
from typing import Final

import numpy as np
import trimesh
from numpy.typing import NDArray

from tslam_bench.errors import AssetError

BYTE_ORDER_MARK: Final = b"\xef\xbb\xbf"
"""What some editors write before a text in UTF-8."""

_NUMBER: Final = rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_OBJ_VERTEX: Final = re.compile(rb"^[^\S\n]*v[^\S\n]", re.MULTILINE)
_OBJ_FACE: Final = re.compile(rb"^[^\S\n]*fo?[^\S\n]", re.MULTILINE)
_OBJ_PLAIN_VERTEX: Final = re.compile(rb"^v(?: +" + _NUMBER + rb"){3,} *\r?$", re.MULTILINE)
_OBJ_PLAIN_FACE: Final = re.compile(rb"^f((?: +[1-9]\d*(?:/\d*(?:/\d+)?)?)+) *\r?$", re.MULTILINE)
_OBJ_CURVED: Final = re.compile(rb"^[^\S\n]*(?:curv2?|surf|bzp|bsp|cdc|cdp|res)[^\S\n]", re.MULTILINE)
_STL_RECORD: Final = np.dtype([("normal", "<f4", 3), ("vertices", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEAD: Final = 84


def is_plain_obj(data: bytes) -> bool:
    """Whether all vertices and faces of an OBJ file are spelled as trimesh expects them.

    Raises:
        AssetError: part of it is of a kind that cannot be read.
    """
    if _OBJ_CURVED.search(data):
        raise AssetError(".obj with free-form curves or surfaces; export it as polygons")
    return (
        not data.startswith(BYTE_ORDER_MARK)
        and re.search(rb"\\[^\S\n]*\n|\r(?!\n)", data) is None
        and len(_OBJ_VERTEX.findall(data)) == sum(1 for _ in _OBJ_PLAIN_VERTEX.finditer(data))
        and len(_OBJ_FACE.findall(data)) == sum(1 for _ in _OBJ_PLAIN_FACE.finditer(data))
    )


def obj_triangles(data: bytes) -> int:
    """How many triangles the polygons of a plain OBJ file make."""
    return sum(max(len(face[1].split()) - 2, 0) for face in _OBJ_PLAIN_FACE.finditer(data))


def plain_obj(data: bytes) -> bytes:
    """An OBJ file with its vertices, faces and materials spelled plainly, and nothing else.

    Blanks of all kinds, comments, line endings, continued lines, a byte-order mark, and indices that count back from the last
    vertex.

    Raises:
        AssetError: a face refers to a vertex that is not there, or a line makes no sense.
    """
    text = data.removeprefix(BYTE_ORDER_MARK).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    text = re.sub(rb"\\[^\S\n]*\n", b" ", text)
    lines, count = [], 0
    for line in text.split(b"\n"):
        words = line.partition(b"#")[0].split()
        match words[:1]:
            case [b"v"]:
                if len(words) < 4:
                    raise AssetError(f"not a readable .obj file (vertex {count + 1} has fewer than three coordinates)")
                count += 1
                lines.append(b" ".join(words[:4]))
            case [b"f" | b"fo"]:
                lines.append(b"f " + b" ".join(b"%d" % _corner(word, count) for word in words[1:]))
            case [b"usemtl"]:
                lines.append(b" ".join(line.split()))
    return b"\n".join(lines) + b"\n"


def _corner(word: bytes, count: int) -> int:
    """The vertex, from 1, of a corner of an OBJ face that stands after ``count`` vertices."""
    try:
        index = int(word.partition(b"/")[0])
    except ValueError as error:
        raise AssetError(f"not a readable .obj file (a face has the corner {word[:40].decode('latin-1')!a})") from error
    if index == 0:
        raise AssetError(".obj faces refer to vertex 0; its vertices count from 1")
    if index < -count:
        raise AssetError(f".obj faces refer to vertices that are not there ({index} after {count} vertices)")
    return index if index > 0 else count + 1 + index


def read_off(data: bytes, most: int) -> trimesh.Trimesh:
    """The mesh in a text in the OFF format, polygons cut into fans.

    The keyword may be missing, in lower case, or say that normals, colours or texture coordinates follow each vertex; the counts
    may stand on its line.

    Args:
        data: the file's bytes.
        most: largest number of vertices, and of triangles.

    Raises:
        AssetError: something else, damaged, or above the limit.
    """
    text = data.removeprefix(BYTE_ORDER_MARK).decode("latin-1")
    rows = [words for line in text.splitlines() if (words := line.partition("#")[0].split())]
    keyword = rows[0][0] if rows and re.fullmatch(r"(?:ST)?C?N?4?N?OFF", rows[0][0].upper()) else ""
    if keyword:
        if "4" in keyword or keyword.endswith("nOFF") or "BINARY" in (word.upper() for word in rows[0][1:]):
            raise AssetError("an .off file that is binary, or not of three dimensions; export it as a text, or as .ply")
        rows = [row for row in (rows[0][1:], *rows[1:]) if row]
    try:
        counts = [int(word) for word in rows[0]]
        if not 2 <= len(counts) <= 3 or min(counts) < 0:
            raise ValueError
    except (IndexError, ValueError) as error:
        raise AssetError("not a readable .off file (no counts of vertices and faces after OFF)") from error
    if max(counts[:2]) > most:
        raise AssetError(f".off with {max(counts[:2])} vertices or faces; the limit is {most}")
    end = 1 + counts[0] + counts[1]
    if len(rows) < end:
        raise AssetError(f"not a readable .off file ({len(rows) - 1} lines of vertices and faces; it states {end - 1})")
    if len(rows) > end:
        raise AssetError("not a readable .off file (more follows its last face)")
    try:
        vertices = np.array([row[:3] for row in rows[1 : 1 + counts[0]]], dtype=np.float64).reshape(-1, 3)
        polygons = [[int(word) for word in row[1 : 1 + int(row[0])]] for row in rows[1 + counts[0] :]]
    except ValueError as error:
        raise AssetError("not a readable .off file (a vertex or face is not made of numbers)") from error
    if any(len(polygon) != int(row[0]) for polygon, row in zip(polygons, rows[1 + counts[0] :], strict=True)):
        raise AssetError("not a readable .off file (a face has fewer corners than it states)")
    return _mesh(vertices, _fans(polygons, most), ".off")


def _fans(polygons: list[list[int]], most: int) -> NDArray[np.int64]:
    total = sum(max(len(polygon) - 2, 0) for polygon in polygons)
    if total > most:
        raise AssetError(f"{total} triangles; the limit is {most}")
    fans = [(p[0], a, b) for p in polygons for a, b in itertools.pairwise(p[1:])]
    try:
        return np.array(fans, dtype=np.int64).reshape(-1, 3)
    except OverflowError as error:
        raise AssetError("faces refer to vertices that are not there") from error


def read_stl(data: bytes, most: int) -> trimesh.Trimesh:
    """The mesh in an STL file, binary or text; equal vertices are not merged.

    What follows the triangles of a binary file is passed over when it cannot hold another one, or holds nothing.

    Args:
        data: the file's bytes.
        most: largest number of triangles.

    Raises:
        AssetError: something else, damaged, or above the limit.
    """
    count = int.from_bytes(data[80:84], "little")
    end = _STL_HEAD + count * _STL_RECORD.itemsize
    text = data.removeprefix(BYTE_ORDER_MARK).lstrip()
    if len(data) < _STL_HEAD or (len(data) != end and text[:5].lower() == b"solid" and b"facet" in text.lower()):
        return _read_stl_text(text, most)
    if count > most:
        raise AssetError(f"not a readable .stl file (it states {count} triangles; the limit is {most})")
    if len(data) < end:
        raise AssetError(f"not a readable .stl file (it states {count} triangles and ends before the last)")
    more = data[end:]
    if len(more) >= _STL_RECORD.itemsize and more.strip(b"\0"):
        raise AssetError(
            f"not a readable .stl file ({len(more)} bytes follow the {count} triangles that it states); export it again"
        )
    corners = np.frombuffer(data, _STL_RECORD, count, _STL_HEAD)["vertices"].reshape(-1, 3)
    return _mesh(corners.astype(np.float64), np.arange(3 * count).reshape(-1, 3), ".stl")


def _read_stl_text(data: bytes, most: int) -> trimesh.Trimesh:
    text = data.lower().replace(b"\r", b"\n")
    # Names are anything up to the end of their line.
    text, solids = re.subn(rb"^[^\S\n]*solid\b[^\n]*", b" ", text, flags=re.MULTILINE)
    text, ends = re.subn(rb"^[^\S\n]*end[^\S\n]*solid\b[^\n]*", b" ", text, flags=re.MULTILINE)
    text, facets = re.subn(rb"\bfacet\s+normal(?:\s+\S+){3}\s+outer\s+loop\b", b" ", text)
    text, finished = re.subn(rb"\bend\s*loop\s+end\s*facet\b", b" ", text)
    text, corners = re.subn(rb"\bvertex\b", b" ", text)
    if not solids or solids != ends:
        raise AssetError("not a readable .stl file (neither binary nor a text from solid to endsolid)")
    if facets > most:
        raise AssetError(f"{facets} triangles; the limit is {most}")
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # what numpy says of something that is no number
        try:
            numbers = np.fromstring(text.decode("latin-1"), dtype=np.float64, sep=" ") if text.strip() else np.zeros(0)
        except (DeprecationWarning, ValueError) as error:
            raise AssetError("not a readable .stl file (something that is no number)") from error
    if not facets == finished == corners / 3 == len(numbers) / 9:
        raise AssetError("not a readable .stl file (a facet has not three corners of three numbers)")
    return _mesh(numbers.reshape(-1, 3), np.arange(3 * facets).reshape(-1, 3), ".stl")


def _mesh(vertices: NDArray[np.float64], faces: NDArray[np.int64], suffix: str) -> trimesh.Trimesh:
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise AssetError(f"{suffix} faces refer to vertices that are not there")
    return trimesh.Trimesh(vertices, faces, process=False)
