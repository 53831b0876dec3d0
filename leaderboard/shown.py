"""Pictures as a page shows them: files beside it, named by their content, loaded when they are seen."""

from __future__ import annotations

import hashlib
import io
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from PIL import Image

from tslam_bench.errors import InvalidInputError
from tslam_bench.files import atomic_file, write_json

PICTURES: Final = "pictures"
"""Folder of the pictures, beside the page."""
LIST_FILE: Final = "pictures.json"
"""What each picture shows: a page can be built again from it without the submissions."""
LINKS_FILE: Final = "viewer.json"
"""Beside the page: which object of which entry its 3D viewer shows, and where."""
_NAME: Final = re.compile(r"[0-9a-f]{24}\.webp")

Key = tuple[str, str, str]
"""(kind, content hash, object); the hash is empty for the true mesh."""

Links = Mapping[tuple[str, str], str]
"""(content hash, object) -> address relative to the page."""


@dataclass(frozen=True)
class Shown:
    """A picture's file name and its size in pixels."""

    file: str
    width: int
    height: int

    @property
    def address(self) -> str:
        """Relative to the page."""
        return f"{PICTURES}/{self.file}"


def write_pictures(images: Mapping[Key, bytes], folder: Path) -> dict[Key, Shown]:
    """Writes WebP files and their list into ``folder``, and removes those of an earlier page."""
    shown: dict[Key, Shown] = {}
    if not images and not folder.exists():
        return shown
    folder.mkdir(parents=True, exist_ok=True)
    for key, data in images.items():
        with Image.open(io.BytesIO(data)) as image:
            shown[key] = Shown(f"{hashlib.sha256(data).hexdigest()[:24]}.webp", *image.size)
        path = folder / shown[key].file
        if not path.is_file():
            with atomic_file(path) as temporary:
                temporary.write_bytes(data)
    kept = {picture.file for picture in shown.values()}
    for path in folder.iterdir():
        if _NAME.fullmatch(path.name) and path.name not in kept:
            path.unlink()
    rows = [
        {"kind": kind, "content_hash": content, "object": name, **asdict(picture)}
        for (kind, content, name), picture in sorted(shown.items())
    ]
    write_json(folder / LIST_FILE, rows)
    return shown


def read_pictures(folder: Path) -> dict[Key, Shown]:
    """What :func:`write_pictures` wrote; empty where there is nothing.

    Raises:
        InvalidInputError: the list is not one, or names a file that is not there.
    """
    path = folder / LIST_FILE
    if not path.is_file():
        return {}
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
        shown = {
            (row["kind"], row["content_hash"], row["object"]): Shown(row["file"], row["width"], row["height"])
            for row in rows
        }
    except (ValueError, KeyError, TypeError) as error:
        raise InvalidInputError(f"{path}: no list of pictures ({error!r:.80}); build the page again") from error
    for picture in shown.values():
        if not _NAME.fullmatch(picture.file) or not (folder / picture.file).is_file():
            raise InvalidInputError(f"{path}: {picture.file:.60} is not there; build the page again")
    return shown


def write_links(links: Links, folder: Path) -> None:
    """Writes what the viewer beside a page shows."""
    rows = [
        {"content_hash": content, "object": name, "address": link} for (content, name), link in sorted(links.items())
    ]
    write_json(folder / LINKS_FILE, rows)


def read_links(folder: Path) -> dict[tuple[str, str], str]:
    """What :func:`write_links` wrote, of pages that are still there; empty where there is nothing.

    Raises:
        InvalidInputError: the list is not one, or leads elsewhere.
    """
    path = folder / LINKS_FILE
    if not path.is_file():
        return {}
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
        links = {(row["content_hash"], row["object"]): str(row["address"]) for row in rows}
    except (ValueError, KeyError, TypeError) as error:
        raise InvalidInputError(f"{path}: no list of links ({error!r:.80}); build the page again") from error
    for link in links.values():
        if not re.fullmatch(r"viewer/[\w.-]+\.html#\S*", link):
            raise InvalidInputError(f"{path}: {link[:60]!r} does not lead into the viewer; build the page again")
    return {key: link for key, link in links.items() if (folder / link.partition("#")[0]).is_file()}
