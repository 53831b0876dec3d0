"""Commitments to a hidden split: published before, they say nothing; opened afterwards, they prove that nothing was exchanged.

An *opening* holds the secret seed and a line per object with the hashes of its source mesh and of its products. The *commitment*
is the SHA-256 of the opening. Who is given the opening computes that hash, draws the generated objects again from the seed, and
compares them; what came from a folder of meshes is compared where the split is prepared.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from tslam_bench.constants import PROTOCOL_VERSION
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import atomic_file, cache_directory, read_plain_file, write_json
from tslam_bench.objects import splits, store
from tslam_bench.preparation.manifest import products_sha256
from tslam_bench.sources.generator.generate import GENERATOR_VERSION, draw, mesh_sha256
from tslam_bench.sources.generator.hidden import hidden_name, secret_sha256

COMMITMENT_VERSION: Final = 1
_MAX_SIZE: Final = 8 * 2**20


def opening_path(split: str, cache: Path | None = None) -> Path:
    """Where the organiser's cache keeps the opening."""
    return (cache or cache_directory()) / f"hidden-{split}.opening.json"


def check_free(split: str, secret: str | None, cache: Path | None = None) -> str | None:
    """Looks whether a hidden split may be made, or gone on with.

    Returns:
        the secret of the split that is there already, if there is one; else ``secret``.

    Raises:
        InvalidInputError: the name is one of the benchmark's, or holds other objects.
    """
    if split in splits.SPLITS or split in splits.SPLIT_ALIASES or split == "quick":
        raise InvalidInputError(f"--name {split}: is one of the benchmark's own; choose another")
    path = opening_path(split, cache)
    if not path.exists():
        if splits.prepared_names(split, cache):
            raise InvalidInputError(f"--name {split}: holds objects that were not made by assets hide; choose another")
        return secret
    known = read_opening(path)["seed"]
    if secret not in (None, known):
        raise InvalidInputError(f"--name {split}: holds objects of another seed; choose another name, or delete {path}")
    return known


def write_opening(split: str, secret: str, cache: Path | None = None) -> dict[str, Any]:
    """Writes the opening of what is prepared of a split, readable by its owner alone, and returns it."""
    records = store.list_objects(split, cache) if splits.split_directory(split, cache).is_dir() else []
    opening = {
        "commitment_version": COMMITMENT_VERSION,
        "protocol_version": PROTOCOL_VERSION,
        "generator_version": GENERATOR_VERSION,
        "split": split,
        "seed": secret,
        "objects": [_line(record) for record in records],
    }
    with atomic_file(opening_path(split, cache)) as temporary:
        temporary.write_text(json.dumps(opening, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    os.chmod(opening_path(split, cache), 0o600)  # noqa: PTH101
    return opening


def _line(record: Mapping[str, Any]) -> dict[str, Any]:
    number = record["details"].get("number")
    generated = isinstance(number, int) and record["name"] == hidden_name(number)
    return {
        "name": record["name"],
        "category": record["category"],
        "number": number if generated else None,
        "source_sha256": record["source_sha256"],
        "products_sha256": products_sha256(record),
    }


def commit(opening: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Writes what is to be published, and returns it."""
    stated = ("commitment_version", "protocol_version", "generator_version", "split")
    commitment = {
        **{name: opening[name] for name in stated},
        "count": len(opening["objects"]),
        "sha256": _sha256(opening),
    }
    write_json(path, commitment)
    return commitment


def read_opening(path: Path) -> dict[str, Any]:
    """Reads an opening. Raises InvalidInputError if it is none."""
    keys = {"commitment_version", "protocol_version", "generator_version", "split", "seed", "objects"}
    return _read(path, keys, "an opening")


def check_opening(opening_file: Path, commitment_file: Path, cache: Path | None = None) -> list[str]:
    """Compares an opening with the commitment that was published before, and its objects with the seed.

    Returns:
        what was found to be true, a line each.

    Raises:
        InvalidInputError: a file is not what it has to be, or something was exchanged; the message says what.
    """
    opening = read_opening(opening_file)
    keys = {"commitment_version", "protocol_version", "generator_version", "split", "count", "sha256"}
    commitment = _read(commitment_file, keys, "a commitment")
    if commitment["sha256"] != _sha256(opening):
        raise InvalidInputError(
            f"{opening_file}: is not what {commitment_file} commits to: seed or objects were exchanged"
        )
    stated = {**{name: opening[name] for name in keys & opening.keys()}, "count": len(opening["objects"])}
    differing = sorted(name for name, value in stated.items() if commitment[name] != value)
    if differing:
        raise InvalidInputError(f"{commitment_file}: states another {differing[0]} than {opening_file}")
    lines = [f"the opening is what was committed to: {len(opening['objects'])} objects of split {opening['split']}"]
    if opening["generator_version"] != GENERATOR_VERSION:
        raise InvalidInputError(
            f"{opening_file}: of generator version {opening['generator_version']}, this is {GENERATOR_VERSION}; "
            "check it with the package of that time"
        )
    try:
        generated = [item for item in opening["objects"] if item["number"] is not None]
        seed = int(secret_sha256(opening["seed"]), 16)
        for item in generated:
            if mesh_sha256(draw(item["category"], item["number"], seed)[0]) != item["source_sha256"]:
                raise InvalidInputError(f"{opening_file}: {item['name']} is not what the seed gives")
        lines.append(f"{len(generated)} of them are drawn again from the seed, bit for bit")
        lines.append(_compare_prepared(opening, opening_file, cache))
    except (KeyError, TypeError, AttributeError) as error:
        raise InvalidInputError(f"{opening_file}: not an opening ({error!r})") from error
    return lines


def _compare_prepared(opening: Mapping[str, Any], opening_file: Path, cache: Path | None) -> str:
    """Compares the products of what is prepared here."""
    here = 0
    for item in opening["objects"]:
        try:
            record = store.read_record(item["name"], opening["split"], cache)
        except AssetError:
            continue
        if products_sha256(record) != item["products_sha256"]:
            raise InvalidInputError(f"{opening_file}: {item['name']} has other products than are prepared here")
        here += 1
    return f"{here} of them are prepared here, with the same products"


def _read(path: Path, keys: set[str], kind: str) -> dict[str, Any]:
    try:
        value = json.loads(read_plain_file(path, _MAX_SIZE))
        if value.keys() != keys or value["commitment_version"] != COMMITMENT_VERSION:
            raise ValueError("other fields, or another version")
        if not isinstance(value.get("objects", []), list) or not isinstance(value.get("seed", ""), str):
            raise ValueError("fields of another type")
    except (ValueError, AttributeError, RecursionError) as error:
        if isinstance(error, InvalidInputError):
            raise
        raise InvalidInputError(f"{path}: not {kind} ({error})") from error
    return value


def _sha256(opening: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(opening, sort_keys=True).encode()).hexdigest()
