"""Step 7: one video, rendered by Vulkan; needs no GPU physics.

python benchmarks/gpu/step7_video.py
"""

from __future__ import annotations

import subprocess
import sys
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import step as step_module
import tyro
from step import Report, Step, run


@dataclass(frozen=True)
class Settings(Step):
    """Records an episode of the heuristic on the mug."""

    video: Path = Path("gpu_results/video.webp")
    """File to write."""


def work(settings: Settings, report: Report) -> None:
    """The command's own words where it cannot render."""
    settings.video.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "tslam_bench.cli", "env", "video", "--output", str(settings.video)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=settings.seconds - 5)
    report["said"] = (done.stdout + done.stderr).strip().splitlines()[-3:]
    report["bytes"] = settings.video.stat().st_size if settings.video.is_file() else 0
    report.check("exit status", done.returncode, 0)


if __name__ == "__main__":
    with patch.object(step_module, "physics_of", lambda device: nullcontext()):
        run(tyro.cli(Settings), work)
