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
from tslam_bench.scoring.untrusted_zip import COMPRESSIONS, open_zip

MAX_FILES: Final = 20_000
"""Files in a submission."""
MAX_FILE_SIZE: Final = 64 * 2**20
"""Bytes of one uncompressed file: 64 MiB."""
MAX_TOTAL_SIZE: Final = 8 * 2**30
"""Bytes of all uncompressed files: 8 GiB."""
MAX_DIRECTORY: Final = 8 * 2**20
"""Bytes of an archive's list of entries: 400 for each of the most files."""
MAX_COMPRESSION_RATIO: Final = 100
"""Uncompressed to compressed bytes of a zip entry above ``RATIO_FREE_SIZE``."""
RATIO_FREE_SIZE: Final = 2**20
"""Bytes below which the compression ratio of an entry is not looked at: 1 MiB."""

_AS_IT_IS: Final = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
_IGNORED_NAMES = ("readme", "readme.md", "readme.txt", "license", "license.txt", "license.md")


class FileSource:
    """Names and bytes of the regular files of a submission. Can be sent to another process.

    Attributes:
        location: the path as given, for messages.
        sizes: name with forward slashes, relative to the submission -> uncompressed bytes. Hidden files, ``__MACOSX``
            and a README or LICENSE at the top are left out.
    """

    def __init__(self, location: str, sizes: dict[str, int]) -> None:
        self.location = location
        if len(sizes) > MAX_FILES:
            raise InvalidInputError(f"{location}: {len(sizes)} files; at most {MAX_FILES} are read")
        for name, size in sizes.items():
            if size > MAX_FILE_SIZE:
                raise InvalidInputError(f"{location}: {name} has {size} bytes; at most {MAX_FILE_SIZE} are read")
        total = sum(sizes.values())
        if total > MAX_TOTAL_SIZE:
            raise InvalidInputError(f"{location}: {total} bytes uncompressed; at most {MAX_TOTAL_SIZE} are read")
        self.sizes = {name: size for name, size in sizes.items() if not _ignored(name)}

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
        pending = [folder]
        while pending:
            try:
                entries = sorted(os.scandir(pending.pop()), key=lambda entry: entry.name)
            except OSError as error:
                raise InvalidInputError(f"{folder}: cannot be read ({error.strerror})") from error
            for entry in entries:
                name = Path(entry.path).relative_to(folder).as_posix()
                mode = entry.stat(follow_symlinks=False).st_mode
                if stat.S_ISDIR(mode):
                    pending.append(Path(entry.path))
                elif stat.S_ISREG(mode):
                    sizes[name] = entry.stat(follow_symlinks=False).st_size
                else:
                    kind = "a symbolic link" if stat.S_ISLNK(mode) else "not a regular file"
                    raise InvalidInputError(f"{folder}: {_shown(name)} is {kind}; replace it with the file itself")
                if len(sizes) + len(pending) > 2 * MAX_FILES:
                    raise InvalidInputError(f"{folder}: more than {MAX_FILES} files; is this a submission folder?")
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
    """A submission in a zip archive: its files at the top, or in one folder at the top."""

    def __init__(self, path: Path) -> None:
        self._path = path
        sizes: dict[str, int] = {}
        for entry in self._archive.infolist():
            if not entry.is_dir():
                _check_entry(str(path), entry)
                if entry.filename in sizes:
                    raise InvalidInputError(f"{path}: {entry.filename} is in the archive twice; pack it again")
                sizes[entry.filename] = entry.file_size
        self._prefix = _common_folder([name for name in sizes if not name.startswith("__MACOSX/")])
        super().__init__(str(path), {name.removeprefix(self._prefix): size for name, size in sizes.items()})

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
            with self._archive.open(self._prefix + name) as stream:
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
    if path.is_dir():
        return FolderSource(path)
    if not path.exists():
        raise InvalidInputError(f"{path}: no such folder or zip archive; check the path")
    if not path.is_file() or not zipfile.is_zipfile(path):
        raise InvalidInputError(f"{path}: neither a folder nor a zip archive; give one that holds submission.json")
    return ZipSource(path)


def _check_entry(location: str, entry: zipfile.ZipInfo) -> None:
    name = _shown(entry.filename)
    parts = entry.filename.split("/")
    if (
        any(part in ("", ".", "..") for part in parts)
        or "\\" in entry.filename
        or ":" in entry.filename
        or "\0" in entry.orig_filename
    ):
        raise InvalidInputError(f"{location}: the entry {name} leaves the archive; pack it again with relative names")
    mode = entry.external_attr >> 16
    if stat.S_IFMT(mode) not in (0, stat.S_IFREG):
        raise InvalidInputError(f"{location}: {name} is a link or special file; replace it with the file itself")
    if entry.flag_bits & 0x1:
        raise InvalidInputError(f"{location}: {name} is encrypted; pack it without a password")
    if entry.compress_type not in COMPRESSIONS:
        raise InvalidInputError(f"{location}: {name} uses an unusual compression; pack it with deflate")
    if entry.file_size > RATIO_FREE_SIZE and entry.file_size > MAX_COMPRESSION_RATIO * max(entry.compress_size, 1):
        raise InvalidInputError(
            f"{location}: {name} unpacks to more than {MAX_COMPRESSION_RATIO} times its size; refused"
        )


def _common_folder(names: list[str]) -> str:
    """``"folder/"`` if all names are in one folder and submission.json is directly in it, else ``""``."""
    folders = {name.partition("/")[0] for name in names}
    if len(folders) == 1 and f"{next(iter(folders))}/submission.json" in names:
        return f"{folders.pop()}/"
    return ""


def _ignored(name: str) -> bool:
    parts = name.split("/")
    return parts[0] == "__MACOSX" or any(part.startswith(".") for part in parts) or name.lower() in _IGNORED_NAMES


def _shown(name: str) -> str:
    return repr(name[:100])
