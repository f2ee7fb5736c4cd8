"""Plans of what is left of a flight: legal, met or missed as said, and as IPOPT finds them."""

from __future__ import annotations

from time import process_time

import numpy as np
import pytest
from scipy.optimize import NonlinearConstraint, minimize

import scp_recon as sr
from scp_recon.errors import InputError
from scp_recon.in_flight.delivery import Delivery
from scp_recon.in_flight.parent import FlownPlan
from scp_recon.in_flight.prediction import predict
from scp_recon.in_flight.replanning import mission_left, replan
from scp_recon.mission.in_flight import MISS_WEIGHT
from scp_recon.mission.mission import Mission
from scp_recon.mission.states import state_axes
from scp_recon.planning import initial_guess, ipopt
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import Planner
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status
from scp_recon.solution.from_plan import make_solution
from scp_recon.verification.reintegration import verify
from tests.helpers import Array
from tests.scp_recon.support import integrate

OFF = np.array([40.0, -40.0, 20.0, 2e-3, 2e-3, -1e-3])
"""60 m and 3 mm/s."""


@pytest.fixture(scope="module")
def flown(default_plan: Plan) -> FlownPlan:
    return FlownPlan.of(default_plan)


@pytest.fixture(scope="module")
def late(flown: FlownPlan) -> Plan:
    """With one burn left."""
    return again(flown, 26_000.0, OFF)


def again(flown: FlownPlan, at_s: float, off: Array, *overrides: str) -> Plan:
    state = predict(flown, at_s, {}).state + off
    mission = mission_left(flown, Delivery(at_s, state), overrides)
    return replan(flown, mission, certified=False)


def drawn(flown: FlownPlan, at_s: float, seed: int = 0) -> Array:
    """A deviation as likely as the plan says."""
    covariance = predict(flown, at_s, {}).covariance
    return np.random.default_rng(seed).multivariate_normal(np.zeros(6), covariance)


# --- from every leg -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("at_s", "left", "observed"),
    [
        (0.0, 3, True),
        (5_000.0, 3, True),
        (8_000.0, 2, True),
        (17_000.0, 2, False),
        (23_200.0, 2, False),
        (25_000.0, 1, False),
        (33_042.0, 1, False),
    ],
)
def test_from_every_leg_what_is_left_is_planned_and_verified(
    flown: FlownPlan, at_s: float, left: int, observed: bool
) -> None:
    # in the window nothing can be helped any more, so that the flight had better be near its plan
    share = 0.1 if at_s == 8_000.0 else 1.0
    plan = again(flown, at_s, share * drawn(flown, at_s))
    mission = plan.mission
    assert plan.status is Status.CONVERGED
    assert mission.scenario.burn_times_s == (0.0, 8000.0, 25000.0, 34842.0)[-left:]
    assert plan.times_s[0] == at_s
    assert (mission.observed_s is not None) == observed
    names = {constraint.name for constraint in mission.problem.constraints}
    assert ("emission_max" in names) == observed
    miss = np.abs(plan.states[-1] - mission.final_state)
    assert miss[3:].max() < 1e-8
    assert (miss[:3].max() < 1e-4) == (left > 1)
    found = verify(mission, make_solution(plan))
    assert found.ok, found.failed
    assert (found.missed is None) == (left > 1)


def test_in_the_window_what_is_left_of_it_counts(flown: FlownPlan) -> None:
    plan = again(flown, 15_000.0, np.zeros(6), "risk.p_chance=0.6")
    first, last = plan.mission.schedule.window_s
    assert first < 15_000.0
    assert plan.mission.observed_s == (15_000.0, last)
    nodes = plan.times_s[plan.mission.window_nodes]
    assert (nodes[0], nodes[-1]) == (15_000.0, last)


@pytest.mark.parametrize("at_s", [3_000.0, 17_000.0, 26_000.0])
def test_ipopt_finds_the_same_of_the_remaining_problem(flown: FlownPlan, at_s: float) -> None:
    """From scratch: a cold start, facets at IPOPT's own solution without spread."""
    plan = again(flown, at_s, drawn(flown, at_s), "risk.p_chance=0.9")
    mission = plan.mission
    reference = ipopt.plan(mission, initial_guess.cold(mission))
    assert reference.status is Status.CONVERGED
    assert plan.total_dv_m_s == pytest.approx(reference.total_dv_m_s, rel=1e-6)
    if mission.problem.n_burns == 3:  # chance constraints bind
        assert min(margin for margin, _ in plan.worst_margins.values()) < 1e-3
    if mission.problem.n_burns < 3:
        assert plan.burns_m_s == pytest.approx(reference.burns_m_s, abs=1e-6)


# --- one burn left --------------------------------------------------------------------------------


