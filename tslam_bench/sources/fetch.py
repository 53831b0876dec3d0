"""Fetches pinned wheels into the cache with the user's own pip configuration (mirrors, proxies, certificates)."""

from __future__ import annotations

import logging
import re
import subprocess
import sys
import tempfile
import urllib.request
from pathlib import Path

from tslam_bench.errors import AssetError
from tslam_bench.files import atomic_file, cache_directory, ensure_writable_directory, sha256_file
from tslam_bench.sources.wheels import FilePin, WheelPin

logger = logging.getLogger(__name__)


def _normalised(name: str) -> str:
    """Distribution name as package indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _find_wheel(directory: Path, name: str, version: str) -> Path | None:
    """The wheel of ``name`` and ``version`` in ``directory``, if there is one."""
    for path in sorted(directory.glob("*.whl")):
        parts = path.name.split("-")
        if len(parts) >= 5 and _normalised(parts[0]) == _normalised(name) and parts[1] == version:
            return path
    return None


def _pip_reason(output: str) -> str:
    """The line of pip's output that says why it failed."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("ERROR")]
    reason = (errors or lines or ["no output"])[-1].removeprefix("ERROR:").strip()
    return lines[-1] if reason == "Exception:" else reason  # a traceback follows: a full disk, say


def fetch_wheel(name: str, version: str, sha256: str, cache: Path | None = None) -> Path:
    """Returns the path of a pinned wheel in ``<cache>/downloads``, downloading it first where needed.

    A file that is already there is hashed again; one with another hash is fetched anew.

    Args:
        name: distribution name on the package index.
        version: exact version.
        sha256: hexadecimal hash that the wheel must have.
        cache: cache directory (default: the user's).

    Raises:
        AssetError: no network, no such file, a wrong hash, or a cache that cannot be written.
    """
    directory = ensure_writable_directory((cache or cache_directory()) / "downloads")
    present = _find_wheel(directory, name, version)
    if present is not None:
        if sha256_file(present) == sha256:
            return present
        logger.warning("%s: does not have the pinned SHA-256; downloading it again", present)
    with tempfile.TemporaryDirectory(dir=directory, prefix=".fetch-") as temporary:
        command = [sys.executable, "-m", "pip", "download", "--no-deps", "--no-input", "--disable-pip-version-check"]
        command += ["--only-binary", ":all:", "--dest", temporary, f"{name}=={version}"]
        try:
            result = subprocess.run(command, capture_output=True, text=True, check=False)
        except OSError as error:
            raise AssetError(
                f"{name}=={version}: cannot start pip ({error}); run inside an environment that has pip"
            ) from error
        wheel = _find_wheel(Path(temporary), name, version)
        if result.returncode != 0 or wheel is None:
            raise AssetError(
                f"{name}=={version}: download failed ({_pip_reason(result.stderr or result.stdout)}); "
                f"check the network and pip's index settings, or put the wheel into {directory}"
            )
        found = sha256_file(wheel)
        if found != sha256:
            raise AssetError(
                f"{name}=={version}: the downloaded wheel has SHA-256 {found}, expected {sha256}; "
                "the package index does not serve the pinned file"
            )
        target = directory / wheel.name
        wheel.replace(target)
    return target


def fetch(pin: WheelPin, cache: Path | None = None) -> Path:
    """:func:`fetch_wheel` for an entry of :mod:`tslam_bench.sources.wheels`."""
    return fetch_wheel(pin.name, pin.version, pin.sha256, cache)


def fetch_file(pin: FilePin, cache: Path | None = None) -> Path:
    """Returns the path of a pinned file in ``<cache>/downloads``, downloading it first where needed.

    Raises:
        AssetError: no server hands out the pinned file, or the cache cannot be written.
    """
    directory = ensure_writable_directory((cache or cache_directory()) / "downloads")
    target = directory / pin.name
    if target.exists():
        if sha256_file(target) == pin.sha256:
            return target
        logger.warning("%s: does not have the pinned SHA-256; downloading it again", target)
    reasons = []
    for url in pin.urls:
        host = url.split("/")[2]
        try:
            with atomic_file(target) as temporary:
                _download(url, temporary, pin.size)
                if sha256_file(temporary) != pin.sha256:
                    raise AssetError("does not serve the pinned file")
            return target
        except (OSError, ValueError, AssetError) as error:
            reasons.append(f"{host}: {error}")
    raise AssetError(
        f"{pin.name}: download failed ({'; '.join(reasons)}); check the network, or put the file into {directory}"
    )


def _download(url: str, path: Path, size: int) -> None:
    """Writes what a server hands out to ``path``, but never more than ``size`` bytes."""
    request = urllib.request.Request(url, headers={"User-Agent": "tslam-bench"})
    with urllib.request.urlopen(request, timeout=60) as response, path.open("wb") as stream:
        left = size
        while block := response.read(min(1 << 20, left + 1)):
            left -= len(block)
            if left < 0:
                raise AssetError("sends more than the pinned file holds")
            stream.write(block)
