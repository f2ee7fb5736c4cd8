"""Estimate the probability that flights fail, with exact limits, by flying few of many draws.

The normal law predicts for every draw of the errors whether the flight fails, and by what margin.
Draws fall into six strata by this margin. A random share of each stratum is flown. Flights that end
unlike the law's verdict correct the estimate (double sampling; Horvitz and Thompson, JASA 47 (1952)
663):

    P(fail) = P(law fails) + sum_h +-P(stratum h, flown, unlike) / share_h,   minus where the law fails.

The number of draws follows a Poisson law. All counts are therefore independent Poisson numbers, and
every limit here is exact, however wrong the normal law is. X is the number of draws that fail by
the law and whose flights do not contradict it. N is the expected number of draws, and d_h the
number of flights unlike the law in stratum h. Each such flight adds a_h to X: 1 / share_h, or 1 - 1
/ share_h where the law fails. Their mean addition to X / N is r. Then

    e(r) = exp(lean N r) prod_h (1 - lean a_h)^d_h

has the mean 1, for any `lean` fixed beforehand that leaves every factor positive. X's p-value over it
is a p-value (Ignatiadis, Wang and Ramdas, Biometrika 111 (2024) 417). The limit is the largest P(fail)
at which that exceeds the tail's probability.

If no flight is unlike the law, n flights of the stratum that surely holds leave a probability of
about ln(1 / tail) / n undecided.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammainc, gammaincc, gammaln, xlogy

from formulations.arrays import Array, Indices

EDGES = np.array([-1.0, -0.3, 0.0, 0.3, 1.0])
"""Edges of the strata, as multiples of the margin beyond which a verdict is sure."""
FAILS = np.repeat([True, False], 3)
"""Whether the law fails in each stratum; the first and the last are sure."""
COUNT = len(FAILS)

LEAN = 0.9
"""Lean over the share flown of the stratum that surely holds. One flight of this stratum that fails
after all then raises the cost of 4.4 without such a flight by 2.3; with 0.99 it would raise it by
4.6."""

BISECTIONS, HALVINGS = 60, 14
"""Steps that find a mean to the last bit, and the logarithm of a share to a thousandth."""

Shares = tuple[float, float, float, float, float, float]
Counts = tuple[int, int, int, int, int, int]


@dataclass(frozen=True)
class Allocation:
    """Strata of draws and the flights in each, fixed before any is drawn.

    Attributes:
        draws: expected number.
        near: margin by the law up to which a verdict is not sure; m in files.
        share: of the draws that are flown, by stratum from what surely fails to what surely holds.
        lean: of the limits of most and of least failures.

    Raises:
        ValueError: if these give no limits.
    """

    draws: float
    near: float
    share: Shares
    lean: tuple[float, float]

    def __post_init__(self) -> None:
        """Check that every factor of e stays positive."""
        share, (most, least) = np.array(self.share), self.lean
        if not (0.0 < self.draws < np.inf and 0.0 <= self.near < np.inf):
            raise ValueError("the number of draws must be positive, and the margin not negative")
        if not (np.all((share > 0.0) & (share <= 1.0)) and min(self.lean) > 0.0):
            raise ValueError("the shares must be positive and at most 1, and the leans positive")
        worth = _failure_weights(share)
        if np.any(1.0 - most * worth <= 0.0) or np.any(1.0 + least * worth <= 0.0):
            raise ValueError("the leans must be below the shares")

    def strata(self, margin: Array) -> Indices:
        """Stratum of each margin."""
        return strata_of(margin, self.near)


@dataclass(frozen=True)
class Counted:
    """Counts of an allocation, by stratum.

    Attributes:
        allocation: that was flown.
        drawn: draws.
        flown: of them.
        unlike: flights that do not end as the law says.

    Raises:
        ValueError: if more are flown than drawn, or unlike than flown.
    """

    allocation: Allocation
    drawn: Counts
    flown: Counts
    unlike: Counts

    def __post_init__(self) -> None:
        """Check that each count is one of those before."""
        counts = np.array([self.drawn, self.flown, self.unlike])
        if np.any(np.diff(counts, axis=0) > 0) or np.any(counts < 0) or not sum(self.drawn):
            raise ValueError("flown must not exceed drawn, and unlike must not exceed flown")

    @property
    def failed(self) -> float:
        """Estimated probability of failing."""
        unlike = np.array(self.unlike) * np.where(FAILS, -1.0, 1.0) / self.allocation.share
        failed = np.sum(np.where(FAILS, self.drawn, 0.0) + unlike) / sum(self.drawn)
        return float(np.clip(failed, 0.0, 1.0))

    @property
    def equivalent(self) -> int:
        """Number of plain flights whose probability of failing has the same standard error."""
        share, n = np.array(self.allocation.share), sum(self.drawn)
        p = np.clip(self.failed, 0.5 / n, 1.0 - 0.5 / n)
        unknown = np.sum(np.array(self.unlike) * (1.0 - share) / share**2) / n
        return max(1, int(n * p * (1.0 - p) / (p * (1.0 - p) + unknown)))

    def limits(self, tail: float) -> tuple[float, float]:
        """Least and most probability of failing, each missed with a probability of `tail` at most."""
        a, unlike = self.allocation, np.array(self.unlike, dtype=float)
        failing = np.array(float(np.sum((np.array(self.drawn) - unlike)[FAILS])))
        share, draws = np.array(a.share), np.array(a.draws)
        least = least_failures(failing, unlike, share, np.array(a.lean[1]), draws, tail)
        most = most_failures(failing, unlike, share, np.array(a.lean[0]), draws, tail)
        return float(np.clip(least, 0.0, 1.0)), float(np.clip(most, 0.0, 1.0))


def failed_at(allocation: Allocation, drawn: Indices, unlike: Indices) -> Array:
    """Estimated probability of failing of many events, from counts by stratum, shape (events, 6)."""
    adds = unlike * np.where(FAILS, -1.0, 1.0) / allocation.share
    return np.asarray(np.sum(np.where(FAILS, drawn, 0.0) + adds, axis=1) / drawn[0].sum())


def most_at(allocation: Allocation, drawn: Indices, unlike: Indices, tail: float) -> Array:
    """Upper limit of failing of many events, each by itself, from counts by stratum, (events, 6)."""
    failing = np.sum((drawn - unlike)[:, FAILS], axis=1).astype(float)
    law, event = np.unique(failing, return_inverse=True)
    share, lean = np.array(allocation.share), np.array(allocation.lean[0])
    none = np.zeros((len(law), COUNT))
    most = most_failures(law, none, share, lean, np.array(allocation.draws), tail)
    log_e = unlike @ np.log1p(-lean * _failure_weights(share))
    return np.asarray(most[event] - log_e / (lean * allocation.draws))


def strata_of(margin: Array, near: float) -> Indices:
    """Stratum of each margin by the law, whose verdict is not sure up to `near`."""
    return np.searchsorted(near * EDGES, margin, side="right")


def _failure_weights(share: Array) -> Array:
    """Addition to the failures of a flown draw that is unlike the law, shape (..., 6)."""
    return np.where(FAILS, 1.0, 0.0) + np.where(FAILS, -1.0, 1.0) / share


def most_failures(
    failing: Array, unlike: Array, share: Array, lean: Array, draws: Array, tail: float
) -> Array:
    """Upper limit of the probability of failing; it may exceed 1.

    The law's part is where its p-value falls as fast as e grows: the hazard of a gamma law is `lean`.

    Args:
        failing: draws that fail by the law and are not flown otherwise, shape (...).
        unlike: flights unlike the law by stratum, shape (..., 6).
        share: of the draws that are flown, shape (..., 6).
        lean: below every share where the law holds.
        draws: expected number.
        tail: probability with which the limit may be missed.
    """
    log_e = np.sum(unlike * np.log1p(-lean[..., None] * _failure_weights(share)), axis=-1)
    low, high = np.zeros_like(failing), failing / (1.0 - lean)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        below = _density(failing + 1.0, middle) < lean * gammaincc(failing + 1.0, middle)
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    with np.errstate(divide="ignore"):
        tails = np.log(gammaincc(failing + 1.0, high)) - np.log(tail)
    return np.asarray((high + (tails - log_e) / lean) / draws)


def least_failures(
    failing: Array, unlike: Array, share: Array, lean: Array, draws: Array, tail: float
) -> Array:
    """Lower limit of the probability of failing, which may be negative.

    As `most_failures`, with the reversed hazard.
    """
    log_e = np.sum(unlike * np.log1p(lean[..., None] * _failure_weights(share)), axis=-1)
    x = np.maximum(failing, 1.0)
    low, high = (x - 1.0) / (1.0 + lean), x + 40.0 * np.sqrt(x) + 100.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        above = _density(x, middle) > lean * gammainc(x, middle)
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    mean = np.where(failing > 0.0, low, 0.0)
    with np.errstate(divide="ignore"):
        tails = np.where(failing > 0.0, np.log(gammainc(x, low)), 0.0) - np.log(tail)
    return np.asarray((mean - (tails - log_e) / lean) / draws)


def _density(shape: Array, at: Array) -> Array:
    """Density of the gamma law with unit scale."""
    return np.asarray(np.exp(xlogy(shape - 1.0, at) - at - gammaln(shape)))


@dataclass(frozen=True)
class Survey:
    """Statistics that are known before draws are allocated.

    Attributes:
        near: margin by the law beyond which no flight should end unlike it, m.
        share: of the draws that fall into each stratum, shape (6,).
        unlike: share of each stratum's flights that end unlike the law, shape (6,).
    """

    near: float
    share: Array
    unlike: Array

    @property
    def failed(self) -> float:
        """Probability of failing."""
        return float(self.share @ np.where(FAILS, 1.0 - self.unlike, self.unlike))


DRAW = 0.02
"""Time of a draw by the law over that of a flight followed to the second."""

TIMES = (3.0, 4.0, 6.0, 8.0, 12.0, 16.0)
"""Draws per plain flight that are tried."""

NEAR = 2.0 ** np.arange(-6, 4)
"""Shares flown of what is not sure that are tried, over the root of its flights unlike the law."""

UNLIKE = 0.01
"""Least share of flights unlike the law that is reckoned with where a verdict is not sure."""


def allocate(
    survey: Survey,
    plain: int,
    width: tuple[float, float],
    tail: float,
    *,
    mirrored: bool = False,
    draw: float = DRAW,
    times: tuple[float, ...] = TIMES,
) -> Allocation | None:
    """The cheapest allocation whose limits are as near to the estimate as expected.

    Args:
        survey: statistics known before the allocation.
        plain: flights that it is to save.
        width: distances of the limits of most and of least failures.
        tail: probability with which either may be missed.
        mirrored: whether the choice of flown draws must not depend on the law's verdict, so that
            strata of one margin have one share.
        draw: time of a draw by the law over that of a flight.
        times: draws per plain flight that are tried.

    Returns:
        The allocation; None if that many plain flights are cheaper.
    """
    q = max(survey.failed, 1.0 / plain)
    draws, near = (part.ravel() for part in np.meshgrid(np.array(times) * plain, NEAR))
    unsure = np.sqrt(np.maximum(survey.unlike[1:-1], UNLIKE))
    if mirrored:
        unsure = np.maximum(unsure, unsure[::-1])
    unsure = np.minimum(near[:, None] * unsure, 1.0)
    most_lean = np.sqrt(-2.0 * np.log(tail) / (draws * q))

    def leans(share: Array) -> Array:
        """Leans limited by one flight of the sure strata, or by normal sampling errors."""
        return np.minimum(LEAN * share, most_lean)

    def widths(fails: Array, holds: Array) -> tuple[Array, Array]:
        """Distances of both limits from the estimate, by the shares flown of the sure strata."""
        share = np.column_stack([fails, unsure, holds])
        unlike = draws[:, None] * survey.share * share * survey.unlike
        failing = draws * survey.share[FAILS].sum() - unlike[:, FAILS].sum(axis=1)
        most = most_failures(failing, unlike, share, leans(holds), draws, tail)
        return most - q, q - least_failures(failing, unlike, share, leans(fails), draws, tail)

    low = np.full((2, len(draws)), -12.0)
    high = np.log(np.stack([unsure.min(axis=1)] * 2))
    fits = np.all(np.array(widths(*np.exp(high))) <= np.array(width)[:, None], axis=0)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        to_most, to_least = widths(*np.exp(middle))
        enough = np.stack([to_least <= width[1], to_most <= width[0]])
        low, high = np.where(enough, low, middle), np.where(enough, middle, high)
    fails, holds = np.exp(high.max(axis=0, keepdims=True).repeat(2, axis=0) if mirrored else high)
    share = np.column_stack([fails, unsure, holds])
    flown = share @ survey.share
    cost = np.where(fits, draws * (draw + flown), np.inf)
    best = int(np.argmin(cost))
    if cost[best] >= plain:
        return None
    lean = float(leans(holds)[best]), float(leans(fails)[best])
    return Allocation(float(draws[best]), survey.near, tuple(share[best].tolist()), lean)
