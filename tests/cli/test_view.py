"""``tslam-bench view``: rollout files and submissions without a simulator, a live policy with one, and what it refuses."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tslam_bench.cli import main
from tslam_bench.viewing.packing import unpack

WITHOUT_SIMULATOR = """
import sys
from importlib.machinery import PathFinder
absent = ("sapien", "torch", "mani_skill", "stable_baselines3", "mujoco", "coacd", "manifold3d")
find = PathFinder.find_spec
PathFinder.find_spec = classmethod(lambda cls, name, *rest: None if name.split(".")[0] in absent else find(name, *rest))
from tslam_bench.cli import main
main(sys.argv[1:])
"""


def listed(folder: Path) -> dict:
    text = (folder / "catalogue.js").read_text(encoding="utf-8")
    return json.loads(text.removeprefix("tslam.catalogue=").rstrip(";\n"))


def header(folder: Path, kind: str, name: str = "mug", entry: int = 0) -> dict:
    file = listed(folder)["entries"][entry]["objects"][name][kind]
    return unpack((folder / file).read_text(encoding="ascii"))[1]


def refused(capsys: pytest.CaptureFixture, *arguments: str) -> str:
    with pytest.raises(SystemExit) as caught:
        main(["view", *arguments])
    assert caught.value.code == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("tslam-bench:")]
    return line


@pytest.fixture
def cached(primitive_cache: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TSLAM_BENCH_CACHE", str(primitive_cache))
    return primitive_cache


@pytest.mark.usefixtures("cached")
def test_submissions_are_shown_without_simulator_and_torch(run: Path, tmp_path: Path) -> None:
    archive = tmp_path / "random.zip"
    source = run / "submissions" / "random-grid"
    with zipfile.ZipFile(archive, "w") as stream:
        for path in source.rglob("*"):
            stream.write(path, path.relative_to(source))
    given = [str(run / "submissions" / "heuristic-hull"), str(archive)]
    chosen = ["--object", "mug", "--pose", "2", "0", "--output", str(tmp_path / "out"), "--no-browser"]
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_SIMULATOR, "view", *given, *chosen], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(tmp_path / "out" / "index.html"))
    assert [(e["explorer"], list(e["objects"])) for e in listed(tmp_path / "out")["entries"]] == [
        ("heuristic", ["mug"]),
        ("random", ["mug"]),
    ]
    for entry in (0, 1):
        poses = header(tmp_path / "out", "episodes", entry=entry)["poses"]
        assert [pose["pose"] for pose in poses] == [0, 2]
        assert all("no simulator" in pose["note"] and pose["source"] == "interpolated" for pose in poses)
        assert [c["count"] for c in header(tmp_path / "out", "shape", entry=entry)["counts"]] == [1, 2, 4, 8]


@pytest.mark.usefixtures("cached")
def test_rollout_files_are_completed_here(run: Path, tmp_path: Path) -> None:
    folder = run / "submissions" / "heuristic-hull" / "rollouts" / "mug"
    files = [str(folder / f"pose{pose}_seed0.npz") for pose in (5, 0, 2)]
    output = tmp_path / "out"
    main(["view", *files, "--reconstructor", "hull", "grid", "--no-replay", "--output", str(output), "--no-browser"])
    assert [e["reconstructor"] for e in listed(output)["entries"]] == ["hull", "grid"]
    assert [c["poses"] for c in header(output, "shape")["counts"]] == [[0], [0, 2], [0, 2, 5]]
    assert {pose["source"] for pose in header(output, "episodes")["poses"]} == {"interpolated"}
    first, second = (entry["objects"]["mug"] for entry in listed(output)["entries"])
    assert first["episodes"] == second["episodes"] and first["shape"] != second["shape"]
    main(["view", files[0], "--reconstructor", "none", "--no-replay", "--output", str(output), "--no-browser"])
    (entry,) = header(output, "shape")["counts"]
    assert entry["poses"] == [5] and entry["reason"] == "missing" and entry["iou"] == 0


@pytest.mark.usefixtures("cached")
def test_all_submissions_of_a_run_are_compared(run: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    main(["view", str(run), "--object", "mug", "--pose", "0", "--no-replay", "--output", str(output), "--no-browser"])
    entries = [(e["explorer"], e["reconstructor"], e["remark"]) for e in listed(output)["entries"]]
    assert entries == [
        ("heuristic", "hull", ""),
        ("mine", "hull", '"><script>alert(1)</script>'),
        ("random", "grid", ""),
        ("tslam_chamfer", "hull", "privileged"),
    ]


@pytest.mark.usefixtures("cached")
def test_bad_input_is_one_line(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    rollout = str(run / "submissions" / "heuristic-hull" / "rollouts" / "mug" / "pose0_seed0.npz")
    other = str(run / "submissions" / "random-grid" / "rollouts" / "mug" / "pose0_seed0.npz")
    output = ["--output", str(tmp_path / "out"), "--no-browser"]
    assert "no such" in refused(capsys, str(tmp_path / "nothing"), *output)
    assert "submission.json is missing" in refused(capsys, str(run / "scores"), *output)
    assert "a second episode of mug in pose 0; give one" in refused(capsys, rollout, other, "--no-replay", *output)
    assert "pose 8" in refused(capsys, "--pose", "8", *output)
    assert "unknown" in refused(capsys, "--object", "mugg", *output)
    assert "holds nothing of hammer" in refused(
        capsys, str(run / "submissions/random-grid"), "--object", "hammer", *output
    )
    assert "holds something else" in refused(capsys, rollout, "--output", str(run), "--no-browser")
    assert "a reference has no policy" in refused(capsys, "--policy", "oracle", *output)


def test_a_policy_explores_now_objects_of_any_split(tmp_path: Path) -> None:
    output = tmp_path / "live"
    chosen = ["--object", "mug-000", "--split", "train", "--policy", "random_targets", "--pose", "7"]
    main(["view", *chosen, "--output", str(output), "--no-browser"])
    (pose,) = header(output, "episodes", "mug-000")["poses"]
    assert (pose["pose"], pose["source"]) == (7, "live")
    assert listed(output)["hand"] == "data/hand.js" and listed(output)["title"] == "random_targets feels mug-000"
    assert 0 < sum(path.stat().st_size for path in output.rglob("*") if path.is_file()) < 1.5e6
