"""The number of torch threads of a block."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch

from tslam_bench.errors import InvalidInputError


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Runs a block with ``count`` torch threads and restores the number afterwards."""
    if count < 1:
        raise InvalidInputError(f"threads {count}: choose at least 1")
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
