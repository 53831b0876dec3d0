"""The whole benchmark as one run: assets, training, episodes, reconstruction, scores, page.

``baselines/run_all.sh`` sets up the environment and calls this. Each stage is a ``tslam-bench`` command that can be typed by
hand; this module only plans them and hands them to :class:`tslam_bench.evaluation.jobs.JobRunner`.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import tyro

from tslam_bench.cli.ending import one_line_errors
from tslam_bench.cli.progress import Progress
from tslam_bench.constants import QUICK_OBJECTS
from tslam_bench.episodes import check_salt
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.jobs import Job, JobRunner
from tslam_bench.evaluation.launchers import LauncherName, make_launcher
from tslam_bench.evaluation.policies import get_baseline
from tslam_bench.evaluation.weights import METADATA_FILE, shipped_seeds, shipped_weights
from tslam_bench.objects.splits import known_names
from tslam_bench.objects.store import asset_sha256, list_objects
from tslam_bench.plugins import parse_arguments
from tslam_bench.reconstruction.registry import get_reconstructor
from tslam_bench.reconstruction.registry import shipped_weights as shipped_reconstructor
from tslam_bench.reconstruction.training_config import COLLECTED_ONLY
from tslam_bench.scoring.submission import INFO_FILE

from .presets import PRESETS, RunSettings

_ONE_PROCESS: Final = ("--processes", "1")
"""Jobs run side by side, so each simulates in one process."""
_TEST_ASSETS: Final = "assets-test"
"""Job that prepares the test objects and the hand."""
_SHIPPED: Final = "shipped"
"""Folder, inside that of a run that trains too, of what shipped weights did."""


@dataclass(frozen=True)
class Arguments:
    """Runs the whole benchmark: assets, training, episodes, reconstruction, scores and page.

    Choose one of --quick, --tiny, --scripted, --shipped and --full; the other flags change it. Run the same command again to go
    on after a stop; what is there is reused.
    """

    quick: bool = False
    """Five objects, all baselines after 32,000 training steps, and those whose weights are shipped: 15 minutes on 2 cores."""
    tiny: bool = False
    """One object, five explorers, hardly any training: checks that the path works."""
    scripted: bool = False
    """The whole test split, three seeds, the explorers that are not trained: about an hour on 2 cores."""
    shipped: bool = False
    """The same, and the learned policies whose weights are shipped: only reconstructors are trained."""
    full: bool = False
    """The whole test split, three seeds, the paper's training budget: days on a CPU."""
    objects: tuple[str, ...] | None = None
    """Test objects instead of the preset's."""
    baselines: tuple[str, ...] | None = None
    """Policies instead of the preset's: ids (tslam-bench baselines list), module:Class or file.py:Class."""
    seeds: tuple[int, ...] | None = None
    """Repetitions of every episode instead of the preset's."""
    steps: int | None = None
    """Training steps of each learned baseline instead of the preset's."""
    reconstructors: tuple[str, ...] | None = None
    """Reconstructors instead of the preset's: ids (tslam-bench reconstruct list), module:Class or file.py:Class."""
    retrain: bool = False
    """Train the learned reconstructors even if their weights are shipped."""
    policy_salt: str | None = None
    """Hexadecimal digits that explorers' random numbers come from, instead of the preset's."""
    output: Path | None = None
    """Folder of the run; default: runs/ and the preset's name."""
    workers: int = os.cpu_count() or 2
    """Processes at a time; on a cluster: cores of one job that uses several."""
    launcher: LauncherName = "local"
    """Where the commands run: here, or on the machines of a Ray or SLURM cluster (docs/clusters.md)."""
    address: str | None = None
    """Of the Ray cluster; default: the one that runs here, or else a new one of this machine alone."""
    slurm: tuple[str, ...] = ()
    """Parameters of submitit, key=value: slurm_partition=cpu timeout_min=600 mem_gb=8."""
    dry_run: bool = False
    """Print the commands without running them."""


def settings_of(arguments: Arguments) -> RunSettings:
    """The preset with the changes that were asked for.

    Raises:
        InvalidInputError: not exactly one preset, or an empty or unknown choice.
    """
    chosen = [name for name in PRESETS if getattr(arguments, name)]
    if len(chosen) != 1:
        raise InvalidInputError("choose one of --quick, --tiny, --scripted, --shipped and --full (--help tells more)")
    changes = {
        name: getattr(arguments, name)
        for name in ("objects", "baselines", "seeds", "steps", "reconstructors", "policy_salt")
        if getattr(arguments, name) is not None
    }
    for name, value in changes.items():
        if value in ((), 0):
            raise InvalidInputError(f"--{name}: give at least one")
    settings = replace(PRESETS[chosen[0]], **changes)
    check_salt(settings.policy_salt)
    for baseline in settings.baselines:
        spec = get_baseline(baseline)
        if spec.kind == "learned" and spec.id != baseline:
            raise InvalidInputError(f"--baselines {baseline}: give the id alone, and --seeds for seeds of the training")
        if spec.kind == "learned" and "baselines" in changes and not settings.steps:
            if not settings.shipped:
                raise InvalidInputError(f"--baselines {baseline}: --{settings.name} trains nothing; give --steps too")
            known = [seed for seed in settings.seeds if seed in shipped_seeds(baseline)]
            shipped_weights(baseline, known[0] if known else settings.seeds[0])
    for reconstructor in settings.reconstructors:
        get_reconstructor(reconstructor)
    settings = replace(settings, retrain=settings.retrain or arguments.retrain)
    unique = {name: tuple(dict.fromkeys(getattr(settings, name))) for name in ("baselines", "reconstructors", "seeds")}
    return replace(settings, **unique)  # type: ignore[arg-type]


