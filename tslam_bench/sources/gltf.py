"""What a glTF file refers to and holds, read before trimesh opens it."""

from __future__ import annotations

import json
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import unquote

from tslam_bench.errors import AssetError

_TRIANGLE_FAN = 6


def read_header(data: bytes, suffix: str) -> dict[str, Any]:
    """The JSON part of a ``.glb`` or ``.gltf`` file.

    Raises:
        AssetError: it is not what its suffix says.
    """
    if suffix == ".glb":
        if data[:4] != b"glTF" or data[16:20] != b"JSON":
            raise AssetError("not a readable .glb file (no binary glTF of version 2)")
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    try:
        header = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise AssetError(f"not a readable {suffix} file (its JSON part: {type(error).__name__})") from error
    if not isinstance(header, dict):
        raise AssetError(f"not a readable {suffix} file (its JSON part is no object)")
    return header


def _items(header: dict[str, Any], key: str) -> list[dict[str, Any]]:
    items = header.get(key, [])
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise AssetError(f"glTF {key} are no list of objects")
    return items


def check_data(header: dict[str, Any]) -> None:
    """Raises AssetError for a mesh that trimesh would not read whole.

    Numbers that are not in a buffer (it would make as many zeros as are announced), those that replace others, those that stand
    for fractions, and triangle fans, which it leaves out.
    """
    accessors = _items(header, "accessors")
    required = header.get("extensionsRequired", [])
    compressed = isinstance(required, list) and any(
        isinstance(name, str) and name.endswith(("_draco_mesh_compression", "_meshopt_compression"))
        for name in required
    )
    if compressed or any("bufferView" not in accessor for accessor in accessors):
        raise AssetError("glTF is compressed, or has accessors without data; export it uncompressed")
    if any("sparse" in accessor for accessor in accessors):
        raise AssetError("glTF has sparse accessors, which cannot be read; export it without")
    for mesh in _items(header, "meshes"):
        for primitive in _items(mesh, "primitives"):
            if primitive.get("mode") == _TRIANGLE_FAN:
                raise AssetError("glTF has triangle fans, which cannot be read; export it as triangles")
            attributes = primitive.get("attributes")
            index = attributes.get("POSITION") if isinstance(attributes, dict) else None
            if isinstance(index, int) and 0 <= index < len(accessors) and accessors[index].get("normalized"):
                raise AssetError("glTF has quantised positions, which cannot be read; export it without quantisation")


def referenced_files(header: dict[str, Any]) -> list[str]:
    """Names (as written) of the buffers that lie beside the file.

    Raises:
        AssetError: a name leaves the file's folder or is an address.
    """
    names = []
    for buffer in _items(header, "buffers"):
        uri = buffer.get("uri")
        if uri is None or (isinstance(uri, str) and uri.startswith("data:")):
            continue
        path = PurePosixPath(unquote(uri).replace("\\", "/")) if isinstance(uri, str) else PurePosixPath("/")
        if path.is_absolute() or ".." in path.parts or not path.parts or ":" in path.parts[0]:
            raise AssetError(f"glTF buffer {str(uri)[:80]!r} is outside the file's folder")
        names.append(str(uri))
    return names
