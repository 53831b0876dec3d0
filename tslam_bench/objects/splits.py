"""The test split: the 50 distinct objects of ContactDB, their aliases, what is left out and why.

ContactDB: S. Brahmbhatt, C. Ham, C. C. Kemp and J. Hays, "ContactDB: Analyzing and predicting grasp contact via thermal
imaging", CVPR 2019.
"""

from __future__ import annotations

from dataclasses import dataclass


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
