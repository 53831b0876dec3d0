"""Trains a learned baseline with PPO (protocol section 11): environments, checkpoints, logs and the finished model.

A run is cut into chunks of ``checkpoint_every`` steps. Each chunk starts from a checkpoint, with freshly reset
environments and random numbers seeded from (seed, steps so far): a run that was killed and resumed ends with the same
weights, bit for bit, as one that was not.
"""

from __future__ import annotations

import dataclasses
import io
import json
import os
import platform
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from gymnasium.vector import VectorEnv

from tslam_bench.constants import ENVIRONMENT_ID, NUM_JOINTS
from tslam_bench.curves import Curves
from tslam_bench.engine.gpu_physics import simulation_device
from tslam_bench.engine.rewards import COVERAGE_WEIGHT
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.evaluation.policies import get_baseline
from tslam_bench.evaluation.weights import METADATA_FILE
from tslam_bench.files import atomic_directory, ensure_writable_directory, write_json, writing
from tslam_bench.hand_constants import ARM_JOINTS, JOINT_NAMES
from tslam_bench.machine import processor_name, source_commit
from tslam_bench.objects.store import asset_sha256, list_objects
from tslam_bench.registration import make_vec
from tslam_bench.version import __version__

from .model_files import make_network, write_model
from .network import PolicyNetwork
from .ppo import PPO
from .training_config import PAPER_STEPS, TrainingConfig

CHECKPOINT_STATE: Final = "state.json"
CHECKPOINT_TENSORS: Final = "state.pt"
CURVE_FILE: Final = "curve.jsonl"
"""One line per iteration: what TensorBoard gets, for programs."""
Report = Callable[[int, dict[str, float]], None]
"""Called with the control steps so far and the figures of the last iteration, empty during the first."""


def train(config: TrainingConfig, output: Path, command: str = "", on_progress: Report | None = None) -> dict[str, Any]:
    """Trains, or goes on with, the run in ``output``; a finished one is left as it is.

    Writes ``model.safetensors``, ``model.json`` (the returned metadata), ``curve.jsonl``, ``tensorboard/`` and, while it
    runs, ``checkpoints/<steps>/``.

    Args:
        config: the recipe.
        output: the model's directory.
        command: command line to record.
        on_progress: called after every decision.

    Returns:
        Metadata: recipe, steps, seconds, mean return of the last iteration, machine, versions, command.

    Raises:
        InvalidInputError: a setting is unusable, or ``output`` holds a run with other settings.
        AssetError: ``output`` cannot be written, or the split is not prepared.
    """
    config.check()
    output = Path(output)
    metadata_path = output / METADATA_FILE
    if metadata_path.is_file():
        metadata = json.loads(metadata_path.read_text(encoding="utf-8"))
        _check_same_settings(config, metadata["config"], output)
        return metadata
    assets = _assets(config)
    ensure_writable_directory(output)
    checkpoint = _last_checkpoint(output)
    state = json.loads((checkpoint / CHECKPOINT_STATE).read_text(encoding="utf-8")) if checkpoint else None
    if state is not None:
        _check_same_settings(config, state["config"], output)
        if state["assets"] != assets:
            raise InvalidInputError(f"{output}: was begun with other objects; delete it or choose another output")

    threads = torch.get_num_threads()
    environments = make_training_environments(config)
    try:
        network = untrained_network(config)
        learner = PPO(config, environments, network, learning_device(config))
        if checkpoint is not None and state is not None:
            tensors = torch.load(checkpoint / CHECKPOINT_TENSORS, map_location=learner.device, weights_only=True)
            learner.load_state(tensors)
        log = _Log(config, output, learner, state)
        with log:
            while learner.steps < config.total_steps:
                _learn_chunk(learner, config, log, on_progress)
                if learner.steps < config.total_steps:
                    _save_checkpoint(learner, config, assets, output, log)
    finally:
        environments.close()
        torch.set_num_threads(threads)

    spec = get_baseline(config.baseline)
    metadata = {
        "baseline": spec.id,
        "reward_mode": spec.reward_mode,
        "privileged": spec.privileged,
        "control_mode": config.control_mode,
        "action_repeat": config.action_repeat,
        "config": _plain(config),
        "assets": assets,
        "steps": learner.steps,
        "paper_steps": PAPER_STEPS,
        "seed": config.seed,
        "seconds": round(log.seconds, 1),
        "mean_return": log.mean_return,
        "machine": machine_description(),
        "commit": source_commit(),
        "versions": {
            "tslam_bench": __version__,
            "torch": str(torch.__version__),
            "python": platform.python_version(),
        },
        "command": command or " ".join(sys.argv),
    }
    write_model(output, network, metadata)
    shutil.rmtree(output / "checkpoints", ignore_errors=True)
    return metadata


