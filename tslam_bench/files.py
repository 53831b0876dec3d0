"""Files: the user cache, hashes, and writes that leave nothing half-written."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final

from tslam_bench.errors import AssetError, InvalidInputError

CACHE_VARIABLE = "TSLAM_BENCH_CACHE"
_NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)
"""What a disk says that takes no more, whoever writes to it."""
_TAKEN: Final = (errno.ENOTEMPTY, errno.EEXIST, errno.EACCES)
"""What a system says of a directory that is to be put where one stands."""
_WITHOUT_WAITING: Final = getattr(os, "O_NONBLOCK", 0)
_KINDS: Final = {
    stat.S_IFDIR: "a folder",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
}
_MOST_RIVALS: Final = 1000
"""Others that may put a directory in the same place at the same time before writing it is given up."""


def cache_directory() -> Path:
    """The user cache directory (not created): ``$TSLAM_BENCH_CACHE``, or the platform's cache folder.

    Raises:
        AssetError: neither is set, as for a user in a container who is in no list of users.
    """
    override = os.environ.get(CACHE_VARIABLE)
    if override:
        return Path(override).expanduser().absolute()
    try:
        if sys.platform == "darwin":
            base = Path.home() / "Library" / "Caches"
        elif sys.platform == "win32":
            base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
        else:
            base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError as error:
        raise AssetError(
            f"this user has no home directory; set {CACHE_VARIABLE} to a directory that you can write"
        ) from error
    return base / "tslam_bench"


def ensure_writable_directory(directory: Path) -> Path:
    """Creates ``directory`` and proves that a file can be written in it.

    Raises:
        AssetError: the directory cannot be created or written.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise AssetError(
            f"{directory}: cannot be written ({error.strerror or error}); "
            f"set {CACHE_VARIABLE} to a directory that you can write, or choose another output directory"
        ) from error
    return directory


def package_data(*parts: str) -> Path:
    """A file or folder that comes with the package outside its modules: ``package_data("assets", "manifest_test.json")``.

    A wheel has it inside the package, a clone beside it.
    """
    package = Path(__file__).parent
    inside = package.joinpath(*parts)
    return inside if inside.exists() else package.parent.joinpath(*parts)


