"""Finds the openings of a surface and closes those that a person would take for damage.

An opening is a closed chain of edges that have one face only. What it is shows in the faces around it: those of a *hole* in a
wall go on across it, those of a *mouth* (the rim of a cup, the neck of a bottle) end in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import REACHABLE_BALL_RADIUS
from tslam_bench.geometry.meshes import TriangleMesh

MAX_HOLE = 25e-3
"""Widest hole (m) in a wall that is closed."""
MAX_MOUTH = 2 * REACHABLE_BALL_RADIUS
"""Widest opening of any kind (m) that is closed: what lies behind a narrower one can never be felt (see ``voids``)."""
MAX_HOLE_SHARE = 0.25
"""... and never one wider than this share of the longest edge."""
GAPING = 0.5
"""A hole wider than this share of the longest edge is how the thing was meant: the mouth of a bowl that curves inwards."""
_FLAT = np.cos(np.pi / 4)


@dataclass(frozen=True)
class Opening:
    """An opening of a surface.

    Attributes:
        corners: (N,) vertices around it, in the order that faces of a patch have.
        width: four times its area by its perimeter (m): the diameter of a circle, twice the width of a slit.
        in_wall: whether the faces around it go on across it, within 45 degrees on average.
    """

    corners: NDArray[np.int64]
    width: float
    in_wall: bool

    def kind(self, extents: NDArray[np.float64]) -> Literal["damage", "mouth", "unclear"]:
        """What a person would take it for in an object with these ``extents`` (m)."""
        longest = float(extents.max())
        if self.width <= (min(MAX_HOLE, MAX_HOLE_SHARE * longest) if self.in_wall else MAX_MOUTH):
            return "damage"
        return "unclear" if self.in_wall and self.width <= GAPING * longest else "mouth"


def find_openings(mesh: TriangleMesh) -> list[Opening]:
    """All openings of a mesh in metres whose faces share vertices; chains that cross themselves are cut where they do."""
    edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, inverse, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    single = np.flatnonzero((count[inverse.ravel()] == 1) & (edges[:, 0] != edges[:, 1]))
    normal_at = dict(zip(map(tuple, edges[single].tolist()), mesh.face_normals()[single // 3], strict=True))
    # A patch runs along an edge the other way than the face that is there.
    following: dict[int, list[int]] = {}
    for start, end in edges[single].tolist():
        following.setdefault(end, []).append(start)
    openings = []
    for start in list(following):
        while following.get(start):
            chain, place = [start], {start: 0}
            while following.get(chain[-1]):
                reached = following[chain[-1]].pop()
                if reached in place:
                    loop = chain[place[reached] :]
                    del chain[place[reached] + 1 :]
                    for corner in loop[1:]:
                        del place[corner]
                    if len(loop) > 2:
                        openings.append(_opening(mesh, loop, normal_at))
                else:
                    place[reached] = len(chain)
                    chain.append(reached)
    return openings


def _opening(mesh: TriangleMesh, loop: list[int], normal_at: dict[tuple[int, ...], NDArray[np.float64]]) -> Opening:
    corners = mesh.vertices[loop]
    following = np.roll(corners, -1, axis=0)
    area = np.cross(corners - corners.mean(axis=0), following - corners.mean(axis=0)).sum(axis=0) / 2
    lengths = np.linalg.norm(following - corners, axis=1)
    size = float(np.linalg.norm(area))
    around = np.array([normal_at[b, a] for a, b in zip(loop, [*loop[1:], loop[0]], strict=True)])
    along = lengths @ (around @ area) / max(size * lengths.sum(), 1e-300)
    return Opening(np.array(loop), 4 * size / max(float(lengths.sum()), 1e-300), bool(along >= _FLAT))


def close(mesh: TriangleMesh, openings: Sequence[Opening]) -> TriangleMesh:
    """The mesh with a fan of triangles round the middle of each opening."""
    vertices, faces = [mesh.vertices], [mesh.faces]
    for number, opening in enumerate(openings):
        vertices.append(mesh.vertices[opening.corners].mean(axis=0, keepdims=True))
        middle = np.full(len(opening.corners), len(mesh.vertices) + number)
        faces.append(np.stack([opening.corners, np.roll(opening.corners, -1), middle], axis=1))
    return TriangleMesh(np.concatenate(vertices), np.concatenate(faces))
