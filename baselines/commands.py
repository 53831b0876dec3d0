"""``tslam-bench baselines``: list, train and export the registered policies."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from tslam_bench.cli.commands import run_command
from tslam_bench.cli.progress import Progress
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.policies import list_baselines
from tslam_bench.evaluation.weights import shipped_seeds

from .training_config import TrainingConfig


@dataclass(frozen=True)
class List:
    """Name the registered policies, with their kind, their reward and the training seeds whose weights are shipped."""

    json: bool = False
    """Print JSON instead of a table."""


@dataclass(frozen=True)
class Train:
    """Train a learned baseline with PPO, or go on with a run that was stopped; a finished one is left alone."""

    config: tyro.conf.OmitArgPrefixes[TrainingConfig]
    output: Path | None = None
    """Directory of the model; default: runs/models/ID."""


@dataclass(frozen=True)
class Export:
    """Make weights to ship of trained models: one file each, in half precision, and its training record as JSON."""

    models: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Directories that baselines train wrote, each of another id and seed."""
    output: Path
    """Folder for ID-SEED.safetensors and ID-SEED.json; in a clone, baselines/weights ships them."""
    commit: str | None = None
    """Commit of the code that trained them, for models that do not say."""


def main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench baselines`` with the given arguments.

    Raises:
        BenchmarkError: bad input; the message is one line.
    """
    asked = shlex.join(["tslam-bench", "baselines", *arguments])
    commands = {
        "list": (List, _list),
        "train": (Train, partial(_train, asked=asked)),
        "export": (Export, _export),
    }
    about = "The registered policies; tslam-bench evaluate evaluates them."
    run_command("tslam-bench baselines", about, commands, arguments)


def _list(command: List) -> None:
    specs = list_baselines()
    if command.json:
        print(json.dumps([{**spec.row(), "shipped_seeds": shipped_seeds(spec.id)} for spec in specs], indent=2))
        return
    rows = [("id", "kind", "reward", "privileged", "shipped", "summary")]
    for s in specs:
        seeds = ",".join(map(str, shipped_seeds(s.id)))
        rows.append((s.id, s.kind, s.reward_mode or "-", "yes" if s.privileged else "no", seeds or "-", s.summary))
    widths = [max(len(row[i]) for row in rows) for i in range(5)]
    for row in rows:
        print("  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[5]]))


def _train(command: Train, asked: str) -> None:
    from .training import train

    config = command.config
    config.check()
    output = command.output or Path("runs/models") / config.baseline
    with Progress(f"train {config.baseline}", "step", config.total_steps) as bar:

        def show(done: int, figures: dict[str, float]) -> None:
            values = (figures.get("episode/return", 0.0), figures.get("episode/touched_voxels", 0.0))
            bar.show(done, note="return {:.0f}, {:.0f} voxels touched".format(*values) if figures else "")

        metadata = train(config, output, asked, show)
        bar.show(metadata["steps"])
    print(f"{output}: {metadata['baseline']}, {metadata['steps']} steps in {metadata['seconds']:.0f} s")


def _export(command: Export) -> None:
    from .export import export, weights_path

    if not command.models:
        raise InvalidInputError("export: name at least one directory of a trained model")
    models: dict[Path, Path] = {}
    for model in command.models:
        path = weights_path(model, command.output)
        if path in models:
            raise InvalidInputError(f"{model}: of the same id and seed as {models[path]}; export one of them")
        models[path] = model
    for model in models.values():
        path = export(model, command.output, command.commit)
        print(f"{path}: {path.stat().st_size:,} bytes")
