"""Broken and hostile mesh files, made from good ones: what the importer has to survive.

Everything is drawn from a seeded generator; the same seed gives the same bytes. Mutants come in three kinds: geometry that is
damaged and then written properly, files whose bytes are damaged, and files that are hostile by design.
"""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import trimesh

from tslam_bench.geometry.meshes import TriangleMesh

Generator = np.random.Generator


class Mutant(NamedTuple):
    """A file to import.

    Attributes:
        kind: what was done.
        name: file name.
        files: bytes of the file, and of those that lie beside it, by name.
        in_metres: import it with the unit stated (m) rather than scaled to hand-held size.
    """

    kind: str
    name: str
    files: dict[str, bytes]
    in_metres: bool = False


FORMATS = ("stl", "stl_ascii", "ply", "ply_ascii", "off", "obj", "glb", "gltf", "dae", "zip", "kmz", "zae")


def write(mesh: TriangleMesh, file_format: str, stem: str) -> tuple[str, dict[str, bytes]]:
    """File name, and files, of a mesh in one of ``FORMATS``."""
    if file_format in ("zip", "kmz", "zae"):
        inner = {"zip": "stl", "kmz": "dae", "zae": "dae"}[file_format]
        name, files = write(mesh, inner, "model")
        return f"{stem}.{file_format}", {f"{stem}.{file_format}": zipped({f"models/{name}": files[name]})}
    loaded = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    if file_format == "gltf":
        scene = loaded.scene()
        parts = {name: bytes(data) for name, data in scene.export(file_type="gltf").items()}
        return f"{stem}.gltf", {f"{stem}.gltf": parts.pop("model.gltf"), **parts}
    if file_format == "ply_ascii":
        data: bytes | str = loaded.export(file_type="ply", encoding="ascii")
    else:
        data = loaded.export(file_type=file_format)
    name = f"{stem}.{file_format.split('_')[0]}"
    return name, {name: data.encode() if isinstance(data, str) else bytes(data)}


