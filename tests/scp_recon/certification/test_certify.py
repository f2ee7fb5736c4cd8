"""A certified plan's promise is what flights reach that planning has not seen."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from formulations.rows.exact import FLIGHT
from scp_recon.certification import certify as certification
from scp_recon.certification.certify import (
    FIRST_SEED,
    FLIGHTS_MIN,
    certify,
    flights_needed,
    judged,
    raised,
    successes_needed,
    with_nodes_at,
)
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.monte_carlo.whole_flight import kept_flights
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.scenario.load import load_scenario
from scp_recon.solution.from_plan import make_solution
from scp_recon.verification.reintegration import verify

ASKED = 0.9


def mission_of(scope: str) -> Mission:
    changes = {"risk.p_chance": ASKED, "risk.allocation": "exact", "risk.scope": scope}
    return Mission.from_scenario(load_scenario().replace(changes))


@pytest.fixture(scope="module", params=["node", "flight"])
def certified(request: pytest.FixtureRequest) -> Plan:
    """By a fifth of the flights."""
    mission = mission_of(request.param)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(certification, "FLIGHTS_MIN", 2_000)
        patch.setattr(certification, "FAILURES", 100)
        return certify(mission, initial_guess.cold(mission), lambda m, s, aim: plan(m, s, aim=aim))


@given(asked=st.floats(0.5, 0.999), samples=st.integers(1000, 100_000))
def test_so_many_successes_and_no_fewer_reach_what_is_asked(asked: float, samples: int) -> None:
    needed = successes_needed(asked, samples)
    if needed < samples:
        assert proportion(needed, samples).low >= asked
    assert proportion(needed - 1, samples).low < asked


@given(asked=st.floats(0.5, 0.9996))
def test_flights_are_enough_for_a_few_hundred_failures(asked: float) -> None:
    flights = flights_needed(asked)
    assert flights >= max(FLIGHTS_MIN, 300 / (1.0 - asked)) - 1


def test_a_probability_that_takes_too_many_flights_is_refused() -> None:
    with pytest.raises(InputError) as error:
        flights_needed(1.0 - 1e-6)
    assert error.value.entry == "risk.p_chance"
    assert "at most 0.9997, or --certify no" in error.value.allowed
    assert flights_needed(0.9997) == 1_000_000


@given(needed=st.floats(0.51, 0.999), loss=st.floats(0.0, 0.5))
def test_a_loss_is_made_up_for(needed: float, loss: float) -> None:
    assert needed < raised(needed, loss, 10_000) < 1.0
    assert raised(needed, loss + 0.1, 10_000) > raised(needed, loss, 10_000)


def test_the_lower_limit_is_what_was_asked(certified: Plan) -> None:
    reached = certified.certificate
    assert reached is not None
    assert certified.aim is not None
    assert reached.low >= ASKED
    assert certified.aim > ASKED
    assert reached.seed == FIRST_SEED + reached.rounds - 1
    again = kept_flights(certified.mission, certified.burns_m_s, reached.samples, reached.seed)
    assert judged(certified.mission, again)[1] == (reached.reached, reached.low, reached.high)


def test_other_flights_bear_it_out(certified: Plan) -> None:
    kept = kept_flights(certified.mission, certified.burns_m_s, 2_000, seed=77)
    assert judged(certified.mission, kept)[1].high >= ASKED


def test_the_solution_says_so_and_is_verified(certified: Plan) -> None:
    solution = make_solution(certified)
    assert solution.risk is not None
    assert solution.risk.certificate is not None
    assert (solution.risk.asked, solution.risk.aim) == (ASKED, certified.aim)
    checked = verify(certified.mission, solution)
    assert checked.ok, checked.failed
    names = {p.name for p in checked.probabilities}
    assert (FLIGHT in names) == (solution.risk.scope == "flight")


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"low": 0.95}, "risk"),
        ({"reached": 0.5}, "risk"),
    ],
)
def test_a_certificate_that_its_flights_do_not_give_is_named(
    certified: Plan, changes: dict[str, float], name: str
) -> None:
    solution = make_solution(certified)
    assert solution.risk is not None
    assert solution.risk.certificate is not None
    told = solution.risk.certificate.model_copy(update=changes)
    risk = solution.risk.model_copy(update={"certificate": told})
    checked = verify(certified.mission, solution.model_copy(update={"risk": risk}))
    assert name in checked.failed


def test_a_probability_that_the_nodes_do_not_have_is_named(certified: Plan) -> None:
    solution = make_solution(certified)
    assert solution.risk is not None
    law = solution.risk.normal_law
    least = min(law, key=lambda event: min(event.probability))
    raised_law = [
        event.model_copy(update={"probability": [1.0 - 1e-9] * len(event.t_s)})
        if event is least
        else event
        for event in law
    ]
    risk = solution.risk.model_copy(update={"normal_law": raised_law})
    checked = verify(certified.mission, solution.model_copy(update={"risk": risk}))
    assert {"risk", "constraints"} <= set(checked.failed)


def test_nodes_are_added_where_flights_touch() -> None:
    mission = mission_of("node")
    a, b = mission.times_s[70:72]
    finer = with_nodes_at(mission, np.array([a + 20.0, a + 30.0, a + 31.0, b + 40.0]))
    assert {round(a + 30.0), round(b + 40.0)} <= {round(t) for t in finer.times_s.tolist()}
    assert len(finer.times_s) > len(mission.times_s)
    assert finer.scenario.grid.nodes_s
    again = with_nodes_at(finer, np.array([mission.times_s[80] + 20.0]))
    assert set(finer.scenario.grid.nodes_s) < set(again.scenario.grid.nodes_s)


def test_flights_are_kept_or_not_at_every_second() -> None:
    """A plan whose mean grazes a limit between nodes loses flights that no node shows."""
    mission = mission_of("node")
    found = plan(mission, initial_guess.cold(mission))
    kept = kept_flights(mission, found.burns_m_s, 500, seed=3)
    assert kept.whole <= kept.whole_at_nodes <= min(c.min() for c in kept.at_nodes.values())
    assert all(kept.throughout[n] <= c.min() for n, c in kept.at_nodes.items())
    assert math.isclose(kept.samples, 500)
