"""Compiled functions where numba gets no cache: they work, give the same, and it is said once."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import tslam_bench

MODULE = """
    import numpy as np
    from tslam_bench.compiled import njit

    @njit(cache=True)
    def doubled(values):
        return 2.0 * values.sum()

    @njit(cache=True)
    def both(values):
        return doubled(values) + values[0]
"""
PROGRAM = """
    import sys, warnings
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        {before}
        import numpy as np
        sys.path.insert(0, {folder!r})
        from of_the_test import both
        print(both(np.arange(10.0)))
    for warning in caught:
        if "compiled" in str(warning.message):
            print(str(warning.message).replace(chr(10), " "))
"""


def run(folder: Path, before: str = "") -> list[str]:
    """What a new process prints whose cache is in ``folder``."""
    (folder / "of_the_test.py").write_text(textwrap.dedent(MODULE))
    os.utime(folder / "of_the_test.py", (0, 0))  # or the cache would be of an older module
    code = textwrap.dedent(PROGRAM).format(before=before, folder=str(folder))
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache")}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a cache that works."""
    folder = tmp_path_factory.mktemp("numba")
    assert run(folder) == ["90.0"] and list(folder.rglob("*.nbi")) and run(folder) == ["90.0"]
    return folder


def test_no_place_for_a_cache(tmp_path: Path) -> None:
    """An installation that cannot be written, and no home: numba finds no place and raises when a module is imported."""
    line, said = run(tmp_path, "import numba.core.caching as caching; caching.CacheImpl._locator_classes = []")
    assert line == "90.0"
    assert said.startswith(
        "there is no place for compiled functions (set NUMBA_CACHE_DIR to a folder that you can write)"
    )


def test_a_full_disk(tmp_path: Path) -> None:
    line, said = run(tmp_path, "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))")
    assert line == "90.0" and said.startswith("numba's cache cannot be used (OSError: [Errno 27] File too large")


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_damaged_files(filled: Path, suffix: str) -> None:
    """As a process leaves them that is killed, or a disk that is full."""
    for path in filled.rglob(f"*.{suffix}"):
        path.write_bytes(path.read_bytes()[:100] if suffix == "nbi" else b"garbage")
    found, *said = run(filled)
    assert found == "90.0" and said and all(text.startswith("numba's cache cannot be used") for text in said)


def test_nothing_is_compiled_without_it() -> None:
    root = Path(tslam_bench.__file__).parents[1]
    folders = [root / name for name in ("tslam_bench", "tasks", "baselines", "leaderboard", "benchmarks")]
    own = [path for folder in folders for path in folder.rglob("*.py") if path.name != "compiled.py"]
    assert len(own) > 100 and not [path for path in own if "import numba" in path.read_text(encoding="utf-8")]
    assert not [path for path in own if "from numba" in path.read_text(encoding="utf-8")]
