"""Searches the recipe of the learned explorers: where ``TrainingConfig``'s defaults come from.

    python benchmarks/recipe_search.py --output search.jsonl --steps 256000 --candidates default slower_adam
    python benchmarks/recipe_search.py --output search.jsonl --steps 800000 --seeds 0 1 --candidates ...
    python benchmarks/recipe_search.py --output search.jsonl --document docs/baselines.md

A candidate is a change of the recipe. It is trained by ``train``, as ``tslam-bench baselines train`` does, on a fixed list of
*train* objects, and then explores a fixed list of *val* objects, by samples of its policy and by the policy's mean. No test
object is used. Its line is written as soon as it is known; a stopped search goes on where it was, candidates of one round
are trained side by side. The first line of the file names the objects. Scripted explorers are candidates too.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from report import machine, markdown_table, replace_section
from rollouts import Hands

from tslam_bench.baselines.training import CURVE_FILE, train
from tslam_bench.baselines.training_config import TrainingConfig
from tslam_bench.constants import HORIZON
from tslam_bench.engine.hand_batch import BatchSettings
from tslam_bench.engine.spaces import OBSERVATION_ARRAYS
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.policies import get_baseline, make_baseline
from tslam_bench.evaluation.policy import Policy
from tslam_bench.grids import merge, world_to_object
from tslam_bench.objects.store import load_object, prepared_names
from tslam_bench.scoring.metrics import TouchCoverage

AIM: Final[dict[str, Any]] = {"initial_aim": (0.0, -0.4, 0.2)}
"""The untrained policy rests on the middle of the workspace."""
BROAD: Final[dict[str, Any]] = {"initial_std": 1.0, "initial_arm_std": 0.3}
"""Fingers move more than the arm."""
CALM: Final[dict[str, Any]] = {**AIM, "initial_arm_std": 0.3, "clock": 5}
"""The arm moves less than the fingers, and the policy is given a clock."""
MYOPIC: Final[dict[str, Any]] = {"gamma": 0.9, "gae_lambda": 0.8}
"""What an action earned soon counts, and little of the noise of all that follows."""
REPEAT: Final[dict[int, dict[str, Any]]] = {
    repeat: {"action_repeat": repeat, "gamma": round(0.97 ** (repeat / 4), 4), "batch_size": 1600 // repeat}
    for repeat in (1, 2, 8)
}
"""Other action repeats with the same discount per control step and as many minibatches."""
CANDIDATES: Final[dict[str, dict[str, Any]]] = {
    "random_targets": {"baseline": "random_targets"},
    "heuristic": {"baseline": "heuristic"},
    "start": {},
    "lr 1e-4": {"learning_rate": 1e-4},
    "3 epochs": {"epochs": 3},
    "10 epochs": {"epochs": 10},
    "std .3": {"initial_std": 0.3, "initial_arm_std": 0.3},
    "std 1": {"initial_std": 1.0, "initial_arm_std": 1.0},
    "gamma .99": {"gamma": 0.99},
    "gamma .9": {"gamma": 0.9},
    "gamma .9, lambda .8": MYOPIC,
    "hand": {"network": "hand"},
    "clip joints": {"clip_each_joint": True},
    "std rate 10": {"std_learning_rate": 10.0},
    "std rate 10, std .4": {"std_learning_rate": 10.0, "initial_std": 0.4, "initial_arm_std": 0.4},
    "state std": {"state_std": True},
    "noise .5": {"noise_correlation": 0.5},
    "noise .8": {"noise_correlation": 0.8},
    "clock": {"clock": 5},
    "clock, std .3": {"clock": 5, "initial_std": 0.3, "initial_arm_std": 0.3},
    "clock, clip joints": {"clock": 5, "clip_each_joint": True},
    "hand, clip joints": {"network": "hand", "clip_each_joint": True},
    "aim": AIM,
    "aim, broad fingers": {**AIM, **BROAD},
    "aim, broad fingers, clock": {**AIM, **BROAD, "clock": 5},
    "aim, broad fingers, clock, no coverage": {**AIM, **BROAD, "clock": 5, "baseline": "tslam_no_coverage"},
    "aim, broad fingers, clock, lambda .02": {**AIM, **BROAD, "clock": 5, "coverage_bonus": 0.015},
    "aim, broad fingers, clock, delta": {**AIM, **BROAD, "clock": 5, "control_mode": "pd_joint_delta_pos"},
    "aim, broad fingers, clock, repeat 1": {**AIM, **BROAD, "clock": 5, **REPEAT[1]},
    "aim, broad fingers, clock, repeat 2": {**AIM, **BROAD, "clock": 5, **REPEAT[2]},
    "aim, broad fingers, clock, repeat 8": {**AIM, **BROAD, "clock": 5, **REPEAT[8]},
    "aim, broad fingers, clock, lr decay": {**AIM, **BROAD, "clock": 5, "final_learning_rate": 0.1},
    "aim, broad fingers, clock, hand": {**AIM, **BROAD, "clock": 5, "network": "hand"},
    "aim, broad fingers, clock, clip joints": {**AIM, **BROAD, "clock": 5, "clip_each_joint": True},
    "aim, broad fingers, gamma .9, lambda .8": {**AIM, **BROAD, **MYOPIC},
    "aim, broad fingers, std rate 10": {**AIM, **BROAD, "std_learning_rate": 10.0},
    "calm": CALM,
    "calm, gamma .9, lambda .8": {**CALM, **MYOPIC},
    "calm, lambda .8": {**CALM, "gae_lambda": 0.8},
    "calm, state std": {**CALM, "state_std": True},
    "calm, repeat 2": {**CALM, "action_repeat": 2, "gamma": 0.985, "batch_size": 800},
    "calm, hand": {**CALM, "network": "hand"},
    "calm, lr 1e-3": {**CALM, "learning_rate": 1e-3, "target_kl": 0.2},
    "calm, 64 hands": {**CALM, "num_envs": 64, "batch_size": 800},
    "calm, gamma .9, lambda .8, lr decay": {**CALM, **MYOPIC, "final_learning_rate": 0.1},
    "calm, gamma .9, lambda .8, std rate 10": {**CALM, **MYOPIC, "std_learning_rate": 10.0},
    "calm, no coverage": {**CALM, "baseline": "tslam_no_coverage"},
    "lr decay": {"final_learning_rate": 0.0},
    "64 hands": {"num_envs": 64, "batch_size": 800},
    "batch 800": {"batch_size": 800},
    "entropy": {"entropy_coefficient": 0.003},
    "repeat 1": REPEAT[1],
    "repeat 2": REPEAT[2],
    "repeat 8": REPEAT[8],
    "delta": {"control_mode": "pd_joint_delta_pos"},
    "no coverage": {"baseline": "tslam_no_coverage"},
    "lambda .02": {"coverage_bonus": 0.015},
}
"""Name -> changes of the recipe that the search began with (``START``)."""
START: Final[dict[str, Any]] = {
    "baseline": "tslam",
    "initial_aim": (0.0, 0.0, 0.0),
    "initial_std": 0.6,
    "initial_arm_std": 0.6,
    "std_learning_rate": 1.0,
    "gamma": 0.97,
    "gae_lambda": 0.95,
    "clock": 0,
}
"""The recipe that the search began with."""


@dataclass(frozen=True)
class Config:
    """Trains candidates and compares them."""

    output: Path
    """JSON lines: the objects first, then one line per candidate, budget and seed."""
    candidates: tuple[str, ...] = ()
    """Names of candidates to train, in this order; those that have their line are left out."""
    steps: int = 256_000
    """Control steps of each."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of each."""
    models: Path = Path("runs/recipe_search")
    """Folder for the trained models."""
    side_by_side: int = 2
    """Candidates that are trained at a time, each with one process that simulates and one thread that learns."""
    train_objects: int = 96
    """Train objects, spread evenly over the names of those that are prepared when the search begins."""
    val_objects: int = 24
    """Val objects, chosen likewise."""
    poses: tuple[int, ...] = (0, 2, 5, 7)
    """Poses in which each val object is explored; by the mean in the first two only."""
    document: Path | None = None
    """Page whose section ``recipe`` is replaced by the table."""


