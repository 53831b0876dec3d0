"""``tslam-bench reconstruct``: list, train and run reconstructors."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from tslam_bench.cli.commands import run_command
from tslam_bench.cli.progress import Progress
from tslam_bench.constants import OCCUPANCY_THRESHOLD, WORKSPACE_EDGE
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import atomic_file, check_output
from tslam_bench.grids import merge, world_to_object
from tslam_bench.reconstruction.inputs import read_grids
from tslam_bench.reconstruction.registry import list_reconstructors, make_reconstructor
from tslam_bench.reconstruction.training_config import COLLECTED_ONLY, TrainingConfig

_SIMULATED_STREAM = 4  # keeps the simulated touches apart from other uses of the seed


@dataclass(frozen=True)
class List:
    """Name the reconstructors."""

    json: bool = False
    """Print JSON instead of a table."""


@dataclass(frozen=True)
class Train:
    """Train a learned reconstructor on simulated touches of prepared objects.

    A run that was stopped goes on where it was saved last; a finished one is left alone.
    """

    config: tyro.conf.OmitArgPrefixes[TrainingConfig]
    output: Path
    """Checkpoint to write."""
    data: Path | None = None
    """Folder of collected touches (tslam-bench reconstruct collect); without one, touches are simulated as it goes."""
    split: str = "train"
    """Split to learn from."""
    count: int | None = None
    """Learn from this many of its prepared objects, the first by name; all of them if not given."""
    objects: tuple[str, ...] = ()
    """Learn from these of its prepared objects."""
    threshold_split: str = "val"
    """Split whose prepared objects fix the threshold; if none is prepared, the training objects do."""
    threshold_objects: tuple[str, ...] = ()
    """Fix the threshold on these of its prepared objects; all of them if not given."""
    log: Path | None = None
    """Directory of a TensorBoard log."""


@dataclass(frozen=True)
class Collect:
    """Let explorers and a simulation feel prepared objects, for `reconstruct train --data`.

    Writes OUTPUT/<policy>/<object>.npz and OUTPUT/simulated/<object>.npz; files that exist are kept.
    """

    output: Path
    """Folder to write."""
    policies: tuple[str, ...] = ("heuristic", "random_targets")
    """Explorers: ids (tslam-bench baselines list), or your own as module:Class or path/to/file.py:Class."""
    model: Path | None = None
    """Trained model, if there is one explorer and it needs one."""
    folder: str | None = None
    """Name of the folder instead of the explorer's, if there is one explorer."""
    repetitions: int = 1
    """Episodes per explorer, object and pose."""
    simulated: int = 8
    """Simulated explorations per object; 0 makes none."""
    split: str = "train"
    """Split of the objects; not test."""
    objects: tuple[str, ...] = ()
    """These of its prepared objects; all of them if not given."""
    seed: int = 0
    """Seed of the simulated touches."""
    processes: int | None = None
    """Worker processes of the simulation; the cores if not given."""


@dataclass(frozen=True)
class Export:
    """Write trained networks in half precision, with the record of their training, into one file that can be shipped."""

    models: tyro.conf.Positional[tuple[Path, ...]]
    """Checkpoints of one architecture; several unet are averaged."""
    output: Path
    """File to write, ending in .safetensors."""
    views: int = 4
    """unet: turned and mirrored copies of the grids that each network sees, 1 to 8."""
    temperature: float = 1.0
    """unet: what the logits are divided by, fixed on held-out objects."""


@dataclass(frozen=True)
class Run:
    """Reconstruct a shape from touched and visited grids, and write it as a mesh or a probability grid."""

    touched: tuple[Path, ...]
    """One or more .npz files with the arrays touched and, optionally, visited; they are merged."""
    output: Path
    """File to write: .ply, .stl, .obj or .off for a mesh in metres, .npz for the probabilities."""
    reconstructor: str = "hull"
    """Which one: an id (tslam-bench reconstruct list), or your own as module:Class or path/to/file.py:Class."""
    model: Path | None = None
    """Checkpoint, for those that need one."""
    poses: tuple[int, ...] = ()
    """Pose of each file, if its grids are in the world frame (rollouts are); none: they are in the object frame."""
    split: str = "train"
    """Split that mean_shape and retrieval are built from."""
    threads: int = 1
    """Torch threads."""