def untrained_network(config: TrainingConfig) -> PolicyNetwork:
    """The policy that a run begins with; its weights are drawn from the run's seed."""
    arm = [JOINT_NAMES.index(name) for name in ARM_JOINTS[:3]]
    std = np.full(NUM_JOINTS, config.initial_std, dtype=np.float32)
    std[arm] = config.initial_arm_std
    mean = np.zeros(NUM_JOINTS, dtype=np.float32)
    if config.control_mode == "pd_joint_pos":  # where the palm rests on what lies in the workspace
        mean[arm] = config.initial_aim
    return make_network(config.network, std.tolist(), config.seed, config.state_std, config.clock, mean.tolist())


def make_training_environments(config: TrainingConfig) -> VectorEnv:
    """The environments of a run: objects and poses drawn per episode; a step is a decision."""
    return make_vec(
        ENVIRONMENT_ID,
        config.num_envs,
        config.device,
        objects=config.objects or None,
        split=config.split,
        reward_mode=get_baseline(config.baseline).reward_mode or "none",
        control_mode=config.control_mode,
        processes=config.processes,
        action_repeat=config.action_repeat,
    )


def learning_device(config: TrainingConfig) -> str:
    """``cpu`` or ``cuda``: where ``make_vec`` simulates, there the network learns."""
    return simulation_device(config.device, ENVIRONMENT_ID)


def machine_description() -> dict[str, Any]:
    """Kind of machine: system, processor and cores."""
    return {"system": platform.system(), "processor": processor_name(), "cores": os.cpu_count()}


class _Log:
    """TensorBoard, the curve file and the clock of a run; a resumed run goes on with those of the checkpoint."""

    def __init__(self, config: TrainingConfig, output: Path, learner: PPO, state: dict[str, Any] | None) -> None:
        self._learner = learner
        self._has_coverage = get_baseline(config.baseline).reward_mode != "no_coverage"
        self._seconds_before = float(state["seconds"]) if state else 0.0
        self._start = self._last = time.perf_counter()
        self.mean_return: float | None = state["mean_return"] if state else None
        self.figures: dict[str, float] = {}
        self._curve = output / CURVE_FILE
        lines = self._curve.read_text(encoding="utf-8").splitlines() if self._curve.is_file() else []
        done = [line for line in lines if line.endswith("}") and json.loads(line)["steps"] <= learner.steps]
        with writing(self._curve):
            self._curve.write_text("".join(f"{line}\n" for line in done), encoding="utf-8")
        self._writer = Curves(output / "tensorboard", learner.steps + 1)

    def __enter__(self) -> _Log:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    @property
    def seconds(self) -> float:
        """Seconds that the run took so far, earlier parts included."""
        return self._seconds_before + time.perf_counter() - self._start

    def add(self, learned: dict[str, float], steps: int) -> None:
        """Takes down an iteration of ``steps`` control steps."""
        now = time.perf_counter()
        figures = {f"train/{name}": value for name, value in learned.items()}
        episodes = self._learner.episodes
        if episodes:
            mean = {name: float(np.mean([episode[name] for episode in episodes])) for name in episodes[0]}
            coverage = COVERAGE_WEIGHT * mean["new_visited"] if self._has_coverage else 0.0
            self.mean_return = mean["return"]
            figures["episode/return"] = mean["return"]
            figures["episode/touched_voxels"] = mean["new_touched"]
            figures["episode/visited_voxels"] = mean["new_visited"]
            figures["episode/reward_coverage"] = coverage
            figures["episode/reward_discovery"] = mean["return"] - coverage
        figures["time/steps_per_second"] = steps / (now - self._last)
        for stage, seconds in self._learner.seconds.items():
            figures[f"time/{stage}_seconds"] = seconds
        self._last, self.figures = now, figures
        for name, value in figures.items():
            self._writer.add(name, value, self._learner.steps)
        rounded = {name: round(value, 5) for name, value in figures.items()}
        with writing(self._curve), self._curve.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"steps": self._learner.steps, **rounded}) + "\n")


