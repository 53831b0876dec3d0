"""Seals: what tells a file that was made here from one that somebody sent along.

A seal is an HMAC over the content under a random key in this user's asset cache, which goes nowhere.
"""

from __future__ import annotations

import hmac
import json
import os
import secrets
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from tslam_bench.errors import AssetError
from tslam_bench.files import cache_directory, ensure_writable_directory

KEY_FILE: Final = "verification.key"
_KEY_SIZE: Final = 32


def seal(content: Mapping[str, Any]) -> str:
    """The seal of JSON content; the key is drawn if there is none.

    Raises:
        AssetError: the key cannot be read or written.
    """
    return _seal(content, _made_key())


def sealed_here(content: Mapping[str, Any], claimed: object) -> bool:
    """Whether ``claimed`` is the seal of this content, made by this user on this machine.

    Raises:
        AssetError: the key cannot be read.
    """
    key = _key()
    return (
        key is not None
        and isinstance(claimed, str)
        and hmac.compare_digest(claimed.encode(), _seal(content, key).encode())
    )


def _seal(content: Mapping[str, Any], key: bytes) -> str:
    return hmac.new(key, json.dumps(content, sort_keys=True).encode(), "sha256").hexdigest()


def _key() -> bytes | None:
    """The key of this user's seals, or None if none was made here yet."""
    path = cache_directory() / KEY_FILE
    try:
        key = path.read_bytes() if path.is_file() else None
    except OSError as error:
        raise AssetError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
    if key is not None and len(key) != _KEY_SIZE:  # anybody can seal with an empty one
        raise AssetError(f"{path}: damaged; delete it (what it has sealed counts as made elsewhere then)")
    return key


def _made_key() -> bytes:
    """The key of this user's seals; it is drawn if there is none, and is never there in part."""
    path = ensure_writable_directory(cache_directory()) / KEY_FILE
    if not path.exists():
        try:
            descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{KEY_FILE}-")  # readable by its owner alone
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(secrets.token_bytes(_KEY_SIZE))
            try:
                os.link(name, path)
            except FileExistsError:
                pass
            except OSError:  # a file system without links
                Path(name).replace(path)
            Path(name).unlink(missing_ok=True)
        except OSError as error:
            raise AssetError(f"{path}: cannot be written ({error.strerror}); check its permissions") from error
    key = _key()
    assert key is not None
    return key