@dataclass(frozen=True)
class Task:
    """One candidate to train and judge."""

    name: str
    steps: int
    seed: int
    models: Path
    train_objects: tuple[str, ...]
    val_objects: tuple[str, ...]
    poses: tuple[int, ...]

    @property
    def key(self) -> tuple[str, int, int]:
        """What a line is found by; scripted explorers have no budget and no seed."""
        return (self.name, self.steps, self.seed)


def spread(names: Sequence[str], count: int) -> tuple[str, ...]:
    """``count`` of the names, evenly spread; all if there are fewer."""
    chosen = np.unique(np.linspace(0, len(names) - 1, min(count, len(names))).round().astype(int))
    return tuple(names[index] for index in chosen)


@cache
def coverage(name: str) -> TouchCoverage:
    """Which touched voxels cover which samples of a val object's surface."""
    return TouchCoverage(load_object(name, "val").surface_points[:20_000])


def explore(explorer: Policy, objects: Sequence[str], poses: Sequence[int]) -> dict[str, float]:
    """Touched voxels per pose with their standard error over objects, and surface touched after one pose and after all."""
    settings = BatchSettings(
        objects=tuple(objects), split="val", control_mode=explorer.control_mode, reward_mode="none"
    )
    hands = Hands(len(objects), settings)
    seen = {name: hands.arrays[name] for name in OBSERVATION_ARRAYS}
    touched: dict[str, list[NDArray[np.bool_]]] = {name: [] for name in objects}
    for pose in poses:
        seeds = [int(seed) for seed in np.random.SeedSequence([pose]).generate_state(len(objects))]
        explorer.reset(len(objects), seeds)
        hands.reset(1000 * pose, objects, [pose] * len(objects))
        for _ in range(HORIZON):
            hands.step(explorer.act(seen))
        for name, grid in zip(objects, hands.arrays["final_occupancy"][:, 0].astype(bool), strict=True):
            touched[name].append(world_to_object(grid, pose))
    means = np.array([np.mean([grid.sum() for grid in grids]) for grids in touched.values()])
    one = [np.mean([coverage(name).recall(grid) for grid in grids]) for name, grids in touched.items()]
    every = [coverage(name).recall(merge(grids)) for name, grids in touched.items()]
    return {
        "touched": round(float(means.mean()), 1),
        "error": round(float(means.std(ddof=1) / np.sqrt(len(means))), 1),
        "recall_1": round(float(np.mean(one)), 4),
        f"recall_{len(poses)}": round(float(np.mean(every)), 4),
    }


