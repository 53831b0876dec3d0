"""Fixtures that several test files share."""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: its threads wait for each other on small tensors

import pytest
from prepared_shapes import prepared_box, prepared_sphere, prepared_torus

from tslam_bench.objects.store import PreparedObject


@pytest.fixture(scope="session")
def box() -> PreparedObject:
    return prepared_box()


@pytest.fixture(scope="session")
def sphere() -> PreparedObject:
    return prepared_sphere()


@pytest.fixture(scope="session")
def torus() -> PreparedObject:
    return prepared_torus()
