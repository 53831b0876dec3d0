"""Where to draw the surface in an uncertain volume."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.reconstruction.volume import Volume

LOWEST: Final = 0.1
HIGHEST: Final = 0.6
_SMALLEST: Final = 1e-4


def level_of_best_iou(probability: NDArray[np.floating]) -> float:
    """The level whose solid has the largest expected IoU with the truth, if the probabilities are right.

    The cells that are at least ``t`` are expected to share sum(p, p >= t) cells with the truth, and to unite with it to
    count(p >= t) + sum(p, p < t). The ratio of the two expectations stands for the expected ratio: there are many cells.
    A level of 0.5 has the fewest wrong cells, not the best IoU: where all is unsure, it calls nothing solid. (For F-measures
    this is known as plug-in optimisation of the threshold, e.g. Lipton et al., ECML 2014.)

    Args:
        probability: any shape, in [0, 1].

    Returns:
        A number between 0.1 and 0.6; 0.5 if nothing is above 0.1.
    """
    values = np.sort(np.asarray(probability, dtype=np.float64).reshape(-1))[::-1]
    shared = np.cumsum(values)
    expected = shared / (np.arange(1, len(values) + 1) + shared[-1] - shared)
    allowed = (values >= LOWEST) & (values <= HIGHEST)
    if not allowed.any():
        return 0.5
    return float(values[allowed][int(expected[allowed].argmax())])


def volume_at_level(probability: NDArray[np.floating], level: float | None = None) -> Volume:
    """A volume whose 0.5 level is ``level`` of ``probability`` (R, R, R): the difference of their logits is taken off.

    ``level`` None: :func:`level_of_best_iou`.
    """
    level = level_of_best_iou(probability) if level is None else level
    p = np.clip(probability, _SMALLEST, 1 - _SMALLEST)
    odds = p / (1 - p) * ((1 - level) / level)
    return Volume((odds / (1 + odds)).astype(np.float32), "linear")
