"""Evaluates one policy: episodes, merged grids, reconstructions, submissions (protocol sections 6, 9 and 12).

Layout below the output folder::

    rollouts/<explorer>/source.json
    rollouts/<explorer>/<object>/pose<k>_seed<s>.npz
    reconstructors/<explorer>-<reconstructor>.json
    submissions/<explorer>-<reconstructor>/     its rollouts are hard links to those above, where the file system allows

The two kinds of JSON files say what the results depend on: results of another model, or of code that has changed, are not mixed.

Every file is written whole or not at all and is not made again, so a run that was killed goes on where it stopped.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import ENVIRONMENT_ID, GRID_SIZE, NUM_POSES
from tslam_bench.episodes import check_salt, new_salt, shuffled
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.evaluation.policies import (
    PolicySpec,
    fixed_model,
    get_baseline,
    make_baseline,
    policy_label,
    policy_source,
)
from tslam_bench.evaluation.policy import CheckedPolicy
from tslam_bench.evaluation.rollouts import roll_out_batch
from tslam_bench.evaluation.weights import shipped_weights, training_record
from tslam_bench.files import ensure_writable_directory, write_json
from tslam_bench.grids import merge, world_to_object
from tslam_bench.hand_constants import CONTROL_MODES
from tslam_bench.objects.splits import check_split, object_set, resolve_name
from tslam_bench.objects.store import asset_sha256, load_object
from tslam_bench.reconstruction.registry import (
    ReconstructorSpec,
    get_reconstructor,
    make_reconstructor,
    reconstructor_source,
)
from tslam_bench.reconstruction.volume import Reconstructor
from tslam_bench.registration import make_vec
from tslam_bench.scoring.info import OBJECT_SETS, SubmissionInfo, Training
from tslam_bench.scoring.origin import write_origin
from tslam_bench.scoring.rollout import Rollout, rollout_file
from tslam_bench.scoring.submission import RECONSTRUCTED_POSES, SubmissionWriter, read_submission
from tslam_bench.version import __version__

SOURCE_FILE: Final = "source.json"
SIDE_BY_SIDE: Final = 8
"""Episodes that are rolled out at a time."""
Grid = NDArray[np.bool_]
Grids = tuple[Grid, Grid]
"""Touched and visited."""


@dataclass(frozen=True)
class EvaluationConfig:
    """What to evaluate.

    Attributes:
        policy: registered id, ``module:Class``, a class or function, or a policy that is already made.
        objects: objects of the split; aliases are resolved.
        seeds: repetitions; each is 8 episodes per object.
        object_set: ``quick`` or ``test``: which ranking the submissions are for; of another split its name.
        model: directory of the trained model of a learned baseline, or a file of weights; or what a policy of the user's
            reads. None lets a learned baseline play repetition s with the shipped weights of training seed s.
        arguments: handed to the policy's class or function.
        policy_salt: hexadecimal digits from which the explorer's random numbers and the order of the episodes come; None
            takes that of the episodes which are there already, or draws one.
        label: remark that is shown beside every figure of the submission.
        authors: whose submission it is.
        privileged: the policy saw or was rewarded with the true shape; known of registered ones.
        processes: worker processes that simulate; None means the cores. Results do not depend on it.
        split: of the objects; follows from ``object_set``.
        spec: what ``policy`` is.
    """

    policy: Any
    objects: tuple[str, ...]
    seeds: tuple[int, ...] = (0,)
    object_set: str = "test"
    model: Path | None = None
    arguments: Mapping[str, Any] = field(default_factory=dict)
    policy_salt: str | None = None
    label: str = ""
    authors: tuple[str, ...] = ("The tslam-bench authors",)
    privileged: bool = False
    processes: int | None = None
    split: str = field(init=False)
    spec: PolicySpec = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "spec", get_baseline(self.policy))
        if "model" in self.arguments:
            raise InvalidInputError("argument 'model': give it as the model, so that its content is recorded")
        if self.spec.kind == "reference" and (self.arguments or self.model):
            raise InvalidInputError(f"policy {self.spec.id!r}: a reference takes no arguments and no model")
        if self.policy_salt is not None:
            check_salt(self.policy_salt)
        if not self.objects or not self.seeds:
            raise InvalidInputError("evaluation: give at least one object and one seed")
        if min(self.seeds) < 0 or len(set(self.seeds)) != len(self.seeds):
            raise InvalidInputError(f"seeds {list(self.seeds)}: must be different and not negative")
        split = check_split("test" if self.object_set in OBJECT_SETS else self.object_set)
        object.__setattr__(self, "split", split)
        object.__setattr__(self, "objects", tuple(dict.fromkeys(resolve_name(name, split) for name in self.objects)))


@dataclass(frozen=True)
class ChosenReconstructor:
    """A reconstructor, and what its results depend on."""

    spec: ReconstructorSpec
    made: Reconstructor
    source: Mapping[str, Any]


def make_reconstructors(
    specifications: Sequence[Any], learning_objects: Sequence[str] = ()
) -> dict[str, ChosenReconstructor]:
    """Reconstructors by id. ``none`` alone gives none.

    Args:
        specifications: ``ID``, ``module:name`` or, for those that have learned, ``ID=MODEL`` or ``module:name=MODEL``; or
            classes, functions, or reconstructors that are already made.
        learning_objects: train objects that ``mean_shape`` and ``retrieval`` are built from; empty: all prepared.

    Raises:
        InvalidInputError: unknown id, a model that is missing or unreadable, or one id twice.
        UserCodeError: the user's code raised something.
    """
    if tuple(specifications) == ("none",):
        return {}
    reconstructors: dict[str, ChosenReconstructor] = {}
    for specification in specifications:
        name, _, path = specification.partition("=") if isinstance(specification, str) else (specification, "", "")
        model = Path(path) if path else None
        spec = get_reconstructor(name)
        if spec.id in reconstructors:
            raise InvalidInputError(f"reconstructor {spec.id!r}: given twice")
        made = make_reconstructor(name, model, objects=learning_objects)
        source = reconstructor_source(name, model, learning_objects)
        reconstructors[spec.id] = ChosenReconstructor(spec, made, source)
    return reconstructors


def evaluate(
    config: EvaluationConfig,
    reconstructors: Mapping[str, ChosenReconstructor],
    output: Path,
    on_progress: Callable[[str, int, int], None] | None = None,
) -> list[Path]:
    """Explores every object in all 8 poses, reconstructs from 1, 2, 4 and 8 merged poses, and writes one submission per
    reconstructor.

    Args:
        config: what to evaluate.
        reconstructors: see :func:`make_reconstructors`.
        output: folder of the run.
        on_progress: called with (stage, done, total) after each episode and each object.

    Returns:
        The submissions' folders.

    Raises:
        InvalidInputError: a model is missing, ``output`` holds results of another model or of other code, or a policy or
            reconstructor of the user's gave something unusable.
        UserCodeError: the user's code raised something. Episodes that are finished are kept.
        AssetError: an object is not prepared, or ``output`` cannot be written.
    """
    spec = config.spec
    report = on_progress or (lambda stage, done, total: None)
    folder = output / "rollouts" / spec.id
    source = explore(config, folder, report) if spec.kind != "reference" else {}
    submissions = []
    for name, reconstructor in reconstructors.items():
        submission = output / "submissions" / f"{spec.id}-{name}"
        record = output / "reconstructors" / f"{submission.name}.json"
        _record_source(record, reconstructor.source, f"{submission}: holds other reconstructions", submission.is_dir())
        with SubmissionWriter(submission, submission_info(config, name, source)) as writer:
            total = len(config.objects) * len(config.seeds)
            for done, (object_name, seed) in enumerate(_repetitions(config)):
                _add_object(writer, config, folder, reconstructor.made, object_name, seed)
                report(f"reconstruct {name}", done + 1, total)
        write_origin(read_submission(submission, split=config.split))
        submissions.append(submission)
    return submissions


def explore(config: EvaluationConfig, folder: Path, report: Callable[[str, int, int], None]) -> dict[str, Any]:
    """Rolls out every episode that ``folder`` lacks, in an order that the salt shuffles.

    Returns:
        what the episodes depend on: the content of ``source.json``.

    Raises:
        InvalidInputError: ``folder`` holds episodes of another model, of other code, of other assets or of another salt.
    """
    players = _players(config)
    modes = sorted({baseline.control_mode for baseline in players.values()})
    if len(modes) > 1:
        raise InvalidInputError(f"policy {config.spec.id!r}: its weights act in {' and in '.join(modes)}; evaluate one")
    path = ensure_writable_directory(folder) / SOURCE_FILE
    known = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    salt = config.policy_salt or known.get("policy_salt") or new_salt()
    source = _source(config, modes[0], salt)
    _record_source(path, source, f"{folder}: holds other episodes", bool(known))
    episodes = [(name, pose, seed) for name, seed in _repetitions(config) for pose in range(NUM_POSES)]
    missing = [e for e in shuffled(salt, episodes) if not (folder / rollout_file(*e)).is_file()]
    report("explore", len(episodes) - len(missing), len(episodes))
    if not missing:
        return source
    width, done = min(SIDE_BY_SIDE, len(missing)), len(episodes) - len(missing)
    envs = make_vec(
        ENVIRONMENT_ID,
        width,
        "cpu",
        objects=config.objects,
        split=config.split,
        control_mode=modes[0],
        processes=config.processes,
    )
    try:
        for seeds, baseline in players.items():
            its = [episode for episode in missing if episode[2] in seeds]
            for first in range(0, len(its), width):
                baseline.playing = its[first : first + width]
                for rollout in roll_out_batch(envs, baseline, baseline.playing, salt):
                    rollout.save(folder)
                    done += 1
                    report("explore", done, len(episodes))
    finally:
        envs.close()
    return source


def _players(config: EvaluationConfig) -> dict[tuple[int, ...], CheckedPolicy]:
    """Repetitions -> the policy that plays them: one plays all, but shipped weights play the repetition of their seed."""
    label = policy_label(config.policy)
    if config.spec.kind != "learned" or fixed_model(config.spec, config.model, config.arguments) is not None:
        return {config.seeds: CheckedPolicy(make_baseline(config.policy, config.model, **config.arguments), label)}
    return {
        (seed,): CheckedPolicy(make_baseline(config.policy, **config.arguments, seed=seed), label)
        for seed in config.seeds
    }


def merged_grids(rollouts: Sequence[Rollout]) -> Grids:
    """Touched and visited of several poses of one object, carried into the object frame and united."""
    touched = merge(world_to_object(rollout.touched, rollout.pose) for rollout in rollouts)
    visited = merge(world_to_object(rollout.visited, rollout.pose) for rollout in rollouts)
    return touched, visited


def reference_grids(identifier: str, object_name: str, split: str = "test") -> Grids:
    """Grids of a reference explorer in the object frame.

    ``oracle``: every voxel that the true surface crosses is touched, every voxel whose centre is outside is visited.
    ``nothing``: both empty.
    """
    if identifier == "nothing":
        return np.zeros((GRID_SIZE,) * 3, dtype=bool), np.zeros((GRID_SIZE,) * 3, dtype=bool)
    prepared = load_object(object_name, split)
    return prepared.surface.copy(), ~prepared.solid


def manifest_sha256(config: EvaluationConfig) -> str:
    """Hash of the object set's assets; of the evaluated objects alone while the set is not prepared as a whole.

    Raises:
        AssetError: an evaluated object is not prepared.
    """
    try:
        return asset_sha256(object_set(config.object_set), config.split)
    except AssetError:
        return asset_sha256(config.objects, config.split)


def submission_info(config: EvaluationConfig, reconstructor: str, source: Mapping[str, Any]) -> SubmissionInfo:
    """What the submission says about itself; budget and hardware come from the model's metadata.

    ``source`` is what :func:`explore` returned, empty for a reference.
    """
    spec = config.spec
    training, label, name = Training(), config.label, spec.id
    if spec.kind == "learned":
        fixed = fixed_model(spec, config.model, config.arguments)
        models = [fixed] if fixed is not None else [shipped_weights(spec.id, seed) for seed in config.seeds]
        records = [training_record(model) for model in models]
        machine = records[0]["machine"]
        training = Training(  # of several trainings, the longest
            steps=max(int(record["steps"]) for record in records),
            wall_time_hours=max(float(record["seconds"]) for record in records) / 3600,
            hardware=f"{machine['processor']}, {machine['cores']} cores",
        )
        name = spec.reference or name
        if config.model is None and not label:
            label = f"shipped weights: {training.steps:,} training steps"
    return SubmissionInfo(
        method=f"{_with_arguments(name, config.arguments)} + {reconstructor}",
        explorer=spec.id,
        reconstructor=reconstructor,
        authors=config.authors,
        asset_manifest_sha256=manifest_sha256(config),
        seeds=config.seeds,
        object_set=config.object_set,
        privileged=spec.privileged or config.privileged,
        package_version=__version__,
        reward_mode=spec.reward_mode,
        control_mode=source.get("control_mode", CONTROL_MODES[0]),
        policy_salt=source.get("policy_salt"),
        training=training,
        label=label,
    )


def _add_object(
    writer: SubmissionWriter,
    config: EvaluationConfig,
    folder: Path,
    reconstructor: Reconstructor,
    object_name: str,
    seed: int,
) -> None:
    """Adds one object's rollouts and reconstructions, those that are not there yet."""
    missing = [n for n in RECONSTRUCTED_POSES if not writer.has_reconstruction(object_name, n, seed)]
    if config.spec.kind == "reference":
        if missing:
            volume = reconstructor.reconstruct(*reference_grids(config.spec.id, object_name, config.split))
            for count in missing:
                writer.add_reconstruction(object_name, count, seed, volume)
        return
    paths = {pose: folder / rollout_file(object_name, pose, seed) for pose in range(NUM_POSES)}
    rollouts = {pose: Rollout.load(path) for pose, path in paths.items()}
    for pose, rollout in rollouts.items():
        if not writer.has_rollout(object_name, pose, seed):
            writer.add_rollout(rollout, paths[pose])
    for count in missing:
        grids = merged_grids([rollouts[pose] for pose in RECONSTRUCTED_POSES[count]])
        writer.add_reconstruction(object_name, count, seed, reconstructor.reconstruct(*grids))


