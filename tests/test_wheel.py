"""The wheel: what it holds, and that it works from any folder once it is installed."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from tslam_bench.extras import EXTRAS

ROOT = Path(__file__).parents[1]
EPISODE = """
import gymnasium as gym, numpy as np, tslam_bench
env = gym.make("TactileSLAM-v0", object="mug", pose=0)
observation, _ = env.reset(seed=0)
observation, reward, *_ = env.step(np.zeros(28, dtype=np.float32))
print("STEPPED", tuple(observation["occupancy"].shape), tslam_bench.__file__)
"""
pytestmark = pytest.mark.slow


def run(*command: object, folder: Path) -> str:
    """Standard output of a command that must succeed."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        [str(part) for part in command], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "pip", "wheel", ROOT, "--no-deps", "--quiet", "--wheel-dir", folder, folder=folder)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Interpreter of a new virtual environment that holds the wheel; its dependencies are those of this environment."""
    folder = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", folder, folder=folder)
    python = folder / "bin" / "python"
    run(python, "-m", "pip", "install", "--quiet", "--no-deps", wheel, folder=folder)
    site = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", folder=folder).strip())
    # A folder named in a .pth file is searched, but the .pth files in it (our editable install) are not read.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    return python


def test_the_wheel_holds_every_module_and_nothing_with_a_generic_name(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0].split("-")[0] for name in names} == {"tslam_bench"}
    for folder in ("tslam_bench", "tasks", "baselines", "leaderboard"):
        inside = "" if folder == "tslam_bench" else "tslam_bench/"
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in (".py", ".jinja", ".css", ".js", ".sh", ".typed") or path.parent.name == "weights":
                assert inside + path.relative_to(ROOT).as_posix() in names
    assert "tslam_bench/assets/constraints.txt" in names
    for split in ("test", "train", "val"):
        assert f"tslam_bench/assets/manifest_{split}.json" in names


@pytest.mark.parametrize("inside_the_clone", [False, True])
def test_an_installed_wheel_makes_an_environment(installed: Path, tmp_path: Path, inside_the_clone: bool) -> None:
    output = run(installed, "-c", EPISODE, folder=ROOT if inside_the_clone else tmp_path)
    assert "STEPPED (1, 2, 32, 32, 32)" in output
    # In the clone's root Python finds the clone's package first; elsewhere the installed one.
    assert (str(ROOT / "tslam_bench") in output) == inside_the_clone


def test_an_installed_wheel_evaluates_and_scores(installed: Path, tmp_path: Path) -> None:
    command = installed.parent / "tslam-bench"
    options = ["--objects", "mug", "--reconstructor", "grid", "--output", tmp_path / "run"]
    run(command, "evaluate", "--policy", "random", *options, folder=tmp_path)
    submission = tmp_path / "run" / "submissions" / "random-grid"
    assert "mug" in run(command, "score", submission, "--objects", "mug", folder=tmp_path)
    run(command, "leaderboard", submission, "--output", tmp_path / "page", folder=tmp_path)
    assert (tmp_path / "page" / "index.html").stat().st_size > 10_000


def test_the_core_scores_without_simulator_and_torch(wheel: Path, tmp_path: Path) -> None:
    """A virtual environment that holds the wheel and what its core requires, nothing else."""
    run(sys.executable, "-m", "venv", tmp_path / "venv", folder=tmp_path)
    python = tmp_path / "venv" / "bin" / "python"
    options = ["--quiet", "--constraint", ROOT / "constraints.txt"]
    run(python, "-m", "pip", "install", *options, wheel, folder=tmp_path)
    absent = [module for modules in EXTRAS.values() for module in modules]
    find = f"import importlib.util as u; print([m for m in {absent} if u.find_spec(m)])"
    assert run(python, "-c", find, folder=tmp_path).strip() == "[]"
    example = ROOT / "examples" / "6_score_a_submission.py"
    assert "IoU area" in run(python, example, "--objects", "mug", "--output", "balls", folder=tmp_path)
    command = tmp_path / "venv" / "bin" / "tslam-bench"
    run(command, "leaderboard", "balls", "--output", "page", folder=tmp_path)
    assert (tmp_path / "page" / "index.html").stat().st_size > 10_000
    done = subprocess.run([command, "doctor", "--no-probe"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stdout + done.stderr and done.returncode == 0, done.stdout
    assert "core     " in done.stdout and "-> pip install 'tslam-bench[sim]'" in done.stdout
    assert "this machine can: score submissions\n" in done.stdout
    for arguments in (["evaluate", "--policy", "random"], ["assets", "prepare", "--hand"]):
        done = subprocess.run([command, *arguments], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 2 and "pip install 'tslam-bench[" in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1
