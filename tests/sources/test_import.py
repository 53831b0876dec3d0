"""Reading mesh files of all kinds, scanning folders, organisers' manifests, and what hostile files get."""

from __future__ import annotations

import io
import json
import os
import sys
import time
import zipfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import trimesh

import tslam_bench
from tslam_bench.cli import assets
from tslam_bench.constants import ENVIRONMENT_ID, NUM_JOINTS
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.objects import splits, store
from tslam_bench.objects.hand import hand_directory, load_hand
from tslam_bench.preparation.repair import repair
from tslam_bench.preparation.schedule import remove_unlisted
from tslam_bench.preparation.workers import WorkerPool
from tslam_bench.sources import meshfiles
from tslam_bench.sources.generator import generate
from tslam_bench.sources.importer import read_set, scan
from tslam_bench.sources.meshfiles import read_mesh_file
from tslam_bench.sources.scaling import LONGEST_EDGE, scale_to_hand

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))
import build_importing
import fuzz_importer
import mesh_mutations

EXTENTS = np.array([0.3, 0.2, 0.1])


def l_shape() -> trimesh.Trimesh:
    """A shape whose axes cannot be confused: extents (0.3, 0.2, 0.1), more of it at low x."""
    return trimesh.util.concatenate(
        [
            trimesh.creation.box(bounds=[[0, 0, 0], [0.3, 0.2, 0.05]]),
            trimesh.creation.box(bounds=[[0, 0, 0.05], [0.1, 0.2, 0.1]]),
        ]
    )


VOLUME = 0.004
CENTROID = np.array([0.125, 0.1, 0.0375])
"""Of the L shape: boxes of 3 and 1 litre with centres (0.15, 0.1, 0.025) and (0.05, 0.1, 0.075)."""


def volume_and_centroid(mesh) -> tuple[float, np.ndarray]:
    """Of a closed mesh, by the divergence theorem, one triangle at a time."""
    volume, moment = 0.0, np.zeros(3)
    for a, b, c in mesh.vertices[mesh.faces]:
        signed = float(np.dot(a, np.cross(b, c))) / 6
        volume += signed
        moment += signed * (a + b + c) / 4
    return volume, moment / volume


@pytest.mark.parametrize("file_format", mesh_mutations.FORMATS)
def test_every_format_keeps_volume_and_orientation(tmp_path, file_format):
    """Text and binary, archives, a .gltf with its buffer beside it; y is up in .obj, .dae and glTF: (x, y, z) -> (x, -z, y)."""
    name, files = mesh_mutations.write(l_shape(), file_format, "shape")
    for path, data in files.items():
        (tmp_path / path).write_bytes(data)
    volume, centroid = volume_and_centroid(read_mesh_file(tmp_path / name))
    y_up = file_format in ("obj", "glb", "gltf", "dae", "kmz", "zae")
    assert volume == pytest.approx(VOLUME, rel=1e-5)
    np.testing.assert_allclose(centroid, [0.125, -0.0375, 0.1] if y_up else CENTROID, atol=1e-6)


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


@pytest.mark.parametrize(("up", "order"), [("Z_UP", [0, 1, 2]), ("Y_UP", [0, 2, 1]), ("X_UP", [2, 1, 0])])
def test_collada_unit_up_axis_and_node_transform(tmp_path, up, order):
    path = tmp_path / "shape.dae"
    path.write_text(COLLADA.format(up=up))
    # 10 x 20 x 30 inches, the node doubles x.
    np.testing.assert_allclose(read_mesh_file(path).extents, (0.0254 * np.array([20, 20, 30]))[order], rtol=1e-6)


def test_collada_conventions_are_found_wherever_they_stand(tmp_path):
    """In another encoding, with blanks, after a long comment; a unit elsewhere in the document does not count."""
    text = COLLADA.format(up=" Z_UP\n").replace('"1.0"?>', '"1.0" encoding="utf-16"?>')
    text = text.replace("<asset>", f"<!--{30_000 * 'x'}--><asset>").replace(
        "<library_geometries>", '<extra><unit meter="7"/></extra><library_geometries>'
    )
    path = tmp_path / "shape.dae"
    path.write_bytes(text.encode("utf-16"))
    np.testing.assert_allclose(read_mesh_file(path).extents, 0.0254 * np.array([20, 20, 30]), rtol=1e-6)


