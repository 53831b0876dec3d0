"""PLY files: every encoding is read as trimesh reads it, what lies is refused, and a small file costs little."""

from __future__ import annotations

import io
import struct
import tracemalloc
from typing import Literal

import numpy as np
import pytest
import trimesh

from tslam_bench.errors import InvalidInputError
from tslam_bench.geometry.ply import MAX_MESH_ELEMENTS, read_ply

CUBE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
QUADS = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [2, 3, 7, 6], [1, 2, 6, 5], [0, 4, 7, 3]]
MIXED = [[0, 3, 2], [0, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [2, 3, 7, 6], [1, 2, 6], [1, 6, 5], [0, 4, 7, 3]]
SPHERE = trimesh.creation.icosphere(2, 0.123456789)
Encoding = Literal["ascii", "binary_little_endian", "binary_big_endian"]
ENCODINGS: tuple[Encoding, ...] = ("ascii", "binary_little_endian", "binary_big_endian")


def ply(
    encoding: Encoding,
    vertices,
    faces,
    vertex_type: str = "float",
    comment: bytes = b"",
    more: bool = False,
    end: str = "\n",
    face_list: str = "list uchar int vertex_indices",
) -> bytes:
    """A PLY file written by hand; ``more``: normals, colours, a further list and a further element."""
    head = ["ply", f"format {encoding} 1.0", f"element vertex {len(vertices)}"]
    head += [f"property {vertex_type} {axis}" for axis in "xyz"]
    head += ["property uchar red"] if more else []
    head += [f"element face {len(faces)}", *(["property short flags"] if more else []), f"property {face_list}"]
    head += ["property list uchar float texcoord", "element edge 2", "property int vertex1"] if more else []
    start = end.join(head[:2]).encode() + end.encode() + (b"comment " + comment + end.encode() if comment else b"")
    start += end.join([*head[2:], "end_header"]).encode() + end.encode()
    code = {"float": "f", "double": "d", "int": "i", "uchar": "B", "uint": "I", "char": "b"}
    count_code, index_code = (code[word] for word in face_list.split()[1:3])
    rows: list[list[tuple[str, float]]] = []
    rows += [[(code[vertex_type], x) for x in v] + ([("B", 200)] if more else []) for v in vertices]
    rows += [
        [
            *([("h", -3)] if more else []),
            (count_code, len(face)),
            *((index_code, corner) for corner in face),
            *([("B", len(face)), *[("f", 0.5)] * len(face)] if more else []),
        ]
        for face in faces
    ]
    rows += [[("i", 0)], [("i", 1)]] if more else []
    if encoding == "ascii":
        return start + "".join(" ".join(repr(value) for _, value in row) + end for row in rows).encode()
    order = "<" if "little" in encoding else ">"
    return start + b"".join(struct.pack(order + "".join(c for c, _ in r), *(v for _, v in r)) for r in rows)


def peer(data: bytes) -> trimesh.Trimesh:
    """The mesh as trimesh reads it."""
    mesh = trimesh.load_mesh(io.BytesIO(data), file_type="ply", process=False, fix_texture=False)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("vertex_type", ["float", "double"])
@pytest.mark.parametrize("shape", ["sphere", "quads"])
def test_meshes_are_those_of_trimesh_bit_for_bit(encoding: Encoding, vertex_type: str, shape: str) -> None:
    vertices, faces = (SPHERE.vertices.tolist(), SPHERE.faces.tolist()) if shape == "sphere" else (CUBE, QUADS)
    data = ply(encoding, vertices, faces, vertex_type)
    mesh, expected = read_ply(data, "file"), peer(data)
    np.testing.assert_array_equal(mesh.vertices, np.asarray(expected.vertices, dtype=np.float64))
    np.testing.assert_array_equal(mesh.faces, expected.faces)
    assert mesh.is_watertight and mesh.vertices.dtype == np.float64 and mesh.faces.dtype == np.int64


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_what_trimesh_writes_is_read_bit_for_bit(encoding: str) -> None:
    coloured = SPHERE.copy()
    coloured.visual.vertex_colors = np.arange(4 * len(SPHERE.vertices)).reshape(-1, 4) % 255
    for mesh in (SPHERE, coloured):
        data = mesh.export(file_type="ply", encoding=encoding)
        data = data.encode() if isinstance(data, str) else bytes(data)
        np.testing.assert_array_equal(read_ply(data, "file").vertices, peer(data).vertices)
        np.testing.assert_array_equal(read_ply(data, "file").faces, peer(data).faces)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("more", [False, True])
@pytest.mark.parametrize(
    "face_list", ["list uchar int vertex_index", "list uint uint vertex_indices", "list char int x"]
)
def test_mixed_polygons_foreign_comments_and_further_properties(encoding, end, more, face_list) -> None:
    """What other programs export and trimesh's reader of binary files refuses."""
    if more and face_list.endswith(" x"):
        face_list = "list uchar int vertex_index"
    data = ply(encoding, CUBE, MIXED, comment="Größe: é".encode("latin-1"), more=more, end=end, face_list=face_list)
    mesh = read_ply(data, "file")
    assert (
        mesh.is_watertight and mesh.is_winding_consistent and mesh.volume == pytest.approx(1) and len(mesh.faces) == 12
    )
    # The order of trimesh's own reader of texts: triangles, first halves, second halves.
    expected = trimesh.geometry.triangulate_quads([np.array(face) for face in MIXED])
    np.testing.assert_array_equal(mesh.faces, expected)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_fans_of_polygons(encoding: Encoding) -> None:
    angles = np.linspace(0, 2 * np.pi, 7, endpoint=False)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    vertices = np.concatenate([np.column_stack([ring, np.full(7, z)]) for z in (0.0, 1.0)])
    sides = [[k, (k + 1) % 7, 7 + (k + 1) % 7, 7 + k] for k in range(7)]
    faces = [[*range(6, -1, -1)], [*range(7, 14)], *sides]
    mesh = read_ply(ply(encoding, vertices.tolist(), faces, "double"), "file")
    assert mesh.is_watertight and mesh.volume == pytest.approx(3.5 * np.sin(2 * np.pi / 7)) and len(mesh.faces) == 24


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_an_empty_mesh(encoding: Encoding) -> None:
    mesh = read_ply(ply(encoding, [], []), "file")
    assert mesh.vertices.shape == (0, 3) and mesh.faces.shape == (0, 3)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(
    ("vertices", "faces", "reason"),
    [
        (CUBE, [*QUADS, [0, 1]], "a face of fewer than three corners"),
        (CUBE, [*QUADS, [0, 1, 8]], "missing vertices"),
        (CUBE, [*QUADS, [0, 1, -1]], "missing vertices"),
        (CUBE, [*QUADS, [0, 1, 2**31 - 1]], "missing vertices"),
    ],
)
def test_faces_that_cannot_be_are_refused(encoding: Encoding, vertices, faces, reason: str) -> None:
    with pytest.raises(InvalidInputError, match=f"file: .*{reason}"):
        read_ply(ply(encoding, vertices, faces), "file")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_truncation_and_every_lengthening_is_refused(encoding: Encoding) -> None:
    for faces in (QUADS, MIXED):
        data = ply(encoding, CUBE, faces).rstrip()
        for length in range(len(data)):
            if encoding != "ascii" or data[length : length + 1].isspace():  # a cut number is another number
                with pytest.raises(InvalidInputError):
                    read_ply(data[:length], "file")
        with pytest.raises(InvalidInputError, match="more follows"):
            read_ply(data + b" 3", "file")


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b"element vertex 8", b"element vertex 1000001", "1000001 vertex elements; at most 1000000"),
        (b"element face 6", b"element face 999999999999999999", "at most 1000000"),
        (b"element face 6", b"element face -1", "header line 'element face -1'"),
        (b"element face 6", b"element vertex 6", "element 'vertex' twice"),
        (b"property float z", b"property float y", "with one twice"),
        (b"property float z\n", b"", "no vertices with x, y and z"),
        (b"property float z", b"property quad z", "header line"),
        (b"property list uchar int", b"property list float int", "whose length is no whole number"),
        (b"vertex_indices", b"vertex_indices\nproperty int a\nproperty int a", "with one twice"),
        (b"list uchar int vertex_indices", b"int vertex_indices", "no faces with a list"),
        (b"property list uchar int vertex_indices\n", b"", "an element with no property"),
        (b"format ascii 1.0", b"format ascii 2.0", "header line"),
        (b"format ascii 1.0\n", b"", "header line"),
        (b"format ascii", b"format ebcdic", "header line"),
        (b"ply\n", b"plyx\n", "no header"),
        (b"end_header", b"comment " + b"x" * 20_000 + b"\nend_header", "no header of at most 16384 bytes"),
        (b"element vertex", b"".join(b"element e%d 0\nproperty int a\n" % k for k in range(70)) + b"element vertex",
         "more than 64 properties"),
        (b"\n4 0 3 2 1", b"\n4 0 3 2 one", "no number"),
        (b"\n4 0 3 2 1", b"\n4 0 3 2 1.5", "a number that is no int32"),
        (b"\n4 0 3 2 1", b"\n4 0 3 2 nan", "a number that is no int32"),
        (b"\n4 0 3 2 1", b"\n-4 0 3 2 1", "a list of -4 values"),
        (b"\n4 0 3 2 1", b"\n4.5 0 3 2 1", "a list of 4.5 values"),
        (b"\n4 0 3 2 1", b"\n1e300 0 3 2 1", "a list of"),
    ],
)  # fmt: skip
def test_texts_that_lie_are_refused_in_one_line(old: bytes, new: bytes, reason: str) -> None:
    data = ply("ascii", CUBE, QUADS)
    assert old in data
    with pytest.raises(InvalidInputError, match=reason) as caught:
        read_ply(data.replace(old, new, 1), "file")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_one_polygon_of_very_many_corners_costs_no_more_than_the_file(encoding: Encoding) -> None:
    """15 million corners in 60 MB (30 in a text): no triangle of it is made."""
    corners = 15_000_000
    head = ply(encoding, CUBE, [], face_list="list uint int vertex_indices").replace(
        b"element face 0", b"element face 1"
    )
    if encoding == "ascii":
        data = head + b"%d" % corners + b" 1" * corners
    else:
        order: Literal["little", "big"] = "little" if "little" in encoding else "big"
        data = head + corners.to_bytes(4, order) + b"\0" * (4 * corners)
    tracemalloc.start()
    try:
        with pytest.raises(InvalidInputError, match=r"a list of 1\.5e\+07 values; at most 1000000"):
            read_ply(data, "file")
        assert tracemalloc.get_traced_memory()[1] < 400e6
    finally:
        tracemalloc.stop()


def test_many_small_polygons_above_the_limit_are_refused_before_they_are_cut() -> None:
    count = MAX_MESH_ELEMENTS // 2 + 1
    head = ply("binary_little_endian", CUBE, []).replace(b"element face 0", b"element face %d" % count)
    data = head + (b"\4" + bytes(16)) * count
    with pytest.raises(InvalidInputError, match=f"{2 * count} triangles; at most {MAX_MESH_ELEMENTS}"):
        read_ply(data, "file")
