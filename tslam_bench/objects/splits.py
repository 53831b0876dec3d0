"""Splits and the names of their objects. The test split is a table: the 50 distinct objects of ContactDB.

ContactDB: S. Brahmbhatt, C. Ham, C. C. Kemp and J. Hays, "ContactDB: Analyzing and predicting grasp contact via thermal
imaging", CVPR 2019.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass
from pathlib import Path

from tslam_bench.constants import QUICK_OBJECTS
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import cache_directory

SPLITS = ("test", "train", "val")
"""The benchmark's own splits; an organiser may add others."""
SPLIT_ALIASES = {"contactdb50": "test"}


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


def object_set(name: str, cache: Path | None = None) -> tuple[str, ...]:
    """Objects of a ranking: the five of the quick run (``quick``), or all of a split (``test``, an organiser's own)."""
    return QUICK_OBJECTS if name == "quick" else tuple(known_names(name, cache))


def check_split(split: str, cache: Path | None = None) -> str:
    """Canonical name of a split. Raises InvalidInputError unless it is ours or prepared in the cache."""
    resolved = SPLIT_ALIASES.get(split, split)
    root = (cache or cache_directory()) / "objects"
    if resolved in SPLITS or (re.fullmatch(r"[A-Za-z0-9_-]+", resolved) and (root / resolved).is_dir()):
        return resolved
    known = sorted({*SPLITS, *SPLIT_ALIASES})
    raise InvalidInputError(f"split {split!r}: unknown{_suggest(split, known)}; choose one of {', '.join(known)}")


def split_directory(split: str, cache: Path | None = None) -> Path:
    """Directory of a split's objects (may not exist)."""
    return (cache or cache_directory()) / "objects" / split


def prepared_names(split: str, cache: Path | None = None) -> list[str]:
    """Names of the objects that a split's directory holds, sorted."""
    directory = split_directory(split, cache)
    if not directory.is_dir():
        return []
    return sorted(path.parent.name for path in directory.glob("[!.]*/record.json"))


def known_names(split: str, cache: Path | None = None) -> list[str]:
    """Names (without aliases) of a split: the definition's for ``test``, what is prepared for the others; sorted."""
    return sorted(OBJECTS) if split == "test" else prepared_names(split, cache)


def _suggest(name: str, known: list[str]) -> str:
    """ " (did you mean ...?)" when there are near matches."""
    near = difflib.get_close_matches(name.lower(), known, n=3, cutoff=0.5)
    return f" (did you mean {' or '.join(near)}?)" if near else ""


def resolve_name(name: str, split: str = "test", cache: Path | None = None) -> str:
    """The object that ``name``, which may be an alias, stands for in a canonical split.

    Raises:
        InvalidInputError: there is no such object; the message lists near matches.
    """
    if split == "test":
        if name in ALIASES:
            return ALIASES[name]
        if name in EXCLUDED:
            raise InvalidInputError(f"object {name!r}: left out of split test: {EXCLUDED[name]}")
    known = known_names(split, cache)
    if name in known:
        return name
    if not known:
        raise AssetError(
            f"object {name!r}: split {split} is not prepared; run: tslam-bench assets prepare --split {split}"
        )
    candidates = [*known, *ALIASES] if split == "test" else known
    raise InvalidInputError(
        f"object {name!r}: unknown in split {split}{_suggest(name, candidates)}; "
        f"see: tslam-bench assets list --split {split}"
    )


def find_split(name: str, cache: Path | None = None) -> str:
    """The benchmark's split that has an object of this name (or alias): test, train or val.

    Raises:
        InvalidInputError: none has; the message lists near matches.
    """
    for split in SPLITS:
        if name in known_names(split, cache) or (split == "test" and name in ALIASES):
            return split
    if name in EXCLUDED:
        return "test"  # whoever loads it learns why it is left out
    candidates = [known for split in SPLITS for known in known_names(split, cache)]
    raise InvalidInputError(
        f"object {name!r}: unknown in the splits {', '.join(SPLITS)}{_suggest(name, [*candidates, *ALIASES])}; "
        "see: tslam-bench assets list --split SPLIT"
    )
