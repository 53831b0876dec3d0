"""Where the skin links are, on the CPU: all bodies of a scene read in one call, as matrices.

Asking link by link costs more than half as much as a physics step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tslam_bench.compiled import njit

POSE_SIZE = 7
"""Numbers of a packed pose: unit quaternion (w, x, y, z), then position (m), as SAPIEN packs it."""


def rows_of(entities: Sequence[Any], links: Sequence[Any]) -> NDArray[np.int64]:
    """(L,) rows of ``links`` (articulation link components) in :func:`packed_poses` of a scene with these entities."""
    return np.array([entities.index(link.entity) for link in links], dtype=np.int64)


def packed_poses(scene: Any) -> NDArray[np.float32]:
    """(M, 7) poses of all bodies of a SAPIEN scene in the world, in the order of ``scene.entities``."""
    return np.frombuffer(scene.pack_poses(), dtype=np.float32).reshape(-1, POSE_SIZE)


@njit(cache=True)
def link_matrices(packed: Any, rows: Any, matrices: Any) -> None:
    """Writes (E, L, 3, 4) float32 ``matrices`` of the ``rows`` (L,) of ``packed`` poses (E, M, 7)."""
    one, two = np.float32(1.0), np.float32(2.0)
    for env in range(packed.shape[0]):
        for link in range(len(rows)):
            row = rows[link]
            w, x, y, z = packed[env, row, 0], packed[env, row, 1], packed[env, row, 2], packed[env, row, 3]
            matrix = matrices[env, link]
            matrix[0, 0] = one - two * (y * y + z * z)
            matrix[0, 1] = two * (x * y - w * z)
            matrix[0, 2] = two * (x * z + w * y)
            matrix[1, 0] = two * (x * y + w * z)
            matrix[1, 1] = one - two * (x * x + z * z)
            matrix[1, 2] = two * (y * z - w * x)
            matrix[2, 0] = two * (x * z - w * y)
            matrix[2, 1] = two * (y * z + w * x)
            matrix[2, 2] = one - two * (x * x + y * y)
            matrix[0, 3], matrix[1, 3], matrix[2, 3] = packed[env, row, 4], packed[env, row, 5], packed[env, row, 6]
