"""Scores of a submission: every object, seed and number of poses, then aggregated (protocol sections 10 and 12).

Scoring simulates nothing. A score says ``verified: true`` if a record of a replay, made here of these very files, is behind it.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, Final

from tslam_bench.errors import AssetError
from tslam_bench.objects.splits import object_set, resolve_name
from tslam_bench.objects.store import asset_sha256
from tslam_bench.scoring.flags import Evidence, flags
from tslam_bench.scoring.measure import load_truth, score_seeds
from tslam_bench.scoring.origin import has_origin
from tslam_bench.scoring.score_file import ObjectScore, SubmissionScore, aggregate
from tslam_bench.scoring.submission import Submission, read_submission
from tslam_bench.scoring.verification import VerificationRecord, find_record

FULL_ENTRY_SEEDS: Final = 3
"""Fewest seeds of a full entry on the test split."""
EXPECTED_IMPLAUSIBLE: Final = 0.02
"""A share of implausible touches up to this is not remarked on: where a finger presses several millimetres into the union of
hulls, the field's gradient is no longer the way out. Of 450 honest sets of eight poses, eight had any, at most 0.8 %."""


class WorkerDied(AssetError):
    """A process was killed that worked for others."""


class WorkerPool:
    """Processes that score objects and keep what they loaded for the next submission.

    One that dies (a system without memory kills the largest) takes the submission with it that was scored, not the next ones.
    Where the system refuses processes, this one does the work; a warning says so once.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._processes: ProcessPoolExecutor | None = None

    def map(self, function: Callable[..., Any], *values: Iterable[Any]) -> Iterator[Any]:
        """As the builtin. Raises WorkerDied if a process dies."""
        given = [list(value) for value in values]
        try:
            started = self._start(function, given) if self._workers > 1 else None
            yield from map(function, *given) if started is None else started
        except BrokenProcessPool as error:
            self.close()
            raise WorkerDied(
                "a process that scored was killed, probably for want of memory; free some, or score with --workers 1"
            ) from error

    def _start(self, function: Callable[..., Any], values: Sequence[list[Any]]) -> Iterator[Any] | None:
        """Results of the processes; None, and one worker from now on, where there can be none."""
        reason = "this is a daemonic process, which may start no others"
        if not multiprocessing.current_process().daemon:
            try:
                if self._processes is None:
                    # spawn: a forked copy of a process whose libraries have started threads may hang
                    context = multiprocessing.get_context("spawn")
                    self._processes = ProcessPoolExecutor(self._workers, mp_context=context)
                return self._processes.map(function, *values)
            except (OSError, ImportError, NotImplementedError) as error:  # no more processes or files; no semaphores
                reason = f"the system refuses worker processes ({error})"
                self.close()
        self._workers = 1
        warnings.warn(f"{reason}; this one does the work alone, with the same results", stacklevel=3)
        return None

    def close(self) -> None:
        """Ends the processes; the next call of :meth:`map` starts others."""
        processes, self._processes = self._processes, None
        if processes is not None:
            processes.shutdown(cancel_futures=True)


@contextlib.contextmanager
def worker_pool(workers: int) -> Iterator[WorkerPool | None]:
    """Processes for :func:`score_submission`; None for one worker."""
    if workers <= 1:
        yield None
        return
    pool = WorkerPool(workers)
    try:
        yield pool
    finally:
        pool.close()


def score_submission(
    submission: Submission | Path | str,
    objects: Sequence[str] | None = None,
    pool: WorkerPool | None = None,
    on_progress: Callable[[int, int], None] | None = None,
    cache: Path | None = None,
    record: VerificationRecord | None = None,
    split: str = "test",
) -> SubmissionScore:
    """Scores a submission against the prepared objects of the asset cache.

    Args:
        submission: one that was read, or its folder or zip archive. What is scored has its ``content_hash``.
        objects: names to score; by default those of the submission's object set.
        pool: processes that score objects (:func:`worker_pool`); the result does not depend on it.
        on_progress: called with (done, all) objects.
        cache: asset cache; by default the user's.
        record: what a replay of its rollouts found; by default the record beside the submission, if there is one to be trusted.
        split: of its objects; one that was read has its own.

    Raises:
        InvalidInputError: the submission is refused or has changed since it was read, an object is unknown, or ``record`` is of
            other files or assets.
        AssetError: an object is not prepared.
    """
    if not isinstance(submission, Submission):
        submission = read_submission(submission, split=split)
    split = submission.split
    asked = objects or object_set(submission.info.object_set, cache)
    names = tuple(dict.fromkeys(resolve_name(name, split, cache) for name in asked))
    if record is None:
        record, remark = find_record(submission, names, cache)
    else:
        record.check(submission, names, "verification record", cache)
        remark = None
    parts = [submission.of_object(name) for name in names]
    records = [record and record.of_object(name) for name in names]
    results: list[ObjectScore] = []
    evidence: list[Evidence] = []
    scored = (pool.map if pool else map)(_score_part, parts, names, records, [cache] * len(names))
    for done, scores in enumerate(scored, start=1):
        results += [score for score, _ in scores]
        evidence += [facts for _, facts in scores]
        if on_progress:
            on_progress(done, len(names))
    raised = [] if submission.info.privileged else flags(results, evidence)
    return SubmissionScore(
        info=submission.info,
        content_hash=submission.content_hash,
        objects=names,
        asset_sha256=asset_sha256(names, split, cache),
        results=tuple(results),
        aggregate=aggregate(results, len(names)),
        notes=(*([remark] if remark else []), *_notes(submission, results, names, cache, record), *raised),
        tier="reported" if record is None else record.tier,
        own_run=has_origin(submission) or _attested_explorer(submission, record),
    )


def _attested_explorer(submission: Submission, record: VerificationRecord | None) -> bool:
    """Whether the policy of the explorer's name was run and gave these actions."""
    if record is None or record.attestation is None or record.tier == "replayed":
        return False
    return record.attestation.policy.get("policy") == submission.info.explorer


