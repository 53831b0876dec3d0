"""Reading a submission's files from a folder or a zip archive without trusting either.

Nothing is ever extracted. Names are checked before anything is opened, sizes before anything is read.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import os
import stat
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import IO, Any, Final

from tslam_bench.errors import InvalidInputError
from tslam_bench.files import kind_of_file
from tslam_bench.scoring.untrusted_zip import COMPRESSIONS, open_zip

MAX_FILES: Final = 20_000
"""Files in a submission."""
MAX_FILE_SIZE: Final = 64 * 2**20
"""Bytes of one uncompressed file: 64 MiB."""
MAX_TOTAL_SIZE: Final = 8 * 2**30
"""Bytes of all uncompressed files: 8 GiB. What an archive unpacks to costs no more than a folder may, whatever its ratio."""
MAX_DIRECTORY: Final = 8 * 2**20
"""Bytes of an archive's list of entries: 400 for each of the most files."""

_AS_IT_IS: Final = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
_AT_THE_TOP: Final = ("readme", "readme.md", "readme.txt", "license", "license.txt", "license.md")
_LITTER: Final = ("__macosx", "desktop.ini", "thumbs.db", "ehthumbs.db", "icon", "icon\r", "$recycle.bin", "@eadir")
"""What file managers leave in folders, besides hidden files."""


class FileSource:
    """Names and bytes of the regular files of a submission. Can be sent to another process.

    Attributes:
        location: the path as given, for messages.
        sizes: name with forward slashes, relative to the submission -> uncompressed bytes. Hidden files, what file
            managers leave in folders, and a README or LICENSE at the top are left out.
    """

    def __init__(self, location: str, sizes: dict[str, int]) -> None:
        self.location = location
        if len(sizes) > MAX_FILES:
            raise InvalidInputError(f"{location}: {len(sizes)} files; at most {MAX_FILES} are read")
        for name, size in sizes.items():
            if size > MAX_FILE_SIZE:
                raise InvalidInputError(
                    f"{location}: {_shown(name)} has {size} bytes; at most {MAX_FILE_SIZE} are read"
                )
        total = sum(sizes.values())
        if total > MAX_TOTAL_SIZE:
            raise InvalidInputError(f"{location}: {total} bytes uncompressed; at most {MAX_TOTAL_SIZE} are read")
        self.sizes = sizes

    def only(self, names: Iterable[str]) -> FileSource:
        """The same source with some of its files."""
        part = copy.copy(self)
        part.sizes = {name: self.sizes[name] for name in names}
        return part

    def read(self, name: str) -> bytes:
        """Bytes of one listed file.

        Raises:
            InvalidInputError: it cannot be read, or has another size than when the submission was opened.
        """
        with self._open(name) as stream:
            data = stream.read(self.sizes[name] + 1)
        if len(data) != self.sizes[name]:
            raise self.changed(name)
        return data

    def changed(self, name: str) -> InvalidInputError:
        """The refusal of a file that is not what it was when the submission was opened."""
        return InvalidInputError(f"{self.location}: {name} changed while it was read; start again when nothing writes")

    def _open(self, name: str) -> AbstractContextManager[IO[bytes]]:
        raise NotImplementedError


