"""Every legal spelling of OBJ, OFF, STL, PLY and glTF is read whole, or refused in one line.

One shape, a wedge and a pyramid side by side, is written in all the ways that programs and people write it. What has to come back
is known from the shape itself; where trimesh takes a spelling rightly, it is asked too.
"""

from __future__ import annotations

import io
import itertools
import json
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tslam_bench.errors import AssetError
from tslam_bench.sources import readers
from tslam_bench.sources.importer import read_set
from tslam_bench.sources.meshfiles import parse_mesh

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import mesh_mutations

WEDGE = [[0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0], [0, 0, 4], [2, 0, 4]]
WEDGE_FACES = [[0, 3, 2, 1], [0, 1, 5, 4], [0, 4, 3], [1, 2, 5], [2, 3, 4, 5]]
PYRAMID = [[5, 0, 0], [7, 0, 0], [8, 1.5, 0], [7, 3, 0], [5, 3, 0], [6, 1.5, 0.25]]
PYRAMID_FACES = [[4, 3, 2, 1, 0], *([k, (k + 1) % 5, 5] for k in range(5))]
PARTS = ((WEDGE, WEDGE_FACES), (PYRAMID, PYRAMID_FACES))
VERTICES = WEDGE + PYRAMID
FACES = WEDGE_FACES + [[6 + k for k in face] for face in PYRAMID_FACES]
VOLUME = 2 * 3 * 4 / 2 + (2 * 3 + 1 * 3 / 2) * 0.25 / 3
TRIANGLES = sum(len(face) - 2 for face in FACES)


def triangles(vertices, faces) -> list[list[int]]:
    """Polygons cut into fans."""
    return [[face[0], a, b] for face in faces for a, b in itertools.pairwise(face[1:])]


def check(data: bytes, suffix: str) -> None:
    """The whole shape is there, each face the right way round: volume, area and the corners of every polygon."""
    mesh = parse_mesh(data, suffix, up="z")
    read = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert len(mesh.faces) == TRIANGLES
    assert read.volume == pytest.approx(VOLUME, rel=1e-6)
    expected = trimesh.Trimesh(VERTICES, triangles(VERTICES, FACES), process=False)
    assert read.area == pytest.approx(expected.area, rel=1e-6)
    assert {tuple(v) for v in mesh.vertices.round(5).tolist()} == {tuple(map(float, v)) for v in VERTICES}
    # Each polygon lies in one plane: its triangles have one normal, and together its area.
    assert sorted(areas(read)) == pytest.approx(sorted(areas(expected)), rel=1e-5)


def areas(mesh: trimesh.Trimesh) -> list[float]:
    """Area by normal, as x, y, z of the sum of each group."""
    groups: dict[tuple[float, ...], float] = {}
    for normal, area in zip(mesh.face_normals.round(3).tolist(), mesh.area_faces, strict=True):
        key = tuple(x + 0.0 for x in normal)
        groups[key] = groups.get(key, 0.0) + float(area)
    return [round(value, 9) for _, value in sorted(groups.items())]


# --- OBJ --------------------------------------------------------------------------------------------------------


def obj(
    corner: Callable[[int, int, int], str] = lambda k, count, _: str(k + 1),
    by_part: bool = False,
    line: Callable[[str], str] = lambda text: text,
    end: str = "\n",
    extra: tuple[str, ...] = (),
) -> bytes:
    """The shape as OBJ; ``corner`` spells vertex k when there are ``count``, in face number n."""
    lines = [*extra]
    parts = PARTS if by_part else ((VERTICES, FACES),)
    count = number = 0
    for vertices, faces in parts:
        first = count
        lines += [f"v {x} {y} {z}" for x, y, z in vertices]
        count += len(vertices)
        for face in faces:
            lines.append("f " + " ".join(corner(first + k, count, number) for k in face))
            number += 1
    return (end.join(map(line, lines)) + end).encode()


def back(k: int, count: int, _: int) -> str:
    return str(k - count)


