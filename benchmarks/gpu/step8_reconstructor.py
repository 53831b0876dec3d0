"""Step 8: how fast the paper's reconstructor learns on the card; needs no GPU physics.

python benchmarks/gpu/step8_reconstructor.py
"""

from __future__ import annotations

import os
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Literal
from unittest.mock import patch

import numpy as np
import step as step_module
import torch
import torch.nn.functional as functional
import tyro
from step import Report, Step, memory, run, synchronise, tensor_device

from tslam_bench.reconstruction.learned import build_network, network_config
from tslam_bench.reconstruction.training import draw_batch, learning_rate
from tslam_bench.reconstruction.training_config import TrainingConfig
from tslam_bench.reconstruction.training_objects import load_training_shapes, training_names


@dataclass(frozen=True)
class Settings(Step):
    """Trains until the time is over; worker processes draw the examples."""

    size: Literal["small", "paper"] = "paper"
    """Size of ifnet."""
    steps: int = 3000
    """Optimiser steps at most."""
    batch_size: int = 32
    """Examples per step."""
    split: str = "train"
    """Split to learn from."""
    count: int = 200
    """Objects."""
    processes: int = os.cpu_count() or 1
    """Processes that draw examples."""


_shapes: list = []


def _load(split: str, count: int) -> None:
    _shapes[:] = load_training_shapes(training_names(split, count, ()), split, 0)


def _draw(config: TrainingConfig, step: int):
    return draw_batch(_shapes, config, np.random.Generator(np.random.PCG64([config.seed, 1, step])))


def work(settings: Settings, report: Report) -> None:
    """Loss and steps per second, and how long the card waited for examples."""
    config = TrainingConfig("ifnet", settings.size, steps=settings.steps, batch_size=settings.batch_size)
    device = tensor_device(settings)
    network = build_network("ifnet", network_config("ifnet", settings.size), 0).to(device)
    report["parameters"] = sum(parameter.numel() for parameter in network.parameters())
    optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    waited, start, losses = 0.0, time.perf_counter(), []
    arguments = (settings.split, settings.count)
    with ProcessPoolExecutor(settings.processes, initializer=_load, initargs=arguments) as pool:
        ahead = [pool.submit(_draw, config, step) for step in range(min(2 * settings.processes, config.steps))]
        for step in range(config.steps):
            before = time.perf_counter()
            batch = ahead.pop(0).result()
            waited += time.perf_counter() - before
            if step + 2 * settings.processes < config.steps:
                ahead.append(pool.submit(_draw, config, step + 2 * settings.processes))
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(config, step)
            grids, points, labels = (torch.from_numpy(a).to(device) for a in (batch.grids, batch.points, batch.labels))
            loss = functional.binary_cross_entropy_with_logits(network(grids, points), labels)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.detach())
            if (step + 1) % 100 == 0 or step + 1 == config.steps:
                synchronise(settings)
                report["progress"] = {
                    "steps": step + 1,
                    "loss": float(torch.stack(losses[-100:]).mean()),
                    "steps_per_second": (step + 1) / (time.perf_counter() - start),
                    "waited for examples": waited,
                    "memory": memory(settings),
                }


if __name__ == "__main__":
    with patch.object(step_module, "physics_of", lambda device: nullcontext()):
        run(tyro.cli(Settings), work)
