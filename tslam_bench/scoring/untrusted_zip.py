"""Opening zip archives that nobody vouches for: the list of entries is measured before it is read."""

from __future__ import annotations

import contextlib
import zipfile
from pathlib import Path
from typing import IO, Any, Final

COMPRESSIONS: Final = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compressions whose unpacking needs little memory and stops when told."""


def open_zip(file: Path | IO[bytes], most: int) -> zipfile.ZipFile:
    """Opens an archive whose list of entries has at most ``most`` bytes.

    Python's reader makes an object of every entry, at once: of 64 MiB of entries, a gigabyte.

    Raises:
        zipfile.BadZipFile, OSError, ValueError, NotImplementedError: not an archive, damaged, or a longer list.
    """
    with contextlib.ExitStack() as stack:
        stream: Any = stack.enter_context(file.open("rb")) if isinstance(file, Path) else file
        end = zipfile._EndRecData(stream)  # type: ignore[attr-defined]  # what ZipFile itself goes by
        if end is None:
            raise zipfile.BadZipFile("it has no end record")
        size = end[zipfile._ECD_SIZE]  # type: ignore[attr-defined]
        if size > most:
            raise zipfile.BadZipFile(f"its list of entries has {size} bytes; at most {most} are read")
    return zipfile.ZipFile(file)
