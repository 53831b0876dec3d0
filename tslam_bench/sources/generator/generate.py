"""Draws household shapes from seeds: the training objects that need no download (protocol section 8).

Every shape passes a gate before anything is built from it: a clean manifold, one component, the genus its category means it to
have. The same split, category and index give the same shape everywhere.
"""

from __future__ import annotations

import hashlib
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.geometry.meshes import TriangleMesh, from_manifold, is_valid, simplify
from tslam_bench.sources.generator.household import CATEGORIES
from tslam_bench.sources.source import SourceMesh

GENERATOR_VERSION = 1
"""Bumped when the same seed gives another shape."""
GENERATOR_SEED = 20211108
MAX_TRIANGLES = 8_000
"""Triangles of a generated mesh."""
ATTEMPTS = 30
"""Draws until one passes the gate."""


def _generator(category: str, index: int, attempt: int, seed: int) -> np.random.Generator:
    """The random stream of one draw."""
    key = [seed, zlib.crc32(category.encode()), index, attempt]
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(key)))


def draw(category: str, index: int, seed: int = GENERATOR_SEED) -> tuple[TriangleMesh, dict[str, Any]]:
    """Draws shape number ``index`` of a category.

    Args:
        seed: not negative, of any size; another one gives other shapes.

    Returns:
        the mesh (m, z up, centred on its bounding box; longest edge in the category's range) and the facts of the draw.

    Raises:
        InvalidInputError: unknown category.
        AssetError: no draw passes the gate.
    """
    if category not in CATEGORIES:
        raise InvalidInputError(f"category {category!r}: unknown; choose one of {', '.join(sorted(CATEGORIES))}")
    kind = CATEGORIES[category]
    reason = "nothing drawn"
    for attempt in range(ATTEMPTS):
        generator = _generator(category, index, attempt, seed)
        solid, genus = kind.make(generator)
        size = float(generator.uniform(*kind.size))
        if not is_valid(solid):
            reason = f"not a solid ({solid.status().name})"
            continue
        mesh = from_manifold(solid)
        scale = size / float(mesh.extents.max())
        low, high = mesh.bounds
        solid = simplify(solid.translate(-(low + high) / 2).scale([scale] * 3), MAX_TRIANGLES)
        if len(solid.decompose()) != 1:
            reason = f"{len(solid.decompose())} components"
        elif solid.genus() != genus:
            reason = f"genus {solid.genus()}, meant to be {genus}"
        else:
            details = {"index": index, "attempt": attempt, "genus": genus, "longest_edge_m": size}
            return from_manifold(solid), details
    raise AssetError(f"{category} {index}: no draw of {ATTEMPTS} passes the gate (last: {reason})")


@dataclass(frozen=True)
class GeneratedSource:
    """A generated object: the ``index``-th of its category."""

    split: str
    category: str
    index: int

    @property
    def name(self) -> str:
        """Name of the object: category and index."""
        return f"{self.category}-{self.index:03d}"

    def fingerprint(self) -> str:
        """See :class:`tslam_bench.sources.source.Source`."""
        return f"generated:{GENERATOR_VERSION}:{GENERATOR_SEED}:{self.name}"

    def load(self, cache: Path) -> SourceMesh:
        """See :class:`tslam_bench.sources.source.Source`."""
        mesh, details = draw(self.category, self.index)
        return SourceMesh(
            name=self.name,
            split=self.split,
            category=self.category,
            mesh=mesh,
            source=f"generated (generator version {GENERATOR_VERSION}, seed {GENERATOR_SEED})",
            license="Apache-2.0",
            sha256=mesh_sha256(mesh),
            details=details,
        )


def mesh_sha256(mesh: TriangleMesh) -> str:
    """Hash of a mesh that no file holds."""
    return hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes()).hexdigest()


def candidates(split: str, start: int = 0, rounds: int = 1_000) -> list[GeneratedSource]:
    """Objects of a split in the order in which they are prepared: one of each category, then the next of each.

    Raises:
        InvalidInputError: the split has no generated categories.
    """
    categories = [kind.name for kind in CATEGORIES.values() if kind.split == split]
    if not categories:
        raise InvalidInputError(f"split {split!r}: has no generated objects; choose train or val")
    return [GeneratedSource(split, category, index) for index in range(start, rounds) for category in categories]
