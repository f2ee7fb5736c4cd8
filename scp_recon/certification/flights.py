"""Fly a plan under certification: rounds, which adjust the target, and tests, which judge the plan.

The flights of a test have seeds that no round uses. Their results had no influence on the plan that
they judge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from formulations.arrays import Array
from formulations.risk.strata import Counted, Survey, allocate
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import (
    CONFIDENCE,
    FIRST_SEED,
    TEST_CONFIDENCE,
    Estimate,
    interval_of_test,
    of_strata,
    proportion,
    seed_of_test,
)
from scp_recon.monte_carlo.law import Law, fly_strata, survey
from scp_recon.monte_carlo.law_in_time import fly_in_time, survey_in_time
from scp_recon.monte_carlo.whole_flight import (
    KeptFlights,
    WholeFlights,
    kept_flights,
    seconds_of,
)
from scp_recon.planning.plan import Aimed, Certificate, Plan
from scp_recon.results.policy import Policy, policy_of

TEST_WIDTH, ROUND_WIDTH = 0.97, 1.5
"""Widths of intervals of flights in strata over those of plain flights: a test's is no wider. A round's
does not judge, and its standard error is the smaller one all the same."""

TAIL = 0.5 * (1.0 - TEST_CONFIDENCE)
"""Probability with which either limit of a test may be missed."""

LOST_BETWEEN = 0.05
"""Share of 1 - p that flights may lose between nodes."""


class Watch(Protocol):
    """Observes certification."""

    def __call__(
        self,
        step: str,
        plan: Plan,
        samples: int,
        flown: int = 0,
        reached: Estimate | None = None,
        /,
    ) -> None:
        """Report the number of flights flown in a step, such as "round 2" or "look 1".

        After the last flight the probability reached is reported too.
        """
        ...


class KeptCounts(NamedTuple):
    """Counts of flights that keep the limits of the scope: at the nodes, and at all times.

    Flights in strata count as the number of plain flights with the same standard error.
    """

    at_nodes: float
    throughout: float
    samples: int
    strata: Counted | None = None

    @property
    def reached(self) -> float:
        """Share of the flights that keep the limits at all times."""
        return self.throughout / self.samples

    def are_close(self, asked: float) -> bool:
        """Whether flights lose so little between nodes that no node is missing."""
        return self.at_nodes - self.throughout <= LOST_BETWEEN * (1.0 - asked) * self.samples


def kept_of(mission: Mission, flown: KeptFlights) -> KeptCounts:
    """Counts of flights that keep the limits of the required scope."""
    if mission.scenario.risk.scope == "flight":
        return KeptCounts(flown.whole_at_nodes, flown.whole, flown.samples)
    at_nodes = min(int(counts.min()) for counts in flown.at_nodes.values())
    return KeptCounts(at_nodes, min(flown.throughout.values()), flown.samples)


class Step(NamedTuple):
    """A round or a test: its name, and the number, seed and accuracy of its flights.

    `width` is the width of the interval with flights in strata, relative to plain flights.
    """

    name: str
    samples: int
    seed: int
    width: float
    confidence: float


Fly = Callable[[Aimed, Step], tuple[KeptCounts, Array]]
"""Flies a plan: what flights keep, and the times between nodes at which they touch a limit, s."""


def fly_round(plan: Aimed, fly: Fly[Aimed], samples: int, number: int) -> tuple[KeptCounts, Array]:
    """Fly a round to estimate the probability that a plan reaches."""
    seed = FIRST_SEED + number - 1
    return fly(plan, Step(f"round {number}", samples, seed, ROUND_WIDTH, CONFIDENCE))


def run_test(
    plan: Aimed, fly: Fly[Aimed], samples: int, number: int, rounds: int
) -> tuple[Aimed, KeptCounts, Array]:
    """Judge a plan by independent flights, after a number of rounds.

    Returns:
        The plan with its certificate; and as `Fly`.
    """
    step = Step(f"look {number}", samples, seed_of_test(number), TEST_WIDTH, TEST_CONFIDENCE)
    kept, touched_s = fly(plan, step)
    return replace(plan, certificate=certificate_of(kept, number, rounds)), kept, touched_s


def certificate_of(kept: KeptCounts, test: int, rounds: int) -> Certificate:
    """Result of the flights of a test."""
    reached = reached_of(kept, TEST_CONFIDENCE)
    return Certificate(
        flown_of(kept),
        seed_of_test(test),
        *reached,
        at_nodes=max(reached.value, kept.at_nodes / kept.samples),  # but for rounding it is
        rounds=rounds,
        looks=test,
        confidence=TEST_CONFIDENCE,
        strata=kept.strata,
    )


def flown_of(kept: KeptCounts) -> int:
    """Number of flights that were flown."""
    return kept.samples if kept.strata is None else sum(kept.strata.flown)


def reached_of(kept: KeptCounts, confidence: float) -> Estimate:
    """Probability that flights reach, with its exact interval."""
    if kept.strata is None:
        return proportion(int(kept.throughout), kept.samples, confidence)
    return of_strata(kept.strata, confidence)


def with_nodes_at(mission: Mission, times_s: Array) -> Mission:
    """The mission with a new node in each arc with violations, where most flights violate a limit."""
    arcs = np.searchsorted(mission.times_s, times_s)
    new = {float(round(float(np.median(times_s[arcs == arc])))) for arc in np.unique(arcs)}
    nodes = sorted({*mission.scenario.grid.nodes_s} | (new - set(mission.times_s.tolist())))
    return mission.changed({"grid.nodes_s": nodes})


def fly_plan(watch: Watch | None, plan: Plan, step: Step) -> tuple[KeptCounts, Array]:
    """Fly a mission's plan: see `Fly`."""
    if watch is None:
        return _fly(plan, step, None)
    watch(step.name, plan, step.samples)
    kept, touched_s = _fly(plan, step, partial(watch, step.name, plan))
    flown = flown_of(kept)
    watch(step.name, plan, flown, flown, reached_of(kept, step.confidence))
    return kept, touched_s


