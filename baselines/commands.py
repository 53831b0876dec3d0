"""``tslam-bench baselines``: list, train and evaluate the registered explorers."""

from __future__ import annotations

import dataclasses
import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.policies import get_baseline, list_baselines

from .training_config import TrainingConfig

_USAGE = """usage: tslam-bench baselines COMMAND ...

The registered explorers.

commands:
  list      name them, with their kind and reward
  train     train a learned one with PPO
  evaluate  explore objects, reconstruct, and write submissions

tslam-bench baselines COMMAND --help tells more."""


@dataclass(frozen=True)
class ListArguments:
    """Names the registered explorers."""

    json: bool = False
    """Print JSON instead of a table."""


@dataclass(frozen=True)
class TrainArguments:
    """Trains a learned baseline with PPO, or goes on with a run that was stopped; a finished one is left alone."""

    config: tyro.conf.OmitArgPrefixes[TrainingConfig]
    output: Path | None = None
    """Directory of the model; default: runs/models/ID."""


@dataclass(frozen=True)
class EvaluateArguments:
    """Lets an explorer feel objects in all 8 poses, reconstructs them, and writes one submission per reconstructor.

    Goes on where an earlier run of the same command stopped.
    """

    baseline: Annotated[str, tyro.conf.Positional]
    """Id of the explorer (tslam-bench baselines list)."""
    model: Path | None = None
    """Directory of the trained model; learned explorers need it."""
    objects: tuple[str, ...] = ()
    """Objects of the test split; empty: those of the object set."""
    object_set: Literal["quick", "test"] = "quick"
    """Which ranking the submissions are for: the five quick objects or the whole test split."""
    seeds: tuple[int, ...] = (0,)
    """Repetitions; each is 8 episodes per object."""
    reconstructors: tuple[str, ...] = ("grid", "hull")
    """Reconstructors, as ID or ID=MODEL for learned ones; ``none`` only explores."""
    learning_objects: tuple[str, ...] = ()
    """Train objects that mean_shape and retrieval are built from; empty: all that are prepared."""
    output: Path = Path("runs/evaluation")
    """Folder for rollouts/ and submissions/."""
    deterministic: bool = False
    """A learned explorer acts by the mean of its policy instead of sampling."""
    policy_salt: str | None = None
    """Hexadecimal digits that the explorer's random numbers and the order of the episodes come from; default: drawn at random,
    or that of the episodes which are there. It is recorded in the submission."""
    label: str = ""
    """Remark shown beside every figure."""
    processes: int | None = None
    """Worker processes that simulate; default: the cores. Results do not depend on it."""
    torch_threads: int = 1
    """Threads of torch. One is fastest on CPUs: a policy's small tensors are not worth sharing out."""


def main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench baselines`` with the given arguments.

    Raises:
        BenchmarkError: bad input; the message is one line.
    """
    commands = {"list": _list, "train": _train, "evaluate": _evaluate}
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_USAGE)
        sys.exit(0 if arguments else 2)
    if arguments[0] not in commands:
        raise InvalidInputError(f"baselines {arguments[0]!r}: unknown command; choose one of {', '.join(commands)}")
    commands[arguments[0]](list(arguments[1:]))


def _list(arguments: list[str]) -> None:
    parsed = tyro.cli(ListArguments, args=arguments, prog="tslam-bench baselines list")
    specs = list_baselines()
    if parsed.json:
        print(json.dumps([dataclasses.asdict(spec) for spec in specs], indent=2))
        return
    rows = [("id", "kind", "reward", "privileged", "summary")]
    rows += [(s.id, s.kind, s.reward_mode or "-", "yes" if s.privileged else "no", s.summary) for s in specs]
    widths = [max(len(row[i]) for row in rows) for i in range(4)]
    for row in rows:
        print("  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[4]]))


def _train(arguments: list[str]) -> None:
    from tqdm import tqdm

    from .training import train

    parsed = tyro.cli(TrainArguments, args=arguments, prog="tslam-bench baselines train")
    config: TrainingConfig = parsed.config
    config.check()
    output = parsed.output or Path("runs/models") / config.baseline
    with tqdm(total=config.total_steps, unit="step", desc=f"train {config.baseline}", mininterval=1.0) as bar:

        def show(done: int, figures: dict[str, float]) -> None:
            if figures:
                values = (figures.get("episode/return", 0.0), figures.get("episode/touched_voxels", 0.0))
                bar.set_postfix_str("return {:.0f}, {:.0f} voxels touched".format(*values), refresh=False)
            _to(bar, done)

        metadata = train(config, output, _command("train", arguments), show)
        _to(bar, metadata["steps"])
    print(f"{output}: {metadata['baseline']}, {metadata['steps']} steps in {metadata['seconds']:.0f} s")


def _evaluate(arguments: list[str]) -> None:
    from tqdm import tqdm

    parsed = tyro.cli(EvaluateArguments, args=arguments, prog="tslam-bench baselines evaluate")
    spec = get_baseline(parsed.baseline)
    import torch

    from tslam_bench.evaluation.evaluate import EvaluationConfig, evaluate, make_reconstructors
    from tslam_bench.objects.splits import object_set

    if parsed.torch_threads < 1:
        raise InvalidInputError(f"torch_threads {parsed.torch_threads}: must be at least 1")
    torch.set_num_threads(parsed.torch_threads)
    config = EvaluationConfig(
        baseline=spec.id,
        objects=parsed.objects or object_set(parsed.object_set),
        seeds=parsed.seeds,
        object_set=parsed.object_set,
        model=parsed.model,
        deterministic=parsed.deterministic,
        policy_salt=parsed.policy_salt,
        label=parsed.label,
        processes=parsed.processes,
    )
    bars: dict[str, tqdm] = {}

    def show(stage: str, done: int, total: int) -> None:
        if stage not in bars:
            bars[stage] = tqdm(total=total, desc=f"{spec.id}: {stage}", mininterval=1.0)
        _to(bars[stage], done)
        if done == total:
            bars[stage].close()

    submissions = evaluate(
        config, make_reconstructors(parsed.reconstructors, parsed.learning_objects), parsed.output, show
    )
    for submission in submissions:
        print(submission)


def _to(bar: object, done: int) -> None:
    bar.update(done - bar.n)  # type: ignore[attr-defined]


def _command(name: str, arguments: Sequence[str]) -> str:
    return shlex.join(["tslam-bench", "baselines", name, *arguments])
