"""Confidence intervals of probabilities."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import beta, binom

from scp_recon.monte_carlo.estimates import CONFIDENCE, binomial_quantile, proportion


@given(samples=st.integers(1, 20_000), share=st.floats(0.0, 1.0))
def test_interval_is_clopper_and_pearsons(samples: int, share: float) -> None:
    successes = round(share * samples)
    tail = 0.5 * (1.0 - CONFIDENCE)
    low = beta.ppf(tail, successes, samples - successes + 1) if successes else 0.0
    high = beta.ppf(1 - tail, successes + 1, samples - successes) if successes < samples else 1.0
    estimate = proportion(successes, samples)
    assert estimate.value == successes / samples
    assert (estimate.low, estimate.high) == pytest.approx((low, high), abs=1e-9)
    assert 0.0 <= estimate.low <= estimate.value <= estimate.high <= 1.0


@given(
    level=st.floats(1e-9, 1.0 - 1e-9), samples=st.integers(1, 20_000), share=st.floats(1e-3, 0.999)
)
def test_quantile_is_the_binomial_law_s(level: float, samples: int, share: float) -> None:
    """But for rounding where the law steps at the very level."""
    ours, theirs = binomial_quantile(level, samples, share), binom.ppf(level, samples, share)
    least = min(ours, theirs)
    assert ours == theirs or binom.cdf(least, samples, share) == pytest.approx(level, rel=1e-9)


@pytest.mark.parametrize("samples", [10, 60, 200])
@pytest.mark.parametrize("truth", [0.01, 0.3, 0.7, 0.95])
def test_interval_holds_the_truth_at_least_as_often_as_it_claims(
    samples: int, truth: float
) -> None:
    """Summed over all outcomes: no sampling in the test of the sampling."""
    holds = [
        estimate.low <= truth <= estimate.high
        for estimate in (proportion(successes, samples) for successes in range(samples + 1))
    ]
    assert binom.pmf(np.arange(samples + 1), samples, truth) @ holds >= CONFIDENCE
