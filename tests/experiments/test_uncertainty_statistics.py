"""Dispersion with its interval, and normality."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from experiments.uncertainty_sources.flights import dispersion, normality


@pytest.mark.parametrize("flights", [3, 8])
@pytest.mark.parametrize("sigmas", [(1.0, 1.0, 1.0), (5.0, 1.0, 0.2)])
def test_intervals_of_the_dispersion_cover_as_often_as_they_say(
    sigmas: tuple[float, float, float], flights: int
) -> None:
    rng = np.random.default_rng(5)
    covariance = np.diag(np.square(sigmas))
    true = np.sqrt(np.trace(covariance))
    draws = multivariate_normal(cov=covariance).rvs((600, flights), random_state=rng)
    found = [dispersion(sample) for sample in draws]
    covered = np.mean([e.low <= true <= e.high for e in found])
    # Never too narrow, and somewhat too wide in three axes.
    assert 0.92 < covered < 0.999
    assert np.mean([e.value**2 for e in found]) == pytest.approx(true**2, rel=0.1)


def test_the_dispersion_of_one_axis_has_the_textbook_interval() -> None:
    sample = np.random.default_rng(0).standard_normal((20, 3)) * [1.0, 0.0, 0.0]
    e = dispersion(sample)
    s = np.sqrt(np.mean(sample[:, 0] ** 2))
    # Quantiles of chi-squared with 20 degrees of freedom: 9.591 and 34.170.
    expected = (s, s * np.sqrt(20 / 34.170), s * np.sqrt(20 / 9.591))
    assert e == pytest.approx(expected, rel=1e-4)


def test_normality_knows_a_normal_sample_from_another() -> None:
    rng = np.random.default_rng(1)
    normal, skew = normality(rng.standard_normal(3000)), normality(rng.exponential(size=3000))
    assert normal.p_value > 0.01
    assert skew.p_value < 1e-20
    assert normal.correlation > 0.999 > skew.correlation
    assert len(normal.expected) == len(normal.observed) <= 199
    assert np.all(np.diff(normal.expected) > 0.0)
    assert normal.observed[0] < -2.5
    assert normal.observed[-1] > 2.5
