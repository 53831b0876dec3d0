"""From one number per object and seed to one number per method, with its uncertainty (protocol section 10).

Values come as matrices (objects, seeds). Agarwal et al., "Deep reinforcement learning at the edge of the statistical
precipice" (NeurIPS 2021), is the source of the interquartile mean and of the probability of improvement.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

BOOTSTRAP_SAMPLES: Final = 2000
BOOTSTRAP_SEED: Final = 20211110
CONFIDENCE: Final = 0.95


@dataclass(frozen=True)
class Estimate:
    """Aggregates of one metric.

    Attributes:
        mean: mean over objects and seeds; ``low`` and ``high``: its 95 % interval.
        iqm: interquartile mean, the mean of the middle half of all values; ``iqm_low``, ``iqm_high``: its interval.
    """

    mean: float
    low: float
    high: float
    iqm: float
    iqm_low: float
    iqm_high: float


def interquartile_mean(values: NDArray) -> NDArray[np.float64]:
    """Mean of the middle half along the last axis: a quarter of the values, rounded down, is cut from each end."""
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=-1)
    cut = ordered.shape[-1] // 4
    return ordered[..., cut : ordered.shape[-1] - cut].mean(axis=-1)


class Bootstrap:
    """Stratified resampling of (objects, seeds): objects with replacement, and in each drawn object its seeds.

    The same resamples serve every metric of one shape, so that intervals of one table are comparable. With one seed
    only the choice of objects varies; with one object only the seeds do.
    """

    def __init__(self, objects: int, seeds: int, samples: int = BOOTSTRAP_SAMPLES, seed: int = BOOTSTRAP_SEED) -> None:
        if objects < 1 or seeds < 1 or samples < 1:
            raise ValueError(f"bootstrap: {objects} objects, {seeds} seeds, {samples} samples; all must be at least 1")
        generator = np.random.Generator(np.random.PCG64(seed))
        self._object = generator.integers(0, objects, size=(samples, objects, 1))
        self._seed = generator.integers(0, seeds, size=(samples, objects, seeds))
        self.shape = (objects, seeds)

    def resample(self, values: NDArray) -> NDArray[np.float64]:
        """(objects, seeds) -> (samples, objects, seeds)."""
        values = np.asarray(values, dtype=np.float64)
        if values.shape != self.shape:
            raise ValueError(f"bootstrap: values have shape {values.shape}, expected {self.shape}")
        return values[self._object, self._seed]

    def weights(self) -> NDArray[np.float64]:
        """How much each value counts in the mean of each resample: (samples, objects * seeds), every row sums to 1."""
        samples, size = len(self._object), self.shape[0] * self.shape[1]
        drawn = (self._object * self.shape[1] + self._seed).reshape(samples, size) + size * np.arange(samples)[:, None]
        return np.bincount(drawn.ravel(), minlength=samples * size).reshape(samples, size) / size

    def estimate(self, values: NDArray) -> Estimate:
        """Mean and interquartile mean of ``values`` (objects, seeds) with percentile intervals."""
        values = np.asarray(values, dtype=np.float64)
        drawn = self.resample(values).reshape(len(self._object), -1)
        low, high = interval(drawn.mean(axis=1))
        iqm_low, iqm_high = interval(interquartile_mean(drawn))
        return Estimate(
            mean=float(values.mean()),
            low=low,
            high=high,
            iqm=float(interquartile_mean(values.reshape(-1))),
            iqm_low=iqm_low,
            iqm_high=iqm_high,
        )


def resampled_means(values: NDArray, samples: int = BOOTSTRAP_SAMPLES) -> NDArray[np.float64]:
    """Bootstrap distribution of the mean of ``values`` (objects, seeds): (samples,).

    The resamples depend on the shape only, and those of the objects on the number of objects only. So the differences of
    two results of this function are a paired bootstrap: over objects, and over seeds where both have equally many.
    """
    objects, seeds = np.shape(values)
    return Bootstrap(objects, seeds, samples).resample(values).mean(axis=(1, 2))


def curve_intervals(curves: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """95 % intervals of the mean of ``curves`` (objects, seeds, points), point by point: low (points,), high (points,).

    The resamples are those of :func:`resampled_means`.
    """
    objects, seeds, points = np.shape(curves)
    drawn = Bootstrap(objects, seeds).weights() @ np.reshape(curves, (objects * seeds, points))
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(drawn, [tail, 100 - tail], axis=0)
    return low, high


def interval(samples: NDArray, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Percentile interval of bootstrap ``samples`` (B,)."""
    tail = 50 * (1 - confidence)
    low, high = np.percentile(samples, [tail, 100 - tail])
    return float(low), float(high)


def probability_of_improvement(method: NDArray, baseline: NDArray, higher_is_better: bool = True) -> float:
    """Probability that a run of ``method`` beats a run of ``baseline`` on the same object, mean over objects.

    Args:
        method, baseline: (objects, seeds) and (objects, other seeds), the same objects in the same order; ties count
            half.
    """
    method, baseline = np.asarray(method, dtype=np.float64), np.asarray(baseline, dtype=np.float64)
    if method.ndim != 2 or baseline.ndim != 2 or len(method) != len(baseline):
        raise ValueError(f"probability_of_improvement: shapes {method.shape} and {baseline.shape} hold other objects")
    difference = method[:, :, None] - baseline[:, None, :]
    if not higher_is_better:
        difference = -difference
    return float(((difference > 0) + 0.5 * (difference == 0)).mean(axis=(1, 2)).mean())


def estimate_all(values: Mapping[str, NDArray]) -> dict[str, Estimate]:
    """:class:`Estimate` of every metric; all matrices have one shape (objects, seeds)."""
    if not values:
        return {}
    objects, seeds = np.shape(next(iter(values.values())))
    bootstrap = Bootstrap(objects, seeds)
    return {name: bootstrap.estimate(matrix) for name, matrix in values.items()}
