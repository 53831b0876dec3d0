"""How fast training is: control steps per second and where the time goes, beside stable-baselines3's stock loop.

    python benchmarks/training.py
    python benchmarks/training.py --document docs/baselines.md --output training.json

Everything is included: simulating, resets, copying observations, choosing actions, learning, logging. The first side is
``tslam-bench baselines train`` with its default recipe. The second is PPO of stable-baselines3 as this benchmark used it
before: its own loop through the adapter, a decision in every control step, five passes in minibatches of 400, one torch
thread, six 3D convolutions that stride by 4 at once. Both train on the same objects with as many hands. Ends with one JSON line.
"""

from __future__ import annotations

import json
import statistics
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from gymnasium import spaces
from report import machine, markdown_table, print_table, replace_section, write_json
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
from torch import Tensor

from tslam_bench.baselines.network import VELOCITY_SCALE, ConvolutionTrunk
from tslam_bench.baselines.ppo import STAGES
from tslam_bench.baselines.sb3_adapter import TactileVecEnv
from tslam_bench.baselines.training import CURVE_FILE, make_training_environments, train
from tslam_bench.baselines.training_config import TrainingConfig
from tslam_bench.hand_constants import JOINT_LIMITS
from tslam_bench.objects.store import list_objects

_COLUMNS = ("simulate", "copy", "infer", "learn", "rest")
"""Stages; ``copy`` brings observations into the rollout buffer, ``rest`` is logging and what nobody timed."""


@dataclass(frozen=True)
class Config:
    """Measures and compares."""

    objects: tuple[str, ...] = ()
    """Train objects; empty: all that are prepared."""
    iterations: int = 6
    """Iterations of our trainer that are measured, after one that warms up; medians count."""
    stock_iterations: int = 1
    """Iterations of stable-baselines3 that are measured, after one that warms up; 0 leaves it out."""
    network: str = "fast"
    """Network of our trainer."""
    torch_threads: int = 2
    """Threads of our trainer."""
    processes: int | None = None
    """Worker processes; default: the cores."""
    output: Path | None = None
    """JSON file for all figures."""
    document: Path | None = None
    """Page whose section ``training`` is replaced by what was measured."""


