"""An occupancy probability over the workspace: what every reconstructor returns (protocol section 9).

numpy, scipy, scikit-image and trimesh only, so that scoring can read it without torch or a simulator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, Protocol, get_args

import numpy as np
import trimesh
from numpy.typing import NDArray

from tslam_bench.constants import OCCUPANCY_THRESHOLD, WORKSPACE_EDGE, WORKSPACE_LOW
from tslam_bench.errors import InvalidInputError

Interpolation = Literal["nearest", "linear"]

_CROSSING_MARGIN: Final = 1e-4  # marching cubes degenerates where a sample equals the level: keep this much away


@dataclass(frozen=True, eq=False)
class Volume:
    """Occupancy probability over W, sampled at the centres of R^3 equal cells, in the object frame.

    Attributes:
        probability: (R, R, R) float32 in [0, 1], index ``[ix, iy, iz]``; converted to float32 if it is not.
        interpolation: how the samples extend over W. ``"nearest"``: constant in each cell. ``"linear"``: trilinear
            between cell centres, constant from the outermost centres to the faces of W.

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
        size = self.resolution
        cells = (points - WORKSPACE_LOW) / self.cell_edge
        inside = ((cells >= 0) & (cells < size)).all(axis=1)
        result = np.zeros(len(points), dtype=np.float32)
        cells = cells[inside]
        if self.interpolation == "nearest":
            result[inside] = self.probability[tuple(np.floor(cells).astype(np.int64).T)]
            return result

        position = np.clip(cells - 0.5, 0, size - 1)
        low = np.minimum(np.floor(position).astype(np.int64), max(size - 2, 0))
        high = np.minimum(low + 1, size - 1)
        fraction = position - low
        flat = self.probability.reshape(-1)
        value = np.zeros(len(cells))
        for corner in range(8):
            upper = [(corner >> axis) & 1 for axis in range(3)]
            index = [high[:, a] if upper[a] else low[:, a] for a in range(3)]
            weight = np.prod([fraction[:, a] if upper[a] else 1 - fraction[:, a] for a in range(3)], axis=0)
            value += weight * flat[(index[0] * size + index[1]) * size + index[2]]
        result[inside] = value
        return result

    def to_mesh(self, threshold: float = OCCUPANCY_THRESHOLD) -> trimesh.Trimesh:
        """Boundary of the region where the probability is at least ``threshold``: metres, object frame, faces outwards.

        Linear: marching cubes, closed where the solid meets a face of W. Nearest: the faces of the solid cells, two
        triangles each, corners welded; watertight unless two solid cells share no more than an edge. Nothing solid: an
        empty mesh (0 vertices, 0 faces).
        """
        if not 0 < threshold < 1:
            raise InvalidInputError(f"threshold {threshold}: must lie strictly between 0 and 1")
        solid = self.probability >= threshold
        if not solid.any():
            return trimesh.Trimesh(vertices=np.zeros((0, 3)), faces=np.zeros((0, 3), dtype=np.int64), process=False)
        vertices, faces = _cell_faces(solid) if self.interpolation == "nearest" else self._marching_cubes(threshold)
        return trimesh.Trimesh(vertices=WORKSPACE_LOW + self.cell_edge * vertices, faces=faces, process=False)

    def _marching_cubes(self, threshold: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Vertices in cells from the lower corner of W, and faces."""
        from skimage.measure import marching_cubes

        level = self.probability.astype(np.float64) - threshold
        level = np.where(level >= 0, np.maximum(level, _CROSSING_MARGIN), np.minimum(level, -_CROSSING_MARGIN))
        # Mirroring the sign of solid border samples puts the closing surface half a cell out: on the faces of W, where
        # `query` stops being solid.
        outside = np.ones(np.array(level.shape) + 2, dtype=bool)
        outside[1:-1, 1:-1, 1:-1] = False
        padded = np.pad(level, 1, mode="edge")
        padded[outside] = -np.abs(padded[outside])
        vertices, faces, _, _ = marching_cubes(padded, level=0.0, gradient_direction="ascent")
        # Sample i of the padded array sits at cell coordinate i - 1 + 0.5.
        return vertices.astype(np.float64) - 0.5, faces.astype(np.int64)


def _cell_faces(solid: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Faces between solid and empty cells, two outward triangles each; welded integer vertices."""
    padded = np.pad(solid, 1)
    quads = []
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        for side in (0, 1):
            neighbour = np.roll(padded, 1 if side == 0 else -1, axis=axis)
            cells = np.argwhere(padded & ~neighbour) - 1
            corner = np.zeros((4, 3), dtype=np.int64)
            corner[:, axis] = side
            corner[[1, 2], first] = 1
            corner[[2, 3], second] = 1
            quads.append(cells[:, None, :] + (corner if side else corner[::-1])[None])
    corners = np.concatenate(quads)
    vertices, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    index = index.reshape(-1, 4)
    return vertices.astype(np.float64), np.concatenate([index[:, [0, 1, 2]], index[:, [0, 2, 3]]])


class Reconstructor(Protocol):
    """Completes a shape from what was touched (protocol section 9)."""

    name: str

    def reconstruct(self, touched: NDArray[np.bool_], visited: NDArray[np.bool_]) -> Volume:
        """Merged touched and visited grids, each (32, 32, 32) bool in the object frame -> occupancy over W."""
        ...
