"""The registered explorers (protocol section 11): ids are fixed."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.policy import Baseline

MODEL_FILE: Final = "model.safetensors"
"""A finished model's weights: numbers alone, so that a stranger's model cannot run code."""
METADATA_FILE: Final = "model.json"
"""Written last: a model directory without it is unfinished."""


@dataclass(frozen=True)
class BaselineSpec:
    """One registered explorer.

    Attributes:
        id: fixed identifier.
        summary: one line for listings.
        kind: ``scripted`` (acts by rule), ``learned`` (needs a trained model) or ``reference`` (no policy: the grids
            come from the ground truth or stay empty).
        reward_mode: reward that a learned explorer is trained with (protocol section 7); None for the others.
        privileged: training or exploration reads the true shape, so the entry is marked in every ranking.
    """

    id: str
    summary: str
    kind: Literal["scripted", "learned", "reference"]
    reward_mode: str | None = None
    privileged: bool = False


def _learned(identifier: str, reward_mode: str, summary: str, privileged: bool = False) -> BaselineSpec:
    return BaselineSpec(identifier, summary, "learned", reward_mode, privileged)


_SPECS = (
    BaselineSpec("random", "uniform actions each step", "scripted"),
    BaselineSpec("random_targets", "random absolute joint targets, each held for four steps", "scripted"),
    BaselineSpec("heuristic", "power grasp from a randomly placed open hand, reopened and repeated", "scripted"),
    _learned("tslam", "tslam", "PPO on novel touched voxels plus coverage of free space"),
    _learned("tslam_no_coverage", "no_coverage", "PPO on novel touched voxels alone"),
    _learned("tslam_no_discovery", "no_discovery", "PPO on coverage of free space alone"),
    _learned("tslam_knn", "knn", "PPO on the distance of new contact points to known ones, plus coverage"),
    _learned("tslam_points", "points", "PPO on the number of new contact points, plus coverage"),
    _learned("tslam_contact", "contact", "PPO on being in contact, plus coverage"),
    _learned("tslam_disagreement", "disagreement", "PPO on the change of the contacts' alpha shape, plus coverage"),
    _learned(
        "tslam_chamfer", "chamfer", "PPO on the Chamfer distance to the true surface, plus coverage", privileged=True
    ),
    BaselineSpec("oracle", "reference: every surface voxel touched", "reference", privileged=True),
    BaselineSpec("nothing", "reference: nothing touched", "reference", privileged=True),
)
_CLASSES: Final = {
    "random": "tslam_bench.baselines.random_actions:RandomBaseline",
    "random_targets": "tslam_bench.baselines.random_actions:RandomTargetsBaseline",
    "heuristic": "tslam_bench.baselines.heuristic:HeuristicBaseline",
    "learned": "tslam_bench.baselines.learned_policy:LearnedBaseline",  # brings torch
}
"""Where the policies live: the library names them, and imports none of them before one is made."""
_BY_ID = {spec.id: spec for spec in _SPECS}


def list_baselines() -> tuple[BaselineSpec, ...]:
    """All registered explorers: the baselines in the order of protocol section 11, then the references."""
    return _SPECS


def get_baseline(identifier: str) -> BaselineSpec:
    """The registered explorer ``identifier``.

    Raises:
        InvalidInputError: unknown id (the message lists the known ones).
    """
    try:
        return _BY_ID[identifier]
    except KeyError:
        raise InvalidInputError(f"baseline {identifier!r}: unknown; choose one of {', '.join(_BY_ID)}") from None


def make_baseline(identifier: str, model: Path | None = None, deterministic: bool = False) -> Baseline:
    """Builds the policy of a registered explorer.

    Args:
        identifier: a scripted or learned id.
        model: directory that ``tslam-bench baselines train`` wrote; learned explorers need it.
        deterministic: a learned explorer acts by the mean of its policy instead of sampling from it.

    Raises:
        InvalidInputError: unknown id, a reference (it has no policy), or a missing or unreadable model (the message
            gives the training command).
    """
    spec = get_baseline(identifier)
    if spec.kind == "reference":
        raise InvalidInputError(
            f"baseline {identifier!r}: a reference has no policy; evaluate it instead of acting with it"
        )
    if spec.kind != "learned" and model is not None:
        raise InvalidInputError(f"baseline {identifier!r}: takes no model; leave the argument out")
    module, _, name = _CLASSES[spec.id if spec.kind == "scripted" else "learned"].partition(":")
    made = getattr(importlib.import_module(module), name)
    return made.load(spec, model, deterministic=deterministic) if spec.kind == "learned" else made()
