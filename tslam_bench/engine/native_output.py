"""What native libraries print: PhysX reports overflowing GPU buffers to the log and goes on with contacts missing."""

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

OVERFLOW: Final = re.compile(r"overflow|PxGpuDynamicsMemoryConfig|increase (the )?(capacity|its|to)", re.IGNORECASE)
"""PhysX's complaints: 'Contact buffer overflow detected, please increase its size to at least ...' and the like."""


class NativeOutput:
    """Text that was written to file descriptors 1 and 2; complete once :func:`captured_output` has ended."""

    def __init__(self) -> None:
        self.text = ""

    def overflows(self) -> list[str]:
        """Lines in which PhysX says that a GPU buffer was too small."""
        return [line.strip() for line in self.text.splitlines() if OVERFLOW.search(line)]


@contextmanager
def captured_output() -> Iterator[NativeOutput]:
    """Keeps what is written to standard output and error, by C++ too; it is passed on at the end."""
    output = NativeOutput()
    sys.stdout.flush()
    sys.stderr.flush()
    kept = os.dup(1), os.dup(2)
    with tempfile.TemporaryFile() as file:
        try:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
            yield output
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os.dup2(kept[0], 1)
            os.dup2(kept[1], 2)
            for descriptor in kept:
                os.close(descriptor)
            file.seek(0)
            output.text = file.read().decode(errors="replace")
            if output.text:
                sys.stderr.write(output.text)