def main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench reconstruct`` with the given arguments.

    Raises:
        BenchmarkError: bad input; the message is one line.
    """
    commands = {"list": (List, _list), "collect": (Collect, _collect), "train": (Train, _train)}
    commands |= {"export": (Export, _export), "run": (Run, _run)}
    about = "From touched and visited grids to a shape."
    run_command("tslam-bench reconstruct", about, commands, arguments)


def _list(parsed: List) -> None:
    registered = list_reconstructors()
    if parsed.json:
        print(json.dumps([spec.row() for spec in registered], indent=2))
        return
    rows = [("id", "needs", "nothing touched", "summary")]
    rows += [(info.id, info.needs, info.empty, info.summary) for info in registered]
    widths = [max(len(row[i]) for row in rows) for i in range(3)]
    for row in rows:
        print("  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[3]]))


def _collect(parsed: Collect) -> None:
    from tslam_bench.evaluation.collect import collect_episodes
    from tslam_bench.objects.store import load_object
    from tslam_bench.reconstruction.touch_data import SIMULATED_FOLDER, explored_file, simulate_object
    from tslam_bench.reconstruction.training_objects import training_names

    if (parsed.model or parsed.folder) and len(parsed.policies) != 1:
        raise InvalidInputError(f"--model and --folder are of one explorer; {len(parsed.policies)} are given")
    if parsed.repetitions < 1 or parsed.simulated < 0:
        raise InvalidInputError("--repetitions must be at least 1, and --simulated at least 0")
    names = training_names(parsed.split, None, parsed.objects)
    for policy in parsed.policies:
        folder = parsed.output / (parsed.folder or policy_folder(policy))
        with Progress(f"explore with {policy}", "object", len(names)) as bar:
            collect_episodes(
                policy, names, parsed.split, folder, parsed.model, parsed.repetitions, parsed.processes, bar.show
            )
    if parsed.simulated:
        folder = parsed.output / SIMULATED_FOLDER
        with Progress("simulate touches", "object", len(names)) as bar:
            for index, name in enumerate(names):
                if not explored_file(folder, name).is_file():
                    generator = np.random.Generator(np.random.PCG64([parsed.seed, _SIMULATED_STREAM, index]))
                    simulate_object(load_object(name, parsed.split), parsed.simulated, generator).save(folder, name)
                bar.show(index + 1)
    print(f"{parsed.output}: {len(names)} objects of {parsed.split}")


def policy_folder(policy: str) -> str:
    """A folder's name for an id, ``module:Class`` or ``file.py:Class``."""
    from tslam_bench.evaluation.policies import get_baseline

    return get_baseline(policy).id


def _train(parsed: Train) -> None:
    from tslam_bench.reconstruction.learned import LearnedReconstructor, network_config
    from tslam_bench.reconstruction.training import train
    from tslam_bench.reconstruction.training_objects import load_training_shapes, training_names

    config = parsed.config
    config.check()
    network_config(config.architecture, config.size)
    names = training_names(parsed.split, parsed.count, parsed.objects)
    if parsed.data is not None:
        _train_on_data(parsed, names)
        return
    if config.architecture in COLLECTED_ONLY:
        raise InvalidInputError(
            f"{config.architecture}: learns from collected touches; give --data FOLDER (tslam-bench reconstruct collect)"
        )
    try:
        held_out = training_names(parsed.threshold_split, None, parsed.threshold_objects)
    except AssetError:
        if parsed.threshold_objects:
            raise
        held_out = []
    with Progress("sample objects to learn from", "object") as bar:
        shapes = load_training_shapes(names, parsed.split, config.seed, progress=bar.show)
    with Progress("sample objects for the threshold", "object") as bar:
        threshold_shapes = (
            load_training_shapes(held_out, parsed.threshold_split, config.seed, progress=bar.show) or None
        )
    with Progress(f"train {config.architecture}", "step", config.steps) as bar:

        def show(done: int, loss: float) -> None:
            bar.show(done, note="" if math.isnan(loss) else f"loss {loss:.3f}")

        reconstructor = train(shapes, config, parsed.output, parsed.log, threshold_shapes, show)
        bar.show(config.steps)
    assert isinstance(reconstructor, LearnedReconstructor)  # None is of runs that are stopped, the other kind of --data
    print(
        f"{parsed.output}: {config.architecture}, {config.steps} steps on {len(shapes)} objects, "
        f"threshold {reconstructor.threshold:.2f}"
    )


