"""Trained policies on disk: where those that come with the package lie, and what is recorded about any of them.

A *model* is what ``tslam-bench baselines train`` wrote, a folder with ``model.safetensors`` and ``model.json``, or *weights*,
which ``tslam-bench baselines export`` made of one: ``tslam-0.safetensors``, in half precision, with ``tslam-0.json`` beside it.
The second half of the name is the seed of the training. Nothing here needs torch.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any, Final

from tslam_bench.errors import InvalidInputError
from tslam_bench.files import package_data, sha256_file

MODEL_FILE: Final = "model.safetensors"
"""A finished model's weights: numbers alone, so that a stranger's model cannot run code."""
METADATA_FILE: Final = "model.json"
"""Written last: a model directory without it is unfinished."""
WEIGHTS_VARIABLE: Final = "TSLAM_BENCH_WEIGHTS"
"""Names another folder of weights than the one that comes with the package."""
WEIGHTS_SUFFIX: Final = ".safetensors"


def weights_folder() -> Path:
    """The folder of shipped weights; it need not exist."""
    other = os.environ.get(WEIGHTS_VARIABLE)
    return Path(other).expanduser() if other else package_data("baselines", "weights")


def shipped_seeds(identifier: str) -> tuple[int, ...]:
    """Seeds of the trainings whose weights are shipped for a learned explorer, in order; empty if none are."""
    pattern = re.compile(rf"{re.escape(identifier)}-(0|[1-9]\d*){re.escape(WEIGHTS_SUFFIX)}")
    folder = weights_folder()
    names = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
    return tuple(sorted(int(found[1]) for name in names if (found := pattern.fullmatch(name))))


def shipped_weights(identifier: str, seed: int = 0) -> Path:
    """The weights that training with ``seed`` gave.

    Raises:
        InvalidInputError: they are not shipped; the message says which are, or how to train.
    """
    seeds = shipped_seeds(identifier)
    if seed in seeds:
        return weights_folder() / f"{identifier}-{int(seed)}{WEIGHTS_SUFFIX}"
    train = f"train it (tslam-bench baselines train {identifier} --seed {seed} --output DIRECTORY)"
    if not seeds:
        raise InvalidInputError(
            f"policy {identifier!r}: needs a trained model, and none is shipped; {train} and pass its directory"
        )
    listed = ", ".join(f"{identifier}@{known}" for known in seeds)
    raise InvalidInputError(
        f"policy {identifier!r}: weights of training seed {seed} are not shipped; choose {listed}, or {train}"
    )


def weights_file(model: Path) -> Path:
    """The file that holds the numbers of a model: the hash of this file says which policy it is."""
    return model / MODEL_FILE if model.is_dir() else model


def training_record(model: Path) -> dict[str, Any]:
    """What is recorded about the training of a model: steps, seconds, seed, machine, versions, ...

    Raises:
        InvalidInputError: there is no record, it cannot be read, or it is that of other weights.
    """
    model = Path(model)
    path = model / METADATA_FILE if model.is_dir() else model.with_suffix(".json")
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        expected = record.get("weights_sha256")
        int(record["steps"]), float(record["seconds"]), record["machine"]["processor"], record["machine"]["cores"]
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise InvalidInputError(
            f"{path}: holds no training record ({type(error).__name__}: {error}); export the model again"
        ) from error
    if not model.is_dir() and expected != sha256_file(model):
        raise InvalidInputError(f"{path}: is the record of other weights than {model.name}; export the model again")
    return record
