"""``tslam-bench verify``: replays a submission's rollouts, runs its code if asked to, and writes a record that scoring uses."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from tslam_bench.cli.commands import parse
from tslam_bench.cli.progress import Progress, Stages
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.confinement import Limits
from tslam_bench.plugins import parse_arguments
from tslam_bench.scoring.verification import Tolerances, VerificationRecord, record_path


@dataclass(frozen=True)
class Verify:
    """Replays every rollout of a submission on the CPU and writes a record that tslam-bench score uses.

    With --attest the submission's own code runs too, shut in, and its actions and shapes are compared. Exit status 0 if all is as
    claimed, 1 if not; what departs is named. A record of the same files is gone on with: delete it to begin again.
    """

    submission: Annotated[Path, tyro.conf.Positional]
    """Folder or zip archive that holds submission.json."""
    output: Path | None = None
    """The record; default: SUBMISSION.verification.json, beside the submission, where score finds it."""
    split: str = "test"
    """Split that the submission is of: test, or an organiser's own (tslam-bench assets hide)."""
    processes: int = 1
    """Processes that replay. The verdicts do not depend on it."""
    segments: bool = False
    """Replay each ten steps from their joint checkpoint, within tolerances: for rollouts of another kind of processor."""
    tolerances: Tolerances = field(default_factory=Tolerances)
    """What segments may be off by."""
    attest: bool = False
    """Run policy and reconstructor, shut in: recompute actions and shapes, play fresh episodes, swap and turn touches."""
    policy: str = ""
    """Policy to run: id, module:Class or path/to/file.py:Class; default: the id that the submission names."""
    policy_arguments: tuple[str, ...] = ()
    """Arguments of the policy's class, as in tslam-bench evaluate."""
    model: Path | None = None
    """The policy's model."""
    reconstructor: str = ""
    """Reconstructor to run: ID, module:Class, or either with =MODEL; default: the id that the submission names."""
    learning_objects: tuple[str, ...] = ()
    """Train objects that mean_shape and retrieval are built from."""
    limits: Limits = field(default_factory=Limits)
    """What the code may use."""
    json: bool = False
    """Print the verdicts as JSON."""


def main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench verify`` with the given arguments. Raises BenchmarkError for bad input."""
    parsed: Verify = parse("tslam-bench verify", Verify, arguments)
    if parsed.processes < 1:
        raise InvalidInputError(f"--processes {parsed.processes}: give at least 1")
    if parsed.attest and parsed.segments:
        raise InvalidInputError(
            "--attest: computes actions from what a replay shows, bit for bit; leave out --segments"
        )
    given = [parsed.policy, parsed.policy_arguments, parsed.model, parsed.reconstructor, parsed.learning_objects]
    if not parsed.attest and any(given):
        raise InvalidInputError("--policy, --reconstructor, --model: only --attest runs code; add it")
    record = _attest(parsed) if parsed.attest else _replay(parsed)
    failures = [] if record.attestation is None or not parsed.attest else record.attestation.failures()
    if parsed.json:
        verdicts = [{k: v for k, v in asdict(verdict).items() if k != "touched"} for verdict in record.verdicts]
        values = {"content_hash": record.content_hash, "mode": record.mode, "tier": record.tier, "episodes": verdicts}
        attested = {"attestation": record.attestation.to_json(), "failures": failures} if record.attestation else {}
        print(json.dumps({**values, **attested}, indent=2))
    else:
        for verdict in record.departed:
            print(verdict)
        file, all_of_them = parsed.output or record_path(parsed.submission), len(record.verdicts)
        print(f"{file}: {all_of_them - len(record.departed)} of {all_of_them} episodes reproduce")
        if record.attestation is not None:
            print(
                "\n".join(
                    [*failures, *record.attestation.flags()] + ([] if failures else [record.attestation.summary()])
                )
            )
    if record.departed or failures:
        sys.exit(1)


def _replay(parsed: Verify) -> VerificationRecord:
    from tslam_bench.evaluation.verify import verify

    with Progress(f"verify {parsed.submission.name}", "episode", leave=False) as bar:
        tolerances = parsed.tolerances if parsed.segments else None
        return verify(parsed.submission, parsed.output, tolerances, parsed.processes, bar.show, parsed.split)


def _attest(parsed: Verify) -> VerificationRecord:
    from tslam_bench.evaluation.attest import SubmittedCode, attest

    reconstructor, _, model = parsed.reconstructor.partition("=")
    code = SubmittedCode(
        parsed.policy,
        reconstructor,
        parsed.model,
        parse_arguments(parsed.policy_arguments),
        Path(model) if model else None,
        parsed.learning_objects,
    )
    with Stages(f"attest {parsed.submission.name}") as show:
        return attest(parsed.submission, code, parsed.output, parsed.limits, None, parsed.processes, parsed.split, show)
