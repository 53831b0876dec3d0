"""``tslam_bench.evaluate``: an evaluation in one call. Importing this is quick; the simulator comes with the call."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal


def evaluate(
    policy: Any,
    reconstructors: Sequence[Any] = ("grid", "hull"),
    objects: Sequence[str] = (),
    output: str | Path = "runs/evaluation",
    *,
    object_set: Literal["quick", "test"] = "quick",
    split: str = "test",
    seeds: Sequence[int] = (0,),
    arguments: Mapping[str, Any] | None = None,
    model: str | Path | None = None,
    privileged: bool = False,
    authors: Sequence[str] = (),
    label: str = "",
    policy_salt: str | None = None,
    learning_objects: Sequence[str] = (),
    processes: int | None = None,
    on_progress: Callable[[str, int, int], None] | None = None,
) -> list[Path]:
    """Lets a policy feel objects in all 8 poses, reconstructs them, and writes one submission per reconstructor.

    Goes on where an earlier call with the same arguments stopped.

    Args:
        policy: an id, ``module:Class``, ``path/to/file.py:Class``, a class or function, or a policy
            (:class:`tslam_bench.evaluation.policy.Policy`). Of one that is already made only the class is recorded: give a class
            and ``arguments``, or another ``output`` for other settings.
        reconstructors: each an id, ``ID=MODEL``, ``module:name`` or ``module:name=MODEL``, a class or function, or a
            reconstructor; ``("none",)`` only explores.
        objects: objects of the split; empty: those of the object set.
        output: folder for ``rollouts/`` and ``submissions/``.
        object_set: which ranking the submissions are for: the five quick objects or the whole test split.
        split: ``test``, or another split, whose objects are all one set: the organiser's own, or ``val`` for tuning.
        seeds: repetitions; each is 8 episodes per object.
        arguments: keyword arguments of the policy's class or function; recorded.
        model: handed to it as ``model``; the hash of its content is recorded.
        privileged: the policy saw or was rewarded with the true shape.
        authors: whose submission it is; empty: the benchmark's authors, or ``unnamed`` if anything is the user's own.
        label: remark shown beside every figure.
        policy_salt: hexadecimal digits that the policy's random numbers and the order of the episodes come from; None: that
            of the episodes which are there, or a random one.
        learning_objects: train objects that ``mean_shape`` and ``retrieval`` are built from; empty: all prepared.
        processes: worker processes that simulate; None: the cores. Results do not depend on it.
        on_progress: called with (stage, done, total).

    Returns:
        The submissions' folders.

    Raises:
        InvalidInputError: bad input, or a policy or reconstructor of the user's gave something unusable.
        UserCodeError: the user's code raised something. Episodes that are finished are kept.
        AssetError: an object is not prepared, or ``output`` cannot be written.
    """
    from tslam_bench.evaluation import evaluate as evaluation
    from tslam_bench.objects.splits import SPLIT_ALIASES
    from tslam_bench.objects.splits import object_set as objects_of

    chosen = object_set if SPLIT_ALIASES.get(split, split) == "test" else split
    config = evaluation.EvaluationConfig(
        policy=policy,
        objects=tuple(objects) or objects_of(chosen),
        seeds=tuple(seeds),
        object_set=chosen,
        model=None if model is None else Path(model),
        arguments=dict(arguments or {}),
        policy_salt=policy_salt,
        label=label,
        privileged=privileged,
        processes=processes,
    )
    made = evaluation.make_reconstructors(reconstructors, learning_objects)
    own = config.spec.kind == "own" or any(chosen.spec.needs == "own" for chosen in made.values())
    config = replace(config, authors=tuple(authors) or (("unnamed",) if own else config.authors))
    return evaluation.evaluate(config, made, Path(output), on_progress)
