"""Step 2: does the GPU simulation agree with the CPU's? ``tslam-bench gpu-check`` at several sizes.

python benchmarks/gpu/step2_check.py
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import tyro
from step import Report, Step, run

from tslam_bench.constants import ENVIRONMENT_ID, QUICK_OBJECTS, TABLETOP_ID
from tslam_bench.evaluation.gpu_check import Episodes, compare, judge, record
from tslam_bench.registration import make_vec
from tslam_bench.variants import get_variant


@dataclass(frozen=True)
class Settings(Step):
    """Compares whole episodes; ``tslam-bench gpu-check`` itself leaves the stamp that device "auto" asks for."""

    sizes: tuple[int, ...] = (16, 256)
    """Environments of TactileSLAM-v0."""
    tabletop: int = 64
    """Environments of the tabletop variant."""


def work(settings: Settings, report: Report) -> None:
    """The figures of docs/gpu.md for each size."""
    sizes = [(ENVIRONMENT_ID, size) for size in settings.sizes] + [(TABLETOP_ID, settings.tabletop)]
    for environment_id, size in sizes:
        episodes = Episodes.draw(QUICK_OBJECTS, get_variant(environment_id).poses, size)
        recordings, faults = [], 0
        for device, played in (("cuda", episodes), ("cpu", episodes), ("cpu", episodes.perturbed())):
            envs: Any = make_vec(environment_id, size, device, objects=QUICK_OBJECTS)
            recordings.append(record(envs, played))
            faults += int(envs.faults.sum()) if device == "cuda" else 0
            envs.close()
        on_gpu, reference, perturbed = recordings
        found, yardstick = compare(reference, on_gpu), compare(reference, perturbed)
        findings = judge(found, yardstick)
        name = f"{environment_id}, {size}"
        report[f"{name}, found"], report[f"{name}, yardstick"] = asdict(found), asdict(yardstick)
        report[f"{name}, rates"] = [on_gpu.steps_per_second, reference.steps_per_second]
        failed = [finding.name for finding in findings if not finding.passed]
        report.check(f"{name}, figures that failed", len(failed) + faults, 0)
        report[f"{name}, failed"] = failed


if __name__ == "__main__":
    run(tyro.cli(Settings), work)
