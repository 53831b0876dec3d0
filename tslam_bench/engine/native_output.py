"""What native libraries print: PhysX reports overflowing GPU buffers and worse to the log alone, and goes on."""

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

COMPLAINT: Final = re.compile(
    r"overflow|PxGpuDynamicsMemoryConfig|increase (the )?(capacity|its|to)|fail(ed)? to launch|error (code )?700\b|illegal memory"
    r"|mem free failed|out of memory|oblong",
    re.IGNORECASE,
)
"""What PhysX, SAPIEN and CUDA print when results can no longer be trusted: 'Contact buffer overflow detected, please increase its
size to at least ...', kernels that did not launch, memory errors, hulls whose contacts a GPU misses."""


class NativeOutput:
    """Text that was written to file descriptors 1 and 2; complete once :func:`captured_output` has ended."""

    def __init__(self) -> None:
        self.text = ""

    def complaints(self) -> list[str]:
        """Lines that say that the simulation cannot be trusted."""
        return [line.strip() for line in self.text.splitlines() if COMPLAINT.search(line)]


@contextmanager
def captured_output(echo: bool = True) -> Iterator[NativeOutput]:
    """Keeps what is written to standard output and error, by C++ too; with ``echo`` it is passed on at the end."""
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
            if output.text and echo:
                sys.stderr.write(output.text)
