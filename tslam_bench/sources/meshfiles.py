"""Reads mesh files of the kinds that 3D Warehouse and ShapeNet hold, as one mesh with z up.

Scenes are baked: every node's transform is applied. COLLADA states its unit and its up axis, glTF is metres and y up, OBJ is
taken as y up (as both sites publish it), the others as z up. Files are untrusted: nothing is unpacked to disk, and no file is
opened but the mesh and the buffers beside it. trimesh refuses what is broken; what it would take the wrong way, or not end
with, is found before it reads. The rest is left to the memory and the time that an import's worker may use.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path, PurePosixPath
from typing import Any, Literal
from urllib.parse import unquote

import numpy as np
import trimesh

from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import read_plain_file
from tslam_bench.geometry.meshes import TriangleMesh
from tslam_bench.geometry.ply import read_ply
from tslam_bench.sources import collada, gltf, readers

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
"""Most triangles of a mesh, all instances counted."""
MAX_INSTANCES = 10_000
"""Most nodes of a scene that show something."""
MAX_COORDINATE = 1e12
"""Largest coordinate."""

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
        data = read_plain_file(path, MAX_BYTES)
    except OSError as error:
        raise AssetError(f"cannot be read ({error.strerror or error})") from error
    except InvalidInputError as error:
        raise AssetError(str(error).removeprefix(f"{path}: ")) from error
    files: dict[str, bytes] = {}
    if suffix in ARCHIVE_SUFFIXES:
        name, files = _unpack(data)
        data, suffix = files[name], PurePosixPath(name).suffix.lower()
        base = PurePosixPath(name).parent
        inner = {PurePosixPath(key): content for key, content in files.items()}
        files = {str(key.relative_to(base)): content for key, content in inner.items() if base in key.parents}
    elif suffix == ".gltf":
        files = _beside(path, gltf.referenced_files(gltf.read_header(data, suffix)))
    return parse_mesh(data, suffix, up, files)


def parse_mesh(data: bytes, suffix: str, up: UpAxis = "auto", files: dict[str, bytes] | None = None) -> TriangleMesh:
    """The mesh in the bytes of a file whose format is ``suffix``; ``files`` are those that it may refer to.

    Raises:
        AssetError: one line that says what is wrong with the file.
    """
    if not data.strip():
        raise AssetError("empty file")
    resolver = _Resolver(files or {})
    unit = 1.0
    stated_up: str = _DEFAULT_UP.get(suffix, "z")
    if suffix == ".dae":
        document = collada.inspect(data)
        unit, stated_up = document.unit, document.up
        if document.instances > MAX_INSTANCES:
            raise AssetError(f"scene with {document.instances} geometries; the limit is {MAX_INSTANCES}")
    elif suffix in (".glb", ".gltf"):
        gltf.check_data(gltf.read_header(data, suffix))
        data = data.removeprefix(readers.BYTE_ORDER_MARK)
    elif suffix == ".obj" and not readers.is_plain_obj(data):
        data = readers.plain_obj(data)
    if suffix not in (".glb", ".gltf"):
        resolver = _Resolver({})  # the others refer to materials and textures only, which are not needed
    try:
        with np.errstate(all="ignore"):
            scene = _load(data, suffix, resolver)
            vertices, faces = _bake(scene, merge=suffix not in (".glb", ".gltf"))
            if suffix == ".obj" and len(faces) != (stated := readers.obj_triangles(data)):
                data = readers.plain_obj(data)  # faces of several spellings: trimesh reads all as the first
                vertices, faces = _bake(_load(data, suffix, resolver), merge=True)
                if len(faces) != stated:
                    raise AssetError(f"not a readable .obj file ({len(faces)} triangles of {stated} could be read)")
    except AssetError:
        raise
    except MemoryError as error:
        raise AssetError("needs more memory than it may use") from error
    except Exception as error:  # readers raise many kinds for a file that is not what it says
        reason = _first_line(error) or "its parts do not fit together"
        raise AssetError(f"not a readable {suffix} file ({type(error).__name__}: {reason})") from error
    used, inverse = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], inverse.reshape(-1, 3)
    if not np.isfinite(vertices).all():
        raise AssetError("vertices are not finite")
    if np.abs(vertices).max() > MAX_COORDINATE:
        raise AssetError(f"vertices are further out than any unit explains (beyond {MAX_COORDINATE:g})")
    rotation = _TO_Z_UP[stated_up if up == "auto" else up]
    return TriangleMesh(unit * vertices @ rotation.T, faces.astype(np.int64))


def _bake(scene: trimesh.Scene, merge: bool) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of all meshes of a scene, every instance in its place; lines and points are left out.

    Args:
        scene: the scene as it was read.
        merge: whether to merge equal vertices of a mesh.

    Raises:
        AssetError: nothing is left, something is above its limit, or a face, vertex or transform makes no sense.
    """
    shown: list[tuple[trimesh.Trimesh, np.ndarray]] = []
    count = 0
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not isinstance(geometry, trimesh.Trimesh) or len(geometry.faces) == 0:
            continue
        if geometry.faces.min() < 0 or geometry.faces.max() >= len(geometry.vertices):
            raise AssetError("faces refer to vertices that are not there")
        if not np.isfinite(geometry.vertices).all():
            raise AssetError("vertices are not finite")
        if not np.abs(transform).max() <= MAX_COORDINATE or not np.allclose(transform[3], (0, 0, 0, 1)):
            raise AssetError("a node's transform is not finite, or none that moves, turns and scales")
        count += len(geometry.faces)
        if count > MAX_TRIANGLES or len(shown) >= MAX_INSTANCES:
            raise AssetError(
                f"more than {MAX_TRIANGLES} triangles or {MAX_INSTANCES} instances, which are the limits of a scene"
            )
        shown.append((geometry, transform))
    if not shown:
        raise AssetError("holds no triangles; it may be damaged, or of another kind than its name says")
    vertices, faces, offset = [], [], 0
    if merge:
        for geometry in {id(geometry): geometry for geometry, _ in shown}.values():
            geometry.process()
    for geometry, transform in shown:
        placed = trimesh.Trimesh(geometry.vertices.copy(), geometry.faces.copy(), process=False)
        placed.apply_transform(transform)  # also turns the faces of a mirrored instance
        vertices.append(np.asarray(placed.vertices, dtype=np.float64))
        faces.append(np.asarray(placed.faces, dtype=np.int64) + offset)
        offset += len(placed.vertices)
    return np.concatenate(vertices), np.concatenate(faces)


