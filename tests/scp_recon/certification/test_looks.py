"""The rule by which looks certify, held to the binomial law: no luck is in it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from scp_recon.certification import flights
from scp_recon.certification.flights import Kept, certificate_of
from scp_recon.monte_carlo import estimates
from scp_recon.monte_carlo.estimates import (
    FIRST_SEED,
    LOOKS_MAX,
    look_flights,
    look_seed,
    successes_needed,
)

WRONGLY = 0.025
"""Most often that a plan may be certified which reaches just what was required."""
TAIL = 8.0
"""Standard deviations about the mean within which all numbers of successes are tried."""


def certified(kept: int, samples: int, required: float) -> bool:
    """Whether a look with so many successes certifies a plan, as the code decides it."""
    return certificate_of(Kept(kept, kept, samples), 1, 1).certifies(required)


def passing(required: float, truth: float) -> float:
    """Probability that a look passes a plan, over every number of successes that may come."""
    n = look_flights(required)
    middle, width = n * truth, TAIL * np.sqrt(n * truth * (1.0 - truth))
    counts = range(int(middle - width), min(int(middle + width), n) + 1)
    verdicts = np.array([certified(k, n, required) for k in counts])
    assert not verdicts[0]
    assert verdicts[-1]
    return float(np.sum(binom.pmf(counts, n, truth), where=verdicts))


def wrongly_certified(required: float) -> float:
    """Probability that one of all looks passes, each at a plan that reaches just what is required."""
    return 1.0 - (1.0 - passing(required, required)) ** LOOKS_MAX


@pytest.mark.parametrize("required", [0.7, 0.9, 0.99, 0.999])
def test_a_plan_that_reaches_just_what_is_required_is_hardly_ever_certified(
    required: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At most 2.5 times in 100, both looks together; with 97.5 % each, as of a single look, more."""
    assert 0.8 * WRONGLY < wrongly_certified(required) <= WRONGLY
    monkeypatch.setattr(flights, "LOOK_CONFIDENCE", estimates.CONFIDENCE)
    assert wrongly_certified(required) > 1.5 * WRONGLY


@pytest.mark.parametrize("required", [0.7, 0.99])
def test_a_look_passes_with_the_successes_that_are_aimed_at_and_no_fewer(required: float) -> None:
    n = look_flights(required)
    needed = successes_needed(required, n)
    assert certified(needed, n, required)
    assert not certified(needed - 1, n, required)


def test_no_look_has_the_seed_of_a_round() -> None:
    rounds = {FIRST_SEED + number for number in range(100)}
    assert rounds.isdisjoint(look_seed(number) for number in range(1, LOOKS_MAX + 1))
