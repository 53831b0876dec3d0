"""Imports a folder tree of meshes (3D Warehouse or ShapeNet style) into a split, and an organiser's own set from a manifest."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import sha256_file
from tslam_bench.geometry.meshes import TriangleMesh
from tslam_bench.objects import splits, store
from tslam_bench.sources import meshfiles
from tslam_bench.sources.scaling import scale_to_hand
from tslam_bench.sources.source import SourceMesh

SKIPPED_SUFFIXES = (
    ".mtl",
    ".png",
    ".jpg",
    ".jpeg",
    ".bin",
    ".txt",
    ".json",
    ".md",
    ".csv",
    ".tga",
    ".bmp",
    ".gif",
    ".xml",
    "",
)
"""Files that lie beside meshes and are not reported."""
READING = 2
"""Bumped when a file is read or repaired another way; the benchmark's own objects are not imported."""
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
"""Units of an organiser's manifest, in metres."""


@dataclass(frozen=True)
class ImportedSource:
    """A mesh file of a user's folder.

    Attributes:
        split, name, category: identifiers.
        path: the file.
        license, origin: what the user says about it.
        up: axis that points up in the file.
        unit: metres per unit of the file; None to draw a hand-held size (protocol section 8).
    """

    split: str
    name: str
    category: str
    path: str
    license: str
    origin: str
    up: meshfiles.UpAxis = "auto"
    unit: float | None = None

    def fingerprint(self) -> str:
        """See :class:`tslam_bench.sources.source.Source`."""
        try:
            digest = sha256_file(Path(self.path))
        except OSError:
            digest = "unreadable"
        return f"imported:{READING}:{digest}:{self.up}:{self.unit}:{self.category}:{self.license}:{self.origin}"

    def load(self, cache: Path) -> SourceMesh:
        """See :class:`tslam_bench.sources.source.Source`. Errors name the file."""
        try:
            self._check_name_is_free(cache)
            mesh = meshfiles.read_mesh_file(Path(self.path), self.up)
        except AssetError as error:
            raise AssetError(f"{ascii(Path(self.path).name)[1:-1]}: {error}") from error
        factor = self.unit
        if factor is None:
            mesh, factor = scale_to_hand(mesh, self.name)
        else:
            mesh = TriangleMesh(mesh.vertices * factor, mesh.faces)
        return SourceMesh(
            name=self.name,
            split=self.split,
            category=self.category,
            mesh=mesh,
            source=f"{self.origin}: {Path(self.path).name}",
            license=self.license,
            sha256=sha256_file(Path(self.path)),
            details={"scale": factor},
        )

    def _check_name_is_free(self, cache: Path) -> None:
        """Raises AssetError if an object of another source has this name in a split that is the benchmark's own."""
        if self.split not in splits.SPLITS:
            return
        try:
            holder = store.read_record(self.name, self.split, cache)["source"]
        except (AssetError, KeyError):
            return  # not prepared, or unusable
        if not str(holder).startswith(f"{self.origin}: "):
            raise AssetError(
                f"name {self.name!r} is taken by an object of another source ({holder}); rename the file or its folder"
            )