OBJ = {
    "plain": obj(),
    "by part": obj(by_part=True),
    "negative by part": obj(back, by_part=True),
    "negative at the end": obj(back),
    "negative with textures": obj(lambda k, c, n: f"{k - c}/-1/-1", by_part=True, extra=("vt 0 0", "vn 0 0 1")),
    "tabs": obj(line=lambda text: text.replace(" ", "\t")),
    "tabs and blanks": obj(line=lambda text: "  " + text.replace(" ", " \t ") + "\t "),
    "byte-order mark": readers.BYTE_ORDER_MARK + obj(),
    "windows": obj(end="\r\n"),
    "old mac": obj(end="\r"),
    "comments after faces": obj(line=lambda text: f"{text} # of {text}"),
    "comments in latin-1": "# Größe\n".encode("latin-1") + obj(),
    "continued": obj(line=lambda text: text.replace(" ", " \\\n", 2)),
    "continued for windows": obj(line=lambda text: text.replace(" ", " \\\r\n", 2), end="\r\n"),
    "two spellings of corners": obj(
        lambda k, c, n: f"{k + 1}//1" if n % 2 else f"{k + 1}/1/1", extra=("vt 0 0", "vn 0 0 1")
    ),
    "corners with and without texture": obj(lambda k, c, n: f"{k + 1}/1" if n % 3 else f"{k + 1}", extra=("vt 0 0",)),
    "half of the corners": obj(lambda k, c, n: f"{k + 1}/1" if k % 2 else f"{k + 1}", extra=("vt 0 0",)),
    "trailing slashes": obj(lambda k, c, n: f"{k + 1}//"),
    "fo": obj(line=lambda text: text.replace("f ", "fo ")),
    "groups": obj(by_part=True, line=lambda text: f"g a\ns 1\n{text}" if text.startswith("f") else text),
    "colours": obj(line=lambda text: f"{text} 0.5 0.5 0.5" if text.startswith("v") else text),
    "some colours": obj(line=lambda text: f"{text} 0.5 0.5 0.5" if text.startswith("v 2") else text),
    "weights": obj(line=lambda text: f"{text} 1.0" if text.startswith("v") else text),
    "exponents": obj(
        line=lambda text: " ".join(
            f"{float(word):+.6E}" if text.startswith("v") and word != "v" else word for word in text.split()
        )
    ),
    "materials": obj(by_part=True, line=lambda text: f"usemtl m#{len(text)}\n{text}" if text.startswith("f") else text),
    "objects and lines": obj(extra=("o one", "l 1 2", "p 1"), by_part=True),
    "faces first": b"\n".join(sorted(obj().split(b"\n"), key=lambda line: not line.startswith(b"f"))),
    "a path for windows": obj(extra=("mtllib ..\\materials\\x.mtl",)),
}


@pytest.mark.parametrize("name", OBJ)
def test_obj(name: str) -> None:
    check(OBJ[name], ".obj")


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"f -1 -2 -99", "not there"),
        (b"f 1 2 99", "out of bounds"),
        (b"f 0 1 2", "vertex 0"),
        (b"f 1 2 0/3", "vertex 0"),
        (b"f 1 2 x", "corner 'x'"),
        (b"f 1 2 \xff\x1b[2J", "corner"),
        (b"f 1 2 1.5", "corner '1.5'"),
        (b"v 1 2", "fewer than three"),
        (b"v 1,5 2 3", "could not convert|not a readable"),
        (b"surf 0 1 0 1 1 2 3 4", "free-form"),
    ],
)
def test_obj_that_cannot_be_read_whole(line: bytes, reason: str) -> None:
    refused(obj() + line + b"\n", ".obj", reason)


def refused(data: bytes, suffix: str, reason: str = "") -> None:
    with pytest.raises(AssetError, match=reason) as caught:
        parse_mesh(data, suffix)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 300


# --- OFF --------------------------------------------------------------------------------------------------------


