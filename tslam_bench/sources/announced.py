"""What a mesh file announces in its first bytes, compared with what it is and holds, before a reader believes it."""

from __future__ import annotations

import re

from tslam_bench.errors import AssetError

_MAGIC = (
    (b"glTF", "binary glTF", (".glb",)),
    (b"PK\x03\x04", "zip", (".zip", ".kmz", ".zae")),
    (b"ply\n", "PLY", (".ply",)),
    (b"ply\r", "PLY", (".ply",)),
    (b"<?xml", "XML", (".dae",)),
    (b"\x89PNG", "PNG", ()),
    (b"\xff\xd8\xff", "JPEG", ()),
    (b"%PDF", "PDF", ()),
    (b"\x1f\x8b", "gzip", ()),
    (b"Rar!", "RAR", ()),
    (b"7z\xbc\xaf", "7-zip", ()),
)
"""First bytes, name of the format, suffixes that may have them."""
_PLY_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64", "int64", "uint64"), 8),
}
_HEADER_BYTES = 100_000


def check_announced(data: bytes, suffix: str, max_triangles: int) -> None:
    """Refuses a file whose first bytes belong to another format, or announce more than it holds or may hold.

    Args:
        data: the whole file.
        suffix: what its name says it is.
        max_triangles: the limit.

    Raises:
        AssetError: one line.
    """
    if not data.strip():
        raise AssetError("empty file")
    for magic, kind, suffixes in _MAGIC:
        if data.startswith(magic) and suffix not in suffixes:
            raise AssetError(f"is a {kind} file, not the {suffix} file that its name promises")
    if suffix in (".obj", ".off") and b"\0" in data:
        raise AssetError(f"not a readable {suffix} file (it holds binary data)")
    checks = {".stl": _check_stl, ".ply": _check_ply, ".off": _check_off, ".obj": _check_obj}
    if suffix in checks:
        checks[suffix](data, max_triangles)


def _limit(count: int, max_triangles: int) -> None:
    if count > max_triangles:
        raise AssetError(f"{count} triangles; the limit is {max_triangles}")


def _check_stl(data: bytes, max_triangles: int) -> None:
    if data.lstrip()[:5].lower() == b"solid" and b"\0" not in data[:2000]:
        _limit(data.count(b"endfacet"), max_triangles)
        return
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else 0
    if len(data) != 84 + 50 * count or len(data) < 84:
        raise AssetError(
            f"not a readable .stl file (neither text nor binary: a header for {count} triangles, {len(data)} bytes)"
        )
    _limit(count, max_triangles)


def _check_ply(data: bytes, max_triangles: int) -> None:
    end = data.find(b"end_header", 0, _HEADER_BYTES)
    if not data.startswith(b"ply") or end < 0:
        raise AssetError("not a readable .ply file (no header)")
    lines = [line.split() for line in data[:end].decode("latin-1").splitlines()]
    text = any(line[:2] == ["format", "ascii"] for line in lines)
    needed = rows = 0
    for line in lines:
        if line[:1] == ["element"]:
            if len(line) != 3 or not line[2].isdecimal() or len(line[2]) > 18:
                raise AssetError(f"not a readable .ply file (header line {' '.join(line)[:80]!r})")
            rows = int(line[2])
            if line[1] == "face":
                _limit(rows, max_triangles)
            needed += 2 * rows if text else 0
        elif line[:1] == ["property"] and not text and len(line) > 2:
            needed += rows * _PLY_BYTES.get(line[2] if line[1] == "list" else line[1], 1)
    if needed > len(data) - end:
        raise AssetError(f".ply announces at least {needed} bytes of data and holds {len(data) - end}")


def _check_off(data: bytes, max_triangles: int) -> None:
    found = re.match(
        rb"\s*(?:#[^\n]*\n\s*)*\w{0,4}OFF\s+(?:#[^\n]*\n\s*)*(\d{1,18})\s+(\d{1,18})", data[:_HEADER_BYTES]
    )
    if not found:
        raise AssetError("not a readable .off file (no header with counts)")
    vertices, faces = int(found[1]), int(found[2])
    _limit(faces, max_triangles)
    if vertices + faces > data.count(b"\n") + data.count(b"\r") + 1:
        raise AssetError(f".off announces {vertices} vertices and {faces} faces and has fewer lines")


def _check_obj(data: bytes, max_triangles: int) -> None:
    _limit(data.count(b"\nf "), max_triangles)
    if re.search(rb"^f[^\n]*?[ \t]0+(?=[\s/])", data, re.MULTILINE):
        raise AssetError(".obj faces refer to vertex 0; its vertices count from 1")
