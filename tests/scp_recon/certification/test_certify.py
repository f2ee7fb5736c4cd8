"""A certified plan's promise is what flights reach that planning has not seen."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr, ndtri

from formulations.rows.exact import FLIGHT
from scp_recon.certification.certify import certify, judged, with_nodes_at
from scp_recon.monte_carlo import estimates
from scp_recon.monte_carlo.estimates import FIRST_SEED, proportion, successes_needed
from scp_recon.monte_carlo.whole_flight import kept_flights
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.results.facts import Verification
from scp_recon.results.solution import Solution, make_solution
from scp_recon.verification.consistency import inconsistencies
from scp_recon.verification.probabilities import shortfalls
from scp_recon.verification.reintegration import verify
from tests.scp_recon.certification.support import mission_of

ASKED = 0.9


@pytest.fixture(scope="module", autouse=True)
def fewer() -> Iterator[None]:
    """A tenth of the flights."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(estimates, "FLIGHTS_MIN", 1_000)
        patch.setattr(estimates, "FAILURES", 50)
        yield


@pytest.fixture(scope="module", params=["node", "flight"])
def certified(request: pytest.FixtureRequest) -> Plan:
    mission = mission_of(request.param, ASKED)
    return certify(
        mission, initial_guess.cold(mission), lambda m, s, target: plan(m, s, target=target)
    )


@given(asked=st.floats(0.5, 0.999), samples=st.integers(1000, 100_000))
def test_so_many_successes_and_no_fewer_reach_what_is_asked(asked: float, samples: int) -> None:
    needed = successes_needed(asked, samples)
    if needed < samples:
        assert proportion(needed, samples).low >= asked
    assert proportion(needed - 1, samples).low < asked


def test_the_lower_limit_is_what_was_asked(certified: Plan) -> None:
    reached = certified.certificate
    assert reached is not None
    assert certified.target is not None
    assert reached.low >= ASKED
    assert certified.target > ASKED
    assert reached.seed == FIRST_SEED + reached.rounds - 1
    again = kept_flights(certified.mission, certified.burns_m_s, reached.samples, reached.seed)
    assert judged(certified.mission, again)[1] == (reached.reached, reached.low, reached.high)


def test_other_flights_bear_it_out(certified: Plan) -> None:
    kept = kept_flights(certified.mission, certified.burns_m_s, 1_000, seed=77)
    assert judged(certified.mission, kept)[1].high >= ASKED


@pytest.fixture(scope="module")
def solution(certified: Plan) -> Solution:
    return make_solution(certified)


@pytest.fixture(scope="module")
def checked(certified: Plan, solution: Solution) -> Verification:
    return verify(certified.mission, solution)


def test_the_solution_says_so_and_is_verified(
    certified: Plan, solution: Solution, checked: Verification
) -> None:
    assert solution.risk is not None
    assert solution.risk.certificate is not None
    assert (solution.risk.required, solution.risk.target) == (ASKED, certified.target)
    assert checked.ok, checked.failed
    names = {p.name for p in checked.probabilities}
    assert (FLIGHT in names) == (solution.risk.scope == "flight")


def failures(certified: Plan, told: Solution, checked: Verification) -> list[str]:
    """What verification names, with the flights that it has flown already."""
    mission = certified.mission
    return inconsistencies(mission, told) + shortfalls(mission, told, checked.probabilities)


def claiming(solution: Solution, **changes: float) -> Solution:
    """With another certificate, whose interval is that of its flights unless it is changed."""
    assert solution.risk is not None
    assert solution.risk.certificate is not None
    told = replace(solution.risk.certificate, **changes)
    kept = proportion(round(told.reached * told.samples), told.samples)
    update = dict(zip(("reached", "low", "high"), kept, strict=True)) | {
        "at_nodes": max(told.at_nodes, kept.value)
    }
    told = replace(told, **(update | changes))
    risk = replace(solution.risk, certificate=told)
    return replace(solution, risk=risk)


