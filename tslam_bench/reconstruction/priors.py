"""What the training shapes alone tell: ``mean_shape``, which ignores touch, and ``retrieval``, which picks one of them.

They bound from below what completing a shape by learning should bring.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from tslam_bench.constants import OCCUPANCY_THRESHOLD
from tslam_bench.errors import InvalidInputError
from tslam_bench.grids import turn
from tslam_bench.reconstruction.inputs import GRID_SHAPE, check_grids, empty_volume
from tslam_bench.reconstruction.training_objects import load_training_objects
from tslam_bench.reconstruction.training_shapes import axis_rotations
from tslam_bench.reconstruction.volume import Volume

FAR_VOXELS: Final = 3.0
"""A touched voxel at least this far (voxel edges) from a shape's surface speaks against it with full weight."""
FREE_WEIGHT: Final = 0.5
"""Weight of free space against touch, chosen on rollouts of val objects."""


def _check_shapes(name: str, grids: NDArray[np.bool_]) -> NDArray[np.bool_]:
    grids = np.asarray(grids, dtype=bool)
    if grids.ndim != 4 or len(grids) == 0 or grids.shape[1:] != GRID_SHAPE:
        raise InvalidInputError(f"training {name}: shape {grids.shape}; give at least one (32, 32, 32) grid, stacked")
    return grids


class MeanShapeReconstructor:
    """The mean of the training solids, whatever was touched; also when nothing was.

    A voxel's occupancy is its share of solid training shapes in their canonical orientation. The share at which the
    volume has the best mean IoU with the training solids is mapped to 0.5 (piecewise linear), since few voxels are solid
    in half of all shapes.

    Args:
        solids: (S, 32, 32, 32) bool, the training objects' solid voxels.

    Raises:
        InvalidInputError: no grid, or another shape.
    """

    name = "mean_shape"

    def __init__(self, solids: NDArray[np.bool_]) -> None:
        solids = _check_shapes("solids", solids)
        share = solids.mean(axis=0)
        levels = np.unique(share[share > 0])
        if len(levels) == 0:
            self._volume = empty_volume()
            return
        scores = []
        for level in levels:
            solid = share >= level
            either = np.maximum((solids | solid).sum(axis=(1, 2, 3)), 1)
            scores.append(np.mean((solids & solid).sum(axis=(1, 2, 3)) / either))
        level = float(levels[int(np.argmax(scores))])
        probability = np.interp(share, [0.0, level, max(1.0, level + 1e-9)], [0.0, OCCUPANCY_THRESHOLD, 1.0])
        self._volume = Volume(probability, "linear")

    def reconstruct(self, touched: NDArray[np.bool_], visited: NDArray[np.bool_]) -> Volume:
        """Touched and visited grids (32, 32, 32) bool, object frame -> the same 32^3 volume every time."""
        check_grids(touched, visited)
        return self._volume


class RetrievalReconstructor:
    """The training shape, in one of the 24 rotations that map axes to axes, that agrees best with touch and free space.

    The disagreement is the mean over touched voxels of their distance to the shape's surface voxels, in units of
    :data:`FAR_VOXELS` and at most 1, plus :data:`FREE_WEIGHT` times the share of the shape's solid that is known to be
    free (visited, not touched). Nothing touched: empty, since nothing was felt that could be looked up.

    Args:
        solids: (S, 32, 32, 32) bool, the training objects' solid voxels.
        surfaces: (S, 32, 32, 32) bool, the voxels that their surfaces cross.

    Raises:
        InvalidInputError: no grid, other shapes, or not as many surfaces as solids.
    """

    name = "retrieval"

    def __init__(self, solids: NDArray[np.bool_], surfaces: NDArray[np.bool_]) -> None:
        self._solids = _check_shapes("solids", solids)
        surfaces = _check_shapes("surfaces", surfaces)
        if len(surfaces) != len(self._solids):
            raise InvalidInputError(f"training surfaces: {len(surfaces)} for {len(self._solids)} solids; give one each")
        distances = [distance_transform_edt(~surface) for surface in surfaces]
        self._surface_cost = (np.minimum(np.stack(distances), FAR_VOXELS) / FAR_VOXELS).astype(np.float32)
        sizes = np.maximum(self._solids.sum(axis=(1, 2, 3)), 1)
        self._solid_cost = (FREE_WEIGHT * self._solids / sizes[:, None, None, None]).astype(np.float32)

    def best_match(
        self, touched: NDArray[np.bool_], visited: NDArray[np.bool_]
    ) -> tuple[int, NDArray[np.int64], float]:
        """Index of the best training object, its rotation (3, 3) into the object frame, and its disagreement.

        Equal disagreements go to the earlier object, then to the earlier rotation.
        """
        rotations = axis_rotations()
        free = visited & ~touched
        # The input is turned back into each shape's frame, which is cheaper than turning every shape.
        touched_turned = np.stack([turn(touched, rotation.T).reshape(-1) for rotation in rotations])
        free_turned = np.stack([turn(free, rotation.T).reshape(-1) for rotation in rotations])
        count = len(self._solids)
        cost = self._surface_cost.reshape(count, -1) @ touched_turned.T.astype(np.float32) / touched.sum()
        cost += self._solid_cost.reshape(count, -1) @ free_turned.T.astype(np.float32)
        shape, rotation = np.unravel_index(int(cost.argmin()), cost.shape)
        return int(shape), rotations[rotation], float(cost[shape, rotation])

    def reconstruct(self, touched: NDArray[np.bool_], visited: NDArray[np.bool_]) -> Volume:
        """Touched and visited grids (32, 32, 32) bool, object frame -> 32^3 volume with linear interpolation."""
        touched, visited = check_grids(touched, visited)
        if not touched.any():
            return empty_volume()
        shape, rotation, _ = self.best_match(touched, visited)
        return Volume(turn(self._solids[shape], rotation).astype(np.float32), "linear")


def load_mean_shape(split: str, cache: Path | None, objects: Sequence[str]) -> MeanShapeReconstructor:
    """Built from prepared objects: see :func:`tslam_bench.reconstruction.training_objects.load_training_objects`."""
    return MeanShapeReconstructor(np.stack([item.solid for item in load_training_objects(split, cache, objects)]))


def load_retrieval(split: str, cache: Path | None, objects: Sequence[str]) -> RetrievalReconstructor:
    """Built from prepared objects: see :func:`tslam_bench.reconstruction.training_objects.load_training_objects`."""
    shapes = load_training_objects(split, cache, objects)
    return RetrievalReconstructor(
        np.stack([item.solid for item in shapes]), np.stack([item.surface for item in shapes])
    )
