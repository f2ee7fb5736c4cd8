"""Limits of flights in strata, held to the Poisson law of their counts: no luck is in it."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from scipy.special import gammainc, gammaincc
from scipy.stats import poisson

from formulations.arrays import Array
from formulations.risk.strata import (
    COUNT,
    FAILS,
    Allocation,
    Counted,
    Survey,
    allocate,
    failed_at,
    least_failures,
    most_at,
    most_failures,
)
from scp_recon.certification.flights import TEST_WIDTH
from scp_recon.monte_carlo.estimates import TEST_CONFIDENCE, flights_of_test, proportion
from tests.helpers import usually

TAIL = 0.5 * (1.0 - TEST_CONFIDENCE)
REQUIRED = [0.7, 0.9, 0.99, 0.999]
NEAR = {0.7: 0.12, 0.9: 0.059, 0.99: 0.0186, 0.999: 0.005}
"""Draws whose verdict is not sure, about as many as surveys of the default scenario found."""
UNLIKE = np.array([0.0, 0.0, 0.1, 0.25, 0.03, 0.0])
"""Flights of each stratum that end unlike the law."""
FAR = 8.0
"""Standard deviations about a mean within which all counts are tried."""


def survey_of(required: float) -> Survey:
    near, q = NEAR[required], 1.0 - required
    share = near * np.array([0.0, 0.25, 0.15, 0.2, 0.4, 0.0])
    share[0], share[-1] = max(q - share[:3].sum(), 0.0), 1.0 - q - share[3:].sum()
    return Survey(10.0, share / share.sum(), UNLIKE)


def plain_widths(required: float) -> tuple[float, float]:
    """Distances of the limits of as many plain flights as a look has."""
    n = flights_of_test(required)
    successes = round(n * (1.0 - survey_of(required).failed))
    reached = proportion(successes, n, TEST_CONFIDENCE)
    return reached.value - reached.low, reached.high - reached.value


def allocation_of(required: float, *, mirrored: bool = False) -> Allocation:
    below, above = plain_widths(required)
    widths = TEST_WIDTH * below, TEST_WIDTH * above
    known, n = survey_of(required), flights_of_test(required)
    found = allocate(known, n, widths, TAIL, mirrored=mirrored)
    assert found is not None
    return found


def missed(a: Allocation, share: Array, unlike: Array, *, most: bool) -> float:
    """Probability that a limit misses what flights do, over all counts that may come."""
    worth = np.where(FAILS, 1.0, 0.0) + np.where(FAILS, -1.0, 1.0) / np.array(a.share)
    truth = float(share @ np.where(FAILS, 1.0 - unlike, unlike))
    mean_unlike = a.draws * share * np.array(a.share) * unlike
    mean = a.draws * float(share[FAILS].sum()) - float(mean_unlike[FAILS].sum())
    lean = a.lean[0] if most else a.lean[1]
    first, last = mean - FAR * np.sqrt(mean), mean + FAR * np.sqrt(mean) + FAR**2
    x = np.floor(np.arange(max(0.0, first), last))
    limit = most_failures if most else least_failures
    zeros, many = np.zeros((len(x), COUNT)), np.tile(a.share, (len(x), 1))
    without = limit(x, zeros, many, np.full(len(x), lean), np.full(len(x), a.draws), TAIL)
    sizes = [np.arange(int(m + FAR * np.sqrt(m) + 3 * (m > 0.0)) + 1) for m in mean_unlike]
    total = 0.0
    for counts in itertools.product(*sizes):
        chance = float(np.prod(poisson.pmf(counts, mean_unlike)))
        if chance < 1e-9:
            total += chance  # as if missed
            continue
        sign = -1.0 if most else 1.0
        moved = without + sign * np.sum(np.log1p(sign * lean * worth) * counts) / (lean * a.draws)
        wrong = moved < truth if most else moved > truth
        total += chance * float(poisson.pmf(x, mean).sum(where=wrong))
    return total


LAWS = ["right", "blind in four flights", "blind where sure", "blind near", "nothing fails"]


def flights_like(a: Allocation, law: str, required: float) -> tuple[Array, Array]:
    """Strata's shares, and flights unlike the law: just what is required is reached."""
    share, unlike, q = survey_of(required).share.copy(), np.zeros(COUNT), 1.0 - required
    if law == "right":
        return share, unlike
    if law == "blind near":
        unlike[3] = 0.2
        lost = unlike[3] * share[3]
    else:
        four = 4.0 / (a.draws * a.share[-1])
        lost = {"blind in four flights": four, "blind where sure": 0.5 * q}.get(law, q)
    share[1:3] = 0.0
    share[0] = q - lost
    share[-1] = 1.0 - share[:-1].sum()
    if law != "blind near":
        unlike[-1] = lost / share[-1]
    return share, unlike


