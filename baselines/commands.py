"""``tslam-bench baselines``: list and train the registered policies."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import tyro

from tslam_bench.cli.commands import run_command
from tslam_bench.cli.progress import Progress
from tslam_bench.evaluation.policies import list_baselines

from .training_config import TrainingConfig


@dataclass(frozen=True)
class List:
    """Name the registered policies, with their kind and reward."""

    json: bool = False
    """Print JSON instead of a table."""


@dataclass(frozen=True)
class Train:
    """Train a learned baseline with PPO, or go on with a run that was stopped; a finished one is left alone."""

    config: tyro.conf.OmitArgPrefixes[TrainingConfig]
    output: Path | None = None
    """Directory of the model; default: runs/models/ID."""


def main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench baselines`` with the given arguments.

    Raises:
        BenchmarkError: bad input; the message is one line.
    """
    asked = shlex.join(["tslam-bench", "baselines", *arguments])
    commands = {"list": (List, _list), "train": (Train, partial(_train, asked=asked))}
    about = "The registered policies; tslam-bench evaluate evaluates them."
    run_command("tslam-bench baselines", about, commands, arguments)


def _list(command: List) -> None:
    specs = list_baselines()
    if command.json:
        print(json.dumps([spec.row() for spec in specs], indent=2))
        return
    rows = [("id", "kind", "reward", "privileged", "summary")]
    rows += [(s.id, s.kind, s.reward_mode or "-", "yes" if s.privileged else "no", s.summary) for s in specs]
    widths = [max(len(row[i]) for row in rows) for i in range(4)]
    for row in rows:
        print("  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[4]]))


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