def test_collada_instances_of_nodes_are_all_there(tmp_path):
    """A library node is shown twice, once mirrored and three times as large: 1 + 27 tetrahedra of 10 x 20 x 30 / 6."""
    path = tmp_path / "shape.dae"
    path.write_bytes(
        mesh_mutations.collada(
            scene='<node><instance_node url="#n"/></node>'
            '<node><matrix>-3 0 0 90 0 3 0 0 0 0 3 0 0 0 0 1</matrix><instance_node url="#n"/></node>',
            library='<node id="n"><instance_geometry url="#g"/></node>',
        )
    )
    mesh = read_mesh_file(path)
    volume, _ = volume_and_centroid(mesh)
    assert volume == pytest.approx(28 * 1000, rel=1e-5)
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [90, 60, 90]], atol=1e-3)


def test_materials_groups_and_quads_of_an_obj(tmp_path):
    """A box of quads in two objects and materials; the material library is not needed."""
    corners = [f"v {x} {y} {z}" for x in (0, 2) for y in (0, 3) for z in (0, 4)]
    quads = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]
    head = ["mtllib missing.mtl", *corners, "vt 0 0", "vn 0 0 1", "o first", "usemtl red"]
    faces = ["f " + " ".join(f"{k}/1/1" for k in quad.split()) for quad in quads]
    (tmp_path / "box.obj").write_text("\n".join([*head, *faces[:3], "o second", "usemtl blue", *faces[3:]]) + "\n")
    mesh = read_mesh_file(tmp_path / "box.obj")
    volume, _ = volume_and_centroid(mesh)
    assert abs(volume) == pytest.approx(24)
    np.testing.assert_allclose(mesh.extents, [2, 4, 3])


def test_gltf_instances_keep_their_transforms(tmp_path):
    """The L shape turned, enlarged, mirrored: volumes add up with the sign kept, and every part is where its node puts it."""
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1])
    grow = np.diag([2.0, 2.0, 2.0, 1.0]) + np.array([[0, 0, 0, 1.0]] + 3 * [[0, 0, 0, 0]])
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0]) + np.array([[0, 0, 0, -1.0]] + 3 * [[0, 0, 0, 0]])
    scene.add_geometry(l_shape(), geom_name="l", node_name="turned", transform=turn)
    scene.graph.update("grown", matrix=grow, geometry="l")
    scene.graph.update("mirrored", matrix=mirror, geometry="l")
    scene.export(tmp_path / "scene.glb")
    mesh = read_mesh_file(tmp_path / "scene.glb", up="z")
    volume, centroid = volume_and_centroid(mesh)
    assert volume == pytest.approx((1 + 8 + 1) * VOLUME, rel=1e-5)
    centres = [
        np.array([-CENTROID[1], CENTROID[0], CENTROID[2]]),
        2 * CENTROID + [1, 0, 0],
        CENTROID * [-1, 1, 1] - [1, 0, 0],
    ]
    np.testing.assert_allclose(centroid, np.average(centres, axis=0, weights=[1, 8, 1]), atol=1e-6)


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


def test_litter_in_an_archive_is_no_second_mesh(tmp_path):
    """Finder packs a shadow of every file."""
    path = tmp_path / "shape.zip"
    model = l_shape().export(file_type="stl")
    path.write_bytes(
        archive({"model.stl": model, "__MACOSX/._model.stl": b"x", "._model.stl": b"x", ".cache/a.obj": b"x"})
    )
    np.testing.assert_allclose(read_mesh_file(path).extents, EXTENTS, atol=1e-6)


HARMLESS = ("chain.glb", "count.dae", "outside.obj", "parents.glb", "views.glb")
"""Files that overstate or repeat what is not used, or name a file that is not read: they are taken for what they hold."""


@pytest.mark.parametrize("name", sorted(mesh_mutations.HOSTILE))
def test_hostile_files_get_one_line(tmp_path, name):
    content = mesh_mutations.HOSTILE[name]
    files = content if isinstance(content, dict) else {name: content}
    for member, data in files.items():
        (tmp_path / member).write_bytes(data)
    before = fuzz_importer.snapshot(tmp_path)
    if name in HARMLESS:
        assert 1 <= len(read_mesh_file(tmp_path / name).faces) <= 4
    else:
        with pytest.raises(AssetError) as caught:
            read_mesh_file(tmp_path / name)
        assert str(caught.value).isprintable()
        assert fuzz_importer.reason_class(str(caught.value)) != "other"
    assert fuzz_importer.snapshot(tmp_path) == before  # nothing was unpacked


