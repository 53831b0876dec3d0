"""Trains a learned baseline with stable-baselines3's PPO (protocol section 11).

A run is cut into chunks of ``checkpoint_every`` steps. Each chunk starts from a checkpoint, with freshly reset
environments and random numbers seeded from (seed, steps so far): a run that was killed and resumed ends with the same
weights, bit for bit, as one that was not.
"""

from __future__ import annotations

import dataclasses
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
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

import tslam_bench
from tslam_bench.assets.store import asset_sha256, list_objects
from tslam_bench.baselines.network import NETWORKS, policy_arguments
from tslam_bench.baselines.registry import get_baseline
from tslam_bench.baselines.training_config import METADATA_FILE, MODEL_FILE, PAPER_STEPS, TrainingConfig
from tslam_bench.baselines.vector import TactileVecEnv
from tslam_bench.constants import ENVIRONMENT_ID
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import atomic_directory, atomic_file, ensure_writable_directory, write_json
from tslam_bench.hand_constants import JOINT_LIMITS

CHECKPOINT_STATE: Final = "state.json"


def train(
    config: TrainingConfig, output: Path, command: str = "", on_progress: Callable[[int], None] | None = None
) -> dict[str, Any]:
    """Trains, or goes on with, the run in ``output``; a finished one is left as it is.

    Writes ``model.zip`` (stable-baselines3), ``model.json`` (the returned metadata), ``tensorboard/`` and, while it
    runs, ``checkpoints/<steps>/``.

    Args:
        config: settings.
        output: the model's directory.
        command: command line to record.
        on_progress: called with the steps done so far, after every environment step.

    Returns:
        Metadata: settings, steps, seconds, mean return of the last episodes, machine, versions, command.

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
    torch.set_num_threads(config.torch_threads)
    checkpoint = _last_checkpoint(output)
    state = json.loads((checkpoint / CHECKPOINT_STATE).read_text(encoding="utf-8")) if checkpoint else None
    if state is not None:
        _check_same_settings(config, state["config"], output)
        if state["assets"] != assets:
            raise InvalidInputError(f"{output}: was begun with other objects; delete it or choose another output")

    normalised = VecNormalize(
        VecMonitor(TactileVecEnv(make_training_environments(config))),
        norm_obs=False,
        norm_reward=True,
        gamma=config.gamma,
        clip_reward=np.inf,
    )
    space = normalised.observation_space
    assert isinstance(space, spaces.Dict)
    try:
        if checkpoint is None or state is None:
            model = _new_model(config, normalised)
            seconds_before, mean_return = 0.0, None
        else:
            model = PPO.load(checkpoint / MODEL_FILE, env=normalised, device=learning_device(config))
            statistics = normalised.ret_rms
            statistics.mean, statistics.var = np.float64(state["return_mean"]), np.float64(state["return_variance"])
            statistics.count = state["return_count"]
            seconds_before, mean_return = float(state["seconds"]), state["mean_return"]
        model.set_logger(configure(str(output / "tensorboard"), ["tensorboard"]))
        start = time.perf_counter()
        while model.num_timesteps < config.total_steps:
            steps = min(config.chunk_steps, config.total_steps - model.num_timesteps)
            _learn_chunk(model, config, steps, on_progress)
            if model.ep_info_buffer:
                mean_return = float(np.mean([episode["r"] for episode in model.ep_info_buffer]))
            if model.num_timesteps < config.total_steps:
                seconds = seconds_before + time.perf_counter() - start
                _save_checkpoint(model, normalised, config, assets, output, seconds, mean_return)
        seconds = seconds_before + time.perf_counter() - start
    finally:
        normalised.close()

    spec = get_baseline(config.baseline)
    metadata = {
        "baseline": spec.id,
        "reward_mode": spec.reward_mode,
        "privileged": spec.privileged,
        "config": _plain(config),
        "assets": assets,
        "steps": model.num_timesteps,
        "paper_steps": PAPER_STEPS,
        "seed": config.seed,
        "seconds": round(seconds, 1),
        "mean_return": mean_return,
        "observations": {key: list(entry.shape or ()) for key, entry in space.spaces.items()},
        "machine": machine_description(),
        "versions": {
            "tslam_bench": tslam_bench.__version__,
            "torch": str(torch.__version__),
            "python": platform.python_version(),
        },
        "command": command or " ".join(sys.argv),
    }
    with atomic_file(output / MODEL_FILE) as temporary:
        model.save(temporary)
    write_json(metadata_path, metadata)
    shutil.rmtree(output / "checkpoints", ignore_errors=True)
    return metadata


def make_training_environments(config: TrainingConfig) -> VectorEnv:
    """The environments of a run: objects and poses drawn per episode."""
    return tslam_bench.make_vec(
        ENVIRONMENT_ID,
        config.num_envs,
        config.device,
        objects=config.objects or None,
        split=config.split,
        reward_mode=get_baseline(config.baseline).reward_mode or "none",
        processes=config.processes,
    )


def learning_device(config: TrainingConfig) -> str:
    """``cpu`` or ``cuda``: where ``make_vec`` simulates, there the network learns."""
    return "cuda" if config.device != "cpu" and torch.cuda.is_available() else "cpu"


def machine_description() -> dict[str, Any]:
    """Kind of machine: system, processor and cores."""
    processor = platform.processor() or platform.machine()
    cpu_info = Path("/proc/cpuinfo")
    if cpu_info.is_file():
        names = [
            line.split(":", 1)[1].strip() for line in cpu_info.read_text().splitlines() if line.startswith("model name")
        ]
        processor = names[0] if names else processor
    return {"system": platform.system(), "processor": processor, "cores": os.cpu_count()}


class _Progress(BaseCallback):
    def __init__(self, report: Callable[[int], None]) -> None:
        super().__init__()
        self._report = report

    def _on_step(self) -> bool:
        self._report(self.model.num_timesteps)
        return True


def _new_model(config: TrainingConfig, environments: VecNormalize) -> PPO:
    limits = tuple((float(low), float(high)) for low, high in np.asarray(JOINT_LIMITS))
    return PPO(
        "MultiInputPolicy",
        environments,
        learning_rate=config.learning_rate,
        n_steps=config.rollout_steps,
        batch_size=min(config.batch_size, config.iteration_steps),
        n_epochs=config.epochs,
        gamma=config.gamma,
        gae_lambda=config.gae_lambda,
        clip_range=config.clip_range,
        ent_coef=config.entropy_coefficient,
        policy_kwargs=policy_arguments(NETWORKS[config.network], limits),
        seed=config.seed,
        device=learning_device(config),
    )


def _learn_chunk(model: PPO, config: TrainingConfig, steps: int, on_progress: Callable[[int], None] | None) -> None:
    """``steps`` more steps, as a function of the model's state alone."""
    chunk_seed = int(np.random.SeedSequence([config.seed, model.num_timesteps]).generate_state(1)[0]) >> 1
    model.set_random_seed(chunk_seed)  # torch, numpy (minibatches), and the environments' next reset
    model._last_obs = None  # makes `learn` reset the environments
    assert model.env is not None
    model.env.set_options(
        {"reconfigure": True}
    )  # a GPU scene draws other objects then; the CPU does so at every episode
    callback = _Progress(on_progress) if on_progress else None
    model.learn(total_timesteps=steps, callback=callback, log_interval=1, reset_num_timesteps=False)


def _save_checkpoint(
    model: PPO,
    normalised: VecNormalize,
    config: TrainingConfig,
    assets: dict[str, Any],
    output: Path,
    seconds: float,
    mean_return: float | None,
) -> None:
    """Writes ``checkpoints/<steps>/`` atomically, then removes older ones."""
    target = output / "checkpoints" / f"{model.num_timesteps:010d}"
    with atomic_directory(target) as temporary:
        model.save(temporary / MODEL_FILE)
        state = {
            "config": _plain(config),
            "assets": assets,
            "steps": model.num_timesteps,
            "return_mean": float(normalised.ret_rms.mean),
            "return_variance": float(normalised.ret_rms.var),
            "return_count": float(normalised.ret_rms.count),
            "seconds": seconds,
            "mean_return": mean_return,
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
    compared = (here.keys() | found.keys()) - {"processes"}  # bits do not depend on it
    different = sorted(key for key in compared if here.get(key) != found.get(key))
    if different:
        pairs = ", ".join(f"{key} {found.get(key)!r} there, {here.get(key)!r} here" for key in different)
        raise InvalidInputError(
            f"{output}: holds a run with other settings ({pairs}); choose another output or delete it"
        )
