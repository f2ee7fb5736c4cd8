"""Plans of what is left of a flight: legal, met or missed as said, as IPOPT finds them, and retimed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import NonlinearConstraint, minimize

import scp_recon as sr
from formulations.arrays import Array
from scp_recon.api.planning import plan_left
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import MISS_WEIGHT, Mode
from scp_recon.planning import initial_guess, ipopt
from scp_recon.planning.method import ScpMethod, scp_method
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import Planner, other_starts
from scp_recon.replanning.flown import FlownPlan, predict
from scp_recon.replanning.remainder import Delivery, mission_left, path_planned
from scp_recon.results.solution import make_solution
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status
from scp_recon.verification.reintegration import verify
from tests.helpers import usually
from tests.scenarios import COARSE
from tests.scp_recon.support import integrate, mission_of

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("fewer")]

OFF = np.array([40.0, -40.0, 20.0, 2e-3, 2e-3, -1e-3])
"""60 m and 3 mm/s."""


@pytest.fixture(scope="module")
def flown(default_plan) -> FlownPlan:
    return FlownPlan.of(default_plan)


@pytest.fixture(scope="module")
def late(flown) -> Plan:
    """With one burn left."""
    return again(flown, 26_000.0, OFF)


def again(flown: FlownPlan, at_s: float, off: Array, *overrides: str) -> Plan:
    state = predict(flown, at_s, {}).state + off
    return plan_left(flown, Delivery(at_s, state), overrides)


def drawn(flown: FlownPlan, at_s: float, seed: int = 0) -> Array:
    """A deviation as likely as the plan says."""
    covariance = predict(flown, at_s, {}).covariance
    return np.random.default_rng(seed).multivariate_normal(np.zeros(6), covariance)


@pytest.mark.usefixtures("few_flights")
@pytest.mark.parametrize(
    ("at_s", "left", "observed"),
    usually(
        [
            (4_000.0, 3, True),
            (17_000.0, 2, False),
            (31_242.0, 1, False),
            (0.0, 3, True),
            (25_000.0, 1, False),
        ],
        3,
    ),
)
def test_rest_is_planned_from_every_leg(flown, at_s, left, observed):
    plan = again(flown, at_s, drawn(flown, at_s))
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


@pytest.mark.parametrize("seed", usually([0, 2], 1))
def test_before_window_flight_is_met_or_lost(flown, seed):
    """No burn is left before the window; what is infeasible says so at once, and by how much."""
    plan = again(flown, 8_000.0, drawn(flown, 8_000.0, seed))
    mission, solution = plan.mission, make_solution(plan)
    assert np.abs(plan.states[-1] - mission.final_state)[:3].max() < 1e-3
    assert {stage.name for stage in plan.stages} <= {"P3", "P2"}
    if plan.status is Status.CONVERGED:
        assert verify(mission, solution).ok
    else:
        assert plan.status is Status.INFEASIBLE
        assert solution.violation.max > 1e-3
        worst = min(plan.worst_margins.values())[0]
        assert worst == pytest.approx(-solution.violation.max, rel=1e-6)


@pytest.mark.parametrize("at_s", [3_000.0, 17_000.0])
def test_ipopt_finds_the_same_of_the_remaining_problem(flown, at_s):
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


def test_one_burn_meets_velocity_not_position(late):
    mission = late.mission
    end = integrate(mission.forces, mission.initial_state, [26_000.0, 34_842.0])[-1]
    missed = verify(mission, make_solution(late)).missed
    expected = np.linalg.norm(end[:3] - mission.final_state[:3])
    assert missed.position_m == pytest.approx(expected, abs=1e-3)
    assert missed.velocity_m_s < 1e-8
    with pytest.raises(InputError, match="needs two burns"):
        initial_guess.ballistic(mission)
    with pytest.raises(InputError, match=r"algorithm.*scvx or ptr"):
        Planner(mission, algorithm="scvx-star")  # which cannot weigh a miss
    assert [letter for letter, _ in other_starts(mission)] == ["c", "d"]
    assert late.burns_m_s[0] == pytest.approx(mission.final_state[3:] - end[3:], abs=1e-7)


def test_insufficient_burn_minimises_weighted_miss(flown):
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
    assert found.missed.velocity_m_s > 1e-3
    assert "missed" in str(found)


def test_flight_is_lost_beyond_three_final_sigma(flown, default_plan):
    """In position or in velocity, by the roots of their summed variances; one burn meets velocity."""
    end = default_plan.covariances[-1]
    sigmas = [np.sqrt(np.trace(block)) for block in (end[:3, :3], end[3:, 3:])]
    for part, sigma in zip((slice(0, 3), slice(3, 6)), sigmas, strict=True):
        direction = np.zeros(6)
        direction[part] = [0.6, 0.0, -0.8]
        assert not flown.is_lost(2.99 * sigma * direction)
        assert flown.is_lost(3.01 * sigma * direction)
    for times, status in ((10.0, Status.CONVERGED), (20.0, Status.LOST)):
        plan = again(flown, 26_000.0, times * OFF)
        missed = np.linalg.norm((plan.states[-1] - plan.mission.final_state)[:3])
        assert plan.status is status
        assert (missed > 3.0 * sigmas[0]) == (status is Status.LOST)
    assert "status" in verify(plan.mission, make_solution(plan)).failed


@pytest.mark.parametrize(
    ("at_s", "off", "times"),
    [
        (26_000.0, 20.0, "0, 8000, 25000, 31700, 38300, 45000"),
        (4_000.0, 0.0, "0, 8000, 25000, 34842, 42000"),
        (4_000.0, 0.0, "0, 8000, 34842"),
    ],
)
def test_burns_may_be_added_or_left_out(flown, at_s, off, times):
    """Also where the flight is lost without; the same as the scenario in flight has by itself."""
    plan = again(flown, at_s, off * OFF, f"burns.times_s=[{times}]")
    assert plan.status is Status.CONVERGED
    assert verify(plan.mission, make_solution(plan)).ok
    anew = sr.plan(plan.mission.scenario)
    assert plan.total_dv_m_s == pytest.approx(anew.total_dv_m_s, rel=1e-5)
    with pytest.raises(InputError, match=r"^burns.times_s: .*keep"):
        again(flown, 26_000.0, OFF, "burns.times_s=[0, 8100, 25000, 34842]")


def test_burns_added_after_the_last_one_go_home(flown):
    times = "burns.times_s=[0, 8000, 25000, 34842, 42000, 60000]"
    plan = again(flown, 38_000.0, OFF, times, "observation.required=false")
    assert plan.status is Status.CONVERGED
    assert verify(plan.mission, make_solution(plan)).ok
    assert "burns.times_s" not in [one.entry for one in plan.mission.warnings]
    with pytest.raises(InputError, match=r"^at_s: .*burns.times_s"):
        again(flown, 38_000.0, OFF)


def test_burn_added_after_end_is_warned_about(flown):
    delivery = Delivery.of(17_000.0, predict(flown, 17_000.0, {}).state)
    left = mission_left(flown, delivery, ["burns.times_s=[0, 8000, 25000, 34842, 50842]"])
    (warning,) = (one for one in left.warnings if one.entry == "burns.times_s")
    assert warning.given == "a last burn at 50842 s, 16000 s later than before"


def test_replan_is_flown_and_replanned(flown, default_plan):
    first = again(flown, 9_000.0, 0.1 * drawn(flown, 9_000.0))
    assert first.parent.plan_hash == make_solution(default_plan).plan_hash
    child = FlownPlan.of(first)
    second = again(child, 26_000.0, drawn(child, 26_000.0))
    assert second.parent.plan_hash == make_solution(first).plan_hash
    history = second.mission.scenario.in_flight
    expected = [*default_plan.burns_m_s[:2], first.burns_m_s[0]]
    assert np.array(history.flown_m_s) == pytest.approx(np.array(expected))
    assert second.mission.scenario.burn_times_s == (34_842.0,)


def test_p2_ends_where_p3_stops_early(flown):
    state = predict(flown, 5_000.0, {}).state + drawn(flown, 5_000.0, 3)
    given = Delivery(5_000.0, state), ["navigation.lead_s=1800"]
    mission = mission_left(flown, *given)
    whole = Planner(mission).plan(path_planned(flown, mission), facet_rounds="settle")
    quick = plan_left(flown, *given)
    p3, p3_whole = quick.stages[0].result, whole.stages[0].result
    assert len(p3.records) < len(p3_whole.records)
    assert quick.total_dv_m_s == pytest.approx(whole.total_dv_m_s, rel=5e-6)


def test_a_replan_is_made_as_its_parent_was(flown):
    mission = mission_of(COARSE)
    planner = Planner(mission, formulation="lifted", algorithm="ptr")
    parent = planner.plan(initial_guess.cold(mission), problem="P3")
    flown_parent, stored = (FlownPlan.of(given) for given in (parent, make_solution(parent)))
    assert flown_parent.method == stored.method
    made = again(stored, 17_000.0, OFF).provenance
    assert (made.formulation, made.algorithm) == ("lifted", "ptr")
    star = replace(flown, method=ScpMethod("condensed", "scvx-star", "CLARABEL"))
    assert again(star, 26_000.0, OFF).provenance.algorithm == "scvx"  # which can weigh a miss
    frozen = replace(flown, method=ScpMethod("frozen-stm", "scvx", "CLARABEL"))
    exact = again(frozen, 26_000.0, OFF, "risk.allocation=exact")
    assert exact.provenance.formulation == "condensed"  # of which exact risk has rows


def test_missing_method_gives_way_unknown_is_refused(solution):
    elsewhere = replace(solution, solver="ELSEWHERE")
    assert FlownPlan.of(elsewhere).method.solver == "CLARABEL"
    by_ipopt = replace(solution, method="ipopt", formulation="tuned")
    assert FlownPlan.of(by_ipopt).method == scp_method()
    with pytest.raises(InputError, match=r"^formulation: got 'none'"):
        FlownPlan.of(replace(solution, formulation="none"))


def test_known_quantities_equal_those_computed_anew(flown):
    state = predict(flown, 17_000.0, {}).state
    left = mission_left(flown, Delivery(17_000.0, state))
    anew = Mission.from_scenario(left.scenario)
    assert left.schedule == anew.schedule
    assert left.warnings == anew.warnings
    assert left.times_s == pytest.approx(anew.times_s, abs=1e-9)
    far = Delivery(17_000.0, 100.0 * state)
    scenario = left.scenario.replace({"in_flight.position_m": far.state[:3].tolist()})
    known = Mission.from_scenario(scenario, known=flown.mission)
    assert known.warnings == Mission.from_scenario(scenario).warnings
    assert known.warnings[0].entry == "in_flight.position_m"


@pytest.mark.usefixtures("few_flights")
def test_exact_risk_goes_on_in_flight(flown):
    off = drawn(flown, 3_000.0)
    uniform = again(flown, 3_000.0, off, "risk.p_chance=0.95", COARSE)
    exact = again(flown, 3_000.0, off, "risk.p_chance=0.95", "risk.allocation=exact", COARSE)
    assert exact.status is Status.CONVERGED
    assert exact.total_dv_m_s < 0.99 * uniform.total_dv_m_s
    assert verify(exact.mission, make_solution(exact)).ok


@pytest.mark.usefixtures("few_flights")
def test_whole_flights_are_certified_in_flight(flown):
    state = predict(flown, 17_000.0, {}).state + OFF
    asked = ("risk.allocation=exact", "risk.scope=flight", "risk.p_chance=0.9")
    plan = plan_left(flown, Delivery(17_000.0, state), asked)
    assert plan.certificate.low >= 0.9
    left = mission_left(flown, Delivery(17_000.0, state), asked)
    assert plan.mission.warnings == left.warnings
    assert verify(plan.mission, make_solution(plan)).ok


def test_measured_burn_explains_state_and_enters_history(flown, default_plan):
    burn = 1.4 * flown.burns_m_s[1]
    state = predict(flown, 17_000.0, {2: burn}).state
    strange = sr.replan(default_plan, 17_000.0, state).mission.warnings
    assert [warning.entry for warning in strange] == ["state"]
    plan = sr.replan(default_plan, 17_000.0, state, measured_burns={2: burn})
    assert [warning.entry for warning in plan.mission.warnings] == []
    assert plan.mission.scenario.in_flight.flown_m_s[1] == pytest.approx(burn)


def test_scenario_in_flight_may_be_omitted(scenario):
    flight = {
        "at_s": 17_000.0,
        "position_m": [-122.6, 419.9, -556.2],
        "velocity_m_s": [0.00695, 0.07949, 0.06553],
        "flown_m_s": [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
    }
    plan = sr.plan(scenario.replace({"in_flight": flight}))
    assert plan.status is Status.CONVERGED
    assert plan.times_s[0] == 17_000.0
    tables = scenario.model_dump(mode="json", exclude_none=True)
    assert "in_flight" not in tables
    assert Scenario.validated(tables) == scenario


def after_missed_burn(flown: FlownPlan, at_s: float) -> dict[str, object]:
    """Arguments of `replan` for the mean flight without burn 2."""
    predicted = predict(flown, at_s, {2: np.zeros(3)})
    return {"at_s": at_s, "state": predicted.state, "measured_burns": {2: np.zeros(3)}}


@pytest.fixture(scope="module")
def survivor() -> Plan:
    """A plan of which any burn may be missed."""
    entries = COARSE, "risk.allocation='exact'", "safety.missed_burns=1"
    return sr.plan(mission_of(*entries).scenario, starts=1, certify=False)


def test_missed_burn_loses_observation_not_way_home(survivor):
    """Burn 2 does not happen: the final state is still reached, without the site."""
    given = after_missed_burn(FlownPlan.of(survivor), 9_000.0)
    left = sr.replan(survivor, **given, goal="return", certify=False)
    assert left.status is Status.CONVERGED
    assert left.mission.observed_s is None
    assert {c.name for c in left.mission.problem.constraints} == {"safety_radius"}
    assert verify(left.mission, make_solution(left)).ok
    observed = sr.replan(survivor, **given, certify=False)
    assert observed.status is not Status.CONVERGED


def test_way_home_may_burn_in_the_window(default_plan, flown):
    given = after_missed_burn(flown, 9_000.0)
    added = ["burns.times_s=[0, 8000, 15000, 25000, 34842]"]
    left = sr.replan(default_plan, **given, goal="return", overrides=added)
    assert left.status is Status.CONVERGED
    modes = [leg.mode for leg in left.mission.schedule.legs]
    assert Mode.OBSERVATION not in modes
    assert modes.count(Mode.DELTA_V) == 3
    close = ["burns.times_s=[0, 8000, 15000, 16000, 34842]"]
    with pytest.raises(InputError, match=r"nothing is observed"):
        sr.replan(default_plan, **given, goal="return", overrides=close)


def test_the_last_burn_may_come_later(default_plan, flown):
    given = after_missed_burn(flown, 9_000.0)
    left = sr.replan(default_plan, **given, goal="return", arrive_by=38_000.0)
    assert left.mission.scenario.burns.times_s[-1] == 38_000.0
    with pytest.raises(InputError, match=r"arrive_by: got 20000 s; .* 25000 s"):
        sr.replan(default_plan, **given, arrive_by=20_000.0)
    with pytest.raises(InputError, match="goal: got 'home'"):
        sr.replan(default_plan, **given, goal="home")


def test_corrected_burns_of_the_rest_move_too():
    """The best times without uncertainty would be dearer than those given."""
    given = ['policy.kind="feedback"', "navigation.sigma_position_m=10", "navigation.lead_s=0"]
    exact = ['risk.allocation="exact"', 'risk.scope="flight"', "risk.p_chance=0.9"]
    given += ["navigation.sigma_velocity_m_s=5e-4", COARSE]
    plan = sr.plan(overrides=[*given, *exact], certify=False)
    at_s = 3011.0
    off = np.array([30.0, -20.0, 25.0, 1e-3, -2e-3, 1e-3])
    state = predict(FlownPlan.of(plan), at_s, {}).state + off
    left, free = (
        sr.replan(plan, at_s, state, free_times=on, certify=False) for on in (False, True)
    )
    assert free.status is left.status
    assert free.mission.problem.feedback is not None
    assert free.cost_m_s < 0.98 * left.cost_m_s


def test_on_the_way_home_no_window_parts_burns(default_plan):
    """Nothing is observed, and burns come as early as slews and heating let them."""
    at_s = 9000.0
    off = np.array([30.0, -20.0, 25.0, 1e-3, -2e-3, 1e-3])
    state = predict(FlownPlan.of(default_plan), at_s, {}).state + off
    free = sr.replan(default_plan, at_s, state, goal="return", free_times=True)
    rules = default_plan.mission.scenario.schedule
    first, second, third, last = free.mission.scenario.burns.times_s
    assert (first, second, last) == (*default_plan.mission.scenario.burns.times_s[:2], 34842.0)
    assert third == pytest.approx(second + rules.cycle_s, abs=1.5)
    begin, end = default_plan.mission.schedule.window_s
    assert begin < third < end
    given = sr.replan(default_plan, at_s, state, goal="return")
    assert free.total_dv_m_s < 0.8 * given.total_dv_m_s
