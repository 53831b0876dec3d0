"""Surfaces for the page: reconstructions as small nets with their error, true meshes fine enough to be coloured.

A *net* (Gibson, 1998, "Constrained elastic surface nets") has one vertex in each cell that the surface passes and a quad for
each lattice edge that it crosses. What is solid at the lattice's nodes tells the quads, so a file holds bits and a place
within its cell for each vertex, a quarter of what the triangles would take.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import trimesh
from numpy.typing import NDArray

from tslam_bench.constants import GRID_SIZE, OCCUPANCY_THRESHOLD, WORKSPACE_EDGE, WORKSPACE_LOW
from tslam_bench.errors import InvalidInputError
from tslam_bench.grids import voxel_centres
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring.prediction import invalid_mesh, solid_in_mesh
from tslam_bench.scoring.submission import Reconstruction

NODES: Final = 64
"""Nodes per axis at which a reconstruction is looked at: 3.9 mm apart."""
PLACES: Final = 64
"""Places within a cell, per axis, that a vertex can have."""
ERROR_STEP: Final = 0.4e-3
"""Errors are stored in steps of this (m)."""
MOST_STEPS: Final = 63
"""Largest stored error, in steps: 25 mm."""
FINE: Final = 10e-3
"""Longest edge (m) of a true mesh's triangles, so that colours of corners tell where the error is."""
_MOST_WORK: Final = 1000.0
"""Faces that a line through a mesh's box meets, on average, up to which vertices are moved onto the mesh itself."""


