"""An occupancy probability over the workspace: what every reconstructor returns (protocol section 9).

numpy, numba and trimesh only, so that scoring can read it without torch or a simulator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, Protocol, get_args

import numpy as np
import trimesh
from numpy.typing import NDArray

from tslam_bench.constants import OCCUPANCY_THRESHOLD, WORKSPACE_EDGE, WORKSPACE_LOW
from tslam_bench.errors import InvalidInputError

MAX_TRIANGLES: Final = 8_000_000
"""Largest surface that is made: at most 1.5 GB on the way. A smooth one in a volume of 256^3 has a quarter of this, pure noise
in one of 64^3 three quarters."""
Interpolation = Literal["nearest", "linear"]


@dataclass(frozen=True, eq=False)
class Volume:
    """Occupancy probability over W, sampled at the centres of R^3 equal cells, in the object frame.

    Attributes:
        probability: (R, R, R) float32 in [0, 1], index ``[ix, iy, iz]``; converted to float32 if it is not.
        interpolation: how the samples extend over W. ``"nearest"``: constant in each cell. ``"linear"``: linear on
            the 24 tetrahedra of each cell between centres (:mod:`tslam_bench.geometry.isosurface`), constant from the
            outermost centres to the faces of W.

    Raises:
        InvalidInputError: the array is not cubic, holds values that are not finite or outside [0, 1], or the
            interpolation is unknown.
    """

    probability: NDArray
    interpolation: Interpolation = "linear"

    def __post_init__(self) -> None:
        probability = np.ascontiguousarray(self.probability, dtype=np.float32)
        if probability.ndim != 3 or len(set(probability.shape)) != 1 or probability.shape[0] < 1:
            raise InvalidInputError(f"volume: probability has shape {probability.shape}; it must be (R, R, R)")
        # One comparison finds NaN too: it is neither >= 0 nor <= 1.
        if not ((probability >= 0) & (probability <= 1)).all():
            raise InvalidInputError("volume: probability holds values that are NaN or outside [0, 1]; clip them first")
        if self.interpolation not in get_args(Interpolation):
            raise InvalidInputError(f"volume: interpolation {self.interpolation!r}; choose 'nearest' or 'linear'")
        object.__setattr__(self, "probability", probability)

    @property
    def resolution(self) -> int:
        """Cells per axis, R."""
        return int(self.probability.shape[0])

    @property
    def cell_edge(self) -> float:
        """Edge of one cell (m)."""
        return WORKSPACE_EDGE / self.resolution

    def query(self, points: NDArray) -> NDArray[np.float32]:
        """Occupancy probability at ``points`` (M, 3) in metres: (M,) float32, 0 outside W = [low, high)^3."""
        points = np.asarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InvalidInputError(f"points: shape {points.shape}, expected (M, 3) in metres")
        cells = (points - WORKSPACE_LOW) / self.cell_edge
        if self.interpolation == "nearest":
            index = np.clip(np.floor(cells).astype(np.int64), 0, self.resolution - 1)
            result = self.probability[index[:, 0], index[:, 1], index[:, 2]]
        else:
            from tslam_bench.geometry.isosurface import interpolate

            result = interpolate(self.probability, cells - 0.5)
        inside = ((cells >= 0) & (cells < self.resolution)).all(axis=1)
        return result if inside.all() else np.where(inside, result, np.float32(0))

    def triangles(self, threshold: float = OCCUPANCY_THRESHOLD) -> NDArray[np.float64]:
        """The triangles of :meth:`to_mesh`, by their corners: (T, 3, 3) metres, object frame.

        Raises:
            InvalidInputError: there are more than ``MAX_TRIANGLES``.
        """
        triangles = self._surface(threshold, MAX_TRIANGLES)[0]
        triangles *= self.cell_edge
        triangles += WORKSPACE_LOW
        return triangles

    def to_mesh(self, threshold: float = OCCUPANCY_THRESHOLD, most: int = MAX_TRIANGLES) -> trimesh.Trimesh:
        """Boundary of the region where :meth:`query` is at least ``threshold``: metres, object frame, faces outwards.

        Closed where the solid meets a face of W. Linear: watertight, exact to 1e-4 of a cell. Nearest: the faces of the solid
        cells, two triangles each, exact; watertight unless two solid cells share no more than an edge. Nothing solid: an
        empty mesh (0 vertices, 0 faces).

        Raises:
            InvalidInputError: it has more than ``most`` triangles.
        """
        triangles, keys = self._surface(threshold, most)
        _, first, corners = np.unique(keys, return_index=True, return_inverse=True)
        vertices = WORKSPACE_LOW + self.cell_edge * triangles.reshape(-1, 3)[first]
        return trimesh.Trimesh(vertices=vertices, faces=corners.reshape(-1, 3), process=False)

    def _surface(self, threshold: float, most: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Triangles in cells from the lower corner of W (T, 3, 3), and the keys of their corners (T, 3)."""
        if not 0 < threshold < 1:
            raise InvalidInputError(f"threshold {threshold}: must lie strictly between 0 and 1")
        try:
            if self.interpolation == "nearest":
                return _cell_faces(self.probability >= threshold, most)
            from tslam_bench.geometry.isosurface import surface

            return surface(self.probability, threshold, most)
        except ValueError as error:
            raise InvalidInputError(f"volume: {error}; smooth it or lower its resolution") from error


def _cell_faces(solid: NDArray[np.bool_], most: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Faces between solid and empty cells, two outward triangles each: corners (T, 3, 3) and their keys (T, 3).

    Raises:
        ValueError: there are more than ``most`` triangles; nothing was made then.
    """
    padded = np.pad(solid, 1)
    if 2 * sum(int(np.count_nonzero(np.diff(padded, axis=axis))) for axis in range(3)) > most:
        raise ValueError(f"the surface has more than {most:,} triangles")
    quads = [np.zeros((0, 4, 3), dtype=np.int32)]
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        for side in (0, 1):
            neighbour = np.roll(padded, 1 if side == 0 else -1, axis=axis)
            cells = np.argwhere(padded & ~neighbour).astype(np.int32) - 1
            corner = np.zeros((4, 3), dtype=np.int32)
            corner[:, axis] = side
            corner[[1, 2], first] = 1
            corner[[2, 3], second] = 1
            quads.append(cells[:, None, :] + (corner if side else corner[::-1])[None])
    corners = np.concatenate(quads)
    del quads
    corner_keys = np.ravel_multi_index(tuple(np.moveaxis(corners, -1, 0)), padded.shape)
    count = len(corners)
    triangles, keys = np.empty((2 * count, 3, 3)), np.empty((2 * count, 3), dtype=np.int64)
    for part, half in ((slice(count), [0, 1, 2]), (slice(count, None), [0, 2, 3])):
        triangles[part], keys[part] = corners[:, half], corner_keys[:, half]
    return triangles, keys


class Reconstructor(Protocol):
    """Completes a shape from what was touched (protocol section 9)."""

    name: str

    def reconstruct(self, touched: NDArray[np.bool_], visited: NDArray[np.bool_]) -> Volume:
        """Merged touched and visited grids, each (32, 32, 32) bool in the object frame -> occupancy over W."""
        ...
