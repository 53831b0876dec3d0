"""Many items from many people: one that fails is named, the others are done."""

from __future__ import annotations

import contextlib
import sys
import traceback
from collections.abc import Iterator

from tslam_bench.errors import BenchmarkError, InvalidInputError
from tslam_bench.text import visible


class Batch:
    """Runs items one after the other.

    Args:
        program: begins the lines about items that fail.
        count: how many items there are. The error of a single one is nobody else's: it is raised as it is.
    """

    def __init__(self, program: str, count: int) -> None:
        self.failed: list[str] = []
        self._program, self._count = program, count

    @contextlib.contextmanager
    def item(self, name: str) -> Iterator[None]:
        """A block that handles one item; what it raises is printed on standard error, and the block is left."""
        try:
            yield
        except Exception as error:
            if self._count == 1:
                raise
            if not isinstance(error, BenchmarkError | OSError | MemoryError):
                traceback.print_exc()  # not foreseen: a fault of this program, whatever the item is
            reason = "not enough memory" if isinstance(error, MemoryError) else f"{type(error).__name__}: {error}"
            line = str(error) if isinstance(error, BenchmarkError) else f"{name}: {reason}"
            print(visible(f"{self._program}: {line}"), file=sys.stderr)
            self.failed.append(name)

    def finish(self, done: str) -> None:
        """Raises InvalidInputError if an item failed.

        Args:
            done: what became of the others.
        """
        if self.failed:
            named = ", ".join(self.failed[:5]) + (f" and {len(self.failed) - 5} more" if len(self.failed) > 5 else "")
            raise InvalidInputError(f"{len(self.failed)} of {self._count} failed, see above: {named}; {done}")