def off(head: str = "OFF\n{} {} 0\n", more: str = "", face_more: str = "", end: str = "\n", faces=FACES) -> bytes:
    lines = [f"{x} {y} {z}{more}" for x, y, z in VERTICES]
    lines += [" ".join(map(str, [len(face), *face])) + face_more for face in faces]
    return (head.format(len(VERTICES), len(faces)).replace("\n", end) + end.join(lines) + end).encode()


OFF = {
    "plain": off(),
    "counts beside the keyword": off("OFF {} {} 0\n"),
    "lower case": off("off\n{} {} 0\n"),
    "lower case, counts beside it": off("off {} {} 0\n"),
    "no keyword": off("{} {} 0\n"),
    "triangles": off(faces=triangles(VERTICES, FACES)),
    "two counts": off("OFF\n{} {}\n"),
    "comments": off("# made by hand: OFF\nOFF # the keyword\n\n{} {} 0 # counts\n\n# vertices\n"),
    "latin-1": "# Größe\n".encode("latin-1") + off(),
    "windows": off(end="\r\n"),
    "old mac": off(end="\r"),
    "byte-order mark": readers.BYTE_ORDER_MARK + off(),
    "tabs": off().replace(b" ", b"\t"),
    "colours of vertices": off("COFF\n{} {} 0\n", more=" 255 0 0 255"),
    "normals": off("NOFF\n{} {} 0\n", more=" 0 0 1"),
    "colours of faces": off(face_more=" 255 0 0"),
    "named colours of faces": off(face_more=" # red"),
}


@pytest.mark.parametrize("name", OFF)
def test_off(name: str) -> None:
    check(OFF[name], ".off")


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (off("OFF BINARY\n{} {} 0\n"), "binary"),
        (off("4OFF\n{} {} 0\n", more=" 1"), "three dimensions"),
        (off("nOFF\n3\n{} {} 0\n"), "three dimensions"),
        (off("OFFS\n{} {} 0\n"), "no counts"),
        (off("OFF\n{} {} 0 0\n"), "no counts"),
        (off("OFF\n-{} {} 0\n"), "no counts"),
        (off()[:-30], "states"),
        (off() + b"3 0 1 2\n", "more follows"),
        (off().replace(b"4 0 3 2 1", b"5 0 3 2 1"), "fewer corners"),
        (off().replace(b"4 0 3 2 1", b"4 0 3 2 -1"), "not there"),
        (off().replace(b"4 0 3 2 1", b"4 0 3 2 99999999999999999999"), "not there"),
        (off().replace(b"4 0 3 2 1", b"4 0 3 two 1"), "numbers"),
        (off().replace(b"2 3 0", b"2 nan 0"), "finite"),
        (b"OFF\n2000001 1 0\n", "limit"),
        (b"OFF\n", "no counts"),
    ],
)
def test_off_that_cannot_be_read_whole(data: bytes, reason: str) -> None:
    refused(data, ".off", reason)


# --- STL --------------------------------------------------------------------------------------------------------


def stl(count: int | None = None, head: bytes = b"") -> bytes:
    """Binary."""
    corners = np.array(VERTICES, dtype="<f4")[triangles(VERTICES, FACES)]
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *corner.ravel(), 0) for corner in corners)
    return head.ljust(80, b" ") + struct.pack("<I", len(corners) if count is None else count) + body


def stl_text(name: str = "shape", end: str = "\n", blank: str = " ", by_part: bool = False) -> bytes:
    texts = []
    for vertices, faces in PARTS if by_part else ((VERTICES, FACES),):
        lines = [f"solid {name}"]
        for corners in np.array(vertices, dtype=float)[triangles(vertices, faces)]:
            lines += ["  facet normal 0 0 1", "    outer loop"]
            lines += [f"      vertex {x!r} {y!r} {z:e}" for x, y, z in corners.tolist()]
            lines += ["    endloop", "  endfacet"]
        texts += [*lines, f"endsolid {name}"]
    return (end.join(texts) + end).replace(" ", blank).encode()