@dataclass(frozen=True, eq=False)
class Net:
    """A closed surface as a net, in the object frame.

    Attributes:
        solid: (R, R, R) bool at the centres of R^3 equal cells of W.
        places: (V, 3) uint8 below ``PLACES``: where in its cell each vertex is, in C order of the cells between nodes, of
            which there is one layer beyond W; None: faces of the solid cells themselves are drawn.
    """

    solid: NDArray[np.bool_]
    places: NDArray[np.uint8] | None

    def mesh(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Vertices (V, 3) in metres and triangles (F, 3), facing outwards, as the page draws them."""
        if self.places is None:
            drawn = Volume(self.solid.astype(np.float32), "nearest").to_mesh()
            return np.asarray(drawn.vertices), np.asarray(drawn.faces, dtype=np.int64)
        cells = crossed_cells(self.solid)
        edge = WORKSPACE_EDGE / len(self.solid)
        vertices = WORKSPACE_LOW + edge * (np.argwhere(cells) - 0.5 + (self.places + 0.5) / PLACES)
        return vertices, _faces(self.solid, cells)


def crossed_cells(solid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(R + 1,) * 3: which cells between nodes have corners of both kinds; what lies outside W is empty."""
    padded = np.pad(solid, 1).astype(np.int8)
    corners = padded[:-1] + padded[1:]
    corners = corners[:, :-1] + corners[:, 1:]
    corners = corners[:, :, :-1] + corners[:, :, 1:]
    return (corners > 0) & (corners < 8)


def net(reconstruction: Reconstruction) -> Net:
    """The net of a reconstruction; an invalid one gives an empty net. The work does not depend on its resolution."""
    if isinstance(reconstruction, Volume):
        solid = reconstruction.probability >= OCCUPANCY_THRESHOLD
        if reconstruction.interpolation == "nearest" and reconstruction.resolution == GRID_SIZE:
            return Net(solid, None)
        values = reconstruction.query(voxel_centres(NODES).reshape(-1, 3)).reshape((NODES,) * 3)
        return _net_of_values(values.astype(np.float64))
    if invalid_mesh(reconstruction) is not None:
        return Net(np.zeros((GRID_SIZE,) * 3, dtype=bool), None)
    try:
        solid = solid_in_mesh(reconstruction, voxel_centres(NODES).reshape(-1, 3)).reshape((NODES,) * 3)
    except InvalidInputError:
        return Net(np.zeros((GRID_SIZE,) * 3, dtype=bool), None)
    return _net_of_mesh(solid, reconstruction)


def _net_of_values(values: NDArray[np.float64]) -> Net:
    """Each vertex at the mean of where the edges of its cell cross the threshold."""
    solid = values >= OCCUPANCY_THRESHOLD
    padded = np.pad(values, 1)
    size = len(values) + 1
    total, count = np.zeros((size, size, size, 3)), np.zeros((size, size, size))
    for axis in range(3):
        first = np.moveaxis(padded, axis, 0)[:-1]
        second = np.moveaxis(padded, axis, 0)[1:]
        crossed = (first >= OCCUPANCY_THRESHOLD) != (second >= OCCUPANCY_THRESHOLD)
        share = np.divide(OCCUPANCY_THRESHOLD - first, second - first, out=np.zeros_like(first), where=crossed)
        for u in (0, 1):
            for v in (0, 1):
                part = (slice(None), slice(u, u + size), slice(v, v + size))
                place = np.zeros((size, size, size, 3))
                others = [other for other in range(3) if other != axis]
                place[..., axis], place[..., others[0]], place[..., others[1]] = share[part], u, v
                weight = crossed[part].astype(np.float64)
                total += np.moveaxis(place * weight[..., None], 0, axis)
                count += np.moveaxis(weight, 0, axis)
    cells = crossed_cells(solid)
    return Net(solid, _quantised(total[cells] / count[cells][:, None]))


def _net_of_mesh(solid: NDArray[np.bool_], mesh: trimesh.Trimesh) -> Net:
    """Each vertex at the point of the mesh next to its cell's centre, as far as that is in the cell."""
    cells = crossed_cells(solid)
    edge = WORKSPACE_EDGE / len(solid)
    corners = np.argwhere(cells) - 0.5
    place = np.full((len(corners), 3), 0.5)
    if len(corners) and _meetings(mesh) <= _MOST_WORK:
        centres = WORKSPACE_LOW + edge * (corners + 0.5)
        vertices, faces = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
        import igl  # pages without shapes to turn do without it

        nearest = igl.point_mesh_squared_distance(centres, vertices, faces)[2]
        place = np.clip((nearest - WORKSPACE_LOW) / edge - corners, 0, 1)
    return Net(solid, _quantised(place))


def _meetings(mesh: trimesh.Trimesh) -> float:
    """How many boxes of faces a line through the mesh's box meets on average."""

    def surface(extents: NDArray) -> NDArray:
        return (extents * np.roll(extents, 1, axis=-1)).sum(axis=-1)

    whole = surface(np.maximum(np.asarray(mesh.extents, dtype=np.float64), 1e-12))
    return float(surface(np.ptp(np.asarray(mesh.triangles), axis=1)).sum() / whole)


def _quantised(place: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.clip(np.floor(place * PLACES), 0, PLACES - 1).astype(np.uint8)


def _faces(solid: NDArray[np.bool_], cells: NDArray[np.bool_]) -> NDArray[np.int64]:
    number = np.cumsum(cells.reshape(-1)).reshape(cells.shape) - 1
    padded = np.pad(solid, 1)
    found = [np.zeros((0, 3), dtype=np.int64)]
    for axis in range(3):
        u, v = np.eye(3, dtype=np.int64)[(axis + 1) % 3], np.eye(3, dtype=np.int64)[(axis + 2) % 3]
        first = np.moveaxis(padded, axis, 0)
        changes = np.moveaxis(first[:-1] != first[1:], 0, axis)
        nodes = np.argwhere(changes)
        around = [number[tuple((nodes - shift).T)] for shift in (u + v, v, 0 * u, u)]
        quads = np.stack(around, axis=1)
        inwards = ~padded[tuple(nodes.T)]
        quads[inwards] = quads[inwards][:, ::-1]
        found += [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    return np.concatenate(found)


def fine_mesh(
    vertices: NDArray, faces: NDArray, longest: float = FINE
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The same surface with no edge longer than ``longest`` (m)."""
    if len(faces) and np.ptp(vertices[faces], axis=1).max() > longest:
        vertices, faces = trimesh.remesh.subdivide_to_size(vertices, faces, longest, max_iter=12)
    unique, inverse = np.unique(np.round(vertices, 7), axis=0, return_inverse=True)
    order = np.full(len(unique), len(faces) * 3)
    corners = inverse.reshape(-1)[faces]
    np.minimum.at(order, corners.reshape(-1), np.arange(corners.size))  # in the order of the faces: small differences
    rank = np.argsort(np.argsort(order))
    return unique[np.argsort(order)], rank[corners]


def signed_distances(points: NDArray, vertices: NDArray, faces: NDArray) -> NDArray[np.float64]:
    """(M,) exact distances (m) of ``points`` (M, 3) to a closed mesh, negative inside."""
    mesh = (np.ascontiguousarray(vertices, dtype=np.float64), np.ascontiguousarray(faces, dtype=np.int64))
    points = np.ascontiguousarray(points, dtype=np.float64)
    import igl

    distance = np.sqrt(np.maximum(igl.point_mesh_squared_distance(points, *mesh)[0], 0))
    return np.where(igl.fast_winding_number(*mesh, points) > 0.5, -distance, distance)


def stored_errors(distances: NDArray) -> NDArray[np.int8]:
    """Distances (m) in steps of ``ERROR_STEP``, larger ones as the largest."""
    return np.clip(np.round(distances / ERROR_STEP), -MOST_STEPS, MOST_STEPS).astype(np.int8)
