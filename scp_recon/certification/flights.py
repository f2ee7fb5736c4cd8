"""Fly a plan under certification: rounds, which adjust the target, and tests, which judge the plan.

The flights of a test have seeds that no round uses. Their results had no influence on the plan that
they judge.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from formulations.arrays import Array
from formulations.risk.strata import Counted, allocate
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import (
    CONFIDENCE,
    FIRST_SEED,
    TEST_CONFIDENCE,
    Estimate,
    of_strata,
    proportion,
    seed_of_test,
)
from scp_recon.monte_carlo.strata import DrawsInStrata, Law, fly_strata, surveyed
from scp_recon.monte_carlo.whole_flight import KeptCounts, SampledFlights, kept_flights
from scp_recon.planning.plan import Aimed, Plan
from scp_recon.planning.records import Certificate
from scp_recon.results.policy import policy_of

ROUNDS_MAX = 6
"""Rounds of flights of one certification."""
TEST_WIDTH, ROUND_WIDTH = 0.97, 1.5
"""Widths of intervals of flights in strata over those of plain flights: a test's is no wider. A round's
does not judge, and its standard error is the smaller one all the same."""

TAIL = 0.5 * (1.0 - TEST_CONFIDENCE)
"""Probability with which either limit of a test may be missed."""

LOST_BETWEEN = 0.05
"""Share of 1 - p that flights may lose between nodes."""


Watch = Callable[[str, Plan, int, int, Estimate | None], None]
"""Observes certification: a step such as "calibration 2" or "test 1", its plan, the number of flights,
those flown so far, and after the last of them the probability reached."""


def reached_of(kept: KeptCounts, confidence: float) -> Estimate:
    """Probability that flights reach, with its exact interval."""
    if kept.strata is None:
        return proportion(int(kept.throughout), kept.samples, confidence)
    return of_strata(kept.strata, confidence)


def flown_of(kept: KeptCounts) -> int:
    """Number of flights that were flown."""
    return kept.samples if kept.strata is None else sum(kept.strata.flown)


def unlike_beyond(counted: Sequence[Counted]) -> tuple[float, float]:
    """Shares of the sure strata's flights that ended unlike the law."""
    fails, holds = (
        sum(one.unlike[end] for one in counted) / max(sum(one.flown[end] for one in counted), 1)
        for end in (0, -1)
    )
    return fails, holds


def are_close(kept: KeptCounts, required: float) -> bool:
    """Whether flights lose so little between nodes that no node is missing."""
    return kept.at_nodes - kept.throughout <= LOST_BETWEEN * (1.0 - required) * kept.samples


class Step(NamedTuple):
    """A calibration or a test: its name, and the number, seed and accuracy of its flights.

    `width` is the width of the interval with flights in strata, relative to plain flights. `unlike`
    are the shares of the sure strata's flights that end unlike the law, as earlier flights found.
    """

    name: str
    samples: int
    seed: int
    width: float
    confidence: float
    unlike: tuple[float, float] = (0.0, 0.0)


Fly = Callable[[Aimed, Step], KeptCounts]
"""Flies a plan for a step."""


def fly_round(plan: Aimed, fly: Fly[Aimed], samples: int, number: int) -> KeptCounts:
    """Fly a round to estimate the probability that a plan reaches."""
    seed = FIRST_SEED + number - 1
    return fly(plan, Step(f"calibration {number}", samples, seed, ROUND_WIDTH, CONFIDENCE))


def run_test(
    plan: Aimed,
    fly: Fly[Aimed],
    samples: int,
    number: int,
    rounds: int,
    unlike: tuple[float, float] = (0.0, 0.0),
) -> tuple[Aimed, KeptCounts]:
    """Judge a plan by independent flights, after a number of rounds: the plan with its certificate.

    `unlike` is as of `Step`.
    """
    seed = seed_of_test(number)
    step = Step(f"test {number}", samples, seed, TEST_WIDTH, TEST_CONFIDENCE, unlike)
    kept = fly(plan, step)
    return replace(plan, certificate=certificate_of(kept, number, rounds)), kept


def certificate_of(kept: KeptCounts, test: int, rounds: int) -> Certificate:
    """Result of the flights of a test."""
    reached = reached_of(kept, TEST_CONFIDENCE)
    return Certificate(
        flown_of(kept),
        seed_of_test(test),
        *reached,
        at_nodes=max(reached.value, kept.at_nodes / kept.samples),  # but for rounding it is
        rounds=rounds,
        tests=test,
        confidence=TEST_CONFIDENCE,
        strata=kept.strata,
    )


def with_nodes_at(mission: Mission, times_s: Array) -> Mission:
    """The mission with a new node in each arc with violations, where most flights violate a limit."""
    arcs = np.searchsorted(mission.times_s, times_s)
    new = {float(round(float(np.median(times_s[arcs == arc])))) for arc in np.unique(arcs)}
    nodes = sorted({*mission.scenario.grid.nodes_s} | (new - set(mission.times_s.tolist())))
    return mission.changed({"grid.nodes_s": nodes})


def fly_plan(watch: Watch | None, plan: Plan, step: Step) -> KeptCounts:
    """Fly a mission's plan: see `Fly`."""

    def told(samples: int, flown: int = 0) -> None:
        if watch is not None:
            watch(step.name, plan, samples, flown, None)

    told(step.samples)
    policy = policy_of(plan.mission, plan.final.result.lin)
    flights = SampledFlights(plan.mission, plan.burns_m_s, policy, seed=step.seed)
    kept = None
    if plan.mission.scenario.risk.sampling == "strata":
        kept = _fly_in_strata(flights, plan, step, told)
    if kept is None:
        kept = kept_flights(flights, step.samples, partial(told, step.samples))
    if watch is not None:
        flown = flown_of(kept)
        watch(step.name, plan, flown, flown, reached_of(kept, step.confidence))
    return kept


def _fly_in_strata(
    flights: SampledFlights, plan: Plan, step: Step, told: Callable[[int, int], None]
) -> KeptCounts | None:
    """What flights in strata of the law's margin keep.

    None if as many plain flights are quicker, if all are the same, or if no limit that counts
    separately is within reach.
    """
    law = Law.of(flights.mission, plan.final.result.lin, is_whole=flights.is_whole)
    if flights.certain or not law.limits:
        return None
    law, survey = surveyed(law, flights)
    successes = round((1.0 - survey.failed) * step.samples)
    reached = proportion(successes, step.samples, TEST_CONFIDENCE)
    widths = step.width * (reached.value - reached.low), step.width * (reached.high - reached.value)
    survey = replace(survey, unlike=np.r_[step.unlike[0], survey.unlike[1:-1], step.unlike[1]])
    allocation = allocate(survey, step.samples, widths, TAIL, mirrored=not flights.is_whole)
    if allocation is None:
        return None
    expected = allocation.draws * float(np.dot(allocation.share, survey.share))

    def report(share: float) -> None:
        told(round(expected), round(share * expected))

    return fly_strata(DrawsInStrata(law, flights, allocation), TAIL, report)