@pytest.mark.slow
@pytest.mark.parametrize("law", usually(LAWS, 2))
@pytest.mark.parametrize(
    ("required", "mirrored"), [*((p, False) for p in REQUIRED), (0.9, True), (0.99, True)]
)
def test_no_limit_is_missed_above_its_bound(required, mirrored, law):
    """However wrong the law is, of flights that reach just what is required."""
    a = allocation_of(required, mirrored=mirrored)
    assert not mirrored or a.share == a.share[::-1]
    share, unlike = flights_like(a, law, required)
    too_sure = missed(a, share, unlike, most=True)
    assert too_sure <= TAIL
    assert missed(a, share, unlike, most=False) <= TAIL
    if law == "blind in four flights":  # the worst: little is given away
        assert too_sure > 0.55 * TAIL


@given(st.integers(1, 500), st.floats(0.02, 0.5))
def test_laws_part_is_the_worst_of_all(failing, lean):
    """Of means of the failures, told by SciPy's search: a limit has to hold for each of them."""
    none, one, ends = np.zeros(COUNT), np.ones(COUNT), (0.0, failing + 50.0 * np.sqrt(failing))
    of = np.array(float(failing)), none, one, np.array(lean), np.array(1.0), TAIL

    def above(mean: float) -> float:
        return -(mean + (np.log(gammaincc(failing + 1.0, mean)) - np.log(TAIL)) / lean)

    def below(mean: float) -> float:
        return mean - (np.log(gammainc(failing, mean)) - np.log(TAIL)) / lean

    for limit, side, sign in ((most_failures, above, -1.0), (least_failures, below, 1.0)):
        worst = minimize_scalar(side, bounds=ends, method="bounded", options={"xatol": 1e-8})
        assert limit(*of) == pytest.approx(sign * worst.fun, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("required", REQUIRED)
def test_stratified_test_needs_a_tenth_of_flights(required):
    """With flights as a survey expects them."""
    a, known, n = allocation_of(required), survey_of(required), flights_of_test(required)
    drawn = a.draws * known.share
    flown = drawn * np.array(a.share)
    assert flown.sum() <= 0.1 * n
    counts = (tuple(np.rint(part).astype(int).tolist()) for part in (flown, flown * known.unlike))
    counted = Counted(a, tuple(np.rint(drawn).astype(int).tolist()), *counts)  # type: ignore[arg-type]
    assert counted.failed == pytest.approx(known.failed, rel=0.01)
    assert counted.equivalent > n
    least, most = counted.limits(TAIL)
    below, above = plain_widths(required)
    assert most - counted.failed <= below
    assert counted.failed - least <= above


def test_a_law_that_tells_nothing_leaves_plain_flights():
    share = np.array([0.0, 0.0, 0.1, 0.9, 0.0, 0.0])
    unknown = Survey(1e3, share, np.array([0.0, 0.0, 0.9, 0.1, 0.0, 0.0]))
    assert allocate(unknown, 20_000, plain_widths(0.9), TAIL) is None


NONE = (0, 0, 0, 0, 0, 0)
FAIR = Allocation(1e4, 5.0, (0.1, 0.5, 0.6, 0.6, 0.5, 0.1), (0.09, 0.1))


@pytest.mark.parametrize(
    "changes",
    [
        {"draws": 0.0},
        {"draws": np.inf},
        {"near": -1.0},
        {"share": (0.1, 0.5, 0.5, 0.5, 0.5, 0.0)},
        {"share": (0.1, 0.5, 0.5, 1.1, 0.5, 0.1)},
        {"lean": (0.1, 0.1)},
        {"lean": (0.09, 0.2)},
        {"lean": (0.0, 0.1)},
    ],
    ids=str,
)
def test_an_allocation_that_gives_no_limits_is_refused(changes):
    with pytest.raises(ValueError, match="must be"):
        replace(FAIR, **changes)


@pytest.mark.parametrize(
    "counts",
    [
        ((0, 0, 0, 0, 0, 10), (0, 0, 0, 0, 0, 11), NONE),
        ((0, 0, 0, 0, 0, 10), (0, 0, 0, 0, 0, 5), (0, 0, 0, 0, 0, 6)),
        ((0, 0, 0, 0, 0, 10), (0, 0, 0, 0, 0, 5), (0, 0, 0, 0, 0, -1)),
        (NONE, NONE, NONE),
    ],
)
def test_counts_that_do_not_fit_are_refused(counts):
    with pytest.raises(ValueError, match="must not exceed"):
        Counted(FAIR, *counts)


def test_of_many_events_each_has_its_own_limit():
    rng = np.random.default_rng(5)
    drawn = np.tile([900, 40, 60, 500, 700, 7_800], (30, 1))
    drawn[:, [0, -1]] += np.outer(rng.integers(0, 30, 30), [1, -1])
    unlike = rng.integers(0, 9, (30, COUNT))
    most, failed = most_at(FAIR, drawn, unlike, TAIL), failed_at(FAIR, drawn, unlike)
    for event in range(30):
        own = (tuple(part[event].tolist()) for part in (drawn, drawn, unlike))
        counted = Counted(FAIR, *own)  # type: ignore[arg-type]
        assert most[event] == pytest.approx(counted.limits(TAIL)[1], rel=1e-12)
        assert failed[event] == pytest.approx(counted.failed, rel=1e-12)