def _learn_chunk(learner: PPO, config: TrainingConfig, log: _Log, on_progress: Report | None) -> None:
    """The steps up to the next checkpoint, as a function of the learner's state alone."""
    end = min(learner.steps + config.chunk_steps, config.total_steps)
    last_scene = learner.steps // config.scene_steps * config.scene_steps
    learner.begin(
        *(int(np.random.SeedSequence([config.seed, at]).generate_state(1)[0]) for at in (learner.steps, last_scene))
    )
    report = None if on_progress is None else lambda done: on_progress(done, log.figures)
    while learner.steps < end:
        log.add(learner.iterate(report), config.iteration_steps)


def _save_checkpoint(learner: PPO, config: TrainingConfig, assets: dict[str, Any], output: Path, log: _Log) -> None:
    """Writes ``checkpoints/<steps>/`` atomically, then removes older ones."""
    target = output / "checkpoints" / f"{learner.steps:010d}"
    with atomic_directory(target) as temporary:
        tensors = io.BytesIO()  # torch's own writing of a file ends in a library error on a full disk
        torch.save(learner.state(), tensors)
        (temporary / CHECKPOINT_TENSORS).write_bytes(tensors.getbuffer())
        state = {
            "config": _plain(config),
            "assets": assets,
            "steps": learner.steps,
            "seconds": log.seconds,
            "mean_return": log.mean_return,
        }
        write_json(temporary / CHECKPOINT_STATE, state)
    for other in target.parent.iterdir():
        if other != target:
            shutil.rmtree(other, ignore_errors=True)


def _last_checkpoint(output: Path) -> Path | None:
    """The newest complete checkpoint: complete ones have a bare number for a name, unfinished ones a leading dot."""
    folder = output / "checkpoints"
    complete = sorted(path for path in folder.iterdir() if path.name.isdigit()) if folder.is_dir() else []
    return complete[-1] if complete else None


def _assets(config: TrainingConfig) -> dict[str, Any]:
    """What is trained on: number and hash of the objects."""
    names = config.objects or tuple(record["name"] for record in list_objects(config.split))
    if not names:
        command = f"tslam-bench assets prepare --split {config.split}"
        raise AssetError(f"split {config.split!r}: no object is prepared; run '{command}'")
    return {"objects": len(names), "sha256": asset_sha256(names, config.split)}


def _plain(config: TrainingConfig) -> dict[str, Any]:
    """The settings as JSON reads them back."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def _check_same_settings(config: TrainingConfig, found: dict[str, Any], output: Path) -> None:
    here = _plain(config)
    compared = (here.keys() | found.keys()) - {"processes", "reconfigure_every"}  # bits do not depend on them, on a CPU
    different = sorted(key for key in compared if here.get(key) != found.get(key))
    if different:
        pairs = ", ".join(f"{key} {found.get(key)!r} there, {here.get(key)!r} here" for key in different)
        raise InvalidInputError(
            f"{output}: holds a run with other settings ({pairs}); choose another output or delete it"
        )
