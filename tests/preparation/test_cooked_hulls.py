"""PhysX keeps the collision hulls' volume: what it cooked is read back and compared (objects of the quick set)."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from tslam_bench.constants import QUICK_OBJECTS
from tslam_bench.engine import physics
from tslam_bench.objects.store import load_object

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from cooked_hulls import cook


@pytest.mark.parametrize("name", QUICK_OBJECTS)
def test_cooking_keeps_volume_and_the_limits_of_a_gpu(name):
    prepared = load_object(name)
    cooked = cook(prepared)
    assert len(cooked.after) == prepared.record["hull_count"] == len(prepared.hulls)
    assert abs(cooked.change) < 0.005
    assert abs(cooked.corner_change) < 0.005
    assert cooked.worst < 0.02
    assert max(len(vertices) for vertices, _ in prepared.hulls) <= 64
    assert cooked.vertices.max() <= 64
    assert cooked.triangles.max() <= 64


def test_volumes_are_read_right():
    """Against qhull, before cooking; what PhysX triangulated lies within the hull of its corners."""
    prepared = load_object("hammer")
    cooked = cook(prepared)
    np.testing.assert_allclose(
        cooked.before, [ConvexHull(vertices).volume for vertices, _ in prepared.hulls], rtol=1e-9
    )
    assert (cooked.after <= cooked.corners * (1 + 1e-5)).all()


def test_cooking_in_metres_would_lose_volume(monkeypatch):
    """Why hulls are cooked in centimetres, and proof that the comparison finds a loss."""
    monkeypatch.setattr(physics, "COOKING_SCALE", 1.0)
    assert cook(load_object("wineglass")).change < -0.01
