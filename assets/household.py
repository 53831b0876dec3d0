"""All household categories of the generator.

One function per category draws its proportions from a seeded generator. Sizes inside a function are relative; the generator
scales the result. Walls stay above about 3 % of the longest edge, so that collision hulls can follow them.
"""

from __future__ import annotations

import importlib

from tslam_bench.assets.categories import CATEGORIES, Category

__all__ = ["CATEGORIES", "Category"]

# In this order, which is the order in which categories are taken: the quick run takes the first of them.
for _module in ("vessels", "tools", "toys", "held_out", "kitchen", "hardware", "figures"):
    importlib.import_module(f"tslam_bench.assets.household_{_module}")
