"""Step 4: five reconfigures: does memory come back, and what does one take?

python benchmarks/gpu/step4_reconfigure.py
"""

from __future__ import annotations

import gc
import time
from dataclasses import dataclass

import torch
import tyro
from step import Report, Step, memory, run, synchronise

from tslam_bench.registration import make_vec


@dataclass(frozen=True)
class Settings(Step):
    """Draws other objects five times."""

    num_envs: int = 1024
    """Environments."""
    split: str = "train"
    """Split to draw from."""
    times: int = 5
    """Reconfigures."""


def work(settings: Settings, report: Report) -> None:
    """Seconds and memory of each."""
    envs = make_vec(num_envs=settings.num_envs, device="cuda", split=settings.split)
    report["memory at first"] = memory(settings)
    for number in range(settings.times):
        start = time.perf_counter()
        envs.reset(seed=number, options={"reconfigure": True})
        synchronise(settings)
        seconds = time.perf_counter() - start
        start = time.perf_counter()
        envs.reset(seed=number)
        synchronise(settings)
        report[f"reconfigure {number}"] = {
            "seconds": seconds,
            "plain reset": time.perf_counter() - start,
            "memory": memory(settings),
        }
    envs.close()
    gc.collect()
    if settings.device == "cuda":
        torch.cuda.empty_cache()
    report["memory when closed"] = memory(settings)


if __name__ == "__main__":
    run(tyro.cli(Settings), work)
