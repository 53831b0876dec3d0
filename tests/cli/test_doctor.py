"""``tslam-bench doctor``: on this machine as it is, and on broken ones."""

from __future__ import annotations

import importlib.metadata
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tslam_bench.cli import checkup, main
from tslam_bench.cli.doctor import QUICK_CPU_MINUTES, REFERENCE_RATE, abilities, quick_minutes
from tslam_bench.cli.findings import Finding, guarded, import_remedy
from tslam_bench.cli.probe import Probe
from tslam_bench.extras import EXTRAS
from tslam_bench.files import CACHE_VARIABLE
from tslam_bench.machine import available_memory, usable_cores

ROOT = Path(__file__).parents[2]
MARK = "tslam-bench-probe "


def run(capsys: pytest.CaptureFixture, *arguments: str) -> tuple[int, str, str]:
    status = 0
    try:
        main(arguments)
    except SystemExit as stop:
        status = int(stop.code or 0)
    out, err = capsys.readouterr()
    return status, out, err


def test_it_tells_what_this_machine_can_do() -> None:
    done = subprocess.run([sys.executable, "-m", "tslam_bench.cli", "doctor", "--json"], capture_output=True, text=True)
    report = json.loads(done.stdout)
    found = {finding["name"]: finding for finding in report["findings"]}
    assert len(found) == len(report["findings"]) and "Traceback" not in done.stderr
    assert done.returncode == 0 and report["passed"], done.stdout
    assert report["can"]["simulate and train"] and report["can"]["score submissions"]
    assert found["core"]["figures"]["versions"]["numpy"] == importlib.metadata.version("numpy")
    assert set(found["[sim]"]["figures"]["versions"]) == set(checkup.required_packages()["sim"])
    assert found["cores"]["figures"]["usable"] <= len(os.sched_getaffinity(0))
    speed = found["simulation"]["figures"]
    assert speed["steps_per_second"] * speed["seconds"] == pytest.approx(200 * speed["num_envs"])
    low, high = found["quick run takes"]["figures"]["minutes"]
    assert 0 < low < high
    assert (found["CUDA"]["status"] == "ok") == found["CUDA"]["figures"]["available"]


def test_an_empty_cache_fails_and_every_failure_has_a_remedy(capsys, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(checkup, "has_extra", lambda extra: False)  # no libraries are tried: this is about objects
    status, out, err = run(capsys, "doctor")
    assert status == 1 and "Traceback" not in out + err
    lines = out.splitlines()
    failing = [index for index, line in enumerate(lines) if line.startswith("  FAILS")]
    assert [lines[index].split()[1] for index in failing] == ["hand", "test"]
    assert all("-> " in lines[index + 1] for index in failing)
    assert "pip install 'tslam-bench[assets]'; then tslam-bench assets prepare --quick" in out
    assert "not yet:          score submissions" in out
    assert not (tmp_path / "cache").exists()  # it changes nothing


def test_damaged_objects_are_found(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    for name, text in (("mug", "{"), ("hammer", '{"name": "hammer", "products": {}, "format": 0}')):
        (tmp_path / "objects" / "test" / name).mkdir(parents=True)
        (tmp_path / "objects" / "test" / name / "record.json").write_text(text)
    found = {finding.name: finding for finding in checkup.objects()}["test"]
    assert found.status == "fails" and found.remedy == "tslam-bench assets prepare"
    assert "2 of 2 objects" in found.found and "hammer, mug" in found.found


def test_versions_are_compared_with_the_tested_ones(tmp_path, monkeypatch) -> None:
    tested = checkup.tested_versions()
    assert tested["torch"] == "2.13.0" and tested["mani-skill"].startswith("3.")
    pins = (ROOT / "constraints.txt").read_text().splitlines()
    assert len(tested) == sum("==" in line for line in pins)
    required = checkup.required_packages()
    assert {"numpy", "tyro"} <= set(required["core"]) and "torch" in required["sim"] and "coacd" in required["assets"]
    other = tmp_path / "constraints.txt"
    other.write_text("numpy==0.9\nNumba==1\n")
    monkeypatch.setattr(checkup, "package_data", lambda *parts: other)
    core = {finding.name: finding for finding in checkup.packages()}["core"]
    assert core.status == "note" and "(tested: 0.9)" in core.found and str(other) in core.remedy
    assert f"numba {importlib.metadata.version('numba')} (tested: 1)" in core.found
    other.unlink()
    core = {finding.name: finding for finding in checkup.packages()}["core"]
    assert core.status == "ok" and "not known" in core.found


def test_a_package_that_cannot_be_imported_is_named(tmp_path, monkeypatch) -> None:
    """One raises, and one takes the process along: both are found, by their name."""
    from tslam_bench.cli.doctor import _imports

    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    first, *_, last = EXTRAS["assets"]
    (tmp_path / f"{first}.py").write_text(
        "raise ImportError('libGL.so.1: cannot open shared object file: No such file')"
    )
    (tmp_path / f"{last}.py").write_text("import os; print('noise', flush=True); os.abort()")
    one, two = _imports("assets", Probe("assets").wait(100))
    assert (one.name, two.name) == (first, last) and one.status == two.status == "fails"
    assert "libGL.so.1" in one.found and "apt-get install libgl1" in one.remedy
    assert "crashed (SIGABRT)" in two.found and "pip install --force-reinstall" in two.remedy


def test_a_probe_that_hangs_or_babbles_is_stopped(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (tmp_path / "hangs.py").write_text(
        f'import subprocess, sys\nprint(\'{MARK}["a", {{"x": 1}}]\', flush=True)\n'
        "subprocess.run([sys.executable, '-c', 'import time; time.sleep(99)'])\n"
    )
    tried = Probe(module="hangs").wait(3)
    assert tried.results == {"a": {"x": 1}} and tried.end == "no answer for 3 s"
    (tmp_path / "babbles.py").write_text("import sys; sys.stdout.buffer.write(b'\\xff\\xfe'); sys.exit('the reason')")
    tried = Probe(module="babbles").wait(60)
    assert tried.results == {} and tried.end == "the reason"


def test_a_check_that_goes_wrong_is_a_line() -> None:
    def broken() -> list[Finding]:
        raise RuntimeError("two\nlines")

    (finding,) = guarded("machine", broken)
    assert finding.status == "fails" and finding.name == "broken" and finding.found == "RuntimeError: two lines"


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, 3),
        ({"cpu.max": "max 100000"}, 3),
        ({"cpu.max": "200000 100000"}, 2),
        ({"cpu.max": "50000 100000"}, 1),
        ({"cpu.max": "900000 100000"}, 3),
        ({"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, 3),
        ({"cpu/cpu.cfs_quota_us": "250000", "cpu/cpu.cfs_period_us": "100000"}, 2),
    ],
)
def test_a_containers_share_of_the_cores(files, cores, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1, 2})
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text + "\n")
    assert usable_cores(tmp_path) == cores


