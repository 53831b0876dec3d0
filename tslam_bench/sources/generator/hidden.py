"""Objects of an organiser's hidden split: the generator's kinds of things, drawn from a secret."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from tslam_bench.errors import InvalidInputError
from tslam_bench.sources.generator.generate import GENERATOR_VERSION, draw, mesh_sha256
from tslam_bench.sources.generator.household import CATEGORIES
from tslam_bench.sources.source import SourceMesh

LEAST_SECRET: Final = 12
"""Characters of a secret: a shorter one could be tried out against the commitment."""


@dataclass(frozen=True)
class HiddenSource:
    """A generated object whose name does not say what it is.

    Attributes:
        secret_sha256: hash of the secret that it is drawn from.
    """

    split: str
    number: int
    category: str
    secret_sha256: str

    @property
    def name(self) -> str:
        """Its number."""
        return hidden_name(self.number)

    def fingerprint(self) -> str:
        """See :class:`tslam_bench.sources.source.Source`."""
        return f"hidden:{GENERATOR_VERSION}:{self.secret_sha256}:{self.category}:{self.number}"

    def load(self, cache: Path) -> SourceMesh:
        """See :class:`tslam_bench.sources.source.Source`."""
        mesh, details = draw(self.category, self.number, int(self.secret_sha256, 16))
        return SourceMesh(
            name=self.name,
            split=self.split,
            category=self.category,
            mesh=mesh,
            source=f"generated (generator version {GENERATOR_VERSION}, a secret seed)",
            license="Apache-2.0",
            sha256=mesh_sha256(mesh),
            details={"number": self.number, **details},
        )


def hidden_name(number: int) -> str:
    """Name of the object with a number."""
    return f"h{number:03d}"


def secret_sha256(secret: str) -> str:
    """Hash of a secret. Raises InvalidInputError if it is too short to be one."""
    if len(secret) < LEAST_SECRET:
        raise InvalidInputError(
            f"--seed: at least {LEAST_SECRET} characters, or it could be guessed; leave it out to draw one"
        )
    return hashlib.sha256(secret.encode()).hexdigest()


def hidden_sources(split: str, secret: str, most: int, categories: Sequence[str] = ()) -> list[HiddenSource]:
    """The first ``most`` objects of a secret, in the order in which they are prepared.

    Args:
        categories: kinds of things; empty: all, those of train and val.

    Raises:
        InvalidInputError: the secret is too short, or a category is unknown.
    """
    known = sorted(CATEGORIES)
    for name in categories:
        if name not in CATEGORIES:
            raise InvalidInputError(f"category {name!r}: unknown; choose one of {', '.join(known)}")
    digest = secret_sha256(secret)
    chosen = sorted(set(categories)) or known
    generator = np.random.default_rng(int(digest, 16))
    order: list[str] = []
    while len(order) < most:
        order += [chosen[index] for index in generator.permutation(len(chosen))]
    return [HiddenSource(split, number, category, digest) for number, category in enumerate(order[:most])]