def test_what_the_certificate_says_is_found_sound(
    certified: Plan, solution: Solution, checked: Verification
) -> None:
    assert failures(certified, claiming(solution), checked) == []


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"low": 0.95}, "risk"),
        ({"at_nodes": 0.5}, "risk"),
        ({"samples": 500}, "risk"),
        ({"seed": FIRST_SEED - 1}, "risk"),
        ({"reached": 0.98}, "certificate"),
        ({"reached": 0.85}, "certificate"),
    ],
    ids=lambda value: str(value),
)
def test_a_certificate_that_claims_what_is_not_so_is_named(
    certified: Plan,
    solution: Solution,
    checked: Verification,
    changes: dict[str, float],
    name: str,
) -> None:
    assert name in failures(certified, claiming(solution, **changes), checked)


def test_what_nothing_certifies_has_to_aim_at_what_was_asked(
    certified: Plan, solution: Solution, checked: Verification
) -> None:
    """The plan of a lower probability does not pass for one of a higher."""
    assert solution.risk is not None
    risk = replace(solution.risk, certificate=None)
    told = replace(solution, risk=risk)
    assert failures(certified, told, checked) == []
    higher = certified.mission.scenario.replace({"risk.p_chance": risk.target + 1e-6})
    asked = replace(risk, required=risk.target + 1e-6)
    told = replace(solution, risk=asked, scenario=higher)
    mission = replace(certified.mission, scenario=higher)
    assert inconsistencies(mission, told) == ["risk"]


def test_a_plan_that_misses_its_aim_has_not_converged(
    certified: Plan, solution: Solution, checked: Verification
) -> None:
    assert solution.risk is not None
    target = float(ndtr(ndtri(solution.risk.target) + 0.01))
    told = replace(solution, risk=replace(solution.risk, target=target))
    assert failures(certified, told, checked) == ["violation"]


@pytest.mark.parametrize("off", [0.006, -0.006])
def test_a_probability_that_the_nodes_do_not_have_is_named(
    certified: Plan, solution: Solution, checked: Verification, off: float
) -> None:
    """By no more than 0.006 of about 0.91: of a flight it is its flights that have to tell."""
    assert solution.risk is not None
    law = solution.risk.normal_law
    least = min(law, key=lambda event: min(event.probability))
    at = int(np.argmin(least.probability))
    changed = [p + off * (k == at) for k, p in enumerate(least.probability)]
    lie = replace(least, probability=changed, sigma=None)
    told_law = [lie if event is least else event for event in law]
    risk = replace(solution.risk, normal_law=told_law)
    told = replace(solution, risk=risk, carried=solution.figures)
    found = failures(certified, told, checked)
    assert "constraints" in found
    assert ("risk" in found) == (solution.risk.scope == "node")


@pytest.mark.parametrize("certified", ["flight"], indirect=True)
@pytest.mark.parametrize("told", [0.96, 0.84])
def test_a_flight_law_that_flights_contradict_is_named(
    certified: Plan, solution: Solution, checked: Verification, told: float
) -> None:
    """Of a plan that nothing certifies: 0.3 standard deviations off."""
    assert solution.risk is not None
    law = [replace(solution.risk.normal_law[0], probability=[told], sigma=None)]
    risk = replace(solution.risk, normal_law=law, certificate=None)
    found = failures(certified, replace(solution, risk=risk), checked)
    assert "risk" in found


def test_nodes_are_added_where_flights_touch() -> None:
    mission = mission_of("node")
    a, b = mission.times_s[70:72]
    finer = with_nodes_at(mission, np.array([a + 20.0, a + 30.0, a + 31.0, b + 40.0]))
    assert {round(a + 30.0), round(b + 40.0)} <= {round(t) for t in finer.times_s.tolist()}
    assert len(finer.times_s) > len(mission.times_s)
    assert finer.scenario.grid.nodes_s
    again = with_nodes_at(finer, np.array([mission.times_s[80] + 20.0]))
    assert set(finer.scenario.grid.nodes_s) < set(again.scenario.grid.nodes_s)
