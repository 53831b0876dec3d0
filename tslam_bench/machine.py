"""The machine that we run on: what it is called, and how much of it this process may use."""

from __future__ import annotations

import os
import platform
import re
import subprocess
from pathlib import Path
from typing import Final

_CGROUP: Final = Path("/sys/fs/cgroup")


def processor_name() -> str:
    """What the processor calls itself."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text(encoding="utf-8").splitlines() if information.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def source_commit() -> str | None:
    """The commit of the clone that this code runs from, with ``+changes`` if files differ from it; None for a wheel."""
    root = Path(__file__).parents[1]
    if not (root / ".git").exists():
        return None

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "HEAD") + ("+changes" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return None


def usable_cores(groups: Path = _CGROUP) -> int:
    """Cores that this process gets: those it may run on, or fewer where a container has a share of their time.

    Args:
        groups: where the kernel shows control groups, version 2 or 1.
    """
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota, period = _read(groups / "cpu.max"), 0
    if len(quota) == 2:
        quota, period = quota[:1], int(quota[1])
    else:
        quota = _read(groups / "cpu" / "cpu.cfs_quota_us")
        period = next(map(int, _read(groups / "cpu" / "cpu.cfs_period_us")), 0)
    if not quota or not re.fullmatch(r"[0-9]+", quota[0]) or period <= 0:  # "max" and -1: no limit
        return allowed
    return max(min(allowed, int(quota[0]) // period), 1)


def available_memory(groups: Path = _CGROUP, information: Path = Path("/proc/meminfo")) -> int | None:
    """Bytes that can be had without swapping, within a container's limit; None where the system does not tell.

    Args:
        groups: where the kernel shows control groups, version 2 or 1.
        information: what the kernel says of the memory.
    """
    try:
        found = re.search(r"^MemAvailable:\s*(\d+) kB", information.read_text(encoding="utf-8"), re.MULTILINE)
    except OSError:
        return None
    if found is None:
        return None
    available = int(found[1]) * 1024
    for limit, used, details in (
        ("memory.max", "memory.current", "memory.stat"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat"),
    ):
        most, now, words = (_read(groups / name) for name in (limit, used, details))
        if most and now and most[0].isdigit() and now[0].isdigit():
            cached = (
                int(words[words.index("inactive_file") + 1]) if "inactive_file" in words else 0
            )  # given back on demand
            available = min(available, max(int(most[0]) - int(now[0]) + cached, 0))
    return available


def _read(path: Path) -> list[str]:
    """The words of a small file; none if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8").split()
    except OSError:
        return []
