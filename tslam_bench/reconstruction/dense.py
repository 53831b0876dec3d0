"""``unet``: one or several dense networks, seen from several sides, and what they are unsure of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from tslam_bench.errors import InvalidInputError
from tslam_bench.grids import turn
from tslam_bench.reconstruction.inputs import check_grids, empty_volume
from tslam_bench.reconstruction.levels import volume_at_level
from tslam_bench.reconstruction.torch_threads import torch_threads
from tslam_bench.reconstruction.volume import Volume

SYMMETRIES: Final[tuple[NDArray[np.int64], ...]] = tuple(
    np.array(matrix)
    for matrix in (
        np.diag([1, 1, 1]),
        [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
        [[0, 0, -1], [1, 0, 0], [0, -1, 0]],
        np.diag([-1, -1, -1]),
        [[0, -1, 0], [-1, 0, 0], [0, 0, 1]],
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[0, 0, 1], [0, -1, 0], [-1, 0, 0]],
        np.diag([-1, 1, -1]),
    )
)
"""Signed permutations in which a network sees the grids; all 48 mean the same to it, since it learned from all of them."""
_SMALLEST: Final = 1e-4


@dataclass(frozen=True, eq=False)
class Belief:
    """What the networks think of each cell, object frame.

    Attributes:
        probability: (R, R, R) float32, mean occupancy probability; not moved to any level.
        variance: (R, R, R) float32, variance of the probability over networks and views: what more learning, rather than more
            chance, would settle (Lakshminarayanan et al., NeurIPS 2017).
    """

    probability: NDArray[np.float32]
    variance: NDArray[np.float32]

    @property
    def entropy(self) -> NDArray[np.float32]:
        """(R, R, R) float32, entropy of each cell's occupancy (nats): everything that a touch could settle."""
        p = np.clip(self.probability, _SMALLEST, 1 - _SMALLEST)
        return np.asarray(-(p * np.log(p) + (1 - p) * np.log(1 - p)), dtype=np.float32)


class DenseReconstructor:
    """Mean of dense networks over views, with the surface where the expected IoU is best.

    The volume's 0.5 level is that of :func:`tslam_bench.reconstruction.levels.level_of_best_iou`: the level's logit is taken off
    every cell's. Nothing touched: empty.

    Args:
        name: registered name.
        networks: at least one :class:`tslam_bench.reconstruction.unet.UNet` of one resolution, in evaluation mode.
        training: training records, for the reports.
        views: how many of :data:`SYMMETRIES` each network sees.
        temperature: the logits are divided by it before anything else.
        threads: torch threads.

    Raises:
        InvalidInputError: no network, or a number of views that there is not.
    """

    def __init__(
        self,
        name: str,
        networks: Sequence[torch.nn.Module],
        training: Sequence[dict[str, Any]] = (),
        views: int = 4,
        temperature: float = 1.0,
        threads: int = 1,
    ) -> None:
        if not networks:
            raise InvalidInputError(f"{name}: no network is given")
        if not 1 <= views <= len(SYMMETRIES):
            raise InvalidInputError(f"views {views}: choose 1 to {len(SYMMETRIES)}")
        self.name = name
        self.networks = list(networks)
        self.training = list(training)
        self.views = views
        self.temperature = temperature
        self.threads = threads

    def believe(self, touched: NDArray[np.bool_], visited: NDArray[np.bool_]) -> Belief:
        """Touched and visited grids (32, 32, 32) bool, object frame -> what the networks think; also without touches."""
        touched, visited = check_grids(touched, visited)
        grids = np.stack([touched, visited])
        symmetries = SYMMETRIES[: self.views]
        seen = np.stack([turn(grids, symmetry) for symmetry in symmetries]).astype(np.float32)
        answers = []
        with torch_threads(self.threads), torch.inference_mode():
            for network in self.networks:
                logits = network(torch.from_numpy(seen)) / self.temperature
                for answer, symmetry in zip(torch.sigmoid(logits).numpy(), symmetries, strict=True):
                    answers.append(turn(answer, symmetry.T))
        stacked = np.stack(answers)
        return Belief(stacked.mean(axis=0), stacked.var(axis=0))

    def reconstruct(self, touched: NDArray[np.bool_], visited: NDArray[np.bool_]) -> Volume:
        """Touched and visited grids (32, 32, 32) bool, object frame -> volume with linear interpolation."""
        touched, visited = check_grids(touched, visited)
        if not touched.any():
            return empty_volume()
        return volume_at_level(self.believe(touched, visited).probability)