class FolderSource(FileSource):
    """A submission in a folder. Symbolic links and special files are refused, not followed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        sizes: dict[str, int] = {}
        pending = [""]
        seen = 0
        while pending:
            above = pending.pop()
            try:
                entries = sorted(os.scandir(folder / above), key=lambda entry: entry.name)
            except OSError as error:
                raise InvalidInputError(f"{folder}: cannot be read ({error.strerror})") from error
            for entry in entries:
                name = f"{above}{entry.name}"
                seen += 1
                if seen > 4 * MAX_FILES:
                    raise InvalidInputError(f"{folder}: more than {MAX_FILES} files; is this a submission folder?")
                if _ignored(name):
                    continue
                mode = entry.stat(follow_symlinks=False).st_mode
                if stat.S_ISDIR(mode):
                    pending.append(f"{name}/")
                elif stat.S_ISREG(mode):
                    sizes[name] = entry.stat(follow_symlinks=False).st_size
                else:
                    kind = "a symbolic link" if stat.S_ISLNK(mode) else f"{kind_of_file(mode)}, not a regular file"
                    raise InvalidInputError(f"{folder}: {_shown(name)} is {kind}; replace it with the file itself")
        super().__init__(str(folder), sizes)

    @contextlib.contextmanager
    def _open(self, name: str) -> Iterator[IO[bytes]]:
        try:
            # A link or a pipe that has taken the file's place is neither followed nor waited for.
            with open(self._folder / name, "rb", opener=lambda path, flags: os.open(path, flags | _AS_IT_IS)) as stream:
                if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
                    raise self.changed(name)
                yield stream
        except OSError as error:
            raise InvalidInputError(f"{self.location}: {name} cannot be read ({error.strerror})") from error


class ZipSource(FileSource):
    """A submission in a zip archive: its files at the top, or in one folder at the top.

    Names may be written as some systems pack them: with backslashes, or with ``./`` before them.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        entries: dict[str, zipfile.ZipInfo] = {}
        for entry in self._archive.infolist():
            name = _plain_name(str(path), entry)
            if entry.is_dir() or entry.filename.endswith("\\") or _ignored(name):
                continue
            _check_entry(str(path), entry)
            if name in entries:
                raise InvalidInputError(f"{path}: {_shown(name)} is in the archive twice; pack it again")
            entries[name] = entry
        prefix = _common_folder([*entries])
        inside = {name.removeprefix(prefix): entry for name, entry in entries.items()}
        inside = {name: entry for name, entry in inside.items() if not _ignored(name)}
        self._names = {name: entry.filename for name, entry in inside.items()}
        super().__init__(str(path), {name: entry.file_size for name, entry in inside.items()})

    @functools.cached_property
    def _archive(self) -> zipfile.ZipFile:
        try:
            return open_zip(self._path, MAX_DIRECTORY)
        except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError) as error:
            raise InvalidInputError(f"{self._path}: not a readable zip archive ({error}); pack it again") from error

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_archive"}

    @contextlib.contextmanager
    def _open(self, name: str) -> Iterator[IO[bytes]]:
        try:
            with self._archive.open(self._names[name]) as stream:
                yield stream  # it stops at the declared size and checks the CRC
        except (
            OSError,
            EOFError,
            KeyError,
            zipfile.BadZipFile,
            zlib.error,
            NotImplementedError,
            RuntimeError,
        ) as error:
            raise InvalidInputError(f"{self.location}: {name} is damaged ({error}); pack it again") from error


def open_source(path: Path) -> FileSource:
    """Opens a folder or a zip archive.

    Raises:
        InvalidInputError: it does not exist, is neither, holds links or unsafe names, or exceeds a limit.
    """
    try:
        mode = path.stat().st_mode
        archive = stat.S_ISREG(mode) and zipfile.is_zipfile(path)
    except FileNotFoundError as error:
        raise InvalidInputError(f"{path}: no such folder or zip archive; check the path") from error
    except OSError as error:
        raise InvalidInputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    if stat.S_ISDIR(mode):
        return FolderSource(path)
    if archive:
        return ZipSource(path)
    raise InvalidInputError(f"{path}: neither a folder nor a zip archive; give one that holds submission.json")


def _plain_name(location: str, entry: zipfile.ZipInfo) -> str:
    """An entry's name with single forward slashes between plain parts. Raises InvalidInputError if it leaves the archive."""
    name = entry.filename.replace("\\", "/")
    parts = [part for part in name.split("/") if part not in ("", ".")]
    if name.startswith("/") or ".." in parts or ":" in name or "\0" in entry.orig_filename:
        raise InvalidInputError(
            f"{location}: the entry {_shown(entry.filename)} leaves the archive; pack it again with relative names"
        )
    return "/".join(parts)


def _check_entry(location: str, entry: zipfile.ZipInfo) -> None:
    name = _shown(entry.filename)
    mode = entry.external_attr >> 16
    if stat.S_IFMT(mode) not in (0, stat.S_IFREG):
        raise InvalidInputError(f"{location}: {name} is a link or special file; replace it with the file itself")
    if entry.flag_bits & 0x1:
        raise InvalidInputError(f"{location}: {name} is encrypted; pack it without a password")
    if entry.compress_type not in COMPRESSIONS:
        raise InvalidInputError(f"{location}: {name} uses an unusual compression; pack it with deflate")


def _common_folder(names: list[str]) -> str:
    """``"folder/"`` if all names are in one folder and submission.json is directly in it, else ``""``."""
    folders = {name.partition("/")[0] for name in names}
    if len(folders) == 1 and f"{next(iter(folders))}/submission.json" in names:
        return f"{folders.pop()}/"
    return ""


def _ignored(name: str) -> bool:
    parts = [part.lower() for part in name.split("/")]
    return name.lower() in _AT_THE_TOP or any(part.startswith(".") or part in _LITTER for part in parts)


def _shown(name: str) -> str:
    return repr(name[:100])
