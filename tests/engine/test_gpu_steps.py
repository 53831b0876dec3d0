"""The scripts for the first half hour on a GPU, on an emulated one; how they end, whatever happens."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks" / "gpu"
TRIALS = {
    "step0_library": [],
    "step1_details": ["--num-envs", "3"],
    "step1b_sensing": ["--num-envs", "2", "--steps", "20", "--sizes", "3"],
    "step2_check": ["--sizes", "2", "--tabletop", "2"],
    "step3_speed": ["--sizes", "2", "--workers", "0", "--steps", "3"],
    "step4_reconfigure": ["--num-envs", "2", "--times", "2", "--split", "test"],
    "step5_profile": ["--num-envs", "2", "--steps", "2"],
    "step6_train": ["--num-envs", "2", "--batch-size", "20", "--steps", "400"],
    "step8_reconstructor": ["--size", "small", "--steps", "2", "--batch-size", "2", "--count", "2", "--processes", "1"],
}
WORK = """
import ctypes, sys, time, tyro
sys.path.insert(0, sys.argv.pop(1))
import step
from step import Step, run
step.GRACE = 1.0

def work(settings, report):
    report["first"] = 1
    {body}
    report["second"] = 2

run(tyro.cli(Step), work)
"""


def end_of(body: str, tmp_path: Path, *arguments: str) -> tuple[int, dict]:
    """Exit status and report of a script with this work."""
    script = tmp_path / "script.py"
    script.write_text(WORK.format(body=body), encoding="utf-8")
    output = tmp_path / "report.json"
    command = [sys.executable, script, FOLDER, "--device", "emulated", "--output", output, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    return done.returncode, json.loads(output.read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("body", "status", "ended"),
    [
        ("pass", 0, "finished"),
        ("report.check('figure', 2.0, 1.0)", 1, "finished"),
        ("raise ValueError('no such thing')", 1, "ValueError: no such thing"),
        ("print('PhysX: fail to launch kernel')", 1, "finished"),
        ("time.sleep(50)", 1, "time is up"),
    ],
)
def test_a_step_ends_with_its_file(body, status, ended, tmp_path):
    code, report = end_of(body, tmp_path, "--seconds", "4")
    assert code == status and report["ended"] == ended and report["first"] == 1
    assert report["seconds"] < 20 and report["card"] and report["command"] and report["date"]


def test_a_step_that_hangs_in_native_code_is_ended_and_keeps_what_it_found(tmp_path):
    hang = "ctypes.CDLL(None).pause() if False else [ctypes.CDLL(None).sleep(50) for _ in range(9)]"
    code, report = end_of(hang, tmp_path, "--seconds", "3")
    assert code in (1, 3) and report["first"] == 1 and "second" not in report


@pytest.mark.slow
@pytest.mark.parametrize("script", TRIALS)
def test_every_script_runs_on_an_emulated_gpu(script, tmp_path):
    output = tmp_path / "report.json"
    command = [sys.executable, FOLDER / f"{script}.py", "--device", "emulated", "--output", output, *TRIALS[script]]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=400)
    report = json.loads(output.read_text(encoding="utf-8"))
    assert done.returncode == 0 and report["ended"] == "finished", done.stderr[-2000:]
