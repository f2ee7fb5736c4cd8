"""How far flights end from the one without errors, with intervals, and how normal their ends are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2, probplot, shapiro

from scp_recon.monte_carlo.estimates import CONFIDENCE, Estimate

Array = npt.NDArray[np.float64]

TESTED_MAX = 5000
"""Samples up to which the p-values of Shapiro and Wilk's test are accurate."""

POINTS_MAX = 199
"""Of a quantile-quantile plot."""


def dispersion(deviation: Array) -> Estimate:
    """Root mean square length of deviations that should be zero on average, m.

    Its square, the trace of their second moments S, is taken as chi-squared with Satterthwaite's
    degrees of freedom, n (tr S)^2 / tr S^2. For normal deviations that is exact along one axis; in
    three, the few degrees of freedom that a small sample shows make the interval somewhat too wide.

    Args:
        deviation: shape (n, 3).
    """
    moments = deviation.T @ deviation / len(deviation)
    trace = float(np.trace(moments))
    if trace == 0.0:
        return Estimate(0.0, 0.0, 0.0)
    freedom = len(deviation) * trace**2 / float(np.sum(moments**2))
    tail = 0.5 * (1.0 - CONFIDENCE)
    high, low = (freedom / float(chi2.ppf(p, freedom)) for p in (tail, 1.0 - tail))
    return Estimate(np.sqrt(trace), np.sqrt(trace * low), np.sqrt(trace * high))


@dataclass(frozen=True)
class Normality:
    """How normal a sample is.

    Attributes:
        p_value: of Shapiro and Wilk's test, of the first 5000.
        correlation: of the sample's quantiles with a normal variable's; 1 on a straight line.
        expected, observed: quantiles of a standard normal and of the standardised sample.
    """

    p_value: float
    correlation: float
    expected: Array
    observed: Array


def normality(sample: Array) -> Normality:
    """Test a sample, shape (n,), n > 3, whose values are not all the same."""
    standard = (sample - sample.mean()) / sample.std(ddof=1)
    (expected, observed), (_, _, correlation) = probplot(standard)
    # Evenly spaced along the axis, so that the tails are seen.
    keep = np.unique(np.searchsorted(expected, np.linspace(expected[0], expected[-1], POINTS_MAX)))
    return Normality(
        float(shapiro(standard[:TESTED_MAX]).pvalue),
        float(correlation),
        expected[keep],
        observed[keep],
    )