Command = tuple[str, ...]


def plan(settings: RunSettings, output: Path, workers: int) -> list[Job]:
    """The run's commands, in an order in which one process could run them.

    Raises:
        InvalidInputError: unknown baseline or reconstructor.
    """
    evaluations = _evaluations(settings, output)
    return [
        *_asset_jobs(settings, workers),
        *_training_jobs(settings, output),
        *evaluations,
        *_scoring_jobs(settings, output, evaluations, workers),
    ]


def _objects(settings: RunSettings) -> Command:
    return _listed("--objects", settings.objects)


def _asset_jobs(settings: RunSettings, workers: int) -> list[Job]:
    """These look into the cache, which others change too: they always run, and take seconds if all is there.

    One after the other: train and val objects are compared with those before them.
    """
    prepare: Command = ("tslam-bench", "assets", "prepare")
    several: Command = ("--workers", str(workers))
    test_objects = ("--quick", "--split", "test") if settings.objects == QUICK_OBJECTS else _objects(settings)

    def test_assets() -> str:
        return asset_sha256(settings.objects or known_names("test"))

    command = (*prepare, *test_objects, *several)
    jobs = [Job(_TEST_ASSETS, command, slots=workers, always=True, fingerprint=test_assets)]
    for split, names in settings.learning_objects:
        command = (*prepare, "--split", split, *_listed("--objects", names), *several)
        fingerprint = partial(_learning_sha256, split, names)
        before = (jobs[-1].name,)
        jobs.append(Job(f"assets-{split}", command, before, slots=workers, always=True, fingerprint=fingerprint))
    return jobs


def _learning_sha256(split: str, names: Sequence[str]) -> str:
    """Hash of the names and products of what is learned from."""
    return asset_sha256(names or [record["name"] for record in list_objects(split)], split)


def _listed(flag: str, names: Sequence[str]) -> Command:
    return (flag, *names) if names else ()


def _learning_assets(settings: RunSettings) -> tuple[str, ...]:
    """Names of the jobs that prepare what is learned from."""
    return tuple(f"assets-{split}" for split, _ in settings.learning_objects)


def _models(settings: RunSettings, output: Path) -> dict[str, Path]:
    """Learned reconstructor that is trained -> its checkpoint."""
    return {
        name: output / "models" / f"{name}.pt"
        for name in settings.reconstructors
        if get_reconstructor(name).needs == "model" and (settings.retrain or shipped_reconstructor(name) is None)
    }


def _training_jobs(settings: RunSettings, output: Path) -> list[Job]:
    jobs = []
    learning = dict(settings.learning_objects)
    held_out = "val" if "val" in learning else "train"
    threshold = ("--threshold-split", held_out, *_listed("--threshold-objects", learning[held_out]))
    models, touches = _models(settings, output), output / "touches"
    collected = {name for name in models if settings.collected or name in COLLECTED_ONLY}
    if collected:
        command: Command = ("tslam-bench", "reconstruct", "collect", "--output", str(touches))
        command += _listed("--objects", learning["train"])
        jobs.append(Job("collect-touches", command, (_TEST_ASSETS, "assets-train"), always=True))
    for name, model in models.items():
        after = ("collect-touches",) if name in collected else _learning_assets(settings)
        command = ("tslam-bench", "reconstruct", "train", "--architecture", name)
        command += ("--data", str(touches)) if name in collected else threshold
        command += _listed("--objects", learning["train"])
        command += (*settings.reconstruction_training, "--output", str(model))
        jobs.append(Job(f"train-{name}", command, after, (model,)))
    for name in settings.baselines:
        if get_baseline(name).kind == "learned" and settings.steps:
            folder = output / "models" / name
            command = ("tslam-bench", "baselines", "train", name, "--steps", str(settings.steps))
            command += (
                *_listed("--objects", learning["train"]),
                *settings.training,
                *_ONE_PROCESS,
                "--output",
                str(folder),
            )
            jobs.append(Job(f"train-{name}", command, (_TEST_ASSETS, "assets-train"), (folder / METADATA_FILE,)))
    return jobs


def _reconstructors(settings: RunSettings, baseline: str) -> Command:
    """Most complete nothing to nothing: ``nothing`` is left with one of them, and with the mean shape as its floor."""
    return ("grid", "mean_shape") if baseline == "nothing" else settings.reconstructors


