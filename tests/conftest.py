"""Fixtures that several test files share."""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: its threads wait for each other on small tensors

from pathlib import Path

import pytest
from prepared_shapes import prepared_box, prepared_sphere, prepared_torus

from tslam_bench.files import CACHE_VARIABLE
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


@pytest.fixture(scope="session")
def primitive_cache(box: PreparedObject, torus: PreparedObject, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An asset cache in which a box passes for the mug and a torus for the large torus."""
    from scored_run import write_cache

    folder = tmp_path_factory.mktemp("cache")
    write_cache(folder, box, torus)
    return folder


@pytest.fixture(scope="session")
def run(
    box: PreparedObject, torus: PreparedObject, primitive_cache: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A run's folder: four submissions, one of them with hostile texts, and their scores."""
    from scored_run import write_run

    folder = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_VARIABLE, str(primitive_cache))  # its key seals the scores
        write_run(folder, box, torus, primitive_cache)
    return folder
