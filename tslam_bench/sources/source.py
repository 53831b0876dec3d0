"""What a source of objects is: a promise of a mesh, and the mesh that :mod:`tslam_bench.preparation` makes an object of."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from tslam_bench.geometry.meshes import TriangleMesh


@dataclass(frozen=True)
class SourceMesh:
    """A mesh as its source gives it, in metres, in its canonical orientation.

    Attributes:
        name, split, category, aliases: identifiers.
        mesh: the triangles, not necessarily watertight.
        source: where it comes from, for people.
        license: its licence text.
        sha256: hash of the source file (or of the mesh, where there is no file).
        details: further facts for the record (creator, scale, seed).
    """

    name: str
    split: str
    category: str
    mesh: TriangleMesh
    source: str
    license: str
    sha256: str
    aliases: tuple[str, ...] = ()
    details: dict[str, Any] = field(default_factory=dict)


class Source(Protocol):
    """What can be prepared: a picklable promise of a source mesh."""

    @property
    def name(self) -> str:
        """Name of the object."""

    @property
    def split(self) -> str:
        """Split of the object."""

    def fingerprint(self) -> str:
        """A string that changes whenever :meth:`load` would return something else."""

    def load(self, cache: Path) -> SourceMesh:
        """Reads or makes the mesh. Raises AssetError."""
