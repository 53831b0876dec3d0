"""Curves for TensorBoard: its own reader understands them, and a full disk ends them alone."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tslam_bench.curves import Curves


def scalars(folder: Path) -> list[tuple[int, float]]:
    events = EventAccumulator(str(folder))
    events.Reload()
    return [(event.step, event.value) for event in events.Scalars("loss")]


def test_a_run_that_goes_on_replaces_what_came_after_its_checkpoint(tmp_path: Path) -> None:
    first = Curves(tmp_path)
    for step in range(6):
        first.add("loss", float(step), step)
    first.close()
    second = Curves(tmp_path, first_step=4)
    for step in range(4, 8):
        second.add("loss", 10.0 * step, step)
    second.close()
    assert scalars(tmp_path) == [(0, 0.0), (1, 1.0), (2, 2.0), (3, 3.0), (4, 40.0), (5, 50.0), (6, 60.0), (7, 70.0)]


def test_a_full_disk_ends_the_curves_and_not_the_run(tmp_path: Path) -> None:
    code = """
        import resource, sys
        from pathlib import Path
        from tslam_bench.curves import Curves
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
        curves = Curves(Path(sys.argv[1]))
        for step in range(1000):
            curves.add("loss", 1.0, step)
        curves.close()
        print("done")
    """
    command = [sys.executable, "-c", textwrap.dedent(code), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout == "done\n" and "Traceback" not in done.stderr, done.stderr
    assert done.stderr.count("cannot be written (File too large); the run goes on without curves") == 1
    assert 10 < len(scalars(tmp_path)) < 30  # what fits