def test_a_containers_share_of_the_memory(tmp_path) -> None:
    information = tmp_path / "meminfo"
    information.write_text("MemTotal:       9000 kB\nMemAvailable:    4000 kB\n")
    assert available_memory(tmp_path, information) == 4000 * 1024
    (tmp_path / "memory.max").write_text("1000000\n")
    (tmp_path / "memory.current").write_text("900000\n")
    assert available_memory(tmp_path, information) == 100_000
    (tmp_path / "memory.stat").write_text("anon 300000\ninactive_file 200000\n")
    assert available_memory(tmp_path, information) == 300_000
    (tmp_path / "memory.max").write_text("max\n")
    assert available_memory(tmp_path, information) == 4000 * 1024
    assert available_memory(tmp_path, tmp_path / "none") is None


def test_minutes_of_the_quick_run() -> None:
    assert quick_minutes(1, REFERENCE_RATE) == (QUICK_CPU_MINUTES, 2 * QUICK_CPU_MINUTES)
    assert quick_minutes(2, 2 * REFERENCE_RATE)[0] == QUICK_CPU_MINUTES / 4
    assert quick_minutes(64, REFERENCE_RATE) == quick_minutes(32, REFERENCE_RATE)


def test_remedies_of_imports() -> None:
    assert "libgomp1" in import_remedy("OSError: libgomp.so.1: cannot open shared object file: No such file", "assets")
    unknown = import_remedy("ImportError: libfoo-2.so.7: cannot open shared object file", "sim")
    assert unknown == "install the system library libfoo-2.so.7"
    assert "tslam-bench[sim]" in import_remedy("ImportError: undefined symbol", "sim")


def test_nothing_can_be_done_without_what_it_needs() -> None:
    fine = [Finding("software", "core", "ok", ""), Finding("graphics", "Vulkan", "ok", "")]
    assert abilities(fine)["score submissions"] and abilities(fine)["make videos"] == checkup.has_extra("sim")
    assert not abilities(fine)["simulate on a GPU"]
    for name, lost in (("test", "score submissions"), ("sapien", "simulate and train"), ("coacd", "prepare objects")):
        assert not abilities([*fine, Finding("x", name, "fails", "")])[lost]
