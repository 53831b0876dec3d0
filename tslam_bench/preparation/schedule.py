"""Prepares many objects: parallel processes, resumable, one manifest per split."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from tslam_bench.constants import PROTOCOL_VERSION
from tslam_bench.errors import BenchmarkError, InvalidInputError
from tslam_bench.files import atomic_file, cache_directory, ensure_writable_directory, remove_directory, write_json
from tslam_bench.objects import splits, store
from tslam_bench.preparation.rejections import Rejections
from tslam_bench.preparation.workers import WorkerPool
from tslam_bench.sources import contactdb, wheels
from tslam_bench.sources.fetch import fetch

MANIFEST_VERSION = 2
"""Version of the manifest's layout."""
TIME_LIMIT = 900.0
"""Seconds after which an object is given up."""
_STALE_AGE = 6 * 3600.0


@dataclass(frozen=True)
class ContactDBSource:
    """A test object, read from the pinned wheel in the cache."""

    name: str
    split: str = "test"

    def fingerprint(self) -> str:
        """See :class:`tslam_bench.preparation.pipeline.Source`."""
        return f"{wheels.CONTACTDB_WHEEL.sha256}:{contactdb.member(self.name)}"

    def load(self, cache: Path) -> Any:
        """See :class:`tslam_bench.preparation.pipeline.Source`."""
        from tslam_bench.geometry.meshes import parse_stl
        from tslam_bench.preparation.pipeline import SourceMesh

        item = splits.OBJECTS[self.name]
        data = contactdb.read_mesh_file(self.name, fetch(wheels.CONTACTDB_WHEEL, cache))
        return SourceMesh(
            name=item.name,
            split=self.split,
            category=item.category,
            mesh=parse_stl(data),
            source=f"{contactdb.SOURCE}: {contactdb.member(self.name)}",
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


def _work(source: Any, cache: Path) -> Outcome:
    """Prepares one object in a worker."""
    from tslam_bench.preparation.pipeline import GateError, prepare_object

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
    from tslam_bench.preparation.pipeline import parameters_sha256

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
    items: Iterable[Any],
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
        items: sources (see :class:`tslam_bench.preparation.pipeline.Source`).
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
    pool: WorkerPool[tuple[Any, str], Outcome] = WorkerPool(_work, workers, time_limit)
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
    items: Iterable[Any],
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


def drop_copies(items: Sequence[Any], cache: Path | None = None) -> list[Outcome]:
    """Removes prepared objects that are copies of others (:mod:`tslam_bench.preparation.copies`) and remembers that.

    Args:
        items: the sources that were prepared, most wanted first, all of one split.
        cache: cache directory (default: the user's).

    Returns:
        a ``rejected`` outcome for every object of ``items`` that was removed. Objects of val that repeat one of train are
        removed whenever either split is prepared, but only those in ``items`` are returned.
    """
    from tslam_bench.preparation import copies
    from tslam_bench.preparation.pipeline import LEAKAGE_SPLITS

    cache = cache or cache_directory()
    split = items[0].split if items else ""
    if split not in LEAKAGE_SPLITS:
        return []
    prepared = {each: store.prepared_names(each, cache) for each in LEAKAGE_SPLITS}
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
    if split in store.SPLITS:
        raise InvalidInputError(f"split {split!r}: is not an organiser's own")
    cache = cache or cache_directory()
    gone = sorted(set(store.prepared_names(split, cache)) - set(names))
    for name in gone:
        remove_directory(store.object_directory(name, split, cache))
    return gone


def _prepare_shared(item: Any, cache: Path) -> None:
    """Fetches what several workers need, once, before they start."""
    from tslam_bench.preparation.pipeline import LEAKAGE_SPLITS

    if item.split == "test" or item.split in LEAKAGE_SPLITS:
        wheel = fetch(wheels.CONTACTDB_WHEEL, cache)
        if item.split in LEAKAGE_SPLITS:
            from tslam_bench.preparation.leakage import references

            references(wheel, cache)


def _remove_stale(cache: Path) -> None:
    """Removes what runs that were killed left half-written."""
    for path in [*cache.glob("objects/*/.*"), *cache.glob("decompositions/.*"), *cache.glob("downloads/.fetch-*")]:
        if time.time() - path.stat().st_mtime > _STALE_AGE:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


def write_manifest(split: str, path: Path | None = None, cache: Path | None = None) -> Path:
    """Writes the manifest of what is prepared of a split: ``<cache>/manifest-<split>.json`` unless ``path`` is given.

    A manifest that is written elsewhere is a reference to keep under version control. That of train and val is short: a line
    per object with one hash over its products, and every rejection with its reason.
    """
    cache = cache or cache_directory()
    records = store.list_objects(split, cache)
    manifest: dict[str, Any] = {
        "manifest_version": MANIFEST_VERSION,
        "protocol_version": PROTOCOL_VERSION,
        "split": split,
        "objects": records,
    }
    if path is None or split == "test":
        path = path or cache / f"manifest-{split}.json"
        write_json(path, manifest)
        return path
    lines = [json.dumps(_short(record), sort_keys=True, allow_nan=False) for record in records]
    names = {record["name"] for record in records}
    rejected = {name: entry for name, entry in Rejections(cache).entries(split).items() if name not in names}
    head = json.dumps(manifest | {"objects": [], "rejected": rejected}, indent=1, sort_keys=True, allow_nan=False)
    with atomic_file(path) as temporary:
        text = head.replace('"objects": []', '"objects": [\n' + ",\n".join(lines) + "\n ]", 1)
        temporary.write_text(text + "\n", encoding="utf-8")
    return path


def _short(record: dict[str, Any]) -> dict[str, Any]:
    """A record without what only the files beside it need, and with one hash and the size of all of them."""
    products = {name: stated["sha256"] for name, stated in record["products"].items()}
    short = {key: value for key, value in record.items() if key not in ("products", "decomposition", "field")}
    return short | {
        "products_sha256": hashlib.sha256(json.dumps(products, sort_keys=True).encode()).hexdigest(),
        "bytes": sum(stated["bytes"] for stated in record["products"].values()),
    }