def _repetitions(config: EvaluationConfig) -> Iterator[tuple[str, int]]:
    return ((name, seed) for name in config.objects for seed in config.seeds)


def _source(config: EvaluationConfig, control_mode: str, salt: str) -> dict[str, Any]:
    """What the episodes depend on besides object, pose and seed."""
    return {
        **policy_source(config.policy, dict(config.arguments), config.model),
        "control_mode": control_mode,
        "policy_salt": salt,
        "asset_manifest_sha256": asset_sha256(config.objects, config.split),
        "package_version": __version__,
        "environment": ENVIRONMENT_ID,
    }


def _record_source(path: Path, source: Mapping[str, Any], others: str, resumed: bool) -> None:
    """Writes what results depend on, or raises InvalidInputError (``others``) if those resumed depend on something else."""
    known = json.loads(path.read_text(encoding="utf-8")) if resumed and path.is_file() else source
    if known != source:
        differing = ", ".join(key for key in source if known.get(key) != source[key])
        raise InvalidInputError(f"{others} (another {differing}); delete it or move it away")
    write_json(path, source)


def _with_arguments(identifier: str, arguments: Mapping[str, Any]) -> str:
    """The name of a policy with its arguments, so that two settings are told apart on a leaderboard."""
    if not arguments:
        return identifier
    text = ", ".join(f"{key}={json.dumps(value)}" for key, value in arguments.items())
    return f"{identifier}({text if len(text) <= 150 else text[:147] + '...'})"
