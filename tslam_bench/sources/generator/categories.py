"""The kinds of household things that the generator can draw, each registered by the function that draws it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from manifold3d import Manifold

Random = np.random.Generator
MakeShape = Callable[[Random], tuple[Manifold, int]]


@dataclass(frozen=True)
class Category:
    """A kind of household thing.

    Attributes:
        name: category name.
        split: ``train`` or ``val``.
        make: draws one shape; returns it with the genus it is meant to have.
        size: range (m) of the longest edge.
    """

    name: str
    split: str
    make: MakeShape
    size: tuple[float, float]


REGISTERED: dict[str, Category] = {}
"""All categories by name; their order is that of :mod:`tslam_bench.sources.generator.household`."""


def category(split: str, low: float = 0.07, high: float = 0.2) -> Callable[[MakeShape], MakeShape]:
    """Registers a shape function under its own name; ``low`` and ``high`` (m) bound the longest edge."""

    def register(make: MakeShape) -> MakeShape:
        name = make.__name__.replace("_", "-")
        REGISTERED[name] = Category(name, split, make, (low, high))
        return make

    return register