def _load(data: bytes, suffix: str, resolver: _Resolver) -> trimesh.Scene:
    """The scene in a file's bytes, vertices as they stand."""
    match suffix:
        case ".stl":
            return readers.read_stl(data, MAX_TRIANGLES).scene()
        case ".off":
            return readers.read_off(data, MAX_TRIANGLES).scene()
        case ".ply":
            try:
                return read_ply(data, ".ply", MAX_TRIANGLES).scene()
            except InvalidInputError as error:
                raise AssetError(f"not a readable .ply file ({error})") from error
    options: dict[str, Any] = {} if suffix == ".dae" else {"skip_materials": True}
    return trimesh.load_scene(io.BytesIO(data), file_type=suffix[1:], resolver=resolver, process=False, **options)


class _Resolver(trimesh.resolvers.Resolver):
    """Gives a reader the files beside a mesh, from memory only."""

    def __init__(self, files: dict[str, bytes]) -> None:
        self._files = files

    def find(self, name: str) -> bytes | None:
        """The bytes of a file beside the mesh, None if there is no such file."""
        return self._files.get(name, self._files.get(str(PurePosixPath(unquote(name.strip())))))

    def get(self, name: str) -> bytes:
        """See :meth:`find`; raises FileNotFoundError."""
        found = self.find(name)
        if found is None:
            raise FileNotFoundError(name)
        return found

    def write(self, name: str, data: bytes) -> None:
        """Readers do not write."""
        raise AssetError(f"a reader tried to write {name}")

    def keys(self) -> list[str]:
        """Names of the files beside the mesh."""
        return list(self._files)

    def namespaced(self, namespace: str) -> _Resolver:
        """The same files: names are relative already."""
        return self


def _beside(path: Path, names: list[str]) -> dict[str, bytes]:
    """The files ``names`` in the folder of ``path`` and below, as bytes; links that lead out of it are refused."""
    folder = path.parent.resolve()
    found: dict[str, bytes] = {}
    for name in dict.fromkeys(names):
        beside = (folder / unquote(name)).resolve()
        if folder not in beside.parents:
            raise AssetError(f"refers to {name[:80]!r}, which is outside its folder")
        if not beside.is_file():
            raise AssetError(f"refers to {name[:80]!r}, which is not beside it")
        if beside.stat().st_size + sum(map(len, found.values())) > MAX_BYTES:
            raise AssetError(f"its buffers have more than {MAX_BYTES / 1e6:.0f} MB, which is the limit")
        found[name] = beside.read_bytes()
    return found


def _unpack(data: bytes) -> tuple[str, dict[str, bytes]]:
    """Name of the one mesh in an archive, and all of its files, in memory, within the limits."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [member for member in archive.infolist() if not member.is_dir()]
            if len(members) > MAX_MEMBERS:
                raise AssetError(f"archive with {len(members)} members; the limit is {MAX_MEMBERS}")
            for member in members:
                parts = PurePosixPath(member.filename.replace("\\", "/")).parts
                if not parts or ".." in parts or member.filename.startswith(("/", "\\")) or ":" in parts[0]:
                    raise AssetError(f"archive member {member.filename!r} escapes the archive")
                if member.flag_bits & 1:
                    raise AssetError("archive is encrypted")
            total = sum(member.file_size for member in members)
            if total > MAX_BYTES or total > MAX_RATIO * max(len(data), 1):
                raise AssetError(
                    f"archive unpacks to {total / 1e6:.0f} MB from {len(data) / 1e6:.2f} MB: refused as a bomb"
                )
            meshes = [
                m.filename
                for m in members
                if PurePosixPath(m.filename).suffix.lower() in MESH_SUFFIXES
                and not any(part.startswith(".") or part == "__MACOSX" for part in PurePosixPath(m.filename).parts)
            ]
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


def _first_line(error: Exception) -> str:
    return " ".join("".join(c if c.isprintable() else " " for c in str(error)).split())[:160]
