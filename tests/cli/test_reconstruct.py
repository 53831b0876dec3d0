"""``tslam-bench reconstruct`` as users call it: on a small cache of real prepared boxes."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from prepared_shapes import prepare_primitive

from tslam_bench import cli, grids
from tslam_bench.constants import SURFACE_SAMPLES, VOXEL_EDGE
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.objects import store
from tslam_bench.reconstruction.registry import list_reconstructors, make_reconstructor
from tslam_bench.reconstruction.training_objects import load_training_shapes, training_names


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    cache = tmp_path_factory.mktemp("cache")
    for name, extents in {"box": (0.1, 0.08, 0.06), "plate": (0.14, 0.1, 0.03)}.items():
        mesh = trimesh.creation.box(extents=extents)
        prepared = prepare_primitive(mesh, [mesh], name, spacing=6e-3)
        _, faces = trimesh.sample.sample_surface(mesh, SURFACE_SAMPLES, seed=np.random.default_rng(0))
        store.write(dataclasses.replace(prepared, split="train"), np.asarray(faces), cache)
    return cache


@pytest.fixture
def command(cache, monkeypatch, capsys):
    """Runs ``tslam-bench`` in this process: exit status, standard output, standard error."""
    monkeypatch.setenv("TSLAM_BENCH_CACHE", str(cache))

    def run(*arguments: object) -> tuple[int, str, str]:
        status = 0
        try:
            cli.main([str(argument) for argument in arguments])
        except SystemExit as end:
            status = int(end.code or 0)
        return status, *capsys.readouterr()

    return run


@pytest.fixture
def touches(tmp_path) -> Path:
    """Touched: the eight corners of a box of voxels in the object frame."""
    touched = np.zeros((32, 32, 32), dtype=bool)
    touched[np.ix_([8, 20], [10, 25], [5, 12])] = True
    path = tmp_path / "touches.npz"
    np.savez(path, touched=touched, visited=~touched)
    return path


def test_list_names_every_reconstructor(command):
    status, table, _ = command("reconstruct", "list")
    assert status == 0
    status, text, _ = command("reconstruct", "list", "--json")
    assert status == 0
    records = json.loads(text)
    assert [record["id"] for record in records] == [info.id for info in list_reconstructors()]
    assert all(record["id"] in table and record["summary"] in table for record in records)


def test_run_destroys_neither_its_input_nor_what_is_no_file(command, touches, tmp_path):
    before = touches.read_bytes()
    status, _, error = command("reconstruct", "run", "--touched", touches, "--output", touches)
    assert status == 2 and "which is read; name another place" in error and touches.read_bytes() == before
    os.mkfifo(tmp_path / "pipe.ply")
    status, _, error = command("reconstruct", "run", "--touched", touches, "--output", tmp_path / "pipe.ply")
    assert status == 2 and "pipe.ply: is a pipe, no file, and stays" in error and len(error.splitlines()) == 1


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj", "off"])
def test_run_writes_the_hull_as_a_mesh_in_metres(command, touches, tmp_path, suffix):
    output = tmp_path / "out" / f"hull.{suffix}"
    status, printed, _ = command("reconstruct", "run", "--touched", touches, "--output", output)
    assert status == 0
    assert "8 touched" in printed
    mesh = trimesh.load_mesh(output)
    assert mesh.is_watertight
    extents = VOXEL_EDGE * np.array([12, 15, 7])
    assert np.allclose(mesh.extents, extents, atol=5e-4)
    assert mesh.volume == pytest.approx(np.prod(extents), rel=0.03)


def test_run_merges_rollouts_of_several_poses(command, touches, tmp_path):
    touched = np.load(touches)["touched"]
    half = touched.copy()
    half[15:] = False
    parts = {0: half, 5: touched & ~half}
    for pose, part in parts.items():
        world = grids.object_to_world(part, pose)
        np.savez(
            tmp_path / f"pose{pose}.npz", touched=grids.pack(world), visited=grids.pack(~world), actions=np.zeros(3)
        )
    files = [tmp_path / f"pose{pose}.npz" for pose in parts]
    arguments = ("reconstruct", "run", "--reconstructor", "grid", "--output", tmp_path / "grid.npz")
    status, _, _ = command(*arguments, "--touched", *files, "--poses", *parts)
    assert status == 0
    written = np.load(tmp_path / "grid.npz")
    assert np.array_equal(written["probability"] == 1, touched)
    assert str(written["interpolation"]) == "nearest"


def test_train_then_run(command, touches, tmp_path):
    model = tmp_path / "models" / "ifnet.pt"
    small = ("--steps", 2, "--batch-size", 1, "--points", 32, "--threshold-examples", 1)
    train = ("reconstruct", "train", "--output", model, *small)
    status, printed, error = command(*train, "--log", tmp_path / "log")
    assert status == 0
    assert "ifnet, 2 steps on 2 objects" in printed
    assert "step" in error  # the progress bar
    assert list(tmp_path.glob("log/events*"))
    content = torch.load(model, weights_only=True)
    assert content["training"]["objects"] == ["box", "plate"]
    assert content["training"]["steps"] == 2

    before = model.read_bytes()
    assert command(*train)[0] == 0  # finished: left alone
    assert model.read_bytes() == before
    status, _, error = command(*train, "--seed", 1)
    assert status == 2
    assert "is of another run (seed 0, not 1)" in error

    run = ("reconstruct", "run", "--reconstructor", "ifnet", "--touched", touches)
    assert command(*run, "--model", model, "--output", tmp_path / "shape.npz")[0] == 0
    assert np.load(tmp_path / "shape.npz")["probability"].shape == (32, 32, 32)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "--touched", "nowhere.npz", "--output", "a.ply"], "nowhere.npz: no such file"),
        (["run", "--touched", "TOUCHES", "--output", "a.docx"], "unknown kind of file"),
        (
            ["run", "--touched", "TOUCHES", "--output", "a.ply", "--reconstructor", "poisson"],
            "choose one of grid, hull",
        ),
        (["run", "--touched", "TOUCHES", "--output", "a.ply", "--reconstructor", "ifnet"], "needs a model"),
        (["run", "--touched", "TOUCHES", "--output", "a.ply", "--model", "m.pt"], "takes no model"),
        (["run", "--touched", "TOUCHES", "--output", "a.ply", "--poses", "0", "1"], "2 poses for 1 files"),
        (["run", "--touched", "TOUCHES", "--output", "a.ply", "--poses", "9"], "choose an integer from 0 to 7"),
        (["run", "--touched", "EMPTY", "--output", "a.ply"], "the reconstruction is empty (0 voxels touched)"),
        (["train", "--output", "m.pt", "--split", "test"], "learn from train or val"),
        (["train", "--output", "m.pt", "--split", "val"], "no object is prepared"),
        (["train", "--output", "m.pt", "--count", "5"], "has 2 prepared objects"),
        (["train", "--output", "m.pt", "--objects", "boxx"], "unknown in split train (did you mean box?)"),
        (["train", "--output", "m.pt", "--objects", "box", "--count", "1"], "count and objects: give one of them"),
        (["train", "--output", "m.pt", "--threshold-objects", "box"], "split 'val': no object is prepared"),
        (["train", "--output", "m.pt", "--steps", "0"], "steps 0: choose at least 1"),
        (
            ["train", "--output", "m.pt", "--architecture", "convonet", "--size", "paper"],
            "convonet size 'paper': unknown",
        ),
        (["paint"], "unknown command"),
    ],
)
def test_bad_input_gives_one_line_and_status_2(command, touches, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    np.savez("empty.npz", touched=np.zeros((32, 32, 32), dtype=bool))
    known = {path.name for path in tmp_path.iterdir()}
    filled = [{"TOUCHES": str(touches), "EMPTY": "empty.npz"}.get(word, word) for word in arguments]
    status, printed, error = command("reconstruct", *filled)
    assert status == 2
    assert printed == ""
    line = [text for text in error.splitlines() if text.startswith("tslam-bench: ")]
    assert len(line) == 1
    assert message in line[0]
    assert {path.name for path in tmp_path.iterdir()} == known  # nothing half-written


@pytest.mark.parametrize("arguments", [[], ["list"], ["train"], ["run"]])
def test_help_tells_what_there_is(command, arguments):
    status, printed, _ = command("reconstruct", *arguments, "--help")
    assert status == 0
    assert "reconstruct" in printed


def test_floors_are_built_from_the_training_split(cache, touches):
    touched, visited = (np.load(touches)[name] for name in ("touched", "visited"))
    box, plate = (store.load_object(name, "train", cache) for name in ("box", "plate"))
    mean = make_reconstructor("mean_shape", cache=cache).reconstruct(touched, visited).probability >= 0.5
    assert np.array_equal(mean, box.solid | plate.solid) or np.array_equal(mean, box.solid & plate.solid)
    retrieval = make_reconstructor("retrieval", cache=cache)
    for item in (box, plate):
        found = retrieval.reconstruct(item.surface, ~item.solid).probability >= 0.5
        assert np.array_equal(found, item.solid)
    with pytest.raises(AssetError, match="no object is prepared"):
        make_reconstructor("retrieval", split="val", cache=cache)
    with pytest.raises(InvalidInputError, match="only for testing"):
        make_reconstructor("mean_shape", split="test", cache=cache)


def test_training_shapes_come_from_the_prepared_objects(cache):
    assert training_names("train", cache=cache) == ["box", "plate"]
    assert training_names("train", 1, cache=cache) == ["box"]
    assert training_names("train", objects=("plate", "box", "plate"), cache=cache) == ["box", "plate"]
    shapes = load_training_shapes(["box", "plate"], "train", cache=cache)
    assert [shape.name for shape in shapes] == ["box", "plate"]
    assert np.allclose(shapes[0].half_extents, [0.05, 0.04, 0.03])
    again = load_training_shapes(["box", "plate"], "train", cache=cache)
    assert np.array_equal(shapes[1].near_points, again[1].near_points)


def test_listing_needs_no_torch():
    code = (
        "import sys; from tslam_bench.cli.reconstruct import main; main(['list']);"
        "from tslam_bench.reconstruction.registry import make_reconstructor; make_reconstructor('hull');"
        "sys.exit('torch' in sys.modules or 'sapien' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, env=os.environ, stdout=subprocess.DEVNULL)
