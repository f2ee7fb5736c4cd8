"""Shortfalls: what flights refute, and what a certificate does not promise."""

from __future__ import annotations

from dataclasses import replace

import pytest

from formulations.rows.exact_flight import FLIGHT
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


@pytest.mark.parametrize(
    ("certified", "by_law", "successes", "named"),
    [
        (ENOUGH, None, ENOUGH, []),
        # Though its estimate is more than what was asked, and other flights refute nothing.
        (ENOUGH - 1, None, ENOUGH - 1, ["certificate"]),
        (None, None, 8_900, [f"P({FLIGHT})"]),
        (ENOUGH, None, 8_900, [f"P({FLIGHT})"]),
        # Half of the flights of a plan that spends what was asked reach a little less.
        (None, None, 8_960, []),
        (None, 0.99, 9_100, ["risk"]),
    ],
)
def test_what_flights_refute_and_no_certificate_promises_is_named(
    exact: Mission,
    solution: Solution,
    certified: int | None,
    by_law: float | None,
    successes: int,
    named: list[str],
) -> None:
    told = promising(solution, certified=certified, by_law=by_law)
    assert shortfalls(exact, told, [flown(successes)]) == named


def test_an_estimate_below_what_was_asked_fails_a_plan_of_uniform_risk(solution: Solution) -> None:
    mission = mission_of(f"risk.p_chance={ASKED}")
    assert shortfalls(mission, solution, [flown(8_999)]) == [f"P({FLIGHT})"]
    assert shortfalls(mission, solution, [flown(9_000)]) == []
