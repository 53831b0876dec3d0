"""What ``tslam-bench doctor`` looks at in this process: versions, machine, cache, objects, tools. Needs the core alone."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from tslam_bench.cli.findings import Finding, Status, short
from tslam_bench.constants import QUICK_OBJECTS, QUICK_TRAIN_OBJECTS
from tslam_bench.errors import AssetError
from tslam_bench.extras import EXTRAS
from tslam_bench.files import CACHE_VARIABLE, cache_directory, package_data
from tslam_bench.machine import available_memory, processor_name, usable_cores
from tslam_bench.objects.hand import load_hand
from tslam_bench.objects.splits import OBJECTS, SPLITS, prepared_names
from tslam_bench.objects.store import read_record
from tslam_bench.version import __version__

PYTHONS: Final = ((3, 11), (3, 12))
TESTED_PYTHON: Final = (3, 11)
MEMORY_PER_PROCESS: Final = 1e9
"""Bytes. An evaluation in one process has 0.5 GB at its peak; torch and a policy come on top."""
_DISK_NEEDED: Final = 1e9
_DISK_WISHED: Final = 5e9
"""Bytes. The test split has 0.2 GB, its downloads 0.4, the train split 1.6, a run 0.1 to 1."""
_PURPOSE: Final = {
    "core": "scoring and pages",
    "sim": "environments, training, evaluation",
    "assets": "preparing objects",
    "ray": "runs on a Ray cluster",
    "slurm": "runs on a SLURM cluster",
}
_QUICK: Final = "tslam-bench assets prepare --quick"
_BROWSERS: Final = (
    "firefox",
    "chromium",
    "google-chrome",
    "chromium-browser",
    "brave-browser",
    "microsoft-edge",
    "xdg-open",
)


# -- software -----------------------------------------------------------------------------------------------------------
def python() -> Iterator[Finding]:
    """Interpreter and system."""
    version, found = sys.version_info[:2], f"{platform.python_version()} ({sys.executable})"
    if version not in PYTHONS:
        wanted = " or ".join(f"{major}.{minor}" for major, minor in PYTHONS)
        yield Finding("software", "Python", "fails", found, f"make a virtual environment with Python {wanted}")
    elif version != TESTED_PYTHON:
        yield Finding("software", "Python", "note", f"{found}; tested with {TESTED_PYTHON[0]}.{TESTED_PYTHON[1]}")
    else:
        yield Finding("software", "Python", "ok", found)
    system = f"{platform.system()} {platform.release()}, {platform.machine()}"
    if platform.system() == "Linux" and platform.machine() in ("x86_64", "AMD64"):
        yield Finding("software", "system", "ok", system)
    else:
        yield Finding(
            "software",
            "system",
            "note",
            f"{system}; tested on Linux, x86_64",
            "simulate on Linux; scoring works elsewhere",
        )


def tested_versions() -> dict[str, str]:
    """Package -> the version that our checks run with, from ``constraints.txt``; empty if the file is not there."""
    path = package_data("assets", "constraints.txt")
    if not path.is_file():
        return {}
    pins = re.findall(r"^([\w.-]+)==(\S+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {_canonical(name): version for name, version in pins}


def required_packages() -> dict[str, list[str]]:
    """Extra (``core`` for none) -> names of the packages that it asks for.

    Raises:
        importlib.metadata.PackageNotFoundError: tslam-bench is not installed.
    """
    required: dict[str, list[str]] = {name: [] for name in _PURPOSE}
    for line in importlib.metadata.requires("tslam-bench") or []:
        name = re.split(r"[^\w.-]", line, maxsplit=1)[0]
        extra = re.search(r"extra\s*==\s*['\"](\w+)", line)
        if "platform_machine" in line and platform.machine() not in line:
            continue
        required.get(extra[1] if extra else "core", []).append(name)
    return required


def packages() -> Iterator[Finding]:
    """The core and each extra: what is missing, and what has another version than the tested one."""
    try:
        required = required_packages()
    except importlib.metadata.PackageNotFoundError:
        yield Finding(
            "software", "tslam-bench", "note", f"{__version__}, not installed", "pip install '.[all]' in the clone"
        )
        return
    yield Finding("software", "tslam-bench", "ok", f"{__version__} ({Path(__file__).parents[1]})")
    tested = tested_versions()
    for extra, names in required.items():
        if names:
            yield _extra(extra, names, tested)


def _extra(extra: str, names: Iterable[str], tested: dict[str, str]) -> Finding:
    versions = {name: _version(name) for name in names}
    missing = [name for name, version in versions.items() if version is None]
    others = [
        f"{name} {version} (tested: {tested[_canonical(name)]})"
        for name, version in versions.items()
        if version is not None
        and tested.get(_canonical(name)) not in (None, version.partition("+")[0])  # torch's "+cpu"
    ]
    label = extra if extra == "core" else f"[{extra}]"
    figures = {"versions": versions, "tested": {name: tested.get(_canonical(name)) for name in versions}}
    pip = "pip install tslam-bench" if extra == "core" else f"pip install 'tslam-bench[{extra}]'"
    if missing:
        status: Status = "fails" if extra == "core" else "note"
        return Finding(
            "software", label, status, f"{_PURPOSE[extra]}: {', '.join(missing)} not installed", pip, figures
        )
    if others:
        remedy = f"for the tested versions: {pip} -c {package_data('assets', 'constraints.txt')}"
        return Finding("software", label, "note", f"{_PURPOSE[extra]}: {', '.join(others)}", remedy, figures)
    kind = "in the tested versions" if tested else "installed; which versions were tested is not known here"
    count = f"{len(versions)} package" + ("s" if len(versions) > 1 else "")
    return Finding("software", label, "ok", f"{_PURPOSE[extra]}: {count} {kind}", "", figures)


def has_extra(extra: str) -> bool:
    """Whether every module of an extra can be found; nothing is imported."""
    from importlib.util import find_spec

    return all(find_spec(module) is not None for module in EXTRAS[extra])


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


# -- machine ------------------------------------------------------------------------------------------------------------
def machine() -> Iterator[Finding]:
    """Processor, cores that may be used, memory that is free."""
    cores, installed = usable_cores(), os.cpu_count() or 1
    yield Finding("machine", "processor", "ok", processor_name())
    figures = {"usable": cores, "installed": installed}
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else installed
    if cores < allowed:  # a container's share of time: programs see all cores and start too many processes
        remedy = f"give --workers {cores} (run_all.sh) and --processes {cores} (evaluate, train)"
        yield Finding("machine", "cores", "note", f"{cores}: this container's share of {allowed}", remedy, figures)
    else:
        yield Finding(
            "machine", "cores", "ok", f"{cores}" + (f" of {installed}" if cores < installed else ""), "", figures
        )
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    if load > cores / 2:
        yield Finding("machine", "load", "note", f"{load:.1f}: other programs are running, so speeds below are too low")
    memory = available_memory()
    if memory is None:
        yield Finding("machine", "memory", "note", "cannot be told on this system")
        return
    fitting, found = int(memory // MEMORY_PER_PROCESS), f"{memory / 1e9:.1f} GB available"
    figures = {"available_bytes": memory}
    if fitting < 1:
        yield Finding("machine", "memory", "fails", found, "free memory: one process needs up to 1 GB", figures)
    elif fitting < cores:
        remedy = f"each process needs up to 1 GB: give --workers {fitting} (run_all.sh)"
        yield Finding("machine", "memory", "note", f"{found} for {cores} processes", remedy, figures)
    else:
        yield Finding("machine", "memory", "ok", found, "", figures)


def disks() -> Iterator[Finding]:
    """The cache and the current folder: may they be written, is there room, do locks work."""
    cache, here = cache_directory(), Path.cwd()
    elsewhere = f"set {CACHE_VARIABLE} to a folder that you can write"
    for name, folder, remedy in (
        ("cache", cache, elsewhere),
        ("current folder", here, "change to a folder that you can write"),
    ):
        there = next(parent for parent in (folder, *folder.parents) if parent.exists())
        free = shutil.disk_usage(there).free
        figures = {"path": str(folder), "free_bytes": free}
        found = f"{folder}: {free / 1e9:.1f} GB free"
        if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
            yield Finding(
                "machine", name, "fails" if name == "cache" else "note", f"{folder}: cannot be written", remedy, figures
            )
        elif free < _DISK_WISHED:
            status: Status = "fails" if free < _DISK_NEEDED else "note"
            yield Finding("machine", name, status, found, "make room: objects and runs need 1 to 5 GB", figures)
        else:
            yield Finding("machine", name, "ok", found, "", figures)
    yield _locks(here)


def _locks(folder: Path) -> Finding:
    """File locks keep two runs out of one folder; some network file systems have none."""
    try:
        import fcntl
    except ImportError:
        return Finding("machine", "file locks", "note", "none on this system", "do not start two runs in one folder")
    try:
        with tempfile.TemporaryFile(dir=folder) as stream:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        remedy = "run on a local disk, or on a network file system that is mounted with locks"
        return Finding("machine", "file locks", "note", f"{folder}: {short(error)}", remedy)
    return Finding("machine", "file locks", "ok", "flock works in the current folder")


# -- objects ------------------------------------------------------------------------------------------------------------
def objects() -> Iterator[Finding]:
    """The hand, and each split."""
    prepare = (
        _QUICK if has_extra("assets") else f"pip install 'tslam-bench[assets]'; then {_QUICK} (or: assets unpack FILES)"
    )
    try:
        load_hand()
        yield Finding("objects", "hand", "ok", "prepared")
    except AssetError as error:
        yield Finding("objects", "hand", "fails", str(error).split(";")[0], prepare)
    for split in SPLITS:
        yield _split(split, prepared_names(split), prepare)


def _split(split: str, names: list[str], prepare_quick: str) -> Finding:
    quick = {"test": QUICK_OBJECTS, "train": QUICK_TRAIN_OBJECTS}.get(split, ())
    missing = [name for name in quick if name not in names]
    broken = [name for name in names if not _readable(name, split)]
    figures = {"prepared": len(names), "unreadable": len(broken), "missing_of_the_quick_run": len(missing)}
    command = "tslam-bench assets prepare" + ("" if split == "test" else f" --split {split}")
    if broken:
        found = f"{len(broken)} of {len(names)} objects are damaged or of an older version: {', '.join(broken[:3])}"
        return Finding("objects", split, "fails", found, command, figures)
    if missing:
        found = f"{len(names)} objects; {len(missing)} of the quick run's {len(quick)} are not prepared"
        return Finding("objects", split, "fails" if split == "test" else "note", found, prepare_quick, figures)
    if split == "test" and len(names) < len(OBJECTS):
        return Finding(
            "objects", split, "note", f"{len(names)} of {len(OBJECTS)} objects", f"for all: {command}", figures
        )
    if not names:
        return Finding(
            "objects", split, "note", "none prepared", f"{command} (an hour; the quick run prepares six)", figures
        )
    return Finding("objects", split, "ok", f"{len(names)} objects", "", figures)


def _readable(name: str, split: str) -> bool:
    try:
        read_record(name, split)
    except AssetError:
        return False
    return True


# -- tools --------------------------------------------------------------------------------------------------------------
def tools() -> Iterator[Finding]:
    """Programs that some people need: a browser for the page, containers, SLURM."""
    browser = next((found for found in map(shutil.which, _BROWSERS) if found), None)
    if browser:
        yield Finding("tools", "browser", "ok", browser)
    else:
        yield Finding(
            "tools", "browser", "note", "none here", "copy index.html to a machine that has one; it is one file"
        )
    yield _containers()
    if shutil.which("sbatch"):
        remedy = "" if has_extra("slurm") else "pip install 'tslam-bench[slurm]' for run_all.sh --launcher slurm"
        yield Finding("tools", "SLURM", "note" if remedy else "ok", "sbatch is here", remedy)


def _containers() -> Finding:
    """Docker or Podman, and whether it answers."""
    for program in ("docker", "podman"):
        path = shutil.which(program)
        if path is None:
            continue
        try:
            done = subprocess.run([path, "info"], capture_output=True, text=True, timeout=5, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            return Finding("tools", "containers", "note", f"{path}: {short(error)}", "start its service")
        if done.returncode == 0:
            return Finding("tools", "containers", "ok", f"{path} answers")
        lines = done.stderr.strip().splitlines() or [f"status {done.returncode}"]
        return Finding(
            "tools", "containers", "note", f"{path}: {lines[-1]}", "start its service, if you want containers"
        )
    return Finding("tools", "containers", "note", "neither docker nor podman; optional")