def test_mutants_are_accepted_whole_or_refused_with_a_reason(tmp_path):
    """One of each kind of damage, by the benchmark's own code: see benchmarks/fuzz_importer.py for the long run."""
    good = fuzz_importer.shapes(contactdb=False)
    mutants = [mesh_mutations.mutant(good, index, seed=1) for index in range(len(mesh_mutations.GEOMETRY) + 13)]
    again = [mesh_mutations.mutant(good, index, seed=1) for index in (3, 20)]
    assert [mutants[3].files, mutants[20].files] == [item.files for item in again]
    sources = fuzz_importer.write_mutants(mutants, tmp_path)
    before = fuzz_importer.snapshot(tmp_path)
    outcomes = {}
    for item, source in zip(mutants, sources, strict=True):
        status, reason = fuzz_importer.cheap_import(source, tmp_path)
        assert status in ("accepted", "rejected"), (item.kind, reason)
        assert reason.isprintable()
        outcomes[item.kind] = status, reason
    assert fuzz_importer.snapshot(tmp_path) == before
    kinds = (
        "unchanged",
        "inside out",
        "some faces flipped",
        "few faces removed",
        "faces duplicated",
        "faces degenerate",
    )
    assert [outcomes[kind][0] for kind in kinds] == ["accepted"] * len(kinds)
    words = {
        "vertex not a number": "finite",
        "vertex infinite": "finite",
        "flat": "volume",
        "no faces": "triangles",
        "one point": "extent",
        "metres: 40 m": "unit",
        "metres: 1000 times too small": "unit",
        "empty": "empty",
    }
    for kind, word in words.items():
        assert outcomes[kind][0] == "rejected" and word in outcomes[kind][1], (kind, outcomes[kind])


def test_slivers_that_cancel_out_are_refused():
    """With one vertex far out and the rest scaled to nothing, two slivers are left whose union is empty."""
    damage = mesh_mutations.GEOMETRY["vertex far out"]
    mesh = damage(generate.draw("mug", 0)[0], np.random.Generator(np.random.PCG64(37)))
    mesh, _ = scale_to_hand(mesh._replace(vertices=mesh.vertices.astype(np.float32).astype(float)), "mug")
    with pytest.raises(AssetError, match="encloses no volume"):
        repair(mesh)


@pytest.mark.slow
def test_the_table_of_bad_input_in_the_docs_is_true():
    build_importing.main(build_importing.Config(check=True))


def test_what_counts_as_watertight():
    """The fuzzer's own check finds what is wrong: it is no test that cannot fail."""
    mesh = generate.draw("carton", 0)[0]
    assert fuzz_importer.broken_invariant(mesh) == ""
    assert "watertight" in fuzz_importer.broken_invariant(mesh._replace(faces=mesh.faces[1:]))
    assert "twice" in fuzz_importer.broken_invariant(mesh._replace(faces=np.vstack([mesh.faces, mesh.faces[:1]])))
    assert "volume" in fuzz_importer.broken_invariant(mesh._replace(faces=mesh.faces[:, ::-1]))
    assert "edge" in fuzz_importer.broken_invariant(mesh._replace(vertices=40 * mesh.vertices))


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
    assets.main(arguments)
    report = json.loads((cache / "import-mine.json").read_text())
    assert report["counts"] == {"prepared": 2, "failed": 1}
    (broken,) = [entry for entry in report["files"] if entry["status"] == "failed"]
    assert broken["file"].endswith("broken.stl")
    assert broken["reason"]
    loaded = store.load_object("kitchen-carton", "mine", cache)
    assert loaded.category == "kitchen"
    assert loaded.record["license"] == "CC0"
    assets.main(arguments)  # resumes: nothing is done again
    assert json.loads((cache / "import-mine.json").read_text())["counts"] == {"reused": 2, "failed": 1}
    capsys.readouterr()


def test_an_import_does_not_replace_an_object_of_another_source(folder, tmp_path):
    """A name that a train object of another source holds is refused; one that an earlier run of this import holds is not."""
    cache = tmp_path / "cache"
    (source, *_) = scan(folder, "train", "CC0", "me")
    record = {"name": source.name, "format": store.FORMAT, "products": {}, "source": "generated"}
    path = store.object_directory(source.name, "train", cache) / "record.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(record))
    with pytest.raises(AssetError, match=r"carton\.stl.*taken by.*generated"):
        source.load(cache)
    path.write_text(json.dumps(record | {"source": "me: carton.stl"}))
    assert source.load(cache).name == source.name


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


