"""Every example runs, and does what it says."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from tslam_bench.files import cache_directory

FOLDER = Path(__file__).parents[1] / "examples"
EXAMPLES = sorted(path.name for path in FOLDER.glob("*.py"))
pytestmark = pytest.mark.slow


def run(name: str, *arguments: object, folder: Path, **environment: str) -> str:
    """Standard output of an example."""
    import os

    command = [sys.executable, FOLDER / name, *arguments]
    done = subprocess.run(
        [str(part) for part in command],
        cwd=folder,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def areas(output: str) -> list[float]:
    """The IoU areas that an example printed."""
    return [float(value) for value in re.findall(r"IoU area ([\d.]+)", output)]


def test_explore_an_object(tmp_path: Path) -> None:
    output = run("1_explore_an_object.py", "--poses", 2, "--output", "mug.obj", folder=tmp_path)
    counts = [int(value) for value in re.findall(r"(\d+) voxels touched", output)]
    assert len(counts) == 3 and max(counts[:2]) <= counts[2] <= sum(counts[:2])
    mesh = trimesh.load(tmp_path / "mug.obj", force="mesh")
    assert mesh.is_watertight and 0.02 < np.ptp(mesh.vertices, axis=0).max() < 0.25


def test_your_own_policy(tmp_path: Path) -> None:
    output = run("2_your_own_policy.py", "--objects", "mug", "--output", "run", folder=tmp_path)
    own, random = areas(output)
    assert own > 0.05 and random > 0.05
    # The file's class by its path, as the command line takes it, gives the same rollouts with the same salt.
    assert {path.name for path in (tmp_path / "run" / "submissions").iterdir() if path.is_dir()} == {
        "patter-carve",
        "random_targets-carve",
    }


def test_your_own_reconstructor(tmp_path: Path) -> None:
    hull, own = areas(run("3_your_own_reconstructor.py", "--objects", "mug", "--output", "run", folder=tmp_path))
    assert hull > 0.05 and own > 0.05 and hull != own


def test_train_with_stable_baselines3(tmp_path: Path) -> None:
    arguments = ("--steps", 200, "--num-envs", 4, "--output", "policy.zip")
    assert "trained for 200 decisions" in run("4_train_with_stable_baselines3.py", *arguments, folder=tmp_path)
    assert (tmp_path / "policy.zip").stat().st_size > 10_000


def test_train_on_many_environments(tmp_path: Path) -> None:
    arguments = ("--generations", 2, "--num-envs", 8)
    output = run("5_train_on_many_environments.py", *arguments, folder=tmp_path)
    best = [int(value) for value in re.findall(r"best (\d+)", output)]
    assert len(best) == 2 and min(best) > 20


def test_score_a_submission(tmp_path: Path) -> None:
    output = run("6_score_a_submission.py", "--objects", "cubemedium", "mug", "--output", "balls", folder=tmp_path)
    values = {name: float(iou) for name, iou in re.findall(r"(\w+): IoU ([\d.]+)", output)}
    assert values["cubemedium"] > values["mug"] > 0


def test_your_own_meshes(tmp_path: Path) -> None:
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "hand").symlink_to(cache_directory() / "hand", target_is_directory=True)
    output = run("7_your_own_meshes.py", folder=tmp_path, TSLAM_BENCH_CACHE=str(tmp_path / "cache"))
    surface = int(re.findall(r"(\d+) surface voxels", output)[0])
    assert "cups-cup" in output and surface > 100 and "'occupancy': (1, 2, 32, 32, 32)" in output


def test_look_at_a_rollout(tmp_path: Path) -> None:
    run("8_look_at_a_rollout.py", "--output", "rollout.png", folder=tmp_path)
    panels = np.split(np.asarray(Image.open(tmp_path / "rollout.png").convert("L")), 4, axis=1)
    drawn = [(panel < 250).sum() for panel in panels]
    assert 0 < drawn[0] < drawn[2] < drawn[3], "the touched voxels grow and are fewer than the object"


def test_every_example_is_tested_and_says_how_to_run_it() -> None:
    tested = re.findall(r'run\(\s*"(\w+\.py)"', Path(__file__).read_text(encoding="utf-8"))
    assert sorted(set(tested) | {"1_explore_an_object.py"}) == sorted(EXAMPLES)
    for name in EXAMPLES:
        assert f"python examples/{name}" in (FOLDER / name).read_text(encoding="utf-8")