class PreviousExtractor(BaseFeaturesExtractor):
    """The features of the network that stable-baselines3 trained here before: a convolution that strides by 4, then five."""

    def __init__(self, observation_space: spaces.Dict) -> None:
        flat = sum(int(np.prod(box.shape or ())) for key, box in observation_space.spaces.items() if key != "occupancy")
        trunk = ConvolutionTrunk((8, 8, 16, 16, 32, 32), (4, 3, 3, 3, 3, 3), (4, 1, 2, 1, 2, 1))
        super().__init__(observation_space, trunk.out_features + flat)
        self.trunk = trunk
        limits = torch.as_tensor(np.asarray(JOINT_LIMITS, dtype=np.float32))
        self.middle, self.half_range = limits.mean(dim=1), (limits[:, 1] - limits[:, 0]) / 2

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Entries (n, ...) -> (n, features)."""
        qpos = (observations["qpos"] - self.middle) / self.half_range
        others = [qpos, observations["qvel"] / VELOCITY_SCALE, observations["time"], observations["touch"].float()]
        return torch.cat([self.trunk.convolve(observations["occupancy"].float()), *others], dim=1)


class _Clock(BaseCallback):
    """Seconds of each collection and of each iteration."""

    def __init__(self) -> None:
        super().__init__()
        self.starts: list[float] = []
        self.collected: list[float] = []

    def _on_rollout_start(self) -> None:
        self.starts.append(time.perf_counter())

    def _on_rollout_end(self) -> None:
        self.collected.append(time.perf_counter() - self.starts[-1])

    def _on_step(self) -> bool:
        return True


def our_side(config: Config) -> dict[str, float]:
    """Control steps per second of ``train``, and microseconds per control step by stage."""
    recipe = TrainingConfig(
        "tslam",
        objects=config.objects,
        network=config.network,  # type: ignore[arg-type]
        torch_threads=config.torch_threads,
        processes=config.processes,
    )
    recipe = replace(recipe, steps=(1 + config.iterations) * recipe.iteration_steps)
    with tempfile.TemporaryDirectory() as folder:
        train(recipe, Path(folder))
        curve = [json.loads(line) for line in (Path(folder) / CURVE_FILE).read_text(encoding="utf-8").splitlines()]
    stages: dict[str, list[float]] = {name: [] for name in _COLUMNS}
    rates = [line["time/steps_per_second"] for line in curve[1:]]
    for before, after, rate in zip(curve, curve[1:], rates, strict=False):
        spent = {
            stage: 1e6 * (after[f"time/{stage}_seconds"] - before[f"time/{stage}_seconds"]) / recipe.iteration_steps
            for stage in STAGES
        }
        spent["copy"] = spent.pop("encode")
        spent["rest"] = 1e6 / rate - sum(spent.values())
        for name, value in spent.items():
            stages[name].append(value)
    medians = {name: round(statistics.median(values), 1) for name, values in stages.items()}
    return {
        "steps_per_second": round(statistics.median(rates), 1),
        "lowest": min(rates),
        "highest": max(rates),
        **medians,
    }


def stock_side(config: Config) -> dict[str, float]:
    """The same of stable-baselines3; collecting is not told apart further."""
    recipe = TrainingConfig(
        "tslam",
        objects=config.objects,
        control_mode="pd_joint_delta_pos",
        action_repeat=1,
        processes=config.processes,
    )
    torch.set_num_threads(1)
    vec = VecNormalize(VecMonitor(TactileVecEnv(make_training_environments(recipe), seed=0)), norm_obs=False)
    clock = _Clock()
    try:
        model = PPO(
            "MultiInputPolicy",
            vec,
            n_steps=recipe.decisions,
            batch_size=400,
            n_epochs=5,
            seed=0,
            device="cpu",
            policy_kwargs={
                "features_extractor_class": PreviousExtractor,
                "net_arch": {"pi": [128, 128, 128], "vf": [128, 128, 128]},
            },
        )
        model.learn((1 + config.stock_iterations) * recipe.iteration_steps, callback=clock)
        end = time.perf_counter()
    finally:
        vec.close()
    seconds = np.diff([*clock.starts, end])[1:]
    collected = np.array(clock.collected[1:])
    per_step = 1e6 / recipe.iteration_steps
    return {
        "steps_per_second": round(float(np.median(recipe.iteration_steps / seconds)), 1),
        "collect": round(float(np.median(collected)) * per_step, 1),
        "learn": round(float(np.median(seconds - collected)) * per_step, 1),
    }


def section(config: Config, result: dict[str, Any]) -> str:
    """Markdown of what was measured."""
    ours, stock = result["ours"], result["stock"]
    lines = f"{result['machine']}; {result['objects']} train objects, 32 hands. Microseconds per control step.\n\n"
    simulate, *others = (f"{ours[name]:.0f}" for name in _COLUMNS)
    rows = [
        (f"`{config.network}`, {config.torch_threads} threads", f"{ours['steps_per_second']:.0f}", simulate, *others)
    ]
    if stock:
        collect, learn = f"{stock['collect']:.0f} in all", f"{stock['learn']:.0f}"
        rows.append(("stable-baselines3 as before", f"{stock['steps_per_second']:.0f}", collect, "", "", learn, ""))
    lines += markdown_table(("trainer", "control steps per second", *_COLUMNS), rows)
    return lines + (f"\n{result['ratio']:.1f} times as fast.\n" if stock else "")


def main(config: Config) -> None:
    """Prints a table and one JSON line."""
    result: dict[str, Any] = {"machine": machine(), "objects": len(config.objects or list_objects("train"))}
    result["ours"] = our_side(config)
    result["stock"] = stock_side(config) if config.stock_iterations else None
    if result["stock"]:
        result["ratio"] = round(result["ours"]["steps_per_second"] / result["stock"]["steps_per_second"], 2)
    text = section(config, result)
    table = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")
    ]
    print_table(table[0], table[2:], "training")
    if config.document is not None:
        replace_section(config.document, "training", text)
    write_json(config.output, result)
    print(json.dumps(result))


if __name__ == "__main__":
    main(tyro.cli(Config))
