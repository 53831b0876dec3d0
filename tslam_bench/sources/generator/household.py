"""All household categories of the generator, in their order.

One function per category draws its proportions from a seeded generator. Sizes inside a function are relative; the generator
scales the result. Walls stay above about 3 % of the longest edge, so that collision hulls can follow them.
"""

from __future__ import annotations

from tslam_bench.sources.generator import (  # noqa: F401  (each registers its categories)
    figures,
    hardware,
    held_out,
    kitchen,
    tools,
    toys,
    vessels,
)
from tslam_bench.sources.generator.categories import REGISTERED, Category

__all__ = ["CATEGORIES", "Category"]

_ORDER = (
    "bottle",
    "vase",
    "bowl",
    "tumbler",
    "goblet",
    "mug",
    "pitcher",
    "frying-pan",
    "cooking-pot",
    "teapot",
    "plate",
    "jar",
    "candlestick",
    "mallet",
    "screwdriver",
    "spoon",
    "wrench",
    "paint-brush",
    "key",
    "comb",
    "carton",
    "remote-control",
    "toaster",
    "book",
    "bangle",
    "picture-frame",
    "padlock",
    "spectacles",
    "stool",
    "chair",
    "table-lamp",
    "dumbbell",
    "quadruped",
    "toy-car",
    "chess-piece",
    "doughnut-stack",
    "bucket",
    "mushroom",
    "rocket",
    "cogwheel",
    "trophy",
    "bench",
    "hourglass",
    "anchor",
    "tobacco-pipe",
    "slingshot",
    "fork",
    "funnel",
    "whisk",
    "tongs",
    "corkscrew",
    "cake-stand",
    "muffin-tin",
    "soap-dish",
    "clothes-iron",
    "hair-dryer",
    "spray-bottle",
    "watering-can",
    "colander",
    "table",
    "shelf",
    "ladder",
    "crate",
    "clothes-hanger",
    "faucet",
    "shower-head",
    "pipe-fitting",
    "bolt",
    "spool",
    "tape-dispenser",
    "magnifying-glass",
    "kettlebell",
    "mug-tree",
    "cactus",
    "toy-boat",
    "peg-doll",
    "fish",
)
# The order in which categories are taken: which objects a split holds, and which the quick run takes, follows from it.

CATEGORIES: dict[str, Category] = {name: REGISTERED[name] for name in _ORDER}
"""All categories by name, in their order."""
if len(CATEGORIES) != len(REGISTERED):
    raise AssertionError(f"categories without a place in the order: {sorted(REGISTERED.keys() - CATEGORIES.keys())}")