def test_one_burn_meets_the_velocity_and_misses_what_the_coast_misses(late: Plan) -> None:
    mission = late.mission
    end = integrate(mission.forces, mission.initial_state, [26_000.0, 34_842.0])[-1]
    missed = verify(mission, make_solution(late)).missed
    assert missed is not None
    expected = np.linalg.norm(end[:3] - mission.final_state[:3])
    assert missed.position_m == pytest.approx(expected, abs=1e-3)
    assert missed.velocity_m_s < 1e-8
    assert late.burns_m_s[0] == pytest.approx(mission.final_state[3:] - end[3:], abs=1e-7)


def test_a_burn_that_cannot_meet_it_misses_the_least_by_its_weight(flown: FlownPlan) -> None:
    plan = again(flown, 26_000.0, OFF, "burns.dv_max_m_s=0.03")
    mission, burn = plan.mission, plan.burns_m_s[0]
    before = plan.states[-1, 3:] - burn

    def weighted(dv: Array) -> float:
        miss = np.abs(before + dv - mission.final_state[3:]).sum()
        return float(np.linalg.norm(dv) + MISS_WEIGHT * miss)

    limit = NonlinearConstraint(lambda dv: dv @ dv, 0.0, 0.03**2)
    starts = np.random.default_rng(0).normal(scale=0.01, size=(8, 3))
    tries = [minimize(weighted, x, constraints=[limit], method="SLSQP") for x in starts]
    assert plan.status is Status.CONVERGED
    assert np.linalg.norm(burn) <= 0.03 + 1e-7
    assert weighted(burn) <= min(t.fun for t in tries if t.success) + 1e-6
    found = verify(mission, make_solution(plan))
    assert found.missed is not None
    assert found.missed.velocity_m_s > 1e-3
    assert "missed" in str(found)


def test_scvx_star_says_that_it_cannot_weigh_a_miss(late: Plan) -> None:
    with pytest.raises(InputError, match=r"algorithm.*must be scvx or ptr"):
        Planner(late.mission, algorithm="scvx-star")


# --- what is kept ---------------------------------------------------------------------------------


def test_the_covariance_is_the_initial_one_unless_given(
    flown: FlownPlan, default_plan: Plan
) -> None:
    factor = default_plan.mission.initial_factor
    initial = factor @ factor.T
    plan = again(flown, 17_000.0, np.zeros(6))
    assert plan.covariances[0] == pytest.approx(initial, rel=1e-9, abs=1e-15)
    given = np.diag([4.0, 4.0, 4.0, 1e-8, 1e-8, 1e-8])
    state = predict(flown, 17_000.0, {}).state
    other = sr.plan_again(default_plan, 17_000.0, state, given)
    assert other.covariances[0] == pytest.approx(given, rel=1e-9, abs=1e-15)
    assert make_solution(other).plan_hash != make_solution(plan).plan_hash


def test_the_dispersion_of_the_plan_itself_is_replanned_for_nothing(flown: FlownPlan) -> None:
    """With two burns left there is no choice: on the planned path the plan goes on as it was."""
    plan = again(flown, 17_000.0, np.zeros(6))
    assert plan.burns_m_s == pytest.approx(flown.burns_m_s[2:], abs=1e-7)


def test_a_replan_is_flown_and_replanned_in_its_turn(flown: FlownPlan, default_plan: Plan) -> None:
    first = again(flown, 9_000.0, 0.1 * drawn(flown, 9_000.0))
    assert first.parent is not None
    assert first.parent.plan_hash == make_solution(default_plan).plan_hash
    child = FlownPlan.of(first)
    second = again(child, 26_000.0, drawn(child, 26_000.0))
    assert second.parent is not None
    assert second.parent.plan_hash == make_solution(first).plan_hash
    history = second.mission.scenario.in_flight
    assert history is not None
    expected = [*default_plan.burns_m_s[:2], first.burns_m_s[0]]
    assert np.array(history.flown_m_s) == pytest.approx(np.array(expected))
    assert second.mission.scenario.burn_times_s == (34_842.0,)


def test_a_plan_without_uncertainty_is_replanned_without(mission: Mission) -> None:
    plan = Planner(mission).plan(initial_guess.cold(mission), problem="P3")
    flown = FlownPlan.of(plan)
    assert again(flown, 3_000.0, OFF).final.problem == "P3"


def test_exact_risk_goes_on_in_flight(flown: FlownPlan) -> None:
    off = drawn(flown, 3_000.0)
    uniform = again(flown, 3_000.0, off, "risk.p_chance=0.95")
    exact = again(flown, 3_000.0, off, "risk.p_chance=0.95", "risk.allocation=exact")
    assert exact.status is Status.CONVERGED
    assert exact.total_dv_m_s < 0.99 * uniform.total_dv_m_s
    assert verify(exact.mission, make_solution(exact)).ok


