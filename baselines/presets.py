"""What a run of the whole benchmark does: the usual choices."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal

from tslam_bench.constants import QUICK_OBJECTS, QUICK_TRAIN_OBJECTS, QUICK_VAL_OBJECTS
from tslam_bench.evaluation.policies import list_baselines

from .training_config import PAPER_STEPS

ALL_BASELINES: Final = tuple(spec.id for spec in list_baselines())


@dataclass(frozen=True)
class RunSettings:
    """What a run does; :data:`PRESETS` has the usual ones.

    Attributes:
        name: folder below the output folder, and label.
        objects: test objects; empty: the whole test split.
        object_set: ranking that the submissions are for.
        baselines: policies: ids, or ``module:Class``.
        seeds: repetitions of every episode.
        steps: training steps of each learned baseline; 0: none is trained.
        shipped: the shipped weights of learned baselines explore too, repetition s with those of training seed s.
        training: further arguments of ``tslam-bench baselines train``.
        learning_objects: (split, names) of the objects to learn from; no names: the split's default set, whole. The
            reconstructors' thresholds are fixed on val, or on train while val is not listed.
        reconstructors: ids; learned ones whose weights are not shipped are trained first.
        reconstruction_training: further arguments of ``tslam-bench reconstruct train``.
        retrain: learned reconstructors are trained even if their weights are shipped.
        collected: reconstructors learn from touches that are collected first; else from touches that are simulated as it goes, if
            they can.
        remark: shown beside the figures of learned baselines.
        policy_salt: where explorers' random numbers and the order of episodes come from. Ours do not look at it, so it is fixed:
            a run gives the same figures everywhere.
    """

    name: str
    objects: tuple[str, ...]
    object_set: Literal["quick", "test"]
    baselines: tuple[str, ...]
    seeds: tuple[int, ...]
    steps: int
    training: tuple[str, ...]
    learning_objects: tuple[tuple[str, tuple[str, ...]], ...]
    reconstructors: tuple[str, ...]
    reconstruction_training: tuple[str, ...]
    remark: str
    policy_salt: str = "2021"
    shipped: bool = False
    retrain: bool = False
    collected: bool = False


_QUICK_TRAINING: Final = (
    "--num-envs",
    "8",
    "--batch-size",
    "100",
    "--checkpoint-every",
    "8000",
    "--torch-threads",
    "1",
)
_SCRIPTED: Final = RunSettings(
    name="scripted",
    objects=(),
    object_set="test",
    baselines=tuple(spec.id for spec in list_baselines() if spec.kind != "learned"),
    seeds=(0, 1, 2),
    steps=0,
    training=(),
    learning_objects=(("train", QUICK_TRAIN_OBJECTS), ("val", QUICK_VAL_OBJECTS)),
    reconstructors=("grid", "hull", "carve", "ifnet", "unet"),
    reconstruction_training=("--steps", "1000"),
    remark="",
)
PRESETS: Final[dict[str, RunSettings]] = {
    "quick": RunSettings(
        name="quick",
        objects=QUICK_OBJECTS,
        object_set="quick",
        baselines=ALL_BASELINES,
        seeds=(0,),
        steps=32_000,
        training=_QUICK_TRAINING,
        learning_objects=(("train", QUICK_TRAIN_OBJECTS), ("val", QUICK_VAL_OBJECTS)),
        reconstructors=("grid", "hull", "carve", "ifnet", "unet"),
        reconstruction_training=("--steps", "300"),
        remark="proves the path, not the method",
        shipped=True,
    ),
    "tiny": RunSettings(
        name="tiny",
        objects=("mug",),
        object_set="quick",
        baselines=("random", "heuristic", "tslam", "oracle", "nothing"),
        seeds=(0,),
        steps=800,
        training=("--num-envs", "2", "--batch-size", "50", "--epochs", "1", "--torch-threads", "1"),
        learning_objects=(("train", QUICK_TRAIN_OBJECTS[:2]),),
        reconstructors=("grid", "hull", "carve", "ifnet"),
        reconstruction_training=("--steps", "3", "--batch-size", "2", "--threshold-examples", "4"),
        remark="shows that everything runs, nothing else",
        retrain=True,
    ),
    "scripted": _SCRIPTED,
    "shipped": replace(_SCRIPTED, name="shipped", baselines=ALL_BASELINES, shipped=True),
    "full": RunSettings(
        name="full",
        objects=(),
        object_set="test",
        baselines=ALL_BASELINES,
        seeds=(0, 1, 2),
        steps=PAPER_STEPS,
        training=(),
        learning_objects=(("train", ()),),
        reconstructors=("grid", "hull", "carve", "ifnet", "unet"),
        reconstruction_training=("--steps", "20000", "--batch-size", "16", "--points", "2048"),
        remark="",
        retrain=True,
        collected=True,
    ),
}
"""``quick``: a leaderboard within 15 minutes on 2 cores. ``tiny``: the same path in a minute or two, for CI. ``scripted``: what
needs no policy to be trained, on all test objects, three seeds. ``shipped``: the same and the learned policies whose weights are
shipped. ``full``: everything, with the paper's budget; days on a CPU."""
