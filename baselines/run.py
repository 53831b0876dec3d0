"""The whole benchmark as one run: assets, training, episodes, reconstruction, scores, page.

``baselines/run_all.sh`` sets up the environment and calls this. Each stage is a ``tslam-bench`` command that can be typed by
hand; this module only plans them and hands them to :class:`tslam_bench.baselines.jobs.JobRunner`.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import tyro
from tqdm import tqdm

from tslam_bench.baselines.jobs import Job, JobRunner
from tslam_bench.baselines.learned import METADATA_FILE
from tslam_bench.baselines.registry import get_baseline, list_baselines
from tslam_bench.baselines.training_config import PAPER_STEPS
from tslam_bench.constants import QUICK_OBJECTS
from tslam_bench.errors import BenchmarkError, InvalidInputError

ALL_BASELINES: Final = tuple(spec.id for spec in list_baselines())


@dataclass(frozen=True)
class RunSettings:
    """What a run does; :data:`PRESETS` has the three usual ones.

    Attributes:
        name: folder below the output folder, and label.
        objects: test objects; empty: the whole test split.
        object_set: ranking that the submissions are for.
        baselines: explorers.
        seeds: repetitions of every episode.
        steps: training steps of each learned baseline.
        training: further arguments of ``tslam-bench baselines train``.
        train_objects: arguments of ``tslam-bench assets prepare`` for the train split.
        reconstructors: ids; learned ones are trained first.
        reconstruction_training: further arguments of ``tslam-bench reconstruct train``.
        remark: shown beside the figures of learned baselines.
    """

    name: str
    objects: tuple[str, ...]
    object_set: Literal["quick", "test"]
    baselines: tuple[str, ...]
    seeds: tuple[int, ...]
    steps: int
    training: tuple[str, ...]
    train_objects: tuple[str, ...]
    reconstructors: tuple[str, ...]
    reconstruction_training: tuple[str, ...]
    remark: str


_SMALL_TRAINING: Final = (
    *("--network", "small", "--num-envs", "4", "--rollout-steps", "200", "--batch-size", "200", "--epochs", "4"),
    *("--checkpoint-every", "1600"),
)
PRESETS: Final[dict[str, RunSettings]] = {
    "quick": RunSettings(
        name="quick",
        objects=QUICK_OBJECTS,
        object_set="quick",
        baselines=ALL_BASELINES,
        seeds=(0,),
        steps=4000,
        training=_SMALL_TRAINING,
        train_objects=("--split", "train", "--source", "generated", "--count", "24"),
        reconstructors=("grid", "hull", "ifnet"),
        reconstruction_training=("--steps", "300"),
        remark="proves the path, not the method",
    ),
    "tiny": RunSettings(
        name="tiny",
        objects=("mug",),
        object_set="quick",
        baselines=("random", "heuristic", "tslam", "oracle", "nothing"),
        seeds=(0,),
        steps=256,
        training=(
            "--network",
            "small",
            "--num-envs",
            "2",
            "--rollout-steps",
            "64",
            "--batch-size",
            "64",
            "--epochs",
            "1",
        ),
        train_objects=("--split", "train", "--source", "generated", "--count", "2"),
        reconstructors=("grid", "hull", "ifnet"),
        reconstruction_training=("--steps", "3", "--batch-size", "2", "--threshold-examples", "4"),
        remark="shows that everything runs, nothing else",
    ),
    "full": RunSettings(
        name="full",
        objects=(),
        object_set="test",
        baselines=ALL_BASELINES,
        seeds=(0, 1, 2),
        steps=PAPER_STEPS,
        training=("--network", "paper", "--num-envs", "16"),
        train_objects=("--split", "train"),
        reconstructors=("grid", "hull", "ifnet"),
        reconstruction_training=("--steps", "20000", "--batch-size", "16", "--points", "2048"),
        remark="",
    ),
}
"""``quick``: a leaderboard within 15 minutes on 2 cores. ``tiny``: the same path in a minute or two, for CI. ``full``: the
protocol's objects and the paper's budget; days on a CPU."""


@dataclass(frozen=True)
class Arguments:
    """Runs the whole benchmark: assets, training, episodes, reconstruction, scores and page.

    Choose one of --quick, --tiny and --full; the other flags change it. Run the same command again to go on after a stop;
    what is there is reused.
    """

    quick: bool = False
    """Five objects, all baselines, a few thousand training steps: 15 minutes on 2 cores."""
    tiny: bool = False
    """One object, five explorers, hardly any training: checks that the path works."""
    full: bool = False
    """The whole test split, three seeds, the paper's training budget: days on a CPU."""
    objects: tuple[str, ...] | None = None
    """Test objects instead of the preset's."""
    baselines: tuple[str, ...] | None = None
    """Explorers instead of the preset's (tslam-bench baselines list)."""
    seeds: tuple[int, ...] | None = None
    """Repetitions of every episode instead of the preset's."""
    steps: int | None = None
    """Training steps of each learned baseline instead of the preset's."""
    reconstructors: tuple[str, ...] | None = None
    """Reconstructors instead of the preset's (tslam-bench reconstruct list)."""
    output: Path | None = None
    """Folder of the run; default: runs/ and the preset's name."""
    workers: int = os.cpu_count() or 2
    """Processes at a time."""
    dry_run: bool = False
    """Print the commands without running them."""


def settings_of(arguments: Arguments) -> RunSettings:
    """The preset with the changes that were asked for.

    Raises:
        InvalidInputError: not exactly one preset, or an empty or unknown choice.
    """
    chosen = [name for name in PRESETS if getattr(arguments, name)]
    if len(chosen) != 1:
        raise InvalidInputError("choose one of --quick, --tiny and --full (--help tells more)")
    changes = {
        name: getattr(arguments, name)
        for name in ("objects", "baselines", "seeds", "steps", "reconstructors")
        if getattr(arguments, name) is not None
    }
    for name, value in changes.items():
        if value in ((), 0):
            raise InvalidInputError(f"--{name}: give at least one")
    settings = replace(PRESETS[chosen[0]], **changes)
    for baseline in settings.baselines:
        get_baseline(baseline)
    return settings


