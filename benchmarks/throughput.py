"""Control steps per second: the batched CPU engine beside ManiSkill environments, in one run, on all cores.

    python benchmarks/throughput.py --steps 20000

Everything is included: actions in, observations and rewards out, resets. All sides explore the same ten test objects with
the same kind of actions (random, the hand sent down onto the object at first). Ends with one JSON line.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import gymnasium as gym
import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table

import tslam_bench
from tslam_bench.constants import ENVIRONMENT_ID, HORIZON, NUM_JOINTS
from tslam_bench.tasks.batch import BatchSettings, HandBatch, batch_arrays

TEN_OBJECTS = (
    *("mug", "stanfordbunny", "toruslarge", "wineglass", "hammer"),
    *("cubemedium", "apple", "camera", "scissors", "teapot"),
)


@dataclass(frozen=True)
class Config:
    """Measures and compares."""

    objects: tuple[str, ...] = TEN_OBJECTS
    """Test objects, drawn by each episode."""
    num_envs: int = 32
    """Environments of the batched engine."""
    processes: int = len(os.sched_getaffinity(0))
    """Processes on both sides."""
    steps: int = 20_000
    """Control steps of the batched engine; the others do a quarter."""
    reward_mode: str = "tslam"
    """Reward mode."""


def actions(generator: np.random.Generator, num_envs: int, step: int) -> np.ndarray:
    """(num_envs, 28) random actions that send the hand down in the first quarter of an episode."""
    value = generator.uniform(-1, 1, (num_envs, NUM_JOINTS)).astype(np.float32)
    if step % HORIZON < HORIZON // 4:
        value[:, 1] = -1.0
    return value


def rate(step: Callable[[np.ndarray], object], num_envs: int, total: int) -> float:
    """Control steps per second over whole episodes, after one episode to warm up."""
    generator = np.random.Generator(np.random.PCG64(0))
    rounds = max(1, round(total / (num_envs * HORIZON))) * HORIZON
    for index in range(HORIZON):
        step(actions(generator, num_envs, index))
    start = time.perf_counter()
    for index in range(rounds):
        step(actions(generator, num_envs, index))
    return num_envs * rounds / (time.perf_counter() - start)


def engine_rate(config: Config) -> float:
    """The batched CPU engine."""
    envs = tslam_bench.make_vec(
        num_envs=config.num_envs,
        device="cpu",
        objects=config.objects,
        reward_mode=config.reward_mode,
        processes=config.processes,
    )
    envs.reset(seed=0)
    result = rate(envs.step, config.num_envs, config.steps)
    envs.close()
    return result


class _Unbatched(gym.Wrapper):
    """A ManiSkill environment as AsyncVectorEnv wants it: numpy without the batch dimension."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.observation_space = env.unwrapped.single_observation_space
        self.action_space = env.unwrapped.single_action_space

    def reset(self, **kwargs):
        observation, _ = self.env.reset(**kwargs)
        return {key: value[0].numpy() for key, value in observation.items()}, {}

    def step(self, action):
        observation, reward, terminated, truncated, _ = self.env.step(action)
        plain = {key: value[0].numpy() for key, value in observation.items()}
        return plain, float(reward), bool(terminated), bool(truncated), {}


def _make_unbatched(objects: tuple[str, ...], reward_mode: str) -> gym.Env:
    torch.set_num_threads(1)
    return _Unbatched(gym.make(ENVIRONMENT_ID, objects=objects, reward_mode=reward_mode))


def maniskill_rate(config: Config) -> float:
    """The same task as ManiSkill environments in Gymnasium's AsyncVectorEnv, one per process."""
    make = partial(_make_unbatched, config.objects, config.reward_mode)
    envs = gym.vector.AsyncVectorEnv([make] * config.processes, context="spawn")
    envs.reset(seed=0)
    result = rate(envs.step, config.processes, config.steps // 4)
    envs.close()
    return result


def single_rate(config: Config) -> float:
    """One ManiSkill environment in this process."""
    env = _make_unbatched(config.objects, config.reward_mode)
    env.reset(seed=0)

    def step(action: np.ndarray) -> None:
        if env.step(action[0])[3]:
            env.reset()

    result = rate(step, 1, config.steps // 8)
    env.close()
    return result


def breakdown(config: Config) -> dict[str, float]:
    """Microseconds per control step of each stage in one process of the engine."""
    num_envs = max(1, config.num_envs // config.processes)
    arrays = {name: np.zeros((num_envs, *shape), dtype) for name, (shape, dtype) in batch_arrays().items()}
    batch = HandBatch(num_envs, BatchSettings(objects=config.objects, reward_mode=config.reward_mode), arrays)
    spent = {"physics": 0.0, "drive targets": 0.0, "reading state": 0.0, "sensing": 0.0, "rewards": 0.0, "reset": 0.0}

    def timed(owner: object, name: str, stage: str) -> None:
        inner = getattr(owner, name)

        def outer(*args, **kwargs):
            start = time.perf_counter()
            try:
                return inner(*args, **kwargs)
            finally:
                spent[stage] += time.perf_counter() - start

        setattr(owner, name, outer)

    for scene in batch._scenes:
        timed(scene, "step", "physics")
        timed(scene, "set_targets", "drive targets")
        timed(scene, "read", "reading state")
    timed(batch._sensing, "step", "sensing")
    if batch._rewards is not None:
        timed(batch._rewards, "step", "rewards")
    timed(batch, "_start_anew", "reset")
    batch.reset(list(range(num_envs)), range(num_envs))

    def step(action: np.ndarray) -> None:
        arrays["action"][:] = action
        batch.step()

    generator = np.random.Generator(np.random.PCG64(0))
    for index in range(HORIZON):
        step(actions(generator, num_envs, index))
    for stage in spent:
        spent[stage] = 0.0
    start = time.perf_counter()
    for index in range(2 * HORIZON):
        step(actions(generator, num_envs, index))
    total = time.perf_counter() - start
    per_step = {stage: 1e6 * seconds / (2 * HORIZON * num_envs) for stage, seconds in spent.items()}
    per_step["all"] = 1e6 * total / (2 * HORIZON * num_envs)
    return {stage: round(value, 1) for stage, value in per_step.items()}


def main(config: Config) -> None:
    """Prints a table and one JSON line."""
    torch.set_num_threads(1)
    engine = engine_rate(config)
    maniskill = maniskill_rate(config)
    single = single_rate(config)
    stages = breakdown(config)
    table = Table("what", "control steps per second", "engine is faster by")
    table.add_row(f"engine, {config.num_envs} environments, {config.processes} processes", f"{engine:.0f}", "")
    table.add_row(f"AsyncVectorEnv, {config.processes} processes", f"{maniskill:.0f}", f"{engine / maniskill:.2f}")
    table.add_row("one ManiSkill environment", f"{single:.0f}", f"{engine / single:.2f}")
    console = Console()
    console.print(table)
    parts = Table("stage of the engine", "microseconds per control step, one process")
    for stage, value in stages.items():
        parts.add_row(stage, f"{value:.1f}")
    console.print(parts)
    print(
        json.dumps(
            {
                "engine": round(engine, 1),
                "maniskill_async": round(maniskill, 1),
                "maniskill_single": round(single, 1),
                "engine_over_maniskill": round(engine / maniskill, 2),
                "num_envs": config.num_envs,
                "processes": config.processes,
                "reward_mode": config.reward_mode,
                "microseconds": stages,
            }
        )
    )


if __name__ == "__main__":
    main(tyro.cli(Config))
