"""``tslam-bench evaluate``: a policy explores, reconstructors complete, submissions are written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tslam_bench.cli.commands import parse
from tslam_bench.cli.progress import Stages
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.door import evaluate
from tslam_bench.evaluation.policies import get_baseline
from tslam_bench.plugins import parse_arguments


@dataclass(frozen=True)
class Evaluate:
    """Let a policy feel objects in all 8 poses, reconstruct them, and write one submission per reconstructor.

    Policy and reconstructors are the benchmark's, or your own: module:Class or path/to/file.py:Class; a function that returns one
    will do for the class, and modules of the current folder are found. Goes on where an earlier run of the same command stopped.
    """

    policy: str
    """Id (tslam-bench baselines list), module:Class or path/to/file.py:Class."""
    policy_arguments: tuple[str, ...] = ()
    """Arguments of the policy's class: key=value pairs (values are JSON, or else text) or one JSON object. Learned
    baselines take deterministic=true: act by the mean instead of sampling."""
    model: Path | None = None
    """Trained model: the directory of a learned baseline; your own policy gets the path as its argument model."""
    reconstructor: tuple[str, ...] = ("grid", "hull")
    """Reconstructors (tslam-bench reconstruct list): ID, module:Class, or either with =MODEL; none only explores."""
    objects: tuple[str, ...] = ()
    """Objects of the split; empty: those of the object set."""
    split: str = "test"
    """Split; one of your own (tslam-bench assets hide, or import), or val, is one object set as a whole."""
    object_set: Literal["quick", "test"] = "quick"
    """Which ranking the submissions are for: the five quick objects or the whole test split."""
    seeds: tuple[int, ...] = (0,)
    """Repetitions; each is 8 episodes per object."""
    learning_objects: tuple[str, ...] = ()
    """Train objects that mean_shape and retrieval are built from; empty: all that are prepared."""
    output: Path = Path("runs/evaluation")
    """Folder for rollouts/ and submissions/."""
    privileged: bool = False
    """The policy saw, or was rewarded with, anything that derives from the true shape."""
    authors: tuple[str, ...] = ()
    """Whose submission it is; empty: the benchmark's authors, or "unnamed" if anything is your own."""
    label: str = ""
    """Remark shown beside every figure."""
    policy_salt: str | None = None
    """Hexadecimal digits that the policy's random numbers and the order of the episodes come from; default: drawn at
    random, or that of the episodes which are there. It is recorded in the submission."""
    processes: int | None = None
    """Worker processes that simulate; default: the cores. Results do not depend on it."""
    torch_threads: int = 1
    """Threads of torch. One is fastest on CPUs: a policy's small tensors are not worth sharing out."""


def main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench evaluate`` with the given arguments.

    Raises:
        BenchmarkError: bad input, or the user's own code went wrong; the message is one line.
    """
    parsed: Evaluate = parse("tslam-bench evaluate", Evaluate, arguments)
    if parsed.torch_threads < 1:
        raise InvalidInputError(f"torch_threads {parsed.torch_threads}: must be at least 1")
    spec, policy_arguments = get_baseline(parsed.policy), parse_arguments(parsed.policy_arguments)
    import torch

    torch.set_num_threads(parsed.torch_threads)
    with Stages(spec.id) as show:
        submissions = evaluate(
            parsed.policy,
            parsed.reconstructor,
            parsed.objects,
            parsed.output,
            object_set=parsed.object_set,
            split=parsed.split,
            seeds=parsed.seeds,
            arguments=policy_arguments,
            model=parsed.model,
            privileged=parsed.privileged,
            authors=parsed.authors,
            label=parsed.label,
            policy_salt=parsed.policy_salt,
            learning_objects=parsed.learning_objects,
            processes=parsed.processes,
            on_progress=show,
        )
    for submission in submissions:
        print(submission)
