"""What a glTF file says about itself, checked before a library allocates what it announces."""

from __future__ import annotations

import json
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np

from tslam_bench.errors import AssetError

MAX_DEPTH = 200
"""Longest chain of nodes from a scene to a mesh."""
_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_COMPRESSIONS = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")


def read_header(data: bytes, suffix: str) -> dict[str, Any]:
    """The JSON part of a ``.glb`` or ``.gltf`` file.

    Raises:
        AssetError: it is not what its suffix says.
    """
    if suffix == ".glb":
        magic, version, length, size, kind = np.frombuffer(data[:20].ljust(20, b"\0"), dtype="<u4").tolist()
        if magic != 0x46546C67 or kind != 0x4E4F534A:
            raise AssetError("not a binary glTF file: its magic number is missing")
        if version != 2:
            raise AssetError(f"binary glTF of version {version}; only version 2 can be read")
        if size > len(data) - 20 or length > len(data):
            raise AssetError(f".glb announces {max(length, size + 20)} bytes and holds {len(data)}")
        data = data[20 : 20 + size]
    try:
        header = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise AssetError(f"not a readable {suffix} file (its JSON part: {type(error).__name__})") from error
    if not isinstance(header, dict):
        raise AssetError(f"not a readable {suffix} file (its JSON part is no object)")
    return header


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


def check(header: dict[str, Any], max_bytes: int, max_instances: int, max_corners: int) -> None:
    """Compares what a header announces with what its buffers hold, and with the limits.

    Args:
        header: of :func:`read_header`.
        max_bytes: most bytes of all buffer views, and of all accessors, together.
        max_instances: most nodes.
        max_corners: most corners of all primitives that its scenes show.

    Raises:
        AssetError: names the entry that is wrong.
    """
    try:
        _check_compression(header)
        _check_buffers(header, max_bytes)
        _check_nodes(header, max_instances, max_corners)
    except (KeyError, TypeError, IndexError, ValueError, AttributeError, OverflowError) as error:
        raise AssetError(f"glTF header is inconsistent ({type(error).__name__}: {error})") from error


def _items(header: dict[str, Any], key: str) -> list[Any]:
    items = header.get(key, [])
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise AssetError(f"glTF {key} are no list of objects")
    return items


def _natural(item: dict[str, Any], key: str, default: int | None = None) -> int:
    value = item.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise AssetError(f"glTF {key} is {value!r}; expected a whole number that is not negative")
    return value


def _check_compression(header: dict[str, Any]) -> None:
    used = [name for name in _COMPRESSIONS if name in header.get("extensionsRequired", [])]
    if used:
        raise AssetError(f"glTF is compressed with {used[0]}, which cannot be read; export it uncompressed")


def _check_buffers(header: dict[str, Any], max_bytes: int) -> None:
    buffers, views, accessors = (_items(header, key) for key in ("buffers", "bufferViews", "accessors"))
    lengths = [_natural(buffer, "byteLength") for buffer in buffers]
    total = 0
    for number, view in enumerate(views):
        buffer, length = _natural(view, "buffer"), _natural(view, "byteLength")
        if buffer >= len(buffers) or _natural(view, "byteOffset", 0) + length > lengths[buffer]:
            raise AssetError(f"glTF buffer view {number} reaches outside its buffer")
        total += length
    announced = 0
    for number, accessor in enumerate(accessors):
        count = _natural(accessor, "count")
        size = _COMPONENT_BYTES[accessor["componentType"]] * _COMPONENTS[accessor["type"]]
        announced += count * size
        if "bufferView" in accessor and count:
            view = views[_natural(accessor, "bufferView")]
            stride = _natural(view, "byteStride", size)
            if _natural(accessor, "byteOffset", 0) + (count - 1) * stride + size > view["byteLength"]:
                raise AssetError(f"glTF accessor {number} announces {count} items; its buffer holds fewer")
    if max(total, announced) > max_bytes:
        raise AssetError(f"glTF announces {max(total, announced) / 1e6:.0f} MB; the limit is {max_bytes / 1e6:.0f} MB")


def _check_nodes(header: dict[str, Any], max_instances: int, max_corners: int) -> None:
    nodes, meshes, accessors = (_items(header, key) for key in ("nodes", "meshes", "accessors"))
    if len(nodes) > max_instances:
        raise AssetError(f"glTF with {len(nodes)} nodes; the limit is {max_instances}")
    corners = []
    for mesh in meshes:
        shown = [p.get("indices", p["attributes"]["POSITION"]) for p in mesh["primitives"] if p.get("mode", 4) >= 4]
        if any(not isinstance(k, int) or not 0 <= k < len(accessors) for k in shown):
            raise AssetError("glTF primitive refers to an accessor that is not there")
        corners.append(sum(_natural(accessors[k], "count") for k in shown))
    parent: dict[int, int] = {}
    for number, node in enumerate(nodes):
        if "mesh" in node and _natural(node, "mesh") >= len(meshes):
            raise AssetError(f"glTF node {number} shows a mesh that is not there")
        for child in node.get("children", []):
            if not isinstance(child, int) or not 0 <= child < len(nodes):
                raise AssetError(f"glTF node {number} has a child that is not there")
            if child in parent:
                raise AssetError(f"glTF node {child} has two parents")
            parent[child] = number
    depth: dict[int, int] = {}
    for number in range(len(nodes)):
        chain = [number]
        while chain[-1] in parent and chain[-1] not in depth and len(chain) <= MAX_DEPTH:
            chain.append(parent[chain[-1]])
        known = depth.get(chain[-1], 0)
        if known + len(chain) > MAX_DEPTH:
            raise AssetError(f"glTF nodes form a circle or a chain longer than {MAX_DEPTH}")
        for steps, member in enumerate(reversed(chain)):
            depth.setdefault(member, known + steps)
    total = sum(corners[node["mesh"]] for node in nodes if "mesh" in node)
    if total > max_corners:
        raise AssetError(f"glTF shows {total} corners of triangles; the limit is {max_corners}")