def _evaluations(settings: RunSettings, output: Path) -> list[Job]:
    jobs = []
    for name in settings.baselines:
        spec = get_baseline(name)
        if spec.kind != "learned":
            jobs.append(_evaluation(settings, output, output, name, settings.seeds, ()))
        elif settings.steps:
            label = f"{settings.name}: {settings.steps:,} steps" + (f", {settings.remark}" if settings.remark else "")
            more = ("--model", str(output / "models" / name), "--label", label)
            trained = _evaluation(settings, output, output, name, settings.seeds, more)
            jobs.append(replace(trained, after=(*trained.after, f"train-{name}")))
    if settings.shipped:
        for name in settings.baselines:
            seeds = [seed for seed in settings.seeds if seed in shipped_seeds(name)]
            if seeds:  # always: whether the weights are still the same is for the command to find out
                job = _evaluation(settings, output, output / _SHIPPED if settings.steps else output, name, seeds, ())
                jobs.append(replace(job, name=f"evaluate-{_SHIPPED}-{name}", always=True))
    return jobs


def _evaluation(
    settings: RunSettings, output: Path, folder: Path, name: str, seeds: Sequence[int], more: Command
) -> Job:
    """Evaluates one policy into ``folder``."""
    models, spec, chosen = _models(settings, output), get_baseline(name), _reconstructors(settings, name)
    specifications = [f"{r}={models[r]}" if r in models else r for r in chosen]
    command: Command = ("tslam-bench", "evaluate", "--policy", name, "--object-set", settings.object_set)
    command += (*_objects(settings), "--seeds", *map(str, seeds))
    if spec.kind != "reference":
        command += ("--policy-salt", settings.policy_salt)
    command += ("--reconstructor", *specifications, *_ONE_PROCESS, "--output", str(folder))
    after = [_TEST_ASSETS, *(f"train-{r}" for r in chosen if r in models)]
    if any(get_reconstructor(r).needs == "objects" for r in chosen):
        after.append("assets-train")
        command += _listed("--learning-objects", dict(settings.learning_objects)["train"])
    outputs = tuple(folder / "submissions" / f"{spec.id}-{get_reconstructor(r).id}" / INFO_FILE for r in chosen)
    return Job(f"evaluate-{spec.id}", (*command, *more), tuple(after), outputs)


def _scoring_jobs(settings: RunSettings, output: Path, evaluations: Sequence[Job], workers: int) -> list[Job]:
    jobs = []
    shipped: Command = ()
    for evaluation in evaluations:
        submissions = [path.parent for path in evaluation.outputs]
        run = submissions[0].parents[1]
        folder = run / "scores"
        shipped = shipped if run == output else (str(run),)
        files = tuple(folder / f"{submission.name}.json" for submission in submissions)
        command: Command = ("tslam-bench", "score", *map(str, submissions), *_objects(settings))
        command += ("--output", str(folder if len(files) > 1 else files[0]))
        jobs.append(Job(evaluation.name.replace("evaluate", "score"), command, (evaluation.name,), files))
    page = (output / "leaderboard.json", output / "index.html")
    command = ("tslam-bench", "leaderboard", *shipped, "--scores", str(output / "scores"), "--output", str(output))
    command += ("--workers", str(workers))
    return [*jobs, Job("leaderboard", command, tuple(job.name for job in jobs), page, slots=workers)]


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs ``python -m tslam_bench.baselines.run``; exits with 0, 2 (bad input, a failed job) or 130 (interrupted)."""
    parsed = tyro.cli(Arguments, args=arguments, prog="bash baselines/run_all.sh")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends jobs in order, as Ctrl-C does
    with one_line_errors("run"):
        settings = settings_of(parsed)
        output = parsed.output or Path("runs") / settings.name
        absent = [
            name for name in settings.baselines if get_baseline(name).kind == "learned" and not shipped_seeds(name)
        ]
        if settings.shipped and absent:
            print(f"run: no weights are shipped of {', '.join(absent)}", file=sys.stderr)
        jobs = plan(settings, output, parsed.workers)
        if parsed.dry_run:
            print("\n".join(shlex.join(job.command) for job in jobs))
        else:
            _run(jobs, output, parsed)


def _run(jobs: list[Job], output: Path, arguments: Arguments) -> None:
    started = time.monotonic()
    form = "{l_bar}{bar}| {elapsed} {postfix}"
    slurm = parse_arguments(arguments.slurm)
    engine = (output / "logs" / "submitit").absolute()
    with (
        contextlib.closing(
            make_launcher(arguments.launcher, engine, arguments.workers, arguments.address, slurm)
        ) as launcher,
        Progress("run", "job", len(jobs), disable=not sys.stderr.isatty(), bar_format=form, mininterval=0) as bar,
    ):
        JobRunner(output, launcher, bar.write, bar.show).run(jobs)
    print(f"run: done in {(time.monotonic() - started) / 60:.1f} minutes: {output / 'index.html'}")


if __name__ == "__main__":
    main()
