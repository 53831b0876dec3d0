"""What ``tslam-bench doctor`` finds: one line per thing it looked at."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal

Status = Literal["ok", "note", "fails"]

_LIBRARY: Final = re.compile(r"(lib[\w.+-]+?\.so[.\d]*): cannot open shared object file")
_DEBIAN: Final = {
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
    "libgthread-2.0.so.0": "libglib2.0-0",
    "libglib-2.0.so.0": "libglib2.0-0",
    "libvulkan.so.1": "libvulkan1",
}
"""System library -> Debian's package, of those that small containers lack."""


@dataclass(frozen=True)
class Finding:
    """One line.

    Attributes:
        group: heading that it stands under.
        name: what was looked at.
        status: ``ok``; ``note``: works, but something is missing, untested or slow; ``fails``: has to be put right first.
        found: what was found.
        remedy: what to do about it; empty if there is nothing to do.
        figures: the same in numbers, for ``--json``.
    """

    group: str
    name: str
    status: Status
    found: str
    remedy: str = ""
    figures: Mapping[str, Any] = field(default_factory=dict)


Check = Callable[[], Iterable[Finding]]


def guarded(group: str, check: Check) -> list[Finding]:
    """The lines of a check. One that goes wrong itself is a line too: looking at a broken machine must not end in a traceback."""
    try:
        return list(check())
    except Exception as error:
        return [
            Finding(
                group,
                check.__name__.strip("_"),
                "fails",
                short(error),
                "this is a fault of the check: please report it",
            )
        ]


def short(error: BaseException) -> str:
    """An exception on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]


def import_remedy(message: str, extra: str) -> str:
    """What to do about a package that is installed and cannot be imported."""
    library = _LIBRARY.search(message)
    if library is None:
        return f"install it again: pip install --force-reinstall 'tslam-bench[{extra}]'"
    package = _DEBIAN.get(library[1])
    return f"install the system library {library[1]}" + (
        f" (Debian, Ubuntu: apt-get install {package})" if package else ""
    )
