"""Reading mesh files of all kinds, scanning folders, organisers' manifests, and what hostile files get."""

from __future__ import annotations

import io
import json
import os
import time
import zipfile

import numpy as np
import pytest
import trimesh

from tslam_bench.assets import commands, generate, meshfiles, store
from tslam_bench.assets.importer import read_set, scan
from tslam_bench.assets.meshfiles import read_mesh_file
from tslam_bench.assets.scaling import LONGEST_EDGE, scale_to_hand
from tslam_bench.assets.workers import WorkerPool
from tslam_bench.errors import AssetError, InvalidInputError

EXTENTS = np.array([0.3, 0.2, 0.1])


def l_shape() -> trimesh.Trimesh:
    """A shape whose axes cannot be confused: extents (0.3, 0.2, 0.1), more of it at low x."""
    return trimesh.util.concatenate(
        [
            trimesh.creation.box(bounds=[[0, 0, 0], [0.3, 0.2, 0.05]]),
            trimesh.creation.box(bounds=[[0, 0, 0.05], [0.1, 0.2, 0.1]]),
        ]
    )


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".off", ".obj", ".glb"])
def test_formats_and_their_up_axis(tmp_path, suffix):
    path = tmp_path / f"shape{suffix}"
    l_shape().export(path)
    extents = read_mesh_file(path).extents
    y_up = suffix in (".obj", ".glb")  # file (x, y, z) becomes (x, -z, y)
    np.testing.assert_allclose(extents, EXTENTS[[0, 2, 1]] if y_up else EXTENTS, atol=1e-6)
    np.testing.assert_allclose(read_mesh_file(path, up="z").extents, EXTENTS, atol=1e-6)
    np.testing.assert_allclose(read_mesh_file(path, up="x").extents, EXTENTS[[2, 1, 0]], atol=1e-6)


def test_turning_to_z_up_keeps_the_shape_right_way_round(tmp_path):
    path = tmp_path / "shape.obj"
    l_shape().export(path)
    mesh = read_mesh_file(path)
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).volume > 0  # no mirror image
    assert read_mesh_file(path).vertices[:, 2].max() == pytest.approx(0.2)  # what was y is up


COLLADA = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="inch" meter="0.0254"/><up_axis>{up}</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">0 0 0 10 0 0 0 20 0 0 0 30</float_array><technique_common>
<accessor source="#a" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/><p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><matrix>2 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</matrix>
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


@pytest.mark.parametrize(("up", "order"), [("Z_UP", [0, 1, 2]), ("Y_UP", [0, 2, 1])])
def test_collada_unit_up_axis_and_node_transform(tmp_path, up, order):
    path = tmp_path / "shape.dae"
    path.write_text(COLLADA.format(up=up))
    # 10 x 20 x 30 inches, the node doubles x.
    np.testing.assert_allclose(read_mesh_file(path).extents, (0.0254 * np.array([20, 20, 30]))[order], rtol=1e-6)


def test_scenes_are_baked(tmp_path):
    scene = trimesh.Scene()
    cube = trimesh.creation.box(extents=[0.1, 0.1, 0.1])
    scene.add_geometry(cube, node_name="a")
    scene.add_geometry(cube, node_name="b", transform=trimesh.transformations.translation_matrix([0.5, 0, 0]))
    path = tmp_path / "scene.glb"
    scene.export(path)
    np.testing.assert_allclose(read_mesh_file(path, up="z").extents, [0.6, 0.1, 0.1], atol=1e-6)