@pytest.mark.slow
def test_a_private_set_from_files_to_touch(tmp_path, monkeypatch, capsys):
    """Two meshes of one's own become a split that tasks take: prepared from a manifest, felt, other names refused."""
    carton = generate.draw("carton", 0)[0]
    trimesh.Trimesh(1000 * carton.vertices, carton.faces).export(tmp_path / "carton.stl")
    bracket_mesh = l_shape()
    bracket_mesh.apply_scale(0.5)
    bracket_mesh.export(tmp_path / "bracket.glb")
    entries = [
        {"name": "carton", "category": "box", "file": "carton.stl", "unit": "mm"},
        {"name": "bracket", "category": "part", "file": "bracket.glb", "up": "z"},
    ]
    manifest = tmp_path / "mine.json"
    manifest.write_text(json.dumps({"split": "mine", "license": "ours", "source": "lab", "objects": entries}))
    cache = tmp_path / "cache"
    load_hand()
    hand_directory(cache).parent.mkdir(parents=True)
    hand_directory(cache).symlink_to(hand_directory(), target_is_directory=True)
    monkeypatch.setenv("TSLAM_BENCH_CACHE", str(cache))
    assets.main(["prepare", "--manifest", str(manifest), "--workers", "1"])
    bracket = store.load_object("bracket", "mine")
    np.testing.assert_allclose(np.ptp(bracket.vertices, axis=0), EXTENTS / 2, atol=1e-6)
    assert volume_and_centroid(bracket_mesh)[0] == pytest.approx(bracket.record["volume_m3"], rel=1e-4)
    np.testing.assert_allclose(np.ptp(store.load_object("carton", "mine").vertices, axis=0), carton.extents, rtol=1e-5)

    single = gym.make(ENVIRONMENT_ID, split="mine", object="bracket", pose=0)
    down = np.zeros(NUM_JOINTS, dtype=np.float32)
    down[1] = -1.0
    single.reset(seed=0)
    for _ in range(120):
        single.step(down)
    assert single.unwrapped.touched.any()
    single.close()
    envs = tslam_bench.make_vec(num_envs=2, device="cpu", split="mine", processes=1)
    observation, _ = envs.reset(seed=3)
    assert observation["occupancy"].shape == (2, 2, 32, 32, 32)
    envs.close()
    with pytest.raises(InvalidInputError, match="unknown in split mine"):
        gym.make(ENVIRONMENT_ID, split="mine", object="mug").reset(seed=0)
    with pytest.raises(InvalidInputError, match="yours"):
        gym.make(ENVIRONMENT_ID, split="yours").reset(seed=0)

    manifest.write_text(json.dumps({"split": "mine", "license": "ours", "source": "lab", "objects": entries[:1]}))
    capsys.readouterr()
    assets.main(["prepare", "--manifest", str(manifest), "--objects", "carton", "--workers", "1"])
    assert splits.prepared_names("mine") == ["bracket", "carton"]  # a part of the manifest removes nothing
    assets.main(["prepare", "--manifest", str(manifest), "--workers", "1"])
    assert splits.prepared_names("mine") == ["carton"]
    assert "bracket: no longer in" in capsys.readouterr().out


def test_the_splits_of_the_benchmark_lose_nothing_to_a_manifest():
    with pytest.raises(InvalidInputError, match="'train'"):
        remove_unlisted("train", [])


def misbehave(how: str) -> str:
    """A job for the pool: returns, crashes like native code does, asks for too much memory, or hangs."""
    if how == "crash":
        os.abort()
    if how == "memory":
        try:
            return f"took {np.ones(3 * 2**27).sum():.0f}"  # 3 GiB
        except MemoryError:
            return "refused"
    if how == "hang":
        time.sleep(600)
    return how


def test_crashes_and_hangs_cost_one_job_each():
    pool: WorkerPool[str, str] = WorkerPool(misbehave, size=2, time_limit=8.0, memory_limit=2 * 2**30)
    jobs = ["fine", "crash", "hang", "memory", "well"]
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
    if sys.platform == "linux":
        assert outcomes["memory"] == ("refused", "")
    assert outcomes["crash"][0] is None
    assert "crashed" in outcomes["crash"][1]
    assert outcomes["hang"][0] is None
    assert "given up" in outcomes["hang"][1]
