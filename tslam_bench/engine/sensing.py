"""Touch and coverage, batched over environments: probes, signed distance, contact points, voxel sets (section 5).

Two implementations of one interface: ``sensing_numba.CompiledSensing`` (numpy arrays, CPU simulation) and
``sensing_torch.TorchSensing`` (tensors, GPU simulation). Tests hold one against the other.

Arrays are ``(environments, ...)``; E environments, P probes, N = 32 voxels per axis. World frame, metres.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from tslam_bench.constants import GRID_SIZE
from tslam_bench.engine.arrays import Array, Backend
from tslam_bench.engine.field_atlas import FieldAtlas
from tslam_bench.engine.skin import Skin
from tslam_bench.objects.store import SignedDistanceField

VOXELS: Final = GRID_SIZE**3
MAX_NEW_CONTACTS: Final = 64
"""New contact points kept per environment and step (the first in probe order); more than that is a whole palm landing."""


@dataclass(frozen=True)
class Contacts:
    """What one control step felt.

    Attributes:
        on: (E, P) bool, probes that are on.
        new: (E, P) bool, probes on now that were off one step before.
        points: (E, MAX_NEW_CONTACTS, 3) float32 contact points of new probes, zero where ``mask`` is False.
        mask: (E, MAX_NEW_CONTACTS) bool.
        new_touched: (E,) int64, |T_t minus T_(t-1)| (paper eq. 2).
        new_visited: (E,) int64, |V_t minus V_(t-1)| (paper eq. 3).
    """

    on: Array
    new: Array
    points: Array
    mask: Array
    new_touched: Array
    new_visited: Array


class Sensing(ABC):
    """Senses E environments at once and accumulates their touched and visited grids.

    Args:
        num_envs: E.
        skin: probes and volume points.
        backend: where the arrays live.
        field_dtype: of the signed-distance fields in memory.
    """

    def __init__(self, num_envs: int, skin: Skin, backend: Backend, field_dtype: Any = np.float32) -> None:
        self.num_envs = num_envs
        self.backend = backend
        self.atlas = FieldAtlas(num_envs, backend, field_dtype)
        self._on: Array = backend.full((num_envs, len(skin.probes)), False, bool)

    @property
    @abstractmethod
    def occupancy(self) -> Array:
        """(E, 2, 32, 32, 32) uint8, voxels touched (channel 0) and visited (1) since the episode began."""

    @property
    def touched(self) -> Array:
        """(E, 32, 32, 32) bool, touched since the episode began."""
        return self.occupancy[:, 0] != 0

    @property
    def visited(self) -> Array:
        """(E, 32, 32, 32) bool, visited since the episode began."""
        return self.occupancy[:, 1] != 0

    @property
    @abstractmethod
    def touched_step(self) -> Array:
        """(E, 32, 32, 32) int16, control step (0 = first) of the first touch, -1 where never touched; a view."""

    @property
    def on(self) -> Array:
        """(E, P) bool, probes that are on."""
        return self._on

    def set_object(self, env: int, name: str, field: SignedDistanceField, pose: int) -> None:
        """Puts an object in a pose into one environment; call :meth:`begin` before the next step."""
        self.atlas.set_object(env, name, field, pose)

    @abstractmethod
    def begin(self, envs: Sequence[int]) -> None:
        """Clears the grids and probe memory of ``envs`` for a new episode."""

    @abstractmethod
    def step(self, link_matrices: Array, step: Array) -> Contacts:
        """Senses the hand where it is now and updates the grids.

        Args:
            link_matrices: (E, L, 3, 4) float32, pose of every skin link in the world.
            step: (E,) int, number of the control step in its episode (0 = first).
        """

    @abstractmethod
    def link_touch(self) -> Array:
        """(E, L) uint8: a link's touch bit is on when any of its probes is."""

    def state(self) -> dict[str, Array]:
        """What has been felt in the running episodes, (E, ...) arrays: copies."""
        array = self.backend.array
        return {"on": array(self._on), "occupancy": array(self.occupancy), "touched_step": array(self.touched_step)}

    @abstractmethod
    def set_state(self, envs: Sequence[int], state: Mapping[str, Array]) -> None:
        """Puts rows of :meth:`state`, one per entry of ``envs``, back."""