def _score_part(
    part: Submission, name: str, record: VerificationRecord | None, cache: Path | None
) -> list[tuple[ObjectScore, Evidence]]:
    return score_seeds(part, load_truth(name, cache, part.split), record)


def _notes(
    submission: Submission,
    results: Sequence[ObjectScore],
    names: Sequence[str],
    cache: Path | None,
    record: VerificationRecord | None,
) -> tuple[str, ...]:
    notes = [] if record is None else [record.summary()]
    if record is not None and record.attestation is not None:
        notes += [record.attestation.summary(), *record.attestation.flags()]
    split, whole = submission.split, object_set(submission.info.object_set, cache)
    if tuple(names) != whole:
        notes.append(f"scored on chosen objects ({len(names)}), not on the object set {submission.info.object_set!r}")
    if submission.info.object_set != "quick" and len(submission.info.seeds) < FULL_ENTRY_SEEDS:
        notes.append(f"not a full entry: {len(submission.info.seeds)} of at least {FULL_ENTRY_SEEDS} seeds")
    empty: dict[str, list[str]] = {}
    for result in results:
        where = f"{result.object}, seed {result.seed}"
        if result.missing:
            notes.append(f"{where}: missing, counted as empty: {', '.join(result.missing)}")
        for count, reason in result.reasons.items():
            if reason is not None and reason != "missing":
                empty.setdefault(reason, []).append(f"{where}, {count} poses")
        if result.implausible_touches > EXPECTED_IMPLAUSIBLE:
            share = f"{100 * result.implausible_touches:.1f} %"
            notes.append(f"{where}: {share} of the touched voxels are too far from the object to hold a contact")
    for reason, places in empty.items():
        more = f" and {len(places) - 3} more" if len(places) > 3 else ""
        notes.append(f"counted as empty, {reason}: {'; '.join(places[:3])}{more}")
    # A submission hashes the objects it holds: the whole set, or the chosen ones.
    hashes = [asset_sha256(names, split, cache)]
    with contextlib.suppress(AssetError):
        hashes.append(asset_sha256(whole, split, cache))
    if submission.info.asset_manifest_sha256 not in hashes:
        notes.append("the rollouts were made with other assets, or of other objects, than the ones scored against")
    return tuple(notes)