def sha256_file(path: Path) -> str:
    """Hexadecimal SHA-256 of a file's bytes."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        for block in iter(lambda: stream.read(1 << 20), b""):
            digest.update(block)
    return digest.hexdigest()


def kind_of_file(mode: int) -> str:
    """What a path leads to, by its ``st_mode``: "a file", "a folder", "a pipe", ..."""
    return _KINDS.get(stat.S_IFMT(mode), "a file" if stat.S_ISREG(mode) else "something unknown")


@contextlib.contextmanager
def writing(path: Path, errors: tuple[int, ...] | None = None) -> Iterator[None]:
    """Turns what the system refuses (only ``errors``, if they are named) into one line that names ``path``."""
    try:
        yield
    except OSError as error:
        if errors is not None and error.errno not in errors:
            raise
        reason = error.strerror or str(error)
        raise AssetError(
            f"{path}: cannot be written ({reason}); make room, or choose another place ({CACHE_VARIABLE} moves the cache)"
        ) from error


def place_to_write(path: Path, directory: bool = False) -> Path:
    """Where a file (or directory) ``path`` is written: the path itself, or what it leads to if it is a link.

    Raises:
        InvalidInputError: a device, a pipe, a folder (or a file) stands there, which is not to be replaced.
        AssetError: the path cannot be looked at.
    """
    with writing(path):
        place = Path(os.path.realpath(path))
        try:
            mode = place.stat().st_mode
        except FileNotFoundError:
            return place
    if not (stat.S_ISDIR(mode) if directory else stat.S_ISREG(mode)):
        wanted = "folder" if directory else "file"
        raise InvalidInputError(f"{path}: is {kind_of_file(mode)}, no {wanted}, and stays; name another {wanted}")
    return place


def check_output(path: Path, inputs: Iterable[Path] = ()) -> None:
    """Looks at where a result is going to be written, before the work and not after it.

    Raises:
        InvalidInputError: no file is to be written there, or it is one of the ``inputs`` or lies in one.
        AssetError: the path cannot be looked at.
    """
    place = place_to_write(path)
    for given in inputs:
        read = Path(os.path.realpath(given))
        if read == place or read in place.parents:
            raise InvalidInputError(f"{path}: would be written into {given}, which is read; name another place")


def read_plain_file(path: Path, most: int) -> bytes:
    """Bytes of a file of at most ``most`` bytes; nothing that could wait for ever or never end is read.

    Raises:
        InvalidInputError: it is missing, larger, a pipe, a device or a folder, or may not be read.
    """
    try:
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | _WITHOUT_WAITING)) as stream:
            status = os.fstat(stream.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise InvalidInputError(f"{path}: is {kind_of_file(status.st_mode)}, no file; check the path")
            data = stream.read(most + 1)
    except FileNotFoundError as error:
        raise InvalidInputError(f"{path}: no such file; check the path") from error
    except OSError as error:
        raise InvalidInputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    if len(data) > most:
        raise InvalidInputError(f"{path}: has more than {most} bytes; at most that many are read")
    return data


def _hidden(path: Path, ending: str = "") -> str:
    """Prefix of the name of something temporary beside ``path``, whose own name may be as long as a name can be."""
    return f".{path.stem[:40]}{ending}-"


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside the target; on success it replaces ``path``, on failure it is removed.

    Raises:
        InvalidInputError: something that is no file stands there.
        AssetError: the place cannot be written, or is full.
    """
    target = place_to_write(path)
    ensure_writable_directory(target.parent)
    with writing(path):
        descriptor, name = tempfile.mkstemp(dir=target.parent, prefix=_hidden(target), suffix=target.suffix[:20])
    os.close(descriptor)
    temporary = Path(name)
    try:
        with writing(path, _NO_ROOM):
            yield temporary
        with writing(path):
            temporary.chmod(0o644)
            temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def link_or_copy(source: Path, target: Path) -> None:
    """Makes ``target`` a hard link to ``source``, or a copy where the file system allows no link.

    Neither refers to the other's path: each may be moved or deleted. Both are to be replaced only, never written in place.
    """
    with atomic_file(target) as temporary:
        temporary.unlink()
        try:
            os.link(source.resolve(), temporary)
        except OSError:
            shutil.copyfile(source, temporary)


@contextlib.contextmanager
def atomic_directory(path: Path) -> Iterator[Path]:
    """Yields a temporary directory beside ``path``; on success it replaces ``path``, on failure it is removed.

    Of several that write it at once, each succeeds, and the last one's stays.

    Raises:
        InvalidInputError: something that is no directory stands there.
        AssetError: the place cannot be written, or is full.
    """
    target = place_to_write(path, directory=True)
    ensure_writable_directory(target.parent)
    with writing(path):
        temporary = Path(tempfile.mkdtemp(dir=target.parent, prefix=_hidden(target)))
    try:
        with writing(path, _NO_ROOM):
            yield temporary
        with writing(path):
            temporary.chmod(0o755)
            _replace_directory(temporary, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _replace_directory(new: Path, target: Path) -> None:
    """Puts ``new`` in the place of ``target``. No system does that in one step: what stands there is moved away first."""
    old = Path(tempfile.mkdtemp(dir=target.parent, prefix=_hidden(target, "-old")))
    try:
        for attempt in range(_MOST_RIVALS):
            moved = old / str(attempt)
            with contextlib.suppress(FileNotFoundError):
                target.replace(moved)
            try:
                new.replace(target)
                return
            except OSError as error:  # somebody else's directory has come in between, or the system refuses
                if attempt == _MOST_RIVALS - 1 or error.errno not in _TAKEN:
                    with contextlib.suppress(OSError):
                        moved.replace(target)
                    raise
    finally:
        shutil.rmtree(old, ignore_errors=True)


def remove_directory(path: Path) -> None:
    """Removes a directory as a whole: it is moved out of sight first, so that nobody sees half of it."""
    hidden = Path(tempfile.mkdtemp(dir=path.parent, prefix=_hidden(path, "-old")))
    try:
        path.replace(hidden / "removed")
    finally:
        shutil.rmtree(hidden, ignore_errors=True)


def write_json(path: Path, value: Any) -> None:
    """Writes ``value`` as sorted, indented JSON, atomically."""
    with atomic_file(path) as temporary:
        temporary.write_text(json.dumps(value, indent=2, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8")
