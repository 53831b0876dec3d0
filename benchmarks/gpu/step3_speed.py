"""Step 3: control steps per second, by environments and host threads, and where the time goes.

python benchmarks/gpu/step3_speed.py
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import torch
import tyro
from step import Report, Step, memory, run, synchronise

from tslam_bench.constants import ENVIRONMENT_ID, NUM_JOINTS, QUICK_OBJECTS
from tslam_bench.engine.gpu_memory import gpu_memory
from tslam_bench.engine.maniskill_vector_env import BatchedVectorEnv

STAGES = ("physics", "sensing", "rewards", "whole step")


@dataclass(frozen=True)
class Settings(Step):
    """Measures random hands that come down."""

    sizes: tuple[int, ...] = (64, 256, 1024, 4096, 8192)
    """Environments."""
    workers: tuple[int, ...] = (0, 8)
    """PhysX's threads on the host."""
    steps: int = 100
    """Control steps that are measured, after ten that warm up."""
    objects: tuple[str, ...] = QUICK_OBJECTS
    """Objects, in turn."""


def work(settings: Settings, report: Report) -> None:
    """One entry per size and number of threads."""
    for size in settings.sizes:
        for workers in settings.workers:
            report[f"{size} environments, {workers} threads"] = measure(settings, size, workers)


def measure(settings: Settings, size: int, workers: int) -> dict[str, Any]:
    """Control steps per second, shares of the time with waiting between the stages, memory."""
    start = time.perf_counter()
    environment = gym.make(
        ENVIRONMENT_ID,
        num_envs=size,
        sim_backend="physx_cuda",
        objects=settings.objects,
        sim_config={"scene_config": {"cpu_workers": workers}},
    )
    envs: Any = BatchedVectorEnv(environment)
    envs.reset(seed=0)
    made = time.perf_counter() - start
    generator = torch.Generator(envs.device).manual_seed(0)

    def steps(count: int) -> float:
        synchronise(settings)
        start = time.perf_counter()
        for _ in range(count):
            action = 2 * torch.rand(size, NUM_JOINTS, generator=generator, device=envs.device) - 1
            envs.step(action)
        synchronise(settings)
        return time.perf_counter() - start

    down = torch.zeros(size, NUM_JOINTS, device=envs.device)
    down[:, 1] = -1
    for _ in range(30):
        envs.step(down)
    steps(10)
    seconds = steps(settings.steps)
    result = {
        "steps_per_second": size * settings.steps / seconds,
        "seconds_to_make": made,
        "memory": memory(settings),
        "faults": int(envs.faults.sum()),
        "buffers": vars(gpu_memory(size, environment.unwrapped._starts.most_hulls())),
        "milliseconds": _stages(settings, envs, lambda: steps(10) / 10),
    }
    envs.close()
    return result


def _stages(settings: Settings, envs: Any, one_step) -> dict[str, float]:
    """Milliseconds per control step of each stage; waiting for the device around each makes the whole slower than it is."""
    base = envs.environment.unwrapped
    spent = dict.fromkeys(STAGES, 0.0)

    def timed(owner: Any, name: str, stage: str) -> None:
        inner = getattr(owner, name)

        def outer(*arguments: Any, **named: Any) -> Any:
            synchronise(settings)
            start = time.perf_counter()
            result = inner(*arguments, **named)
            synchronise(settings)
            spent[stage] += time.perf_counter() - start
            return result

        setattr(owner, name, outer)

    timed(base.scene, "step", "physics")
    timed(base.scene, "_gpu_fetch_all", "physics")
    timed(base._sensing, "step", "sensing")
    timed(base._rewards, "step", "rewards")
    whole = one_step()
    return {stage: 1e3 * (whole if stage == "whole step" else spent[stage] / 10) for stage in STAGES}


if __name__ == "__main__":
    run(tyro.cli(Settings), work)