def _fly(
    plan: Plan, step: Step, told: Callable[[int, int], None] | None
) -> tuple[KeptCounts, Array]:
    risk, samples, seed = plan.mission.scenario.risk, step.samples, step.seed
    if risk.sampling == "strata":
        by_strata = _fly_strata if risk.scope == "flight" else _fly_in_time
        found = by_strata(plan, samples, seed, step.width, told)
        if found is not None:
            return found
    seen = partial(told, samples) if told else None
    flown = kept_flights(plan.mission, plan.burns_m_s, samples, seed, seen, _policy(plan))
    return kept_of(plan.mission, flown), flown.touched_s


def _fly_strata(
    plan: Plan, samples: int, seed: int, width: float, seen: Callable[[int, int], None] | None
) -> tuple[KeptCounts, Array] | None:
    """Fly in strata of the law's margin; None if as many plain flights are quicker."""
    law = Law.of(plan.final.result.lin, plan.mission.units.length_m)
    flights = WholeFlights(plan.mission, plan.burns_m_s, _policy(plan))
    known = survey(law, flights, seed)
    allocation = allocate(known, samples, _widths(known, samples, width), TAIL)
    if allocation is None:
        return None
    flown = fly_strata(law, flights, allocation, seed, seen)
    return _kept(flown.whole, flown.at_nodes), flown.touched_s


def _fly_in_time(
    plan: Plan, samples: int, seed: int, width: float, seen: Callable[[int, int], None] | None
) -> tuple[KeptCounts, Array] | None:
    """Fly in strata for limits that count at each second separately."""
    mission = plan.mission
    laws = Law.of_events(plan.final.result.lin, mission.units.length_m)
    if not laws:  # no limit is within reach
        return None
    flights = WholeFlights(mission, plan.burns_m_s, _policy(plan))
    law, known = survey_in_time(laws, mission.times_s, flights, seed)
    widths = _widths(known, samples, width)
    allocation = allocate(known, samples, widths, TAIL, mirrored=True)
    if allocation is None:
        return None
    flown = fly_in_time(law, flights, seconds_of(mission), allocation, seed, TAIL, seen)
    return _kept(flown.throughout, flown.at_nodes), flown.touched_s


def _widths(known: Survey, samples: int, width: float) -> tuple[float, float]:
    """Distances of the interval's ends from the estimate for plain flights, times `width`."""
    reached = interval_of_test(round((1.0 - known.failed) * samples), samples)
    return width * (reached.value - reached.low), width * (reached.high - reached.value)


def _kept(throughout: Counted, at_nodes: Counted) -> KeptCounts:
    """Counts of flights in strata, as plain flights with the same standard error."""
    worth, reached = throughout.equivalent, 1.0 - throughout.failed
    return KeptCounts(
        max(1.0 - at_nodes.failed, reached) * worth, reached * worth, worth, throughout
    )


def _policy(plan: Plan) -> Policy:
    return policy_of(plan.mission, plan.final.result.lin)
