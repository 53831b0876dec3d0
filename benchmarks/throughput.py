"""Control steps per second: the CPU engine beside ManiSkill environments and a MuJoCo peer, in one run, on all cores.

    python benchmarks/throughput.py
    python benchmarks/throughput.py --modes --scaling --document docs/speed.md --output speed.json

Everything is included: actions in, observations and rewards out, resets. All sides explore the same ten test objects with
the same kind of actions (random, the hand sent down onto the object at first). The sides take turns for several rounds, so
that whatever else the machine does hits all of them; medians over the rounds count. Ends with one JSON line.
"""

from __future__ import annotations

import json
import os
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import tyro
from mujoco_peer import EQUAL_PENETRATION, MujocoSettings, with_mujoco
from report import machine, markdown_table, print_table, replace_section, write_json
from rollouts import TEN_OBJECTS, exploring_actions
from stages import STAGES, stage_costs
from tqdm import tqdm

import tslam_bench
from tslam_bench.constants import ENVIRONMENT_ID, HORIZON, REWARD_MODES
from tslam_bench.engine.hand_batch import BatchSettings
from tslam_bench.engine.worker_vector_env import TactileVectorEnv
from tslam_bench.wrappers import NumpyEnv

MUJOCO_USUAL = MujocoSettings(substeps=15)
"""MuJoCo at its usual time step of 2 ms, with its own contact softness."""
SCALES = (1, 8, 32, 128)
"""Environments that ``--scaling`` measures."""


@dataclass(frozen=True)
class Config:
    """Measures and compares."""

    objects: tuple[str, ...] = TEN_OBJECTS
    """Test objects, drawn by each episode."""
    num_envs: int = 32
    """Environments of the engine and of its MuJoCo peer."""
    processes: int = len(os.sched_getaffinity(0))
    """Processes of each side."""
    rounds: int = 3
    """Rounds; in each of them every side has its turn."""
    episodes: int = 2
    """Episodes per environment, round and side; ManiSkill's sides, which have fewer environments, do twice as many."""
    reward_mode: str = "tslam"
    """Reward mode of the comparison."""
    modes: bool = False
    """Also compare the reward modes with each other."""
    scaling: bool = False
    """Also measure the cost per stage with 1, 8, 32 and 128 environments."""
    output: Path | None = None
    """JSON file for all figures."""
    document: Path | None = None
    """Page whose sections ``speed``, ``stages``, ``modes`` and ``scaling`` are replaced by what was measured."""


@dataclass
class Side:
    """One competitor: environments that are ready to step.

    Attributes:
        num_envs: environments that one call of ``step`` steps.
        episodes: episodes per environment in a round.
        step: takes (num_envs, 28) actions.
        close: frees the environments.
        rates: control steps per second of the rounds so far.
    """

    num_envs: int
    episodes: int
    step: Callable[[np.ndarray], object]
    close: Callable[[], None]
    rates: list[float] = field(default_factory=list)

    def run(self, seed: int, episodes: int | None = None) -> float:
        """Control steps per second over whole episodes."""
        generator = np.random.Generator(np.random.PCG64(seed))
        count = (self.episodes if episodes is None else episodes) * HORIZON
        start = time.perf_counter()
        for index in range(count):
            self.step(exploring_actions(generator, self.num_envs, index))
        return self.num_envs * count / (time.perf_counter() - start)

    def summary(self) -> dict[str, float]:
        """Median, lowest and highest rate of the rounds."""
        low, high = min(self.rates), max(self.rates)
        return {"median": round(statistics.median(self.rates), 1), "min": round(low, 1), "max": round(high, 1)}