def run(task: Task) -> dict[str, Any]:
    """Trains a candidate, or goes on with it, and judges it."""
    torch.set_num_threads(1)
    changes = CANDIDATES[task.name]
    start = time.perf_counter()
    line: dict[str, Any] = {"candidate": task.name, "changes": changes, "steps": task.steps, "seed": task.seed}
    baseline = changes.get("baseline", "tslam")
    if get_baseline(baseline).kind == "scripted":
        line["sampled"] = explore(make_baseline(baseline), task.val_objects, task.poses)
        return line | {"seconds": round(time.perf_counter() - start, 1)}
    recipe = replace(
        TrainingConfig(**(START | changes)),
        steps=task.steps,
        seed=task.seed,
        objects=task.train_objects,
        processes=1,
        torch_threads=1,
    )
    folder = task.models / f"{task.name.replace(' ', '_')}-{task.steps}-{task.seed}"
    metadata = train(recipe, folder)
    curve = [json.loads(text) for text in (folder / CURVE_FILE).read_text(encoding="utf-8").splitlines()]
    last = curve[-max(1, len(curve) // 8) :]
    names = ("episode/touched_voxels", "train/approximate_kl", "train/clip_fraction", "train/std")
    line["train"] = {name.split("/")[1]: round(float(np.mean([entry[name] for entry in last])), 4) for name in names}
    line["train"]["explained_variance"] = round(float(np.mean([e["train/explained_variance"] for e in last])), 3)
    for way, poses in (("sampled", task.poses), ("mean", task.poses[:2])):
        line[way] = explore(make_baseline(baseline, folder, deterministic=way == "mean"), task.val_objects, poses)
    return line | {"train_seconds": metadata["seconds"], "seconds": round(time.perf_counter() - start, 1)}


def section(lines: Sequence[dict[str, Any]], objects: dict[str, Any]) -> str:
    """Markdown of all lines, the best of each budget first."""
    text = (
        f"{objects['machine']}; {len(objects['train'])} train objects, {len(objects['val'])} val objects in poses "
        f"{', '.join(map(str, objects['poses']))}.\n\n"
    )
    header = (
        *("candidate", "seed", "touched voxels, sampled", "by the mean", "surface after 1 / all poses"),
        *("on train", "std", "KL", "clipped", "steps/s"),
    )
    for steps in sorted({line["steps"] for line in lines}, reverse=True):
        rows = []
        chosen = [line for line in lines if line["steps"] == steps]
        for line in sorted(chosen, key=lambda entry: -entry["sampled"]["touched"]):
            sampled, trained = line["sampled"], line.get("train")
            recall = " / ".join(f"{value:.3f}"[1:] for key, value in sampled.items() if key.startswith("recall"))
            row = [
                line["candidate"],
                line["seed"] if trained else "",
                f"{sampled['touched']:.0f} +- {sampled['error']:.0f}",
            ]
            row += [f"{line['mean']['touched']:.0f}" if trained else "", recall]
            names = ("touched_voxels", "std", "approximate_kl", "clip_fraction")
            row += [f"{trained[n]:.{d}f}" for n, d in zip(names, (0, 2, 3, 2), strict=True)] if trained else [""] * 4
            rows.append((*row, f"{line['steps'] / line['train_seconds']:.0f}" if trained else ""))
        title = f"{steps:,} control steps" if steps else "Without training"
        text += f"{title}:\n\n{markdown_table(header, rows)}\n"
    return text


def main(config: Config) -> None:
    """Trains what is missing, prints every line, and writes the table."""
    unknown = [name for name in config.candidates if name not in CANDIDATES]
    if unknown:
        raise InvalidInputError(f"candidate {unknown[0]!r}: unknown; choose from {', '.join(CANDIDATES)}")
    if not config.output.is_file():
        objects = {
            "machine": machine(),
            "train": spread(prepared_names("train"), config.train_objects),
            "val": spread(prepared_names("val"), config.val_objects),
            "poses": config.poses,
        }
        config.output.write_text(json.dumps(objects) + "\n", encoding="utf-8")
    objects, *lines = map(json.loads, config.output.read_text(encoding="utf-8").splitlines())
    done = {(line["candidate"], line["steps"], line["seed"]) for line in lines}
    tasks = []
    for seed in config.seeds:
        for name in config.candidates:
            scripted = get_baseline(CANDIDATES[name].get("baseline", "tslam")).kind == "scripted"
            budget, number = (0, 0) if scripted else (config.steps, seed)
            given = (tuple(objects[key]) for key in ("train", "val", "poses"))
            task = Task(name, budget, number, config.models, *given)
            if task.key not in done:
                done.add(task.key)
                tasks.append(task)
    with ProcessPoolExecutor(config.side_by_side, get_context("spawn")) as pool:
        for future in as_completed([pool.submit(run, task) for task in tasks]):
            lines.append(future.result())
            with config.output.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(lines[-1]) + "\n")
            print(json.dumps(lines[-1]), flush=True)
    if config.document is not None:
        replace_section(config.document, "recipe", section(lines, objects))


if __name__ == "__main__":
    main(tyro.cli(Config))