def check_name(text: str, what: str) -> str:
    """Returns ``text`` if it can name a split or an object. Raises InvalidInputError otherwise."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,79}", text):
        raise InvalidInputError(
            f"{what} {text!r}: use letters, digits, '-' and '_' only (at most 80, a letter or digit first)"
        )
    return text


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:60].strip("-") or "mesh"


def scan(
    folder: Path, split: str, license_text: str, origin: str, up: meshfiles.UpAxis = "auto"
) -> list[ImportedSource]:
    """Finds the meshes of a folder tree, sorted by path.

    A mesh's category is the folder below ``folder`` that it is in (``folder`` itself for files at the top); its name is made
    of its path. Links are not followed. Files of unknown kinds become sources too, so that they are reported.

    Raises:
        InvalidInputError: no such folder, a bad split, nothing in it, or a text is missing.
    """
    if check_name(split, "split") == "test":
        raise InvalidInputError("split 'test': is fixed; import into train, val or a split of your own")
    if not folder.is_dir():
        raise InvalidInputError(f"{folder}: no such folder")
    if not license_text.strip() or not origin.strip():
        raise InvalidInputError(
            "--license and --source: say under which licence the meshes are and where they come from"
        )
    found: dict[str, ImportedSource] = {}
    for path in _walk(folder):
        if path.suffix.lower() in SKIPPED_SUFFIXES:
            continue
        relative = path.relative_to(folder)
        category = _slug(relative.parts[0] if len(relative.parts) > 1 else folder.resolve().name)
        base = _slug("-".join([*relative.parts[:-1], relative.stem]))
        name, number = base, 2
        while name in found:
            name, number = f"{base}-{number}", number + 1
        found[name] = ImportedSource(split, name, category, str(path), license_text, origin, up)
    if not found:
        raise InvalidInputError(f"{folder}: holds no mesh; expected {', '.join(meshfiles.SUFFIXES)}")
    return list(found.values())


def _walk(folder: Path) -> Iterator[Path]:
    """Ordinary files below ``folder``, sorted; hidden ones and links are left out."""
    for directory, folders, files in os.walk(folder, followlinks=False):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(files):
            path = Path(directory) / name
            if not name.startswith(".") and path.is_file() and not path.is_symlink():
                yield path


def read_set(manifest: Path) -> tuple[str, list[ImportedSource]]:
    """Reads an organiser's own set: a JSON file beside its meshes.

    ``{"split": NAME, "license": TEXT, "source": TEXT, "objects": [{"name": NAME, "category": NAME, "file": PATH,
    "unit": "m"}, ...]}``; ``unit`` is m, cm, mm or inch, ``up`` (optional) x, y or z, and paths are relative to the manifest.

    Raises:
        InvalidInputError: names the entry that is wrong.
    """
    try:
        content = json.loads(manifest.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise InvalidInputError(f"{manifest}: no such file") from error
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"{manifest}: not a readable JSON file ({error})") from error
    if not isinstance(content, dict) or not isinstance(content.get("objects"), list) or not content["objects"]:
        raise InvalidInputError(
            f"{manifest}: expected an object with 'split', 'license', 'source' and a list 'objects'"
        )
    for key in ("split", "license", "source"):
        if not isinstance(content.get(key), str) or not content[key].strip():
            raise InvalidInputError(f"{manifest}: {key!r} is missing or is not a text")
    split = check_name(content["split"], f"{manifest}: split")
    if split in splits.SPLITS or split in splits.SPLIT_ALIASES:
        raise InvalidInputError(f"{manifest}: split {split!r} is the benchmark's own; choose another name")
    root = manifest.parent.resolve()
    sources: dict[str, ImportedSource] = {}
    for number, entry in enumerate(content["objects"]):
        where = f"{manifest}: objects[{number}]"
        if not isinstance(entry, dict) or not all(
            isinstance(entry.get(key), str) for key in ("name", "category", "file")
        ):
            raise InvalidInputError(f"{where}: expected texts 'name', 'category' and 'file'")
        name = check_name(entry["name"], f"{where}: name")
        path = (root / entry["file"]).resolve()
        if root not in path.parents:
            raise InvalidInputError(f"{where}: file {entry['file']!r} is outside the manifest's folder")
        if not path.is_file():
            raise InvalidInputError(f"{where}: file {entry['file']!r} does not exist")
        unit, up = entry.get("unit", "m"), entry.get("up", "auto")
        if unit not in UNITS or up not in ("auto", "x", "y", "z"):
            raise InvalidInputError(
                f"{where}: unit {unit!r}, up {up!r}; expected a unit of {', '.join(UNITS)} and x, y or z"
            )
        if name in sources:
            raise InvalidInputError(f"{where}: name {name!r} is used twice")
        category = check_name(entry["category"], f"{where}: category")
        sources[name] = ImportedSource(
            split, name, category, str(path), content["license"], content["source"], up, UNITS[unit]
        )
    return split, list(sources.values())


def report(outcomes: list[Any], sources: list[ImportedSource]) -> dict[str, Any]:
    """Summary of an import: what became of every file."""
    paths = {source.name: source.path for source in sources}
    entries = [
        {
            "file": paths.get(o.name, ""),
            "name": o.name,
            "status": o.status,
            "reason": o.message if o.record is None else "",
        }
        for o in outcomes
    ]
    counts: dict[str, int] = {}
    for outcome in outcomes:
        counts[outcome.status] = counts.get(outcome.status, 0) + 1
    return {"counts": counts, "files": sorted(entries, key=lambda entry: entry["name"])}