class _WithoutInfo(NumpyEnv):
    """``info`` is left out: gathering it would cost AsyncVectorEnv time."""

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        return super().reset(**arguments)[0], {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return (*super().step(action)[:4], {})


def _make_unbatched(objects: tuple[str, ...], reward_mode: str) -> gym.Env:
    torch.set_num_threads(1)
    return _WithoutInfo(gym.make(ENVIRONMENT_ID, objects=objects, reward_mode=reward_mode))


def _vector_side(envs: gym.vector.VectorEnv, config: Config, episodes: int) -> Side:
    for name in config.objects:  # cooks, compiles and loads each object once
        envs.reset(seed=0, options={"object": name})
    envs.reset(seed=0)
    return Side(envs.num_envs, episodes, envs.step, envs.close)


def engine_side(config: Config, reward_mode: str | None = None) -> Side:
    """The CPU engine."""
    envs = tslam_bench.make_vec(
        num_envs=config.num_envs,
        device="cpu",
        objects=config.objects,
        reward_mode=reward_mode or config.reward_mode,
        processes=config.processes,
    )
    return _vector_side(envs, config, config.episodes)


def mujoco_side(config: Config, settings: MujocoSettings) -> Side:
    """The same engine on MuJoCo's physics."""
    batch = with_mujoco(BatchSettings(objects=config.objects, reward_mode=config.reward_mode), settings)
    envs = TactileVectorEnv(config.num_envs, batch, config.processes)
    return _vector_side(envs, config, config.episodes)


def maniskill_side(config: Config) -> Side:
    """The same task as ManiSkill environments in Gymnasium's AsyncVectorEnv, one per process."""
    make = partial(_make_unbatched, config.objects, config.reward_mode)
    envs = gym.vector.AsyncVectorEnv([make] * config.processes, context="spawn")
    return _vector_side(envs, config, 2 * config.episodes)


def single_side(config: Config) -> Side:
    """One ManiSkill environment in this process."""
    env = _make_unbatched(config.objects, config.reward_mode)
    for name in config.objects:
        env.reset(seed=0, options={"object": name})
    env.reset(seed=0)

    def step(action: np.ndarray) -> None:
        if env.step(action[0])[3]:
            env.reset()

    return Side(1, 2 * config.episodes, step, env.close)


def take_turns(makers: Mapping[str, Callable[[], Side]], rounds: int, description: str) -> dict[str, Side]:
    """Makes every side, warms it up for an episode, and measures all of them in turn for ``rounds`` rounds."""
    sides: dict[str, Side] = {}
    try:
        for name, make in makers.items():
            sides[name] = make()
            sides[name].run(seed=0, episodes=1)
        for index in tqdm(range(rounds), desc=description):
            for side in sides.values():
                side.rates.append(side.run(seed=1 + index))
    finally:
        for side in sides.values():
            side.close()
    return sides


def compare_sides(config: Config) -> dict[str, Any]:
    """Control steps per second of every side, and the engine's ratio to each."""
    makers = {
        "engine": partial(engine_side, config),
        "maniskill_async": partial(maniskill_side, config),
        "maniskill_single": partial(single_side, config),
        "mujoco_same_substeps": partial(mujoco_side, config, MujocoSettings()),
        "mujoco_equal_penetration": partial(mujoco_side, config, EQUAL_PENETRATION),
        "mujoco_2ms": partial(mujoco_side, config, MUJOCO_USUAL),
    }
    sides = take_turns(makers, config.rounds, "rounds")
    engine = sides["engine"].rates
    # A ratio per round, as neighbours in time share their disturbances; then the median.
    ratios = {
        f"engine_over_{name}": round(statistics.median(a / b for a, b in zip(engine, side.rates, strict=True)), 3)
        for name, side in sides.items()
        if name != "engine"
    }
    return {"steps_per_second": {name: side.summary() for name, side in sides.items()}, "ratios": ratios}


def compare_stages(config: Config) -> dict[str, Any]:
    """Cost of each stage in one process, engine and MuJoCo peer, and the sensing's share of the physics."""
    num_envs = max(1, config.num_envs // config.processes)
    settings = BatchSettings(objects=config.objects, reward_mode=config.reward_mode)
    engine = stage_costs(num_envs, settings)
    mujoco = stage_costs(num_envs, with_mujoco(settings, MujocoSettings()))
    share = (engine["sensing"] + engine["rewards"]) / engine["physics"]
    rounded = [{stage: round(value, 1) for stage, value in costs.items()} for costs in (engine, mujoco)]
    return {
        "num_envs": num_envs,
        "microseconds": rounded[0],
        "mujoco_microseconds": rounded[1],
        "sensing_and_rewards_over_physics": round(share, 3),
    }


def compare_modes(config: Config) -> dict[str, dict[str, float]]:
    """Control steps per second of every reward mode, and relative to the default mode."""
    modes = {mode: partial(engine_side, config, mode) for mode in REWARD_MODES}
    sides = take_turns(modes, config.rounds, "reward modes")
    default = sides[REWARD_MODES[0]].rates
    return {
        mode: {
            **side.summary(),
            "relative": round(statistics.median(a / b for a, b in zip(side.rates, default, strict=True)), 3),
        }
        for mode, side in sides.items()
    }


def compare_scales(config: Config) -> dict[int, dict[str, float]]:
    """Cost of each stage in one process against the number of environments."""
    settings = BatchSettings(objects=config.objects, reward_mode=config.reward_mode)
    scales = tqdm(SCALES, desc="environments")
    return {
        count: {stage: round(value, 1) for stage, value in stage_costs(count, settings).items()} for count in scales
    }


_LABELS = {
    "engine": "engine",
    "maniskill_async": "ManiSkill environments in AsyncVectorEnv",
    "maniskill_single": "one ManiSkill environment",
    "mujoco_same_substeps": "MuJoCo, same substeps, its own contact softness",
    "mujoco_equal_penetration": f"MuJoCo, no deeper penetration ({EQUAL_PENETRATION.substeps} substeps, stiff)",
    "mujoco_2ms": "MuJoCo, time step 2 ms, its own contact softness",
}


def _conditions(config: Config, result: dict[str, Any]) -> str:
    engine = (
        f"{config.num_envs} environments (engine, MuJoCo), {config.processes} processes, {len(config.objects)} objects"
    )
    return f"{result['machine']}; {engine}; {config.rounds} rounds, median (lowest to highest).\n\n"


def sections(config: Config, result: dict[str, Any]) -> dict[str, str]:
    """Markdown of each section that was measured."""
    rows = []
    for name, rate in result["steps_per_second"].items():
        ratio = result["ratios"].get(f"engine_over_{name}")
        spread = f"{rate['median']:.0f} ({rate['min']:.0f} to {rate['max']:.0f})"
        rows.append((_LABELS[name], spread, "" if ratio is None else f"{ratio:.2f}"))
    header = ("what", "control steps per second", "engine is faster by")
    found = {"speed": _conditions(config, result) + markdown_table(header, rows)}
    stages = result["stages"]
    costs = [stages["microseconds"], stages["mujoco_microseconds"]]
    table = markdown_table(
        ("stage", "engine (us)", "MuJoCo peer (us)"),
        [(stage, *(f"{cost[stage]:.0f}" for cost in costs)) for stage in (*STAGES, "all")],
    )
    share = f"\nSensing and rewards cost {100 * stages['sensing_and_rewards_over_physics']:.0f} % of the physics.\n"
    found["stages"] = table + share
    if "modes" in result:
        rows = [
            (f"`{mode}`", f"{rate['median']:.0f} ({rate['min']:.0f} to {rate['max']:.0f})", f"{rate['relative']:.2f}")
            for mode, rate in result["modes"].items()
        ]
        found["modes"] = markdown_table(("reward mode", "control steps per second", "relative to the default"), rows)
    if "scaling" in result:
        rows = [(count, *(f"{cost[s]:.0f}" for s in (*STAGES, "all"))) for count, cost in result["scaling"].items()]
        found["scaling"] = markdown_table(("environments", *STAGES, "all"), rows)
    return found


def _print(found: Mapping[str, str]) -> None:
    for name, text in found.items():
        lines = [line for line in text.splitlines() if line.startswith("|")]
        header, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
        print_table(header, rows, name)


def main(config: Config) -> None:
    """Prints tables and one JSON line."""
    torch.set_num_threads(1)
    result: dict[str, Any] = {"machine": machine(), **compare_sides(config), "stages": compare_stages(config)}
    if config.modes:
        result["modes"] = compare_modes(config)
    if config.scaling:
        result["scaling"] = compare_scales(config)
    for name in ("num_envs", "processes", "rounds", "reward_mode"):
        result[name] = getattr(config, name)
    found = sections(config, result)
    _print(found)
    if config.document is not None:
        for name, text in found.items():
            replace_section(config.document, name, text)
    write_json(config.output, result)
    print(json.dumps(result))


if __name__ == "__main__":
    main(tyro.cli(Config))
