"""The registered policies: the benchmark's explorers (protocol section 11), whose ids are fixed, and the user's own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

from tslam_bench.constants import PRIVILEGED_EXPLORERS
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.policy import Policy
from tslam_bench.evaluation.weights import shipped_seeds, shipped_weights, weights_file
from tslam_bench.files import sha256_file
from tslam_bench.hand_constants import CONTROL_MODES
from tslam_bench.plugins import Registry, Spec


@dataclass(frozen=True)
class PolicySpec(Spec):
    """One registered policy.

    Attributes:
        kind: ``scripted`` (acts by rule), ``learned`` (needs a trained model), ``reference`` (no policy: the grids come
            from the ground truth or stay empty) or ``own`` (the user's).
        reward_mode: reward that a learned explorer is trained with (protocol section 7); None for the others.
        privileged: training or exploration reads the true shape, or there is none: the entry is marked in every ranking.
    """

    kind: Literal["scripted", "learned", "reference", "own"] = "own"
    reward_mode: str | None = None
    privileged: bool = False


def _scripted(identifier: str, factory: str, summary: str) -> PolicySpec:
    return PolicySpec(identifier, summary, factory, kind="scripted")


def _learned(identifier: str, reward_mode: str, summary: str) -> PolicySpec:
    return PolicySpec(
        identifier,
        summary,
        "tslam_bench.baselines.learned_policy:LearnedBaseline.load",  # brings torch
        {"baseline": identifier},
        kind="learned",
        reward_mode=reward_mode,
        privileged=identifier in PRIVILEGED_EXPLORERS,
    )


def _reference(identifier: str, summary: str) -> PolicySpec:
    return PolicySpec(identifier, summary, kind="reference", privileged=identifier in PRIVILEGED_EXPLORERS)


_POLICIES: Final = Registry(
    "policy",
    "tslam_bench.policies",
    (
        _scripted("random", "tslam_bench.baselines.random_actions:RandomBaseline", "uniform actions in each step"),
        _scripted(
            "random_targets",
            "tslam_bench.baselines.random_actions:RandomTargetsBaseline",
            "random absolute joint targets, each held for four steps",
        ),
        _scripted(
            "heuristic",
            "tslam_bench.baselines.heuristic:HeuristicBaseline",
            "power grasp from a randomly placed open hand, reopened and repeated",
        ),
        _scripted(
            "frontier",
            "tslam_bench.baselines.frontier:FrontierBaseline",
            "goes where its own map says that surface is likely and unfelt",
        ),
        _learned("tslam", "tslam", "PPO on novel touched voxels plus coverage of free space"),
        _learned("tslam_no_coverage", "no_coverage", "PPO on novel touched voxels alone"),
        _learned("tslam_no_discovery", "no_discovery", "PPO on coverage of free space alone"),
        _learned("tslam_knn", "knn", "PPO on the distance of new contact points to known ones, plus coverage"),
        _learned("tslam_points", "points", "PPO on the number of new contact points, plus coverage"),
        _learned("tslam_contact", "contact", "PPO on being in contact, plus coverage"),
        _learned("tslam_disagreement", "disagreement", "PPO on the change of the contacts' alpha shape, plus coverage"),
        _learned("tslam_chamfer", "chamfer", "PPO on the Chamfer distance to the true surface, plus coverage"),
        _reference("oracle", "every surface voxel touched"),
        _reference("nothing", "nothing touched"),
    ),
    PolicySpec,
)


def register_policy(
    id: str, factory: str | Callable[..., Policy], *, summary: str = "", privileged: bool = False
) -> None:
    """Makes a policy of your own known under an id, in every process that runs this line.

    Args:
        id: at most 64 of a-z, 0-9, ``_``, ``.``, ``-``; also names folders and the explorer of submissions.
        factory: class, or function that returns a policy (:class:`tslam_bench.evaluation.policy.Policy`), or
            ``module:name`` of one. It is called with the arguments that were asked for and, if one was given, ``model=PATH``.
        summary: one line for listings.
        privileged: the policy saw, or was rewarded with, anything that derives from the true shape.

    Raises:
        InvalidInputError: not an id, or one of the benchmark's own.
    """
    _POLICIES.register(PolicySpec(id, summary, factory, privileged=privileged))


def list_baselines() -> tuple[PolicySpec, ...]:
    """All registered policies: the baselines in the order of protocol section 11, the references, then the user's own."""
    return _POLICIES.all()


def get_baseline(policy: Any) -> PolicySpec:
    """The spec of an id, of ``module:Class``, of a class or function, or of a policy itself.

    ``tslam@1`` is ``tslam`` with the shipped weights of training seed 1.

    Raises:
        InvalidInputError: unknown id (the message lists the known ones), or ``@`` after one that is not learned.
    """
    if not isinstance(policy, str) or "@" not in policy or ":" in policy:
        return _POLICIES.get(policy)
    name, _, seed = policy.partition("@")
    spec = _POLICIES.get(name)
    if spec.kind != "learned" or not (seed.isascii() and seed.isdigit()):
        raise InvalidInputError(
            f"policy {policy!r}: a training seed follows '@', as in tslam@1, and only a learned explorer has one"
        )
    return replace(spec, kwargs={**spec.kwargs, "seed": int(seed)}, reference=policy)


def make_baseline(policy: Any, model: Path | None = None, /, **arguments: Any) -> Policy:
    """Builds a policy.

    Args:
        policy: see :func:`get_baseline`.
        model: of a learned explorer, the directory that ``tslam-bench baselines train`` wrote, or a file of weights; None
            loads the shipped weights. Of a policy of the user's, whatever it reads.
        arguments: handed to its class or function. Learned explorers take ``seed``, that of the training whose shipped
            weights are loaded (default 0), and ``deterministic``: act by the mean of the policy instead of sampling from it.

    Raises:
        InvalidInputError: unknown id, a reference (it has no policy), something that is not a policy, unknown
            arguments, or a missing or unreadable model.
        UserCodeError: the user's code raised something.
    """
    spec = get_baseline(policy)
    if spec.factory is None:
        raise InvalidInputError(f"policy {spec.id!r}: a reference has no policy; evaluate it instead of acting with it")
    made = _POLICIES.make(spec, arguments if model is None else {**arguments, "model": model}, ("reset", "act"))
    mode = getattr(made, "control_mode", None)
    if mode not in CONTROL_MODES:
        raise InvalidInputError(
            f"{_POLICIES.label(spec)}: its control_mode is {mode!r}; choose one of {', '.join(CONTROL_MODES)}"
        )
    return made


def policy_source(policy: Any, arguments: dict[str, Any], model: Path | None) -> dict[str, Any]:
    """What the episodes of a policy depend on: see :meth:`tslam_bench.plugins.Registry.source`.

    Where each repetition has weights of its own, the hashes of all shipped ones, by training seed.
    """
    spec = get_baseline(policy)
    if spec.kind != "learned":
        return _POLICIES.source(spec, arguments, model)
    fixed = fixed_model(spec, model, arguments)
    source = _POLICIES.source(spec, arguments, None if fixed is None else weights_file(fixed))
    if fixed is None:
        seeds = shipped_seeds(spec.id)
        source["model_sha256"] = {str(seed): sha256_file(shipped_weights(spec.id, seed)) for seed in seeds}
    return source


def fixed_model(spec: PolicySpec, model: Path | None, arguments: Mapping[str, Any]) -> Path | None:
    """The model that a learned explorer plays every repetition with; None: each with the weights of its own training seed.

    Raises:
        InvalidInputError: a training seed is named whose weights are not shipped.
    """
    seed = spec.kwargs.get("seed", arguments.get("seed"))
    return model if model is not None or seed is None else shipped_weights(spec.id, seed)


def policy_label(policy: Any) -> str:
    """What messages call a policy."""
    return _POLICIES.label(get_baseline(policy))
