"""Which objects were rejected, and with which parameters: they need not be built again to be rejected again.

Two files say so. ``<cache>/rejected-<split>.json`` holds what this cache has seen; the reference manifests of train and val,
which come with the package, list what was rejected when the default sets were made. An entry counts only while the hash of
everything that decides the object (:func:`tslam_bench.preparation.pipeline.parameters_sha256`) is still the same.
"""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

from tslam_bench.files import package_data, write_json
from tslam_bench.preparation import manifest
from tslam_bench.preparation.pipeline import parameters_sha256
from tslam_bench.sources.source import Source

Entry = dict[str, str]
"""``parameters_sha256``, ``reason`` and, for a copy of another object of train or val, ``original``."""


class Rejections:
    """Objects that a gate rejected, by split.

    Args:
        cache: cache directory.
        reference: directory of the reference manifests (default: those of the package).
    """

    def __init__(self, cache: Path, reference: Path | None = None) -> None:
        self._cache = cache
        self._reference = reference or package_data("assets")

    def get(self, source: Source) -> str | None:
        """Why ``source`` was rejected with its present parameters, or None.

        What the package knows of is kept in the cache from then on. It does not say that an object repeats another one of
        train or val: that depends on what else is prepared.
        """
        parameters = parameters_sha256(source)
        entry = self.entries(source.split).get(source.name)
        if entry is not None and entry.get("parameters_sha256") == parameters:
            return entry["reason"]
        entry = _reference_entries(self._reference / f"manifest_{source.split}.json").get(source.name)
        if entry is None or entry["parameters_sha256"] != parameters or "original" in entry:
            return None
        self._write(source.split, source.name, entry)
        return entry["reason"]

    def entries(self, split: str) -> dict[str, Entry]:
        """What this cache knows of a split: name -> entry, sorted."""
        try:
            known = json.loads(self._path(split).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return dict(sorted(known.items())) if isinstance(known, dict) else {}

    def add(self, source: Source, reason: str) -> None:
        """Remembers that a gate rejected a source."""
        entry = {"parameters_sha256": parameters_sha256(source), "reason": reason}
        self._write(source.split, source.name, entry)

    def add_copy(self, record: dict[str, Any], original: str, reason: str) -> None:
        """Remembers that a prepared object repeats ``original`` (split/name)."""
        entry = {"parameters_sha256": record["parameters_sha256"], "reason": reason, "original": original}
        self._write(record["split"], record["name"], entry)

    def _path(self, split: str) -> Path:
        return self._cache / f"rejected-{split}.json"

    def _write(self, split: str, name: str, entry: Entry) -> None:
        write_json(self._path(split), self.entries(split) | {name: entry})


@functools.cache
def _reference_entries(path: Path) -> dict[str, Entry]:
    """The rejections that a reference manifest lists; none where there is no such manifest."""
    entries: dict[str, Entry] = manifest.read(path)["rejected"]
    return entries
