"""Risk split by Boole's inequality and the Gaussian quantile of a facet."""

from __future__ import annotations

from scipy.special import ndtri


def split_risk(probability: float, parts: int) -> float:
    """Probability that each of `parts` events needs so that all hold together with `probability`.

    P(all) >= 1 - sum P(not each), so a uniform split asks 1 - (1 - p) / n of each.
    """
    return 1.0 - (1.0 - probability) / parts


def quantile(probability: float) -> float:
    """Standard normal quantile Psi^-1: P(a'x <= b) >= p iff a'mu + Psi^-1(p) ||S'a|| <= b.

    Raises:
        ValueError: if the probability is not in [0.5, 1); below one half the condition is not convex.
    """
    if not 0.5 <= probability < 1.0:
        raise ValueError(f"probability {probability} is outside [0.5, 1)")
    return float(ndtri(probability))
