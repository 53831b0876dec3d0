"""Step 5: torch's profile of 20 control steps: which kernels and copies they are made of.

python benchmarks/gpu/step5_profile.py
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import tyro
from step import Report, Step, run, synchronise
from torch.profiler import ProfilerActivity, profile

from tslam_bench.constants import NUM_JOINTS, QUICK_OBJECTS
from tslam_bench.registration import make_vec


@dataclass(frozen=True)
class Settings(Step):
    """Profiles."""

    num_envs: int = 1024
    """Environments."""
    steps: int = 20
    """Control steps."""
    rows: int = 40
    """Rows of the table."""


def work(settings: Settings, report: Report) -> None:
    """The most expensive operations, and copies to the host."""
    envs: Any = make_vec(num_envs=settings.num_envs, device="cuda", objects=QUICK_OBJECTS)
    envs.reset(seed=0)
    action = torch.zeros(settings.num_envs, NUM_JOINTS, device=envs.device)
    for _ in range(5):
        envs.step(action)
    on_card = [ProfilerActivity.CUDA] if settings.device == "cuda" else []
    with profile(activities=[ProfilerActivity.CPU, *on_card]) as found:
        for _ in range(settings.steps):
            envs.step(action)
        synchronise(settings)
    envs.close()
    events = found.key_averages()
    cost = "self_device_time_total" if on_card else "self_cpu_time_total"
    ranked = sorted(events, key=lambda event: getattr(event, cost), reverse=True)
    report["microseconds per step"] = {
        event.key: [round(getattr(event, cost) / settings.steps, 1), event.count / settings.steps]
        for event in ranked[: settings.rows]
    }
    waits = (
        "cudaStreamSynchronize",
        "cudaDeviceSynchronize",
        "aten::_local_scalar_dense",
        "aten::item",
        "aten::nonzero",
    )
    report["waits per step"] = {event.key: event.count / settings.steps for event in events if event.key in waits}


if __name__ == "__main__":
    run(tyro.cli(Settings), work)
