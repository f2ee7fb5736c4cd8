"""What flights refute, and what a certificate does not promise, is named."""

from __future__ import annotations

from dataclasses import replace

import pytest

from formulations.rows.exact import FLIGHT
from scp_recon.certification.flights import Kept, certificate_of
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import proportion, successes_needed
from scp_recon.results.facts import EventProbability, JointProbability, Risk
from scp_recon.results.solution import Solution
from scp_recon.verification.probabilities import shortfalls
from tests.scp_recon.support import mission_of

ASKED, SAMPLES = 0.9, 10_000


@pytest.fixture(scope="module")
def exact() -> Mission:
    return mission_of("risk.allocation=exact", "risk.scope=flight", f"risk.p_chance={ASKED}")


def flown(successes: int) -> JointProbability:
    """What the verification's own flights reach."""
    value, low, high = proportion(successes, SAMPLES)
    return JointProbability(name=FLIGHT, worst_t_s=0.0, estimate=value, low=low, high=high)


def promising(
    solution: Solution, *, certified: int | None, by_law: float | None = None
) -> Solution:
    """A plan whose certificate has so many successes, or none; told by the law as asked."""
    reached = None
    if certified is not None:
        reached = certificate_of(Kept(certified, certified, SAMPLES), 1, 1)
    law = EventProbability(name=FLIGHT, t_s=[0.0], probability=[by_law or ASKED])
    risk = Risk(scope="flight", required=ASKED, target=ASKED, certificate=reached, normal_law=[law])
    return replace(solution, risk=risk)


ENOUGH = successes_needed(ASKED, SAMPLES)
"""Successes whose lower limit is what was asked."""


def test_a_certificate_that_reaches_what_was_asked_is_none(
    exact: Mission, solution: Solution
) -> None:
    assert shortfalls(exact, promising(solution, certified=ENOUGH), [flown(ENOUGH)]) == []


def test_a_certificate_that_falls_one_flight_short_is_named(
    exact: Mission, solution: Solution
) -> None:
    """Though its estimate is more than what was asked, and other flights refute nothing."""
    short = promising(solution, certified=ENOUGH - 1)
    assert shortfalls(exact, short, [flown(ENOUGH - 1)]) == ["certificate"]


@pytest.mark.parametrize("certified", [None, ENOUGH])
def test_flights_that_refute_it_name_the_probability(
    exact: Mission, solution: Solution, certified: int | None
) -> None:
    found = shortfalls(exact, promising(solution, certified=certified), [flown(8_900)])
    assert f"P({FLIGHT})" in found


def test_what_flights_do_not_refute_stands_without_a_certificate(
    exact: Mission, solution: Solution
) -> None:
    """Half of the flights of a plan that spends what was asked reach a little less."""
    assert shortfalls(exact, promising(solution, certified=None), [flown(8_960)]) == []


def test_a_law_that_is_far_from_the_flights_is_named(exact: Mission, solution: Solution) -> None:
    told = promising(solution, certified=None, by_law=0.99)
    assert shortfalls(exact, told, [flown(9_100)]) == ["risk"]


def test_an_estimate_below_what_was_asked_fails_a_plan_of_uniform_risk(solution: Solution) -> None:
    mission = mission_of(f"risk.p_chance={ASKED}")
    assert shortfalls(mission, solution, [flown(8_999)]) == [f"P({FLIGHT})"]
    assert shortfalls(mission, solution, [flown(9_000)]) == []
