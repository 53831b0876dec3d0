"""Reads mesh files of the kinds that 3D Warehouse and ShapeNet hold, as one mesh with z up.

Scenes are baked: every node's transform is applied. COLLADA states its unit and its up axis, glTF is metres and y up, OBJ is
taken as y up (as both sites publish it), the others as z up.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path, PurePosixPath
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np
import trimesh

from tslam_bench.assets.meshes import TriangleMesh
from tslam_bench.errors import AssetError

UpAxis = Literal["auto", "x", "y", "z"]

MESH_SUFFIXES = (".obj", ".dae", ".glb", ".gltf", ".stl", ".ply", ".off")
ARCHIVE_SUFFIXES = (".zip", ".kmz", ".zae")
SUFFIXES = MESH_SUFFIXES + ARCHIVE_SUFFIXES
MAX_BYTES = 200_000_000
"""Largest file, and largest unpacked archive."""
MAX_RATIO = 200
"""Largest ratio of unpacked to packed size of an archive."""
MAX_MEMBERS = 10_000
"""Most members of an archive."""
MAX_TRIANGLES = 2_000_000
"""Most triangles of a mesh."""

_TO_Z_UP = {
    "x": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "z": np.eye(3),
}
_DEFAULT_UP: dict[str, Literal["x", "y", "z"]] = {".obj": "y", ".dae": "y", ".glb": "y", ".gltf": "y"}


def read_mesh_file(path: Path, up: UpAxis = "auto") -> TriangleMesh:
    """Reads one mesh file, or an archive that holds one.

    Args:
        path: a file with one of ``SUFFIXES``.
        up: axis that points up in the file; ``auto`` goes by the format.

    Returns:
        the mesh with z up; metres where the format states a unit, the file's own units elsewhere.

    Raises:
        AssetError: one line that says what is wrong with the file.
    """
    suffix = path.suffix.lower()
    if suffix == ".skp":
        raise AssetError(
            "SketchUp files cannot be read; export COLLADA (.dae) or glTF (.glb) from SketchUp or 3D Warehouse"
        )
    if suffix not in SUFFIXES:
        raise AssetError(f"unknown kind of file {suffix!r}; expected one of {', '.join(SUFFIXES)}")
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise AssetError(f"{size / 1e6:.0f} MB; the limit is {MAX_BYTES / 1e6:.0f} MB")
        data = path.read_bytes()
    except OSError as error:
        raise AssetError(f"cannot be read ({error.strerror or error})") from error
    files: dict[str, bytes] = {}
    if suffix in ARCHIVE_SUFFIXES:
        name, files = _unpack(data)
        data, suffix = files[name], PurePosixPath(name).suffix.lower()
        base = PurePosixPath(name).parent
        inner = {PurePosixPath(key): content for key, content in files.items()}
        files = {str(key.relative_to(base)): content for key, content in inner.items() if base in key.parents}
    elif suffix == ".gltf":
        files = _neighbours(path)
    return parse_mesh(data, suffix, up, files)


def parse_mesh(data: bytes, suffix: str, up: UpAxis = "auto", files: dict[str, bytes] | None = None) -> TriangleMesh:
    """The mesh in the bytes of a file whose format is ``suffix``; ``files`` are those that it may refer to."""
    unit = 1.0
    stated_up: str = _DEFAULT_UP.get(suffix, "z")
    if suffix == ".dae":
        unit, stated_up = _collada_conventions(data)
    options: dict[str, Any] = {"skip_materials": True} if suffix == ".obj" else {}
    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type=suffix[1:], resolver=_Resolver(files or {}), **options)
        mesh = scene.to_geometry() if scene.geometry else None
    except AssetError:
        raise
    except Exception as error:  # readers raise many kinds for a file that is not what it says
        raise AssetError(f"not a readable {suffix} file ({type(error).__name__}: {_first_line(error)})") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise AssetError("holds no triangles")
    if len(mesh.faces) > MAX_TRIANGLES:
        raise AssetError(f"{len(mesh.faces)} triangles; the limit is {MAX_TRIANGLES}")
    vertices, faces = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise AssetError("faces refer to vertices that are not there")
    used, inverse = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], inverse.reshape(-1, 3)
    if not np.isfinite(vertices).all():
        raise AssetError("vertices are not finite")
    if np.abs(vertices).max() > 1e12:
        raise AssetError("vertices are further out than any unit explains")
    rotation = _TO_Z_UP[stated_up if up == "auto" else up]
    return TriangleMesh(unit * vertices @ rotation.T, faces.astype(np.int64))


class _Resolver(trimesh.resolvers.Resolver):
    """Gives a reader the files beside a mesh, from memory only."""

    def __init__(self, files: dict[str, bytes]) -> None:
        self._files = files

    def get(self, name: str) -> bytes:
        """The bytes of a file beside the mesh."""
        key = str(PurePosixPath(name.strip()))
        if key not in self._files:
            raise FileNotFoundError(name)
        return self._files[key]

    def write(self, name: str, data: bytes) -> None:
        """Readers do not write."""
        raise AssetError(f"a reader tried to write {name}")

    def keys(self) -> list[str]:
        """Names of the files beside the mesh."""
        return list(self._files)

    def namespaced(self, namespace: str) -> _Resolver:
        """The same files: names are relative already."""
        return self


def _neighbours(path: Path) -> dict[str, bytes]:
    """Binary files beside a .gltf."""
    found = [
        p for p in path.parent.rglob("*.bin") if p.is_file() and not p.is_symlink() and p.stat().st_size <= MAX_BYTES
    ]
    return {str(PurePosixPath(*p.relative_to(path.parent).parts)): p.read_bytes() for p in found[:20]}


def _unpack(data: bytes) -> tuple[str, dict[str, bytes]]:
    """Name of the one mesh in an archive, and all of its files, in memory, within the limits."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [member for member in archive.infolist() if not member.is_dir()]
            if len(members) > MAX_MEMBERS:
                raise AssetError(f"archive with {len(members)} members; the limit is {MAX_MEMBERS}")
            for member in members:
                parts = PurePosixPath(member.filename.replace("\\", "/")).parts
                if ".." in parts or member.filename.startswith(("/", "\\")) or ":" in parts[0]:
                    raise AssetError(f"archive member {member.filename!r} escapes the archive")
            total = sum(member.file_size for member in members)
            if total > MAX_BYTES or total > MAX_RATIO * max(len(data), 1):
                raise AssetError(
                    f"archive unpacks to {total / 1e6:.0f} MB from {len(data) / 1e6:.2f} MB: refused as a bomb"
                )
            meshes = [m.filename for m in members if PurePosixPath(m.filename).suffix.lower() in MESH_SUFFIXES]
            if len(meshes) != 1:
                raise AssetError(f"archive holds {len(meshes)} meshes; expected one")
            files = {}
            for member in members:
                with archive.open(member) as stream:
                    content = stream.read(member.file_size + 1)
                if len(content) > member.file_size:
                    raise AssetError(f"archive member {member.filename!r} is larger than it says")
                files[member.filename] = content
            return meshes[0], files
    except AssetError:
        raise
    except Exception as error:  # damaged archives raise many kinds
        raise AssetError(f"not a readable archive ({type(error).__name__}: {_first_line(error)})") from error


def _collada_conventions(data: bytes) -> tuple[float, str]:
    """Metres per unit, and the up axis, of a COLLADA document."""
    unit, up = 1.0, "y"
    try:
        for _, element in ElementTree.iterparse(io.BytesIO(data), events=("start",)):
            tag = element.tag.rpartition("}")[2]
            if tag == "unit":
                unit = float(element.get("meter", 1.0))
            elif tag == "library_geometries":
                break
        text = data[:20_000].decode("utf-8", "replace")
        start = text.find("<up_axis>")
        if start >= 0:
            up = text[start + 9 : start + 10].lower()
    except (ElementTree.ParseError, ValueError) as error:
        raise AssetError(f"not a readable .dae file ({_first_line(error)})") from error
    if up not in _TO_Z_UP or not (np.isfinite(unit) and unit > 0):
        raise AssetError(f".dae states up axis {up!r} and unit {unit}")
    return unit, up


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [""])[0][:160]