STL = {
    "plain": stl(),
    "begins like a text": stl(head=b"solid made by a program"),
    "one byte more": stl() + b"\0",
    "a line end more": stl() + b"\r\n",
    "49 bytes more": stl() + b"x" * 49,
    "zeros to the next block": stl() + bytes(4096),
    "begins like a text, one byte more": stl(head=b"solid made by a program") + b"\n",
    "text": stl_text(),
    "text for windows": stl_text(end="\r\n"),
    "text for old mac": stl_text(end="\r"),
    "text with tabs": stl_text(blank="\t"),
    "text in upper case": stl_text().upper(),
    "text without a name": stl_text(name=""),
    "text with words in its name": stl_text(name="vertex facet normal endsolid"),
    "text of several solids": stl_text(by_part=True),
    "text with a byte-order mark": readers.BYTE_ORDER_MARK + stl_text(),
    "text with blank lines": b"\n\n" + stl_text(end="\n\n"),
    "text in latin-1": stl_text(name="Größe").decode().encode("latin-1"),
    "text with odd normals": stl_text().replace(b"normal 0 0 1", b"normal -nan(ind) -nan(ind) 1.#QNAN"),
    "text with keywords in two words": stl_text().replace(b"endloop", b"end loop").replace(b"endfacet", b"end facet"),
}


@pytest.mark.parametrize("name", STL)
def test_stl(name: str) -> None:
    check(STL[name], ".stl")


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (stl() + stl(), "bytes follow the"),
        (stl(count=3), "follow the 3 triangles"),
        (stl(count=0), "follow the 0 triangles"),
        (stl()[:-1], "ends before the last"),
        (stl(count=2**32 - 1), "limit"),
        (stl_text()[:-20], "from solid to endsolid"),
        (stl_text(by_part=True)[:-400], "from solid to endsolid"),
        (stl_text().replace(b"    endloop\n", b"", 1), "three corners|no number"),
        (stl_text().replace(b"    outer loop\n", b"    outer loop\n vertex 0 0 0\n", 1), "three corners"),
        (stl_text().replace(b"vertex 0.0", b"vertex zero", 1), "no number"),
        (stl_text().replace(b"vertex 0.0", b"vertex", 1), "three corners"),
        (b"solid\nendsolid\n", "no triangles"),
        (b"404 not found", "neither"),
    ],
)
def test_stl_that_cannot_be_read_whole(data: bytes, reason: str) -> None:
    refused(data, ".stl", reason)


# --- PLY (all of it: tests/geometry/test_ply.py) and JSON --------------------------------------------------------


def ply(order: str = "<", comment: str = "made by hand") -> bytes:
    name = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    head = f"ply\nformat {name} 1.0\ncomment {comment}\nelement vertex {len(VERTICES)}\n"
    head += "property double x\nproperty double y\nproperty double z\n"
    head += f"element face {len(FACES)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows: list[bytes]
    if order:
        rows = [struct.pack(order + "3d", *vertex) for vertex in VERTICES]
        rows += [struct.pack(f"{order}B{len(face)}i", len(face), *face) for face in FACES]
    else:
        rows = [b"%r %r %r\n" % tuple(vertex) for vertex in VERTICES]
        rows += [b" ".join(b"%d" % k for k in [len(face), *face]) + b"\n" for face in FACES]
    return head.encode("latin-1") + b"".join(rows)


@pytest.mark.parametrize("order", ["<", ">", ""])
@pytest.mark.parametrize("comment", ["made by hand", "Größe", ""])
def test_ply_of_mixed_polygons(order: str, comment: str) -> None:
    check(ply(order, comment), ".ply")


def test_ply_that_cannot_be_read_whole() -> None:
    refused(ply()[:-3], ".ply", "truncated")
    refused(ply() + b"more", ".ply", "more follows")
    refused(ply().replace(b"element face", b"element tristrips"), ".ply", "no faces")