def zipped(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """A zip archive."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name), data, method)  # of no date: the same bytes at any time
    return stream.getvalue()


# --- geometry ---------------------------------------------------------------------------------------------------


def _some(count: int, share: float, generator: Generator) -> np.ndarray:
    chosen = generator.random(count) < share
    chosen[generator.integers(count)] = True
    return chosen


def _spoil(value: float) -> Callable[[TriangleMesh, Generator], TriangleMesh]:
    def change(mesh: TriangleMesh, generator: Generator) -> TriangleMesh:
        vertices = mesh.vertices.copy()
        vertices[generator.integers(len(vertices)), generator.integers(3)] = value
        return TriangleMesh(vertices, mesh.faces)

    return change


def _flip(share: float) -> Callable[[TriangleMesh, Generator], TriangleMesh]:
    def change(mesh: TriangleMesh, generator: Generator) -> TriangleMesh:
        faces = mesh.faces.copy()
        chosen = _some(len(faces), share, generator)
        faces[chosen] = faces[chosen][:, ::-1]
        return TriangleMesh(mesh.vertices, faces)

    return change


def _drop(share: float) -> Callable[[TriangleMesh, Generator], TriangleMesh]:
    def change(mesh: TriangleMesh, generator: Generator) -> TriangleMesh:
        return TriangleMesh(mesh.vertices, mesh.faces[~_some(len(mesh.faces), share, generator)])

    return change


def _duplicate(mesh: TriangleMesh, generator: Generator) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces[_some(len(mesh.faces), 0.3, generator)]]))


def _degenerate(mesh: TriangleMesh, generator: Generator) -> TriangleMesh:
    faces = mesh.faces.copy()
    chosen = _some(len(faces), 0.2, generator)
    faces[chosen, 1] = faces[chosen, 0]
    return TriangleMesh(mesh.vertices, faces)


def _push(mesh: TriangleMesh, generator: Generator) -> TriangleMesh:
    """Vertices pushed through the other side: the surface intersects itself."""
    vertices = mesh.vertices.copy()
    chosen = _some(len(vertices), 0.02, generator)
    vertices[chosen] += 0.7 * generator.normal(size=(chosen.sum(), 3)) * np.ptp(vertices, axis=0)
    return TriangleMesh(vertices, mesh.faces)


def _shuffle(mesh: TriangleMesh, generator: Generator) -> TriangleMesh:
    """Corners exchanged at random: triangle soup."""
    faces = mesh.faces.copy()
    chosen = _some(len(faces), 0.3, generator)
    faces[chosen] = generator.integers(len(mesh.vertices), size=(int(chosen.sum()), 3))
    return TriangleMesh(mesh.vertices, faces)


def _flatten(mesh: TriangleMesh, generator: Generator) -> TriangleMesh:
    return TriangleMesh(mesh.vertices * np.where(np.arange(3) == generator.integers(3), 0.0, 1.0), mesh.faces)


def _scale(factor: float) -> Callable[[TriangleMesh, Generator], TriangleMesh]:
    return lambda mesh, generator: TriangleMesh(mesh.vertices * factor, mesh.faces)


def _move(distance: float) -> Callable[[TriangleMesh, Generator], TriangleMesh]:
    return lambda mesh, generator: TriangleMesh(mesh.vertices + distance, mesh.faces)


GEOMETRY: dict[str, Callable[[TriangleMesh, Generator], TriangleMesh]] = {
    "unchanged": lambda mesh, generator: mesh,
    "vertex not a number": _spoil(np.nan),
    "vertex infinite": _spoil(np.inf),
    "vertex far out": _spoil(1e9),
    "some faces flipped": _flip(0.2),
    "inside out": lambda mesh, generator: TriangleMesh(mesh.vertices, mesh.faces[:, ::-1]),
    "few faces removed": _drop(0.003),
    "many faces removed": _drop(0.5),
    "faces duplicated": _duplicate,
    "faces degenerate": _degenerate,
    "self-intersecting": _push,
    "triangle soup": _shuffle,
    "flat": _flatten,
    "one point": _scale(0.0),
    "one triangle": lambda mesh, generator: TriangleMesh(mesh.vertices, mesh.faces[:1]),
    "no faces": lambda mesh, generator: TriangleMesh(mesh.vertices, mesh.faces[:0]),
    "coordinates 1e30": _scale(1e30),
    "coordinates 1e-30": _scale(1e-30),
    "moved 1e7 away": _move(1e7),
    "metres: 40 m": _scale(400.0),
    "metres: 1000 times too small": _scale(1e-3),
}
"""Damage to the geometry. Those called "metres: ..." are imported with the unit stated."""


# --- bytes ------------------------------------------------------------------------------------------------------


def _change_bytes(count: int, within: int | None = None) -> Callable[[bytes, Generator], bytes]:
    def change(data: bytes, generator: Generator) -> bytes:
        changed = bytearray(data)
        for position in generator.integers(min(len(data), within or len(data)), size=count):
            changed[position] = generator.integers(256)
        return bytes(changed)

    return change


def _cut(data: bytes, generator: Generator) -> bytes:
    return data[: generator.integers(len(data))]


def _insert(data: bytes, generator: Generator) -> bytes:
    position = int(generator.integers(len(data)))
    return data[:position] + generator.bytes(int(generator.integers(1, 200))) + data[position:]


def _delete(data: bytes, generator: Generator) -> bytes:
    position = int(generator.integers(len(data)))
    return data[:position] + data[position + int(generator.integers(1, 200)) :]


def _repeat(data: bytes, generator: Generator) -> bytes:
    start, end = sorted(generator.integers(len(data), size=2).tolist())
    return data[:end] + data[start:end] + data[end:]


def _blank(data: bytes, generator: Generator) -> bytes:
    position = int(generator.integers(len(data)))
    return data[:position] + bytes(min(200, len(data) - position)) + data[position + 200 :]


_NUMBERS = (
    b"-1",
    b"0",
    b"nan",
    b"inf",
    b"1e999",
    b"99999999999999999999",
    b"2147483648",
    b"-2147483649",
    b"1e-320",
    b"0x7f",
)


def _numbers(data: bytes, generator: Generator) -> bytes:
    """Some runs of digits replaced by awkward numbers (in text formats: coordinates, indices, counts)."""
    changed = data
    for _ in range(3):
        position = int(generator.integers(len(changed)))
        start = next(
            (k for k in range(position, min(position + 500, len(changed))) if changed[k : k + 1].isdigit()), None
        )
        if start is not None:
            end = start
            while end < len(changed) and changed[end : end + 1] in b"0123456789.eE-+":
                end += 1
            changed = changed[:start] + _NUMBERS[generator.integers(len(_NUMBERS))] + changed[end:]
    return changed


BYTES: dict[str, Callable[[bytes, Generator], bytes]] = {
    "one byte changed": _change_bytes(1),
    "20 bytes changed": _change_bytes(20),
    "1000 bytes changed": _change_bytes(1000),
    "header bytes changed": _change_bytes(3, within=200),
    "truncated": _cut,
    "bytes inserted": _insert,
    "bytes deleted": _delete,
    "block repeated": _repeat,
    "block of zeros": _blank,
    "numbers exchanged": _numbers,
    "empty": lambda data, generator: b"",
    "random bytes": lambda data, generator: generator.bytes(min(len(data), 20_000)),
}
"""Damage to a file's bytes."""


# --- hostile by design ------------------------------------------------------------------------------------------

_DAE_HEAD = (
    '<?xml version="1.0"?>{doctype}<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">'
)
_DAE_GEOMETRY = """<asset><unit meter="{unit}"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" count="{count}">{numbers}</float_array>
<technique_common><accessor source="#a" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/><p>{faces}</p></triangles></mesh></geometry>
</library_geometries>
"""
_DAE_TAIL = """<library_visual_scenes><visual_scene id="s">{scene}</visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def collada(
    scene: str = '<node><instance_geometry url="#g"/></node>',
    library: str = "",
    doctype: str = "",
    unit: str = "1",
    numbers: str = "0 0 0 10 0 0 0 20 0 0 0 30",
    faces: str = "0 2 1 0 1 3 0 3 2 1 2 3",
    count: int = 12,
) -> bytes:
    """A COLLADA document of one tetrahedron."""
    geometry = _DAE_GEOMETRY.format(unit=unit, numbers=numbers, faces=faces, count=count)
    nodes = f"<library_nodes>{library}</library_nodes>" if library else ""
    return (_DAE_HEAD.format(doctype=doctype) + geometry + nodes + _DAE_TAIL.format(scene=scene)).encode()


def _doubling(levels: int) -> str:
    """Nodes that each instance the next one twice."""
    nodes = [
        f'<node id="n{k}"><instance_node url="#n{k + 1}"/><instance_node url="#n{k + 1}"/></node>'
        for k in range(levels)
    ]
    return "".join(nodes) + f'<node id="n{levels}"><instance_geometry url="#g"/></node>'


def _laughs() -> str:
    entities = "".join(f'<!ENTITY l{k} "{f"&l{k - 1};" * 10}">' for k in range(1, 10))
    return f'<!DOCTYPE COLLADA [<!ENTITY l0 "0 0 0 ">{entities}]>'


_TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype="<f4")
_TETRAHEDRON_FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype="<u4")


def gltf_header() -> dict:
    """Header of a tetrahedron in one buffer of 96 bytes."""
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 12, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 48},
        ],
        "buffers": [{"byteLength": 96}],
    }


def glb(header: dict, body: bytes | None = None) -> bytes:
    """A binary glTF file."""
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    body = _TETRAHEDRON.tobytes() + _TETRAHEDRON_FACES.tobytes() if body is None else body
    length = 12 + 8 + len(text) + 8 + len(body)
    return (
        struct.pack("<III", 0x46546C67, 2, length)
        + struct.pack("<II", len(text), 0x4E4F534A)
        + text
        + struct.pack("<II", len(body), 0x004E4942)
        + body
    )


def _with(*changes: tuple[Sequence[str | int], object]) -> bytes:
    """The tetrahedron with entries of its header replaced: (path, value)."""
    header = gltf_header()
    for path, value in changes:
        target: dict = header
        for step in path[:-1]:
            target = target[step]  # type: ignore[index]
        target[path[-1]] = value  # type: ignore[index]
    return glb(header)


def _flagged_encrypted() -> bytes:
    data = bytearray(zipped({"a.stl": b"solid"}))
    data[6] |= 1
    directory = data.find(b"PK\x01\x02")
    data[directory + 8] |= 1
    return bytes(data)


def _lying_size() -> bytes:
    data = bytearray(zipped({"a.stl": b"\0" * 100_000}))
    directory = data.find(b"PK\x01\x02")
    data[directory + 24 : directory + 28] = struct.pack("<I", 10)
    return bytes(data)


def _linked() -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        link = zipfile.ZipInfo("model.stl")
        link.external_attr = 0o120777 << 16
        archive.writestr(link, "/etc/passwd")
    return stream.getvalue()


_PLY = (
    "ply\nformat {0} 1.0\nelement vertex {1}\nproperty float x\nproperty float y\nproperty float z\n"
    "element face {2}\n{3}end_header\n"
)
_LIST = "property list uchar int vertex_indices\n"

HOSTILE: dict[str, bytes | dict[str, bytes]] = {
    "bomb.zip": zipped({"bomb.stl": b"\0" * 50_000_000}),
    "nested.zip": zipped({"inner.zip": zipped({"bomb.stl": b"\0" * 5_000_000})}),
    "escape.zip": zipped({"../../escaped.stl": b"solid"}),
    "absolute.zip": zipped({"/tmp/escaped.stl": b"solid"}),
    "drive.zip": zipped({"C:/escaped.stl": b"solid"}),
    "link.zip": _linked(),
    "encrypted.zip": _flagged_encrypted(),
    "lying.zip": _lying_size(),
    "members.zip": zipped({f"{k}.txt": b"" for k in range(10_001)}, zipfile.ZIP_STORED),
    "two.zip": zipped({"a.stl": b"", "b.stl": b""}),
    "nothing.kmz": zipped({"doc.kml": b"<kml/>"}),
    "laughs.dae": collada(doctype=_laughs(), numbers="&l9;"),
    "entity.dae": collada(doctype='<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/passwd">]>', numbers="&e;"),
    "circle.dae": collada(
        scene='<node><instance_node url="#a"/></node>',
        library='<node id="a"><instance_node url="#b"/></node><node id="b"><instance_node url="#a"/></node>',
    ),
    "own-parent.dae": collada(scene='<node id="a"><instance_node url="#a"/><instance_geometry url="#g"/></node>'),
    "doubling.dae": collada(scene='<node><instance_node url="#n0"/></node>', library=_doubling(30)),
    "deep.dae": collada(scene="<node>" * 100_000 + '<instance_geometry url="#g"/>' + "</node>" * 100_000),
    "chain.dae": collada(
        scene='<node><instance_node url="#n0"/></node>',
        library="".join(f'<node id="n{k}"><instance_node url="#n{k + 1}"/></node>' for k in range(5000)),
    ),
    "instances.dae": collada(scene='<node><instance_geometry url="#g"/></node>' * 20_000),
    "index.dae": collada(faces="0 2 1 0 1 3 0 3 2 1 2 999999"),
    "negative-index.dae": collada(faces="0 2 1 0 1 3 0 3 2 1 2 -3"),
    "count.dae": collada(count=10**12),
    "numbers.dae": collada(numbers="0 0 0 nan 0 0 0 inf 0 0 0 1e999"),
    "unit.dae": collada(unit="nan"),
    "unit-zero.dae": collada(unit="0"),
    "kml.dae": b"<?xml version='1.0'?><kml><Document/></kml>",
    "count.glb": _with((("accessors", 0, "count"), 10**9)),
    "count-without-data.glb": _with((("accessors", 0), {"componentType": 5126, "count": 10**12, "type": "VEC3"})),
    "negative-count.glb": _with((("accessors", 0, "count"), -5)),
    "negative-offset.glb": _with((("bufferViews", 0, "byteOffset"), -48)),
    "offset.glb": _with((("bufferViews", 1, "byteOffset"), 10**9)),
    "stride.glb": _with((("bufferViews", 0, "byteStride"), -4)),
    "type.glb": _with((("accessors", 0, "type"), "VEC9")),
    "text-count.glb": _with((("accessors", 0, "count"), "4")),
    "circle.glb": _with((("nodes",), [{"children": [1]}, {"children": [2]}, {"children": [1], "mesh": 0}])),
    "parents.glb": _with((("nodes",), [{"children": [1, 2]}, {"children": [3]}, {"children": [3]}, {"mesh": 0}])),
    "chain.glb": _with((("nodes",), [*({"children": [k + 1]} for k in range(5000)), {"mesh": 0}])),
    "instances.glb": _with((("nodes",), [{"mesh": 0}] * 50_000), (("scenes", 0, "nodes"), list(range(50_000)))),
    "views.glb": glb(
        gltf_header()
        | {"buffers": [{"byteLength": 10**5}], "bufferViews": [{"buffer": 0, "byteLength": 10**5}] * 3000},
        bytes(10**5),
    ),
    "index.glb": glb(gltf_header(), _TETRAHEDRON.tobytes() + (_TETRAHEDRON_FACES + 2).tobytes()),
    "matrix.glb": _with((("nodes", 0, "matrix"), [1e308] * 16)),
    "child.glb": _with((("nodes", 0, "children"), [7])),
    "mesh.glb": _with((("nodes", 0, "mesh"), 7)),
    "draco.glb": _with(
        (("extensionsRequired",), ["KHR_draco_mesh_compression"]),
        (("accessors", 0), {"componentType": 5126, "count": 4, "type": "VEC3"}),
    ),
    "json.glb": glb({})[:20] + b"[" * 100_000,
    "list.glb": _with((("meshes",), {"a": 1})),
    "address.gltf": json.dumps(
        gltf_header() | {"buffers": [{"byteLength": 96, "uri": "http://127.0.0.1/x.bin"}]}
    ).encode(),
    "outside.gltf": json.dumps(gltf_header() | {"buffers": [{"byteLength": 96, "uri": "../../secret.bin"}]}).encode(),
    "encoded.gltf": json.dumps(gltf_header() | {"buffers": [{"byteLength": 96, "uri": "%2e%2e/secret.bin"}]}).encode(),
    "absolute.gltf": json.dumps(gltf_header() | {"buffers": [{"byteLength": 96, "uri": "/etc/passwd"}]}).encode(),
    "missing.gltf": json.dumps(gltf_header() | {"buffers": [{"byteLength": 96, "uri": "missing.bin"}]}).encode(),
    "short.gltf": {
        "short.gltf": json.dumps(gltf_header() | {"buffers": [{"byteLength": 96, "uri": "short.bin"}]}).encode(),
        "short.bin": b"\0" * 20,
    },
    "base64.gltf": json.dumps(
        gltf_header() | {"buffers": [{"byteLength": 96, "uri": "data:application/octet-stream;base64,????"}]}
    ).encode(),
    "vertices.ply": _PLY.format("ascii", 10**9, 1, _LIST).encode() + b"0 0 0\n",
    "binary-vertices.ply": _PLY.format("binary_little_endian", 10**9, 1, _LIST).encode() + bytes(100),
    "negative.ply": _PLY.format("ascii", -1, 1, _LIST).encode() + b"0 0 0\n",
    "no-end.ply": _PLY.format("ascii", 3, 1, _LIST).encode().replace(b"end_header\n", b""),
    "list.ply": _PLY.format("binary_little_endian", 1, 1, _LIST.replace("uchar", "int")).encode()
    + bytes(12)
    + struct.pack("<i", 2**31 - 1),
    "index.ply": _PLY.format("ascii", 3, 1, _LIST).encode() + b"0 0 0\n1 0 0\n0 1 0\n3 0 1 99999999\n",
    "points.ply": _PLY.format("ascii", 1, 0, "").encode() + b"0 0 0\n",
    "counts.off": b"OFF\n1000000000 1000000000 0\n0 0 0\n",
    "negative.off": b"OFF\n-3 1 0\n0 0 0\n",
    "index.off": b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n",
    "polygon.off": b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n1000000000 0 1 2\n",
    "count.stl": bytes(80) + b"\xff\xff\xff\xff" + bytes(100),
    "text.stl": b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0\nendloop\nendfacet\nendsolid\n",
    "outside.obj": b"mtllib ../../../../etc/passwd\nusemtl x\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "index.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 999999999999\n",
    "negative-index.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -9\n",
    "zero-index.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n",
    "words.obj": b"v zero one two\nf a b c\n",
    "continued.obj": b"v 0 0 0 \\\n" * 1000,
    "two-corners.obj": b"v 0 0 0\nv 1 0 0\nf 1 2\n",
    "picture.obj": b"\x89PNG\r\n\x1a\n" + bytes(100),
    "page.stl": b"<!doctype html><html><body>404 not found</body></html>",
    "latin.obj": "# Möbel\n".encode("latin-1") * 20_000,
    "model.skp": b"\xff\xfe\xff\x0eS\x00k\x00e\x00t\x00c\x00h\x00U\x00p\x00",
    "model.blend": b"BLENDER-v300",
    "model.fbx": b"Kaydara FBX Binary  \x00",
}
"""Hostile files by name, with what lies beside them."""


def mutant(shapes: Sequence[tuple[str, TriangleMesh]], index: int, seed: int) -> Mutant:
    """Mutant number ``index``: cycles through every kind of damage; shape, format and details are drawn.

    Args:
        shapes: good meshes (m) with their names.
        index: number of the mutant.
        seed: of all draws.
    """
    generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, index])))
    kinds = [*GEOMETRY, *BYTES, "wrong suffix"]
    hostile = sorted(HOSTILE)
    turn, place = divmod(index, len(kinds) + 8)  # eight hostile files in each round
    label, mesh = shapes[generator.integers(len(shapes))]
    if place >= len(kinds):
        name = hostile[(8 * turn + place - len(kinds)) % len(hostile)]
        content = HOSTILE[name]
        return Mutant("hostile", f"{index:04d}-{name}", _renamed(content, name, f"{index:04d}-{name}"))
    kind = kinds[place]
    file_format = FORMATS[generator.integers(len(FORMATS))]
    stem = f"{index:04d}-{label}"
    if kind in GEOMETRY:
        with np.errstate(all="ignore"):
            mesh = GEOMETRY[kind](mesh, generator)
            try:
                name, files = write(mesh, file_format, stem)
            except (ValueError, IndexError, TypeError):  # this writer does not take such a mesh
                name, files = write(mesh, "stl", stem)
        return Mutant(kind, name, files, in_metres=kind.startswith("metres"))
    name, files = write(mesh, file_format, stem)
    if kind == "wrong suffix":
        suffixes = ("stl", "ply", "off", "obj", "glb", "dae", "zip", "gltf")
        wrong = f"{stem}.{suffixes[generator.integers(len(suffixes))]}"
        return Mutant(kind, wrong, {wrong: files[name]})
    return Mutant(kind, name, files | {name: BYTES[kind](files[name], generator)})


def _renamed(content: bytes | dict[str, bytes], name: str, new: str) -> dict[str, bytes]:
    files = dict(content) if isinstance(content, dict) else {name: content}
    files[new] = files.pop(name)
    return files
