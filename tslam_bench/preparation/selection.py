"""Which objects of the benchmark's own splits are to be prepared: the default sets, those of the quick run, parts of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from tslam_bench.constants import QUICK_OBJECTS, QUICK_TRAIN_OBJECTS, QUICK_VAL_OBJECTS
from tslam_bench.errors import InvalidInputError
from tslam_bench.objects import splits
from tslam_bench.preparation.decompose import settings_for
from tslam_bench.sources import sweethome3d
from tslam_bench.sources.contactdb import ContactDBSource
from tslam_bench.sources.generator import generate
from tslam_bench.sources.source import Source

Kind = Literal["all", "furniture", "generated"]
"""Real household models, generated shapes, or both."""
QUICK = {"test": QUICK_OBJECTS, "train": QUICK_TRAIN_OBJECTS, "val": QUICK_VAL_OBJECTS}
"""Objects of the quick set-up."""
FULL_GENERATED = {"train": 600, "val": 60}
"""Objects of a set that is generated only."""
FURNITURE_PER_CATEGORY = 15
"""Real models that one category gives the default set, so that chairs and tables do not fill it."""
ADDED_ROUNDS = {"train": 5, "val": 5}
"""Generated objects per category that the default set has beside the real ones."""


@dataclass(frozen=True)
class Selection:
    """Sources in the order in which they are prepared, and how many of them are wanted (None: all)."""

    sources: Sequence[Source]
    count: int | None = None


def select_test(names: Sequence[str], quick: bool) -> Selection:
    """The test objects ``names`` (or aliases), else those of the quick run or all.

    Raises:
        InvalidInputError: an unknown name.
    """
    names = names or (QUICK["test"] if quick else tuple(splits.OBJECTS))
    resolved = dict.fromkeys(splits.resolve_name(name, "test") for name in names)
    # Those that take longest go first, so that no worker is left alone with one in the end.
    longest_first = sorted(resolved, key=lambda name: -settings_for("test", name).max_hulls)
    return Selection([ContactDBSource(name) for name in longest_first])


def select_training(
    split: str, names: Sequence[str], quick: bool, kind: Kind, count: int | None, cache: Path
) -> Selection:
    """Objects of train or val: those named, else the first ``count``, those of the quick run, or the default set.

    Raises:
        InvalidInputError: an unknown name.
        AssetError: the real models cannot be fetched.
    """
    if quick and not names and count is None:
        names = QUICK[split]
    generated: list[Source] = []
    real: list[Source] = []
    only_generated = quick or kind == "generated"
    if kind != "furniture":
        rounds = 200 if only_generated or names else ADDED_ROUNDS[split]
        generated = [*generate.candidates(split, rounds=rounds)]
    # Named objects that are all generated need nothing fetched.
    if not only_generated and not (names and set(names) <= {source.name for source in generated}):
        limit = FURNITURE_PER_CATEGORY if kind == "all" and not names else None
        real = [*sweethome3d.furniture(split, cache, limit)]
    if names:
        by_name = {source.name: source for source in [*generated, *real]}
        unknown = [name for name in names if name not in by_name]
        if unknown:
            raise InvalidInputError(f"object {unknown[0]!r}: not in split {split} (source: {kind})")
        return Selection([by_name[name] for name in names])
    selection = Selection([*real, *generated], count)
    if kind == "generated" and not quick:
        return replace(selection, count=count or FULL_GENERATED[split])
    return selection