def test_json_with_a_byte_order_mark(tmp_path) -> None:
    header = mesh_mutations.gltf_header()
    buffer = mesh_mutations.glb(header)[-96:]
    header["buffers"] = [{"byteLength": 96, "uri": "shape.bin"}]
    text = json.dumps(header).encode()
    plain = parse_mesh(text, ".gltf", files={"shape.bin": buffer})
    marked = parse_mesh(readers.BYTE_ORDER_MARK + text, ".gltf", files={"shape.bin": buffer})
    np.testing.assert_array_equal(marked.triangles(), plain.triangles())
    (tmp_path / "shape.stl").write_bytes(stl())
    entry = {"name": "shape", "category": "part", "file": "shape.stl"}
    content = {"split": "mine", "license": "CC0", "source": "me", "objects": [entry]}
    (tmp_path / "set.json").write_bytes(readers.BYTE_ORDER_MARK + json.dumps(content).encode())
    assert [source.name for source in read_set(tmp_path / "set.json")[1]] == ["shape"]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"accessors": {"sparse": {"count": 1}}}, "sparse"),
        ({"accessors": {"normalized": True}}, "quantised"),
        ({"primitives": {"mode": 6}}, "triangle fans"),
        ({"extensionsRequired": ["EXT_meshopt_compression"]}, "compressed"),
    ],
)
def test_gltf_that_cannot_be_read_whole(change: dict, reason: str) -> None:
    header = mesh_mutations.gltf_header()
    header["accessors"][0] |= change.get("accessors", {})
    header["meshes"][0]["primitives"][0] |= change.get("primitives", {})
    refused(mesh_mutations.glb(header | {k: v for k, v in change.items() if k == "extensionsRequired"}), ".glb", reason)


def test_gltf_of_triangle_strips() -> None:
    """A tetrahedron is one strip: 0 2 1 3 0 2."""
    header = mesh_mutations.gltf_header()
    header["meshes"][0]["primitives"][0]["mode"] = 5
    header["accessors"][1]["count"] = 6
    strip = np.array([0, 1, 2, 3, 0, 1] + 6 * [0], dtype="<u4")
    body = mesh_mutations.glb(mesh_mutations.gltf_header())[-96:-48] + strip.tobytes()
    mesh = parse_mesh(mesh_mutations.glb(header, body), ".glb", up="z")
    read = trimesh.Trimesh(mesh.vertices, mesh.faces)
    assert read.is_watertight and abs(read.volume) == pytest.approx(1 / 6)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b"<instance_geometry", b'<instance_controller url="#c"/><instance_geometry', "moved by bones"),
        (b"<triangles", b"<polygons><ph><p>0 1 2</p><h>0 1 2</h></ph></polygons><triangles", "holes"),
    ],
)
def test_collada_that_cannot_be_read_whole(old: bytes, new: bytes, reason: str) -> None:
    refused(mesh_mutations.collada().replace(old, new), ".dae", reason)


# --- the second reader ------------------------------------------------------------------------------------------

RIGHT_BY_TRIMESH = {
    ".obj": ("plain", "by part", "windows", "groups", "colours", "weights", "materials", "objects and lines"),
    ".off": ("triangles",),  # its reader of OFF stops at polygons
    ".stl": ("plain", "begins like a text", "text", "text for windows", "text with tabs", "text of several solids"),
}


@pytest.mark.parametrize("suffix", RIGHT_BY_TRIMESH)
def test_trimesh_agrees_where_it_reads_a_spelling(suffix: str) -> None:
    corpus = {".obj": OBJ, ".off": OFF, ".stl": STL}[suffix]
    for name in RIGHT_BY_TRIMESH[suffix]:
        peer = trimesh.load_mesh(io.BytesIO(corpus[name]), file_type=suffix[1:])
        ours = parse_mesh(corpus[name], suffix, up="z")
        assert peer.volume == pytest.approx(VOLUME), name
        np.testing.assert_allclose(
            np.unique(ours.vertices.round(6), axis=0), np.unique(np.asarray(peer.vertices).round(6), axis=0)
        )
        assert len(ours.faces) == len(peer.faces)