def _train_on_data(parsed: Train, names: Sequence[str]) -> None:
    from tslam_bench.objects.store import load_object
    from tslam_bench.reconstruction.touch_data import load_touch_data
    from tslam_bench.reconstruction.training import train

    assert parsed.data is not None
    config = parsed.config
    with Progress("read collected touches", "object", len(names)) as bar:
        data = load_touch_data(parsed.data, [load_object(name, parsed.split) for name in names], bar.show)
    with Progress(f"train {config.architecture}", "step", config.steps) as bar:

        def show(done: int, loss: float) -> None:
            bar.show(done, note="" if math.isnan(loss) else f"loss {loss:.4f}")

        train(data, config, parsed.output, parsed.log, None, show)
        bar.show(config.steps)
    print(f"{parsed.output}: {config.architecture}, {config.steps} steps on {len(data)} objects")


def _export(parsed: Export) -> None:
    from tslam_bench.reconstruction.trained import load_reconstructor
    from tslam_bench.reconstruction.weights import SUFFIX, save_weights

    if parsed.output.suffix != SUFFIX:
        raise InvalidInputError(f"--output {parsed.output}: end it in {SUFFIX}")
    check_output(parsed.output, parsed.models)
    dense = load_reconstructor(parsed.models[0]).name == "unet" if parsed.models else False
    settings = {"views": parsed.views, "temperature": parsed.temperature} if dense else {}
    save_weights(parsed.output, parsed.models, settings)
    made = load_reconstructor(parsed.output)
    print(f"{parsed.output}: {made.name}, {len(parsed.models)} networks, {parsed.output.stat().st_size / 1e6:.1f} MB")


def _run(parsed: Run) -> None:
    suffix = parsed.output.suffix.lower()
    if suffix not in (".ply", ".stl", ".obj", ".off", ".npz"):
        raise InvalidInputError(
            f"--output {parsed.output}: unknown kind of file; end it in .ply, .stl, .obj, .off or .npz"
        )
    check_output(parsed.output, parsed.touched)
    if parsed.poses and len(parsed.poses) != len(parsed.touched):
        raise InvalidInputError(
            f"--poses: {len(parsed.poses)} poses for {len(parsed.touched)} files; give one for each"
        )
    pairs = [read_grids(path) for path in parsed.touched]
    if parsed.poses:
        pairs = [
            (world_to_object(touched, pose), world_to_object(visited, pose))
            for (touched, visited), pose in zip(pairs, parsed.poses, strict=True)
        ]
    touched, visited = (merge(pair[channel] for pair in pairs) for channel in (0, 1))
    reconstructor = make_reconstructor(parsed.reconstructor, parsed.model, parsed.split, threads=parsed.threads)
    volume = reconstructor.reconstruct(touched, visited)
    mesh = volume.to_mesh()
    if suffix != ".npz" and len(mesh.faces) == 0:
        raise InvalidInputError(
            f"{parsed.reconstructor}: the reconstruction is empty ({int(touched.sum())} voxels touched), "
            "and a mesh file cannot hold that; write .npz instead"
        )
    with atomic_file(parsed.output) as temporary:
        if suffix == ".npz":
            with temporary.open("wb") as stream:
                np.savez_compressed(stream, probability=volume.probability, interpolation=volume.interpolation)
        else:
            mesh.export(str(temporary), file_type=suffix[1:])
    solid = float((volume.probability >= OCCUPANCY_THRESHOLD).mean()) * WORKSPACE_EDGE**3 * 1e6
    print(
        f"{parsed.output}: {parsed.reconstructor} from {int(touched.sum())} touched and {int(visited.sum())} visited "
        f"voxels, about {solid:.0f} cm3"
    )