def archive(members: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as handle:
        for name, data in members.items():
            handle.writestr(name, data)
    return stream.getvalue()


def test_an_archive_with_one_mesh(tmp_path):
    path = tmp_path / "shape.zip"
    path.write_bytes(archive({"folder/model.stl": l_shape().export(file_type="stl"), "folder/picture.png": b"x"}))
    np.testing.assert_allclose(read_mesh_file(path).extents, EXTENTS, atol=1e-6)


def stl(vertices: np.ndarray) -> bytes:
    return trimesh.Trimesh(vertices, np.arange(len(vertices)).reshape(-1, 3), process=False).export(file_type="stl")


HOSTILE = {
    "empty.stl": b"",
    "empty.obj": b"",
    "liar.glb": b"this is text",
    "liar.stl": os.urandom(4000),
    "liar.dae": b"<html></html>",
    "cut.dae": COLLADA.format(up="Z_UP")[:700].encode(),
    "bad-up.dae": COLLADA.format(up="Q_UP").encode(),
    "bad-index.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n",
    "points.ply": b"ply\nformat ascii 1.0\nelement vertex 1\n"
    b"property float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n",
    "nan.stl": stl(np.array([[0, 0, 0], [1, 0, np.nan], [0, 1, 0]])),
    "huge.obj": b"v 0 0 0\nv 1e30 0 0\nv 0 1e30 0\nf 1 2 3\n",
    "sketchup.skp": b"\xff\xfe",
    "word.docx": b"PK",
    "liar.zip": b"not an archive",
    "two.zip": archive({"a.stl": b"", "b.stl": b""}),
    "none.zip": archive({"readme.txt": b"hello"}),
    "escape.zip": archive({"../../evil.stl": b"solid"}),
    "absolute.zip": archive({"/etc/evil.stl": b"solid"}),
    "bomb.zip": archive({"bomb.stl": b"\0" * 50_000_000}),
}


@pytest.mark.parametrize("name", sorted(HOSTILE))
def test_hostile_files_get_one_line(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(HOSTILE[name])
    with pytest.raises(AssetError) as caught:
        read_mesh_file(path)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == [path]  # nothing was unpacked


def test_a_file_above_the_limit(tmp_path, monkeypatch):
    path = tmp_path / "big.stl"
    l_shape().export(path)
    monkeypatch.setattr(meshfiles, "MAX_BYTES", 100)
    with pytest.raises(AssetError, match="limit"):
        read_mesh_file(path)


def test_scaling_is_seeded_and_in_range():
    mesh = generate.draw("mug", 0)[0]
    sizes = [float(scale_to_hand(mesh, f"mug-{k}")[0].extents.max()) for k in range(200)]
    assert LONGEST_EDGE[0] <= min(sizes) < 0.06
    assert 0.22 < max(sizes) <= LONGEST_EDGE[1]
    first, _ = scale_to_hand(mesh, "mug-0")
    again, _ = scale_to_hand(mesh, "mug-0")
    np.testing.assert_array_equal(first.vertices, again.vertices)


@pytest.fixture
def folder(tmp_path):
    """A folder of meshes: two good ones, a broken one, texture files, a link that leaves the folder."""
    root = tmp_path / "meshes"
    for name, category in (("carton", "kitchen"), ("book", "study")):
        (root / category).mkdir(parents=True, exist_ok=True)
        mesh = generate.draw(name, 1)[0]
        trimesh.Trimesh(mesh.vertices, mesh.faces).export(root / category / f"{name}.stl")
    (root / "study" / "broken.stl").write_bytes(os.urandom(500))
    (root / "study" / "texture.png").write_bytes(b"x")
    (root / "link.stl").symlink_to(root / "study" / "book.stl")
    return root


def test_scan(folder):
    found = scan(folder, "train", "CC0", "me")
    assert [(s.name, s.category) for s in found] == [
        ("kitchen-carton", "kitchen"),
        ("study-book", "study"),
        ("study-broken", "study"),
    ]


@pytest.mark.parametrize(
    ("split", "license_text", "words"),
    [("test", "CC0", "fixed"), ("../up", "CC0", "letters"), ("train", " ", "--license")],
)
def test_scan_refuses(folder, split, license_text, words):
    with pytest.raises(InvalidInputError, match=words):
        scan(folder, split, license_text, "me")


def test_import_reports_and_goes_on(folder, tmp_path, monkeypatch, capsys):
    cache = tmp_path / "cache"
    monkeypatch.setenv("TSLAM_BENCH_CACHE", str(cache))
    arguments = ["import", str(folder), "--split", "mine", "--license", "CC0", "--source", "me", "--workers", "1"]
    commands.main(arguments)
    report = json.loads((cache / "import-mine.json").read_text())
    assert report["counts"] == {"prepared": 2, "failed": 1}
    (broken,) = [entry for entry in report["files"] if entry["status"] == "failed"]
    assert broken["file"].endswith("broken.stl")
    assert broken["reason"]
    loaded = store.load_object("kitchen-carton", "mine", cache)
    assert loaded.category == "kitchen"
    assert loaded.record["license"] == "CC0"
    commands.main(arguments)  # resumes: nothing is done again
    assert json.loads((cache / "import-mine.json").read_text())["counts"] == {"reused": 2, "failed": 1}
    capsys.readouterr()


def own_set(tmp_path, **changes):
    mesh = generate.draw("book", 0)[0]
    trimesh.Trimesh(1000 * mesh.vertices, mesh.faces).export(tmp_path / "secret.stl")
    entry = {"name": "secret", "category": "books", "file": "secret.stl", "unit": "mm"}
    content = {"split": "hidden", "license": "CC0", "source": "us", "objects": [entry]}
    entry.update({key: value for key, value in changes.items() if key in ("name", "file", "unit", "category")})
    content.update({key: value for key, value in changes.items() if key in ("split", "license", "objects")})
    path = tmp_path / "set.json"
    path.write_text(json.dumps(content))
    return path, mesh


def test_an_organisers_set_keeps_its_size(tmp_path):
    path, mesh = own_set(tmp_path)
    split, (source,) = read_set(path)
    assert split == "hidden"
    np.testing.assert_allclose(source.load(tmp_path).mesh.extents, mesh.extents, rtol=1e-5)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"split": "test"}, "own"),
        ({"split": "a/b"}, "letters"),
        ({"license": ""}, "license"),
        ({"objects": []}, "objects"),
        ({"objects": [3]}, r"objects\[0\]"),
        ({"file": "missing.stl"}, "missing.stl"),
        ({"file": "../secret.stl"}, "outside"),
        ({"unit": "parsec"}, "parsec"),
        ({"name": "a b"}, "a b"),
    ],
)
def test_a_wrong_manifest_is_named(tmp_path, changes, words):
    path, _ = own_set(tmp_path, **changes)
    with pytest.raises(InvalidInputError, match=words) as caught:
        read_set(path)
    assert "\n" not in str(caught.value)


def misbehave(how: str) -> str:
    """A job for the pool: returns, crashes like native code does, or hangs."""
    if how == "crash":
        os.abort()
    if how == "hang":
        time.sleep(600)
    return how


def test_crashes_and_hangs_cost_one_job_each():
    pool: WorkerPool[str, str] = WorkerPool(misbehave, size=2, time_limit=8.0)
    jobs = ["fine", "crash", "hang", "well"]
    outcomes = {}
    try:
        while jobs or pool.busy:
            while jobs and pool.has_room:
                job = jobs.pop(0)
                pool.submit(job, (job,))
            for item, result, reason in pool.results():
                outcomes[item] = (result, reason)
    finally:
        pool.close()
    assert outcomes["fine"] == ("fine", "")
    assert outcomes["well"] == ("well", "")
    assert outcomes["crash"][0] is None
    assert "crashed" in outcomes["crash"][1]
    assert outcomes["hang"][0] is None
    assert "given up" in outcomes["hang"][1]
