"""Makes weights that can be shipped of trained models: half precision, one small file and its training record.

The file in half precision is the thing of record: what is evaluated are its numbers, read back without rounding.
"""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from tslam_bench.constants import GRID_SIZE, NUM_JOINTS
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.policies import get_baseline
from tslam_bench.evaluation.weights import WEIGHTS_SUFFIX, training_record, weights_file
from tslam_bench.files import atomic_file, ensure_writable_directory, sha256_file, write_json
from tslam_bench.hand_constants import JOINT_LIMITS, SKIN_LINKS

from .model_files import read_model, weights_bytes
from .network import PolicyNetwork
from .training import CURVE_FILE

MOST_BYTES: Final = 1_000_000
"""A file of weights is smaller."""
MOST_CHANGE: Final = 0.03
"""Bound on what half precision changes in a policy's mean actions and standard deviations, in halves of joint ranges."""
CURVE_POINTS: Final = 20
"""Points of the training curve in the record: each the mean over as many iterations."""
_CURVES: Final = {"return": "episode/return", "touched_voxels": "episode/touched_voxels"}
_LEFT_OUT: Final = ("objects", "processes", "torch_threads")
"""Settings that are not recorded: the objects' number and hash are, and of the others the weights do not depend."""


def export(model: Path, output: Path, commit: str | None = None) -> Path:
    """Writes ``<id>-<seed>.safetensors`` and the training record ``<id>-<seed>.json``; equal models give equal bytes.

    Args:
        model: directory of a finished model.
        output: folder for both files; those of the same id and seed are replaced.
        commit: of the code that trained it, where the model does not say.

    Returns:
        The file of weights.

    Raises:
        InvalidInputError: no finished model of a learned explorer, too large, or half precision changes what it does.
        AssetError: ``output`` cannot be written.
    """
    network, acting = read_model(model)
    record, path = training_record(model), weights_path(model, output)
    halved = copy.deepcopy(network)
    halved.load_state_dict({name: value.half() for name, value in network.state_dict().items()})  # weights, not buffers
    changes, written = half_precision_change(network, halved), weights_bytes(network, acting)
    fault = None
    if not all(torch.isfinite(value).all() for value in halved.state_dict().values()):
        fault = "a weight is too large for half precision"
    elif max(changes.values()) > MOST_CHANGE:
        fault = f"half precision changes its actions by {max(changes.values()):.3f}, more than {MOST_CHANGE}"
    elif len(written) >= MOST_BYTES:
        fault = f"its weights take {len(written):,} bytes in half precision, less than {MOST_BYTES:,} are shipped"
    if fault:
        raise InvalidInputError(f"{model}: {fault}; ship its directory instead")
    ensure_writable_directory(output)
    with atomic_file(path) as temporary:
        temporary.write_bytes(written)
    kept = ("baseline", "seed", "reward_mode", "privileged", "steps", "paper_steps", "seconds", "mean_return")
    contents = {
        **{name: record.get(name) for name in (*kept, "machine", "versions", "assets")},
        "commit": record.get("commit") or commit,
        "config": {name: value for name, value in record["config"].items() if name not in _LEFT_OUT},
        "curve": training_curve(model / CURVE_FILE),
        "dtype": "float16",
        "half_precision_change": {name: round(value, 5) for name, value in changes.items()},
        "model_sha256": sha256_file(weights_file(model)),
        "weights_sha256": sha256_file(path),
    }
    write_json(path.with_suffix(".json"), contents)
    return path


def weights_path(model: Path, output: Path) -> Path:
    """Where :func:`export` writes the weights of a model.

    Raises:
        InvalidInputError: no finished model of a learned explorer.
    """
    if not model.is_dir():
        raise InvalidInputError(f"{model}: is no directory of a trained model; check the path")
    record = training_record(model)
    seed, spec = record.get("seed"), get_baseline(record.get("baseline"))
    if spec.kind != "learned" or not isinstance(seed, int):
        raise InvalidInputError(f"{model}: its record names no learned explorer and seed; train it again")
    return output / f"{spec.id}-{seed}{WEIGHTS_SUFFIX}"


def training_curve(file: Path) -> dict[str, list[float]]:
    """A training's curve in few points: ``steps``, and means over the iterations up to there. Empty if there is no file."""
    lines = [json.loads(line) for line in file.read_text("utf-8").splitlines()] if file.is_file() else []
    lines = [line for line in lines if all(name in line for name in _CURVES.values())]
    parts = [part for part in np.array_split(np.arange(len(lines)), min(CURVE_POINTS, len(lines)) or 1) if len(part)]
    curve: dict[str, list[float]] = {"steps": [lines[part[-1]]["steps"] for part in parts]}
    for short, name in _CURVES.items():
        curve[short] = [round(float(np.mean([lines[index][name] for index in part])), 2) for part in parts]
    return curve


def half_precision_change(network: PolicyNetwork, halved: PolicyNetwork) -> dict[str, float]:
    """Largest difference of mean actions (``mean``) and of standard deviations (``std``) over drawn observations."""
    observation = drawn_observations(256, np.random.default_rng(0))
    with torch.inference_mode():
        (mean, log_std), (mean_halved, log_std_halved) = (
            each.distribution(each.encode(observation)) for each in (network, halved)
        )
    return {
        "mean": float((mean.clamp(-1, 1) - mean_halved.clamp(-1, 1)).abs().max()),
        "std": float((log_std.exp() - log_std_halved.exp()).abs().max()),
    }


def drawn_observations(count: int, generator: np.random.Generator) -> dict[str, torch.Tensor]:
    """Observations of any kind: joints anywhere, and grids as full as those of early and late steps."""
    low, high = JOINT_LIMITS.T
    time = generator.random((count, 1))
    filled = np.array([0.01, 0.3])[None] * time * generator.random((count, 2))  # of touched, of visited
    cells = generator.random((count, 2, GRID_SIZE, GRID_SIZE, GRID_SIZE), dtype=np.float32)
    drawn: dict[str, Any] = {
        "qpos": generator.uniform(low, high, (count, NUM_JOINTS)).astype(np.float32),
        "qvel": generator.normal(size=(count, NUM_JOINTS)).astype(np.float32),
        "touch": generator.integers(0, 2, (count, len(SKIN_LINKS)), dtype=np.uint8),
        "time": time.astype(np.float32),
        "occupancy": (cells < filled[:, :, None, None, None]).astype(np.uint8),
    }
    return {name: torch.from_numpy(value) for name, value in drawn.items()}
