"""Compiled functions where numba gets no cache: they work, give the same, and it is said once."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

PROGRAM = """
    import warnings
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        {before}
        import numpy as np
        from tslam_bench.geometry.nearest import NearestSamples
        points = np.random.default_rng(0).random((500, 3))
        distance, nearest = NearestSamples(points[:250]).query(NearestSamples(points[250:]))
    print(f"{{distance.sum():.12f}} {{nearest.sum()}}")
    for warning in caught:
        if "compiled" in str(warning.message):
            print(str(warning.message).replace(chr(10), " "))
"""


def run(folder: Path, before: str = "") -> list[str]:
    """What a new process prints whose cache is in ``folder``."""
    code = textwrap.dedent(PROGRAM).format(before=before)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A cache that works, and what is computed with it."""
    folder = tmp_path_factory.mktemp("numba")
    (line,) = run(folder)
    assert list(folder.rglob("*.nbi")) and run(folder) == [line]
    return folder, line


def test_no_place_for_a_cache(filled: tuple[Path, str], tmp_path: Path) -> None:
    """An installation that cannot be written, and no home: numba finds no place and raises when a module is imported."""
    before = "import numba.core.caching as caching; caching.CacheImpl._locator_classes = []"
    line, said = run(tmp_path, before)
    assert line == filled[1]
    assert said.startswith(
        "there is no place for compiled functions (set NUMBA_CACHE_DIR to a folder that you can write)"
    )


def test_a_full_disk(filled: tuple[Path, str], tmp_path: Path) -> None:
    line, said = run(tmp_path, "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))")
    assert line == filled[1] and said.startswith("numba's cache cannot be used (OSError: [Errno 27] File too large")


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_damaged_files(filled: tuple[Path, str], suffix: str) -> None:
    """As a process leaves them that is killed, or a disk that is full."""
    folder, line = filled
    for path in folder.rglob(f"*.{suffix}"):
        path.write_bytes(path.read_bytes()[:100] if suffix == "nbi" else b"garbage")
    found, *said = run(folder)
    assert found == line and said and all(text.startswith("numba's cache cannot be used") for text in said)
