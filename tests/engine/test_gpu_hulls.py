"""Which hulls PhysX cannot cook for a GPU: in processes of their own, as the format is a switch of the whole process."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"

NEEDLE = """
import dataclasses, sys
sys.path[:0] = [sys.argv[1]]
import numpy as np
from gpu_hulls import _enable_gpu, refused_hulls
from tslam_bench.objects.store import load_object

def box(x, y, z):
    corners = np.array([[i, j, k] for i in (0, x) for j in (0, y) for k in (0, z)], dtype=float)
    return corners, np.zeros((0, 3), dtype=np.int64)

_enable_gpu()
hulls = (box(0.1, 0.1, 0.1), box(0.2, 0.0005, 0.0005), box(0.05, 0.04, 0.03))
print([found["hull"] for found in refused_hulls(dataclasses.replace(load_object("mug"), hulls=hulls))])
"""


def test_a_needle_is_refused_and_boxes_are_not():
    command = [sys.executable, "-c", NEEDLE, str(BENCHMARKS)]
    assert subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1] == "[1]"


def test_hulls_of_the_quick_set_are_cooked_and_counted(tmp_path):
    report = tmp_path / "report.json"
    command = [sys.executable, BENCHMARKS / "gpu_hulls.py", "--objects", "mug", "hammer", "--output", report]
    subprocess.run(command, check=True, capture_output=True)
    found = json.loads(report.read_text(encoding="utf-8"))
    assert found["objects"] == 2 and found["hulls"] > 40
    assert found["refused"] == [], "docs/gpu.md names the only test object with such a hull: waterbottle"
