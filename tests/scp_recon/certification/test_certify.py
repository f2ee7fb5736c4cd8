"""A certified plan's promise is what flights reach that planning has not seen."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from formulations.rows.exact import FLIGHT
from scp_recon.certification.certify import certify, judged, with_nodes_at
from scp_recon.monte_carlo import certifying
from scp_recon.monte_carlo.certifying import (
    FIRST_SEED,
    successes_needed,
)
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.monte_carlo.whole_flight import kept_flights
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.solution.from_plan import make_solution
from scp_recon.verification.reintegration import verify
from tests.scp_recon.certification.support import mission_of

ASKED = 0.9


@pytest.fixture(scope="module", autouse=True)
def fewer() -> Iterator[None]:
    """A fifth of the flights."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(certifying, "FLIGHTS_MIN", 2_000)
        patch.setattr(certifying, "FAILURES", 100)
        yield


@pytest.fixture(scope="module", params=["node", "flight"])
def certified(request: pytest.FixtureRequest) -> Plan:
    mission = mission_of(request.param, ASKED)
    return certify(mission, initial_guess.cold(mission), lambda m, s, aim: plan(m, s, aim=aim))


@given(asked=st.floats(0.5, 0.999), samples=st.integers(1000, 100_000))
def test_so_many_successes_and_no_fewer_reach_what_is_asked(asked: float, samples: int) -> None:
    needed = successes_needed(asked, samples)
    if needed < samples:
        assert proportion(needed, samples).low >= asked
    assert proportion(needed - 1, samples).low < asked


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
