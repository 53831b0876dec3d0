"""The form of a manifest: a line per prepared object of a split, and every rejection with its reason."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tslam_bench.constants import PROTOCOL_VERSION
from tslam_bench.files import atomic_file

MANIFEST_VERSION = 2
"""Version of the manifest's layout."""


def write(path: Path, split: str, records: Sequence[dict[str, Any]], rejected: dict[str, dict[str, str]]) -> None:
    """Writes a manifest.

    Args:
        path: the file.
        split: canonical name.
        records: records of the prepared objects (:func:`tslam_bench.objects.store.list_objects`).
        rejected: name -> entry (:mod:`tslam_bench.preparation.rejections`); those that were prepared after all are left out.
    """
    names = {record["name"] for record in records}
    head = {
        "manifest_version": MANIFEST_VERSION,
        "protocol_version": PROTOCOL_VERSION,
        "split": split,
        "objects": [],
        "rejected": {name: entry for name, entry in rejected.items() if name not in names},
    }
    lines = [json.dumps(_short(record), sort_keys=True, allow_nan=False) for record in records]
    text = json.dumps(head, indent=1, sort_keys=True, allow_nan=False)
    text = text.replace('"objects": []', '"objects": [\n' + ",\n".join(lines) + "\n ]", 1)
    with atomic_file(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def _short(record: dict[str, Any]) -> dict[str, Any]:
    """A record without what only the files beside it need, and with one hash and the size of all of them."""
    short = {key: value for key, value in record.items() if key not in ("products", "decomposition", "field")}
    return short | {
        "products_sha256": products_sha256(record),
        "bytes": sum(stated["bytes"] for stated in record["products"].values()),
    }


def products_sha256(record: Mapping[str, Any]) -> str:
    """Hash over the hashes of an object's products."""
    products = {name: stated["sha256"] for name, stated in record["products"].items()}
    return hashlib.sha256(json.dumps(products, sort_keys=True).encode()).hexdigest()


def read(path: Path) -> dict[str, Any]:
    """A manifest: ``objects`` is a list of short records, ``rejected`` maps names to entries; both empty without a file."""
    stated = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return {"objects": [], "rejected": {}} | stated