def plan(settings: RunSettings, output: Path, workers: int) -> list[Job]:
    """The run's commands, in an order in which one process could run them."""
    from tslam_bench.reconstruction.registry import get_reconstructor

    specs = [get_baseline(name) for name in dict.fromkeys(settings.baselines)]
    reconstructors = [get_reconstructor(name) for name in dict.fromkeys(settings.reconstructors)]
    objects = ("--objects", *settings.objects) if settings.objects else ()
    several = ("--workers", str(workers))
    prepare = ("tslam-bench", "assets", "prepare")
    test_objects = ("--quick",) if settings.objects == QUICK_OBJECTS else objects
    # These look into the cache, which others change too: they always run, and take seconds if all is there.
    jobs = [
        Job("assets-test", (*prepare, *test_objects, *several), slots=workers, always=True),
        Job("assets-hand", (*prepare, "--hand"), always=True),
        Job("assets-train", (*prepare, *settings.train_objects, *several), slots=workers, always=True),
    ]
    before_train = ("assets-train",)

    models: dict[str, Path] = {}
    for reconstructor in reconstructors:
        if reconstructor.needs != "model":
            continue
        model = output / "models" / f"{reconstructor.id}.pt"
        models[reconstructor.id] = model
        command = ("tslam-bench", "reconstruct", "train", "--architecture", reconstructor.id)
        arguments = (*settings.reconstruction_training, "--output", str(model))
        jobs.append(Job(f"train-{reconstructor.id}", (*command, *arguments), before_train, (model,)))
    for spec in specs:
        if spec.kind == "learned":
            folder = output / "models" / spec.id
            command = ("tslam-bench", "baselines", "train", spec.id, "--steps", str(settings.steps))
            arguments = (*settings.training, "--output", str(folder))
            after = (*before_train, "assets-hand")
            jobs.append(Job(f"train-{spec.id}", (*command, *arguments), after, (folder / METADATA_FILE,)))

    submissions: list[tuple[str, Path]] = []
    for spec in specs:
        # Whatever completes nothing to nothing need not be run for `nothing`; the mean shape is its floor.
        ids = ("grid", "mean_shape") if spec.id == "nothing" else tuple(r.id for r in reconstructors)
        chosen = [f"{name}={models[name]}" if name in models else name for name in ids]
        folders = [output / "submissions" / f"{spec.id}-{name}" for name in ids]
        command = ("tslam-bench", "baselines", "evaluate", spec.id, "--object-set", settings.object_set, *objects)
        seeds = ("--seeds", *map(str, settings.seeds))
        arguments = (*seeds, "--reconstructors", *chosen, "--output", str(output))
        after = ["assets-test", *(f"train-{name}" for name in ids if name in models)]
        if spec.id == "nothing":
            after.append("assets-train")
        if spec.kind != "reference":
            after.append("assets-hand")
        if spec.kind == "learned":
            arguments += ("--model", str(output / "models" / spec.id))
            budget = f"{settings.name}: {settings.steps:,} steps"
            arguments += ("--label", budget + (f", {settings.remark}" if settings.remark else ""))
            after.append(f"train-{spec.id}")
        outputs = tuple(folder / "submission.json" for folder in folders)
        jobs.append(Job(f"evaluate-{spec.id}", (*command, *arguments), tuple(after), outputs))
        submissions += [(spec.id, folder) for folder in folders]

    scores = output / "scores"
    for spec_id, folder in submissions:
        score = scores / f"{folder.name}.json"
        command = ("tslam-bench", "score", str(folder), *objects, "--output", str(score))
        jobs.append(Job(f"score-{folder.name}", command, (f"evaluate-{spec_id}",), (score,)))
    page = (output / "leaderboard.json", output / "index.html")
    command = ("tslam-bench", "leaderboard", "--scores", str(scores), "--output", str(output))
    jobs.append(Job("leaderboard", command, tuple(f"score-{folder.name}" for _, folder in submissions), page))
    return jobs


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs ``python -m tslam_bench.baselines.run``; exits with 0, 2 (bad input, a failed job) or 130 (interrupted)."""
    parsed = tyro.cli(Arguments, args=arguments, prog="bash baselines/run_all.sh")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends jobs in order, as Ctrl-C does
    try:
        settings = settings_of(parsed)
        output = parsed.output or Path("runs") / settings.name
        _run(plan(settings, output, parsed.workers), output, parsed.workers, parsed.dry_run)
    except BenchmarkError as error:
        print(f"run: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("run: interrupted; run the same command again to go on", file=sys.stderr)
        sys.exit(130)


def _run(jobs: list[Job], output: Path, workers: int, dry_run: bool) -> None:
    if dry_run:
        import shlex

        print("\n".join(shlex.join(job.command) for job in jobs))
        return
    started = time.monotonic()
    interactive = sys.stderr.isatty()
    with tqdm(
        total=len(jobs), unit="job", disable=not interactive, bar_format="{l_bar}{bar}| {elapsed} {postfix}"
    ) as bar:

        def show(done: int, total: int, running: str) -> None:
            bar.set_postfix_str(running, refresh=False)
            bar.update(done - bar.n)
            bar.refresh()

        JobRunner(output, workers, lambda line: bar.write(line), show).run(jobs)
    print(f"run: done in {(time.monotonic() - started) / 60:.1f} minutes: {output / 'index.html'}")


if __name__ == "__main__":
    main()
