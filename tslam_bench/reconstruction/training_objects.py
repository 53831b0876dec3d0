"""Prepared objects of a split as something to learn from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.objects.splits import check_split, resolve_name
from tslam_bench.objects.store import PreparedObject, list_objects, load_object
from tslam_bench.reconstruction.training_shapes import TrainingShape, training_shape

_SHAPE_STREAM = 3  # keeps the samples of the shapes apart from other uses of the seed


def training_names(
    split: str, count: int | None = None, objects: Sequence[str] = (), cache: Path | None = None
) -> list[str]:
    """Names of the objects to learn from, sorted: ``objects``, or the first ``count`` prepared ones, or all prepared ones.

    Raises:
        InvalidInputError: the test split, an unknown split or object, both ``count`` and ``objects``, or fewer prepared
            objects than ``count``.
        AssetError: none is prepared.
    """
    if check_split(split, cache) == "test":
        raise InvalidInputError("split 'test': its objects are only for testing; learn from train or val")
    if count is not None and objects:
        raise InvalidInputError("count and objects: give one of them")
    if count is not None and count < 1:
        raise InvalidInputError(f"count {count}: choose at least 1")
    names = [str(record["name"]) for record in list_objects(split, cache)]
    command = f"`tslam-bench assets prepare --split {split}`"
    if not names:
        raise AssetError(f"split {split!r}: no object is prepared; run {command}")
    if count is not None and count > len(names):
        raise InvalidInputError(
            f"count {count}: split {split!r} has {len(names)} prepared objects; run {command} for more"
        )
    if objects:
        return sorted({resolve_name(name, split, cache) for name in objects})
    return names[:count]


def load_training_objects(split: str, cache: Path | None = None, objects: Sequence[str] = ()) -> list[PreparedObject]:
    """``objects`` of a split to learn from, or all prepared ones. Raises as :func:`training_names`."""
    return [load_object(name, split, cache) for name in training_names(split, objects=objects, cache=cache)]


def load_training_shapes(
    names: Sequence[str],
    split: str,
    seed: int = 0,
    cache: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[TrainingShape]:
    """Prepared objects with their sampled and labelled points.

    Args:
        names: objects, see :func:`training_names`.
        split, cache: where they are.
        seed: seed of the samples; each object's also depend on its place in the list.
        progress: called with the objects done and their number.
    """
    shapes = []
    for index, name in enumerate(names):
        item = load_object(name, split, cache)
        generator = np.random.Generator(np.random.PCG64([seed, _SHAPE_STREAM, index]))
        shapes.append(training_shape(name, item.vertices, item.faces, generator))
        if progress:
            progress(index + 1, len(names))
    return shapes