def test_whole_flights_are_certified_in_flight(flown: FlownPlan) -> None:
    state = predict(flown, 17_000.0, {}).state + OFF
    asked = ("risk.allocation=exact", "risk.scope=flight", "risk.p_chance=0.9")
    mission = mission_left(flown, Delivery(17_000.0, state), asked)
    plan = replan(flown, mission)
    assert plan.certificate is not None
    assert plan.certificate.low >= 0.9
    assert plan.mission.warnings == mission.warnings
    assert verify(plan.mission, make_solution(plan)).ok


# --- burns as telemetry saw them ------------------------------------------------------------------


def test_a_measured_burn_is_what_the_prediction_flies(flown: FlownPlan, default_plan: Plan) -> None:
    burn = 1.1 * flown.burns_m_s[1]
    found = predict(flown, 17_000.0, {2: burn})
    state = default_plan.states[default_plan.times_s == 8_000.0][0].copy()
    state[3:] += burn - flown.burns_m_s[1]
    expected = integrate(default_plan.mission.forces, state, [8_000.0, 17_000.0])[-1]
    assert found.state == pytest.approx(expected, abs=1e-3)
    planned = predict(flown, 17_000.0, {}).covariance
    assert np.linalg.eigvalsh((planned - found.covariance)[:3, :3]).min() > -1e-6
    assert np.trace(found.covariance[:3, :3]) < np.trace(planned[:3, :3])


def test_a_measured_burn_explains_a_state_and_stands_in_the_history(
    flown: FlownPlan, default_plan: Plan
) -> None:
    burn = 1.4 * flown.burns_m_s[1]
    state = predict(flown, 17_000.0, {2: burn}).state
    strange = sr.plan_again(default_plan, 17_000.0, state).mission.warnings
    assert [warning.entry for warning in strange] == ["state"]
    plan = sr.plan_again(default_plan, 17_000.0, state, measured_burns={2: burn})
    assert [warning.entry for warning in plan.mission.warnings] == []
    assert plan.mission.scenario.in_flight is not None
    assert plan.mission.scenario.in_flight.flown_m_s[1] == pytest.approx(burn)


def test_the_prediction_is_the_plan_at_its_nodes(flown: FlownPlan, default_plan: Plan) -> None:
    """A node later, by one arc, as if it were not known."""
    k = 40
    at = default_plan.times_s[k]
    found = predict(flown, float(at) - 1e-9, {})
    assert found.state == pytest.approx(default_plan.states[k], abs=1e-3)
    assert found.covariance == pytest.approx(default_plan.covariances[k], rel=1e-6, abs=1e-9)


# --- frames, files and time -----------------------------------------------------------------------


def test_a_state_may_be_in_sun_north_axes(default_plan: Plan, flown: FlownPlan) -> None:
    mission, state = default_plan.mission, predict(flown, 17_000.0, {}).state + OFF
    axes = state_axes(mission.scenario, mission.rotation, "sun_north").T
    turned = np.concatenate([axes @ state[:3], axes @ state[3:]])
    plain = sr.plan_again(default_plan, 17_000.0, state)
    plan = sr.plan_again(default_plan, 17_000.0, turned, frame="sun_north")
    assert plan.burns_m_s == pytest.approx(plain.burns_m_s, abs=1e-9)


def test_older_scenarios_and_solutions_are_what_they_were(scenario: Scenario) -> None:
    tables = scenario.model_dump(mode="json", exclude_none=True)
    assert tables["schedule"].pop("decision_lead_s") == 1800.0
    assert "in_flight" not in tables
    assert Scenario.validated(tables) == scenario
    assert scenario.model_dump(mode="json", exclude_defaults=True).keys() == (tables.keys())
    said = scenario.model_dump(mode="json", exclude_defaults=True)["schedule"]
    assert "decision_lead_s" not in said


def test_a_scenario_in_flight_can_be_written_by_hand() -> None:
    flight = {
        "at_s": 17_000.0,
        "position_m": [-122.6, 419.9, -556.2],
        "velocity_m_s": [0.00695, 0.07949, 0.06553],
        "flown_m_s": [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
    }
    scenario = load_scenario().replace({"in_flight": flight})
    plan = sr.plan(scenario)
    assert plan.status is Status.CONVERGED
    assert plan.times_s[0] == 17_000.0


def test_a_replan_takes_at_most_a_quarter_of_a_cold_plan(flown: FlownPlan) -> None:
    """With two burns left, programs kept; the quickest of five in turn."""
    again(flown, 17_000.0, OFF)
    cold, near = [], []
    for number in range(5):
        begin = process_time()
        sr.plan()
        middle = process_time()
        again(flown, 17_000.0, 0.1 * number * OFF)
        cold.append(middle - begin)
        near.append(process_time() - middle)
    assert min(near) < 0.25 * min(cold)
