"""The progress bar of every command, on standard error."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Any

from tqdm import tqdm

from tslam_bench.text import visible


class Progress:
    """A bar that is set rather than advanced; use it as a context.

    Args:
        description: what is going on.
        unit: what is counted.
        total: how many there will be, if that is known already.
        options: further ones of tqdm.
    """

    def __init__(self, description: str, unit: str = "it", total: int | None = None, **options: Any) -> None:
        settings = {"file": sys.stderr, "mininterval": 0.5, "miniters": 0, "dynamic_ncols": True, **options}
        self._bar = tqdm(desc=visible(description), unit=unit, total=total, **settings)

    def show(self, done: int, total: int | None = None, note: str = "") -> None:
        """Sets how much is done, and of how much; ``note`` stands behind the bar."""
        if total is not None:
            self._bar.total = total
        if note:
            self._bar.set_postfix_str(note, refresh=False)
        self._bar.update(done - self._bar.n)

    def write(self, line: str) -> None:
        """Prints a line above the bar."""
        self._bar.write(line)

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.close()


class Stages:
    """A bar for each stage of something, one after the other; use it as a context and call it with (stage, done, total)."""

    def __init__(self, description: str) -> None:
        self._description = description
        self._stage = ""
        self._bar: Progress | None = None

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Shows how far a stage is."""
        if stage != self._stage or self._bar is None:
            self.__exit__()
            self._stage, self._bar = stage, Progress(f"{self._description}: {stage}", total=total)
        self._bar.show(done, total)

    def __enter__(self) -> Stages:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.__exit__(None, None, None)
