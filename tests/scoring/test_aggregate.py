"""Aggregation against closed forms and scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import mannwhitneyu, norm, trim_mean

from tslam_bench.scoring.aggregate import (
    Bootstrap,
    curve_intervals,
    estimate_all,
    interquartile_mean,
    interval,
    probability_of_improvement,
    resampled_means,
)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 50, 51])
def test_interquartile_mean_is_the_trimmed_mean(count: int) -> None:
    values = np.random.default_rng(count).random((3, count))
    np.testing.assert_allclose(interquartile_mean(values), trim_mean(values, 0.25, axis=1))


def test_interquartile_mean_ignores_outliers() -> None:
    assert interquartile_mean(np.array([-1e9, 1, 2, 3, 4, 5, 6, 1e9])) == 3.5


def test_interval_of_many_objects_is_the_normal_one() -> None:
    values = np.random.default_rng(0).normal(0.5, 0.2, size=(400, 1))
    estimate = Bootstrap(400, 1).estimate(values)
    half = norm.ppf(0.975) * values.std() / np.sqrt(400)
    assert estimate.mean == pytest.approx(values.mean())
    assert estimate.low == pytest.approx(values.mean() - half, abs=0.1 * half)
    assert estimate.high == pytest.approx(values.mean() + half, abs=0.1 * half)


def test_variance_of_the_two_levels() -> None:
    """Var of the resampled mean = (var between object means + mean var within objects / seeds) / objects."""
    generator = np.random.default_rng(1)
    values = generator.normal(size=(30, 1)) + 2.0 * generator.normal(size=(30, 5))
    drawn = Bootstrap(30, 5, samples=20_000).resample(values).mean(axis=(1, 2))
    expected = (values.mean(axis=1).var() + values.var(axis=1).mean() / 5) / 30
    assert drawn.var() == pytest.approx(expected, rel=0.05)


def test_seeds_stay_with_their_object() -> None:
    values = np.arange(4)[:, None] * 100 + np.arange(3)[None]
    drawn = Bootstrap(4, 3, samples=50).resample(values)
    assert (drawn // 100 == drawn[:, :, :1] // 100).all()
    assert set(np.unique(drawn)) <= set(np.unique(values))


def test_constant_values_have_no_interval() -> None:
    estimate = Bootstrap(5, 2).estimate(np.full((5, 2), 0.25))
    assert (
        estimate.mean == estimate.low == estimate.high == estimate.iqm == estimate.iqm_low == estimate.iqm_high == 0.25
    )


def test_bootstrap_is_deterministic() -> None:
    values = np.random.default_rng(0).random((5, 3))
    assert Bootstrap(5, 3).estimate(values) == Bootstrap(5, 3).estimate(values)
    assert Bootstrap(5, 3, seed=1).estimate(values) != Bootstrap(5, 3, seed=2).estimate(values)
    assert estimate_all({"a": values, "b": values})["b"] == Bootstrap(5, 3).estimate(values)
    assert estimate_all({}) == {}


def test_bootstrap_refuses_other_shapes() -> None:
    with pytest.raises(ValueError, match="expected"):
        Bootstrap(5, 3).estimate(np.zeros((3, 5)))
    with pytest.raises(ValueError, match="at least 1"):
        Bootstrap(0, 3)


def test_probability_of_improvement() -> None:
    better, worse = np.array([[2.0, 3.0], [5.0, 6.0]]), np.array([[1.0], [4.0]])
    assert probability_of_improvement(better, worse) == 1
    assert probability_of_improvement(worse, better) == 0
    assert probability_of_improvement(better, worse, higher_is_better=False) == 0
    assert probability_of_improvement(better, better) == 0.5
    assert probability_of_improvement(np.array([[1.0], [0.0]]), np.array([[0.0], [1.0]])) == 0.5


def test_probability_of_improvement_is_mann_whitney() -> None:
    generator = np.random.default_rng(2)
    x, y = generator.integers(0, 6, (7, 9)), generator.integers(0, 6, (7, 4))
    expected = np.mean([mannwhitneyu(a, b).statistic / (9 * 4) for a, b in zip(x, y, strict=True)])
    assert probability_of_improvement(x, y) == pytest.approx(expected)


def test_probability_of_improvement_refuses_other_objects() -> None:
    with pytest.raises(ValueError, match="other objects"):
        probability_of_improvement(np.zeros((3, 1)), np.zeros((4, 1)))


def test_intervals_of_curves_are_those_of_each_point() -> None:
    curves = np.random.default_rng(0).random((7, 3, 5)).cumsum(axis=2)
    low, high = curve_intervals(curves)
    for point in range(5):
        expected = interval(resampled_means(curves[:, :, point]))
        assert (low[point], high[point]) == pytest.approx(expected, rel=1e-12)
