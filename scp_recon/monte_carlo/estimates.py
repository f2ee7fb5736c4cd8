"""Estimate probabilities, means and quantiles with intervals, and the number of flights needed."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import bdtr, bdtrik, betaincinv, stdtrit

from formulations.arrays import Array
from formulations.risk.strata import Counted
from scp_recon.errors import InputError, option

CONFIDENCE = 0.95

FLIGHTS_MIN, FAILURES, FLIGHTS_MAX = 10_000, 300, 1_000_000
"""Least number of flights of a round; number of allowed failures in a round, 300; largest number of
flights."""

FIRST_SEED, FIRST_TEST_SEED = 1_000, 2_000
"""Seeds of the flights of the first round and of the first test. Later rounds and tests have the
next seeds. No other draws of this library begin at these seeds."""

TESTS_MAX = 2
"""Tests, the last of which certifies a plan or none."""

TEST_CONFIDENCE = 0.975
"""Confidence of a test's interval. Each of its ends alone has 98.75 %: a plan whose probability is just
what was required passes one test at most 1.25 times in 100, and one of two at most 2.5 times."""

TEST_SIZE = 2
"""Flights of a test over those of a round. The surplus of a plan comes mainly from the error of the
test: plans reach 3.4 standard errors of a round more than required, and 4.4 if a test has as many
flights as a round."""


class Estimate(NamedTuple):
    """A value and the ends of its confidence interval.

    Attributes:
        value: the estimate.
        low: lower end.
        high: upper end.
    """

    value: float
    low: float
    high: float

    @property
    def width(self) -> float:
        """Width of the interval."""
        return self.high - self.low


def proportion(successes: int, samples: int, confidence: float = CONFIDENCE) -> Estimate:
    """Probability with its Clopper-Pearson interval."""
    k, n, tail = successes, samples, 0.5 * (1.0 - confidence)
    low = float(betaincinv(k, n - k + 1, tail)) if k > 0 else 0.0
    high = float(betaincinv(k + 1, n - k, 1.0 - tail)) if k < n else 1.0
    return Estimate(k / n, low, high)


def binomial_quantile(level: float, samples: int, probability: float) -> int:
    """Least number of successes that is not exceeded with a probability of `level`.

    As `scipy.stats.binom.ppf`, which takes half a second to import.
    """
    most = int(np.ceil(bdtrik(level, samples, probability)))
    return most - int(most > 0 and bdtr(most - 1, samples, probability) >= level)


def of_strata(counted: Counted, confidence: float) -> Estimate:
    """Probability that flights in strata keep the limits, with its exact interval."""
    least, most = counted.limits(0.5 * (1.0 - confidence))
    return Estimate(1.0 - counted.failed, 1.0 - most, 1.0 - least)


@dataclass(frozen=True)
class Tally:
    """A sample of one quantity, kept as a histogram and the means of batches with their sizes.

    The b bins have ascending edges, shape (b + 1,); values beyond them fall into the outer bins.
    """

    edges: Array
    counts: npt.NDArray[np.int64]
    batch_means: tuple[float, ...] = ()
    batch_sizes: tuple[int, ...] = ()

    @classmethod
    def empty(cls, low: float, high: float, resolution: float) -> Tally:
        """A tally without values, with bins of `resolution` from `low` to `high`."""
        bins = max(1, int(np.ceil((high - low) / resolution)))
        return cls(np.linspace(low, high, bins + 1), np.zeros(bins, dtype=np.int64))

    def add(self, values: Array) -> Tally:
        """The tally with one more batch of values."""
        inside = np.clip(values, self.edges[0], self.edges[-1])
        return Tally(
            self.edges,
            self.counts + np.histogram(inside, self.edges)[0],
            (*self.batch_means, float(values.mean())),
            (*self.batch_sizes, len(values)),
        )

    @property
    def samples(self) -> int:
        """Number of values."""
        return sum(self.batch_sizes)

    def mean(self) -> Estimate:
        """Mean with Student's interval over the batch means; infinite with a single batch."""
        weights = np.array(self.batch_sizes, dtype=float)
        means = np.array(self.batch_means)
        value = float(np.average(means, weights=weights))
        n = len(means)
        if n < 2:
            return Estimate(value, -np.inf, np.inf)
        variance = float(np.average((means - value) ** 2, weights=weights)) / (n - 1)
        half = float(stdtrit(n - 1, 0.5 + 0.5 * CONFIDENCE)) * np.sqrt(variance)
        return Estimate(value, value - half, value + half)

    def quantile(self, probability: float) -> Estimate:
        """Quantile with the distribution-free interval between two order statistics.

        The number of values below the true quantile is binomial, whatever the distribution.
        """
        n = self.samples
        tail = 0.5 * (1.0 - CONFIDENCE)
        ranks = (
            probability * n,
            float(binomial_quantile(tail, n, probability)),
            float(binomial_quantile(1.0 - tail, n, probability)) + 1.0,
        )
        cumulative = np.concatenate([[0.0], np.cumsum(self.counts)])
        value, low, high = (self._at_rank(min(rank, n), cumulative) for rank in ranks)
        return Estimate(value, low, high)

    def _at_rank(self, rank: float, cumulative: Array) -> float:
        """Value at which the cumulative count reaches a rank, interpolated linearly in its bin."""
        at = int(np.searchsorted(cumulative, max(rank, 1.0), side="left"))
        inside = (rank - cumulative[at - 1]) / (cumulative[at] - cumulative[at - 1])
        width = self.edges[at] - self.edges[at - 1]
        return float(self.edges[at - 1] + np.clip(inside, 0.0, 1.0) * width)


def flights_needed(required: float) -> int:
    """Number of flights of a round: enough failures to choose the next target.

    Raises:
        InputError: if it exceeds `FLIGHTS_MAX`.
    """
    rounding = 1e-6  # of 1 - required, in flights
    flights = int(np.ceil(max(FLIGHTS_MIN, FAILURES / (1.0 - required) - rounding)))
    if flights > FLIGHTS_MAX:
        raise InputError(
            "risk.p_chance",
            f"{required:.12g}",
            f"takes {flights} flights to certify, more than {FLIGHTS_MAX}: at most "
            f"{1.0 - FAILURES / FLIGHTS_MAX:g}, or {option('certify', False)}",
        )
    return flights


def flights_of_test(required: float) -> int:
    """Flights of a test that judges whether a probability is reached.

    Raises:
        InputError: if they are too many.
    """
    return TEST_SIZE * flights_needed(required)


def seed_of_test(number: int) -> int:
    """Seed of the flights of a test, counted from one; no round uses it."""
    return FIRST_TEST_SEED + number - 1


def successes_needed(required: float, samples: int) -> int:
    """Least number of successes with which a test passes: its lower limit is at least `required`."""
    least = int(required * samples)

    def passes(successes: int) -> bool:
        return proportion(successes, samples, TEST_CONFIDENCE).low >= required

    return least + bisect_left(range(least, samples), True, key=passes)
