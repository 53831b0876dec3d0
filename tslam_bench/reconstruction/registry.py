"""The registered reconstructors (protocol section 9), and the two priors that serve as floors (section 11)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from tslam_bench.errors import InvalidInputError
from tslam_bench.reconstruction.volume import Reconstructor


@dataclass(frozen=True)
class ReconstructorInfo:
    """One registered reconstructor.

    Attributes:
        id: name in commands and submissions.
        needs: ``nothing``, a trained ``model``, or prepared training ``objects``.
        empty: what it returns when nothing was touched.
        summary: one line.
    """

    id: str
    needs: str
    empty: str
    summary: str


_REGISTERED: Final = (
    ReconstructorInfo("grid", "nothing", "empty", "the touched voxels as they are"),
    ReconstructorInfo("hull", "nothing", "empty", "convex hull of the touched voxel centres"),
    ReconstructorInfo("carve", "nothing", "empty", "the hull without the free space that was swept"),
    ReconstructorInfo("ifnet", "model", "empty", "IF-Net: implicit function in multi-scale features, with free space"),
    ReconstructorInfo(
        "convonet", "model", "empty", "convolutional occupancy network: a U-Net's features, with free space"
    ),
    ReconstructorInfo("mean_shape", "objects", "the mean shape", "mean of the training solids, whatever was touched"),
    ReconstructorInfo(
        "retrieval", "objects", "empty", "training shape, in 24 rotations, that agrees best with the grids"
    ),
)


def list_reconstructors() -> tuple[ReconstructorInfo, ...]:
    """All registered reconstructors, in the order of the documentation."""
    return _REGISTERED


def get_reconstructor(name: str) -> ReconstructorInfo:
    """The registered reconstructor ``name``. Raises InvalidInputError listing the known ones if there is none."""
    for info in _REGISTERED:
        if info.id == name:
            return info
    known = ", ".join(info.id for info in _REGISTERED)
    raise InvalidInputError(f"reconstructor {name!r}: unknown; choose one of {known}")


def make_reconstructor(
    name: str,
    model: Path | None = None,
    split: str = "train",
    cache: Path | None = None,
    threads: int = 1,
    objects: Sequence[str] = (),
) -> Reconstructor:
    """A reconstructor by its id.

    Args:
        name: id, see :func:`list_reconstructors`.
        model: checkpoint, for those that need a model.
        split: split whose prepared objects ``mean_shape`` and ``retrieval`` are built from.
        cache: asset cache, default the user's.
        threads: torch threads of the learned ones.
        objects: build from these objects of the split; empty: all that are prepared.

    Raises:
        InvalidInputError: unknown name; a model missing, unreadable, of another architecture, or given in vain; the test
            split.
        AssetError: no prepared object in the split, or a corrupt one.
    """
    info = get_reconstructor(name)
    if info.needs == "model" and model is None:
        raise InvalidInputError(
            f"reconstructor {name!r}: needs a model; train one with "
            f"`tslam-bench reconstruct train --architecture {name} --output FILE`"
        )
    if info.needs != "model" and model is not None:
        raise InvalidInputError(f"reconstructor {name!r}: takes no model; leave {model} out")
    if name == "grid":
        from tslam_bench.reconstruction.grid import GridReconstructor

        return GridReconstructor()
    if name == "hull":
        from tslam_bench.reconstruction.hull import HullReconstructor

        return HullReconstructor()
    if name == "carve":
        from tslam_bench.reconstruction.carve import CarveReconstructor

        return CarveReconstructor()
    if info.needs == "objects":
        from tslam_bench.reconstruction.priors import MeanShapeReconstructor, RetrievalReconstructor
        from tslam_bench.reconstruction.training_objects import load_training_objects

        shapes = load_training_objects(split, cache, objects)
        solids = np.stack([item.solid for item in shapes])
        if name == "mean_shape":
            return MeanShapeReconstructor(solids)
        return RetrievalReconstructor(solids, np.stack([item.surface for item in shapes]))
    from tslam_bench.reconstruction.learned import load_reconstructor

    assert model is not None
    return load_reconstructor(model, name, threads)
