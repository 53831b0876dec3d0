"""Step 6: training with everything on the device, or with the CPU simulating and the GPU learning.

python benchmarks/gpu/step6_train.py --network paper
python benchmarks/gpu/step6_train.py --simulate cpu     # step 3b of the plan: needs no GPU physics
"""

from __future__ import annotations

import os
import time
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal
from unittest.mock import patch

import step as step_module
import tyro
from step import Report, Step, memory, run, tensor_device

from tslam_bench.baselines import training
from tslam_bench.baselines.model_files import make_network
from tslam_bench.baselines.ppo import PPO
from tslam_bench.baselines.training_config import TrainingConfig


@dataclass(frozen=True)
class Settings(Step):
    """Trains ``tslam`` until the time is over."""

    simulate: Literal["gpu", "cpu"] = "gpu"
    """Where to simulate; the device learns in both cases."""
    network: Literal["fast", "paper"] = "fast"
    """Policy network."""
    num_envs: int = 1024
    """Environments."""
    batch_size: int = 12_800
    """Minibatch (decisions)."""
    steps: int = 10_000_000
    """Control steps at most."""
    split: str = "train"
    """Split to train on."""
    folder: Path | None = None
    """Resumable run in this folder, by the command's own trainer; None: figures alone, nothing is kept."""


def work(settings: Settings, report: Report) -> None:
    """Steps per second, seconds by stage and the return after each iteration."""
    device = tensor_device(settings)
    simulated = "cuda" if settings.simulate == "gpu" else "cpu"
    config = TrainingConfig(
        "tslam",
        steps=settings.steps,
        split=settings.split,
        network=settings.network,
        num_envs=settings.num_envs,
        batch_size=settings.batch_size,
        device=simulated,
        processes=os.cpu_count() if simulated == "cpu" else None,
    )
    config.check()
    if settings.folder is not None:
        with patch.object(training, "learning_device", lambda _: device):
            report["metadata"] = training.train(config, settings.folder, on_progress=lambda *_: None)
        return
    environments = training.make_training_environments(config)
    learner = PPO(config, environments, make_network(config.network, config.initial_std, config.seed), device)
    learner.begin(0)
    start, iteration = time.perf_counter(), 0
    while learner.steps < config.total_steps:
        figures = learner.iterate()
        iteration += 1
        seconds = time.perf_counter() - start
        returns = [episode["return"] for episode in learner.episodes]
        report[f"iteration {iteration}"] = {
            "steps": learner.steps,
            "steps_per_second": learner.steps / seconds,
            "return": sum(returns) / max(1, len(returns)),
            "stages": {stage: round(value, 2) for stage, value in learner.seconds.items()},
            "approximate_kl": figures["approximate_kl"],
            "memory": memory(settings),
        }
    environments.close()


if __name__ == "__main__":
    chosen = tyro.cli(Settings)
    if chosen.simulate == "cpu":
        if chosen.output is None:
            chosen = replace(chosen, output=Path("gpu_results") / "step6_cpu.json")
        with patch.object(step_module, "physics_of", lambda device: nullcontext()):
            run(chosen, work)
    run(chosen, work)
