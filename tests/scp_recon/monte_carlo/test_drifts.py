"""Drifts after a missed or cut burn, flown: against another integrator, and as safe as was required."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import binom

import scp_recon as sr
from scp_recon.advice.trials import limits_violated
from scp_recon.certification import again
from scp_recon.certification.again import shortfalls
from scp_recon.errors import InputError
from scp_recon.mission.constraints import Miss
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.drifts import fly_drifts, states_after
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.physics.forces import acceleration
from scp_recon.planning.initial_guess import cold
from scp_recon.planning.plan import Plan, ended
from scp_recon.planning.planner import plan as plan_by_law
from scp_recon.results.solution import make_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status
from scp_recon.verification.probabilities import drift_safety
from scp_recon.verification.reintegration import _drift_error, verify
from tests.helpers import nightly
from tests.scenarios import COARSE

pytestmark = pytest.mark.slow

DAY_S = 86_400.0
ONE_DAY = (COARSE, "risk.allocation='exact'", "safety.missed_burns=1")


@cache
def planned(*entries: str) -> Plan:
    return sr.plan(load_scenario(None, entries), starts=1, certify=False)


def test_a_drift_is_that_of_another_integrator():
    """The nearest approach of single flights after half of burn 2, by DOP853 with dense output."""
    plan, miss = planned(*ONE_DAY), Miss(2, 0.5)
    mission = plan.mission
    config = Flyer(mission, plan.burns_m_s)
    draws = config.first_draws(3)
    found = fly_drifts(config, [miss], draws)[0]
    start = mission.scenario.burns.times_s[1]
    for number, state in enumerate(states_after(config, [miss], draws)[0]):

        def rate(time, y):
            return np.r_[y[3:], acceleration(*y[:3], mission.forces, mission.forces.moment(time))]

        times = start + np.linspace(0.0, DAY_S, 721)
        flown = solve_ivp(rate, times[[0, -1]], state, "DOP853", times, rtol=1e-10, atol=1e-9)
        distance = np.linalg.norm(flown.y[:3], axis=0)
        assert found.closest_m[number] == pytest.approx(distance.min(), abs=0.1)
        assert found.at_s[number] == pytest.approx(times[np.argmin(distance)], abs=1.0)


def test_missed_burn_is_whole_less_executed():
    plan = planned(*ONE_DAY)
    mission, burns = plan.mission, plan.burns_m_s
    time = np.array([mission.scenario.burns.times_s[1]])
    flown = Flyer(mission, burns).fly_block(time, 0, flights=5)
    config = Flyer(mission, burns)
    misses = [Miss(2), Miss(2, 0.5)]
    missed, half = states_after(config, misses, config.first_draws(5))
    np.testing.assert_allclose(flown.states[0, :, :3], missed[:, :3])
    np.testing.assert_allclose(flown.states[0, :, 3:] - missed[:, 3:], flown.burns_m_s[:, 1])
    np.testing.assert_allclose(flown.states[0, :, 3:] - half[:, 3:], flown.burns_m_s[:, 1] / 2)


def test_a_plan_survives_a_missed_burn_in_flight():
    """Fresh flights of the plan; without planning for it a tenth of them come too near."""
    plan = planned(*ONE_DAY)
    assert not shortfalls(plan)
    without = planned(*ONE_DAY[:2])
    mission = plan.mission
    safe = [
        fly_drifts(config, [Miss(2)], config.first_draws(4000))[0].safe(mission).sum()
        for config in (Flyer(mission, one.burns_m_s, seed=77) for one in (plan, without))
    ]
    assert safe[0] >= binom.ppf(0.001, 4000, 0.997)
    assert safe[1] < 0.97 * 4000
    assert plan.total_dv_m_s < 1.05 * without.total_dv_m_s


def test_flights_judge_drift_where_law_cannot():
    """After burn 4, cut at 0.9, the linear law sees no drift inside, and 43 % of flights are."""
    entries = (COARSE, "risk.allocation='exact'", "safety.cut_short=true")
    mission, name = Mission.from_scenario(load_scenario(None, entries)), "cut_burn_4_at_0.9"
    found = plan_by_law(mission, cold(mission))
    assert found.final.margins[name].margin.min() > 4.0
    assert shortfalls(found)[name] == np.inf
    aware = replace(mission, drift_losses=((name, np.inf),)).problem.drifts
    assert [one.name for one in aware if one.by_planes] == [name]


def test_a_mission_without_safe_plans_ends_infeasible(monkeypatch):
    plan = planned(*ONE_DAY)
    unsafe = ended(plan, Status.INFEASIBLE)
    monkeypatch.setattr(again, "shortfalls", lambda _: {"missed_burn_2": 0.5})
    found = again.with_safe_drifts(plan.mission, lambda _, last: unsafe if last else plan)
    assert found is unsafe


def test_violated_drift_suggests_a_smaller_radius():
    scenario = planned(*ONE_DAY).mission.scenario
    assert limits_violated(scenario, ("missed_burn_2",)) == {
        "safety.drift_radius_m": (500.0, 290.0)
    }


@nightly
def test_verification_refutes_a_drift_that_was_not_planned():
    without = planned(*ONE_DAY[:2])
    mission = Mission.from_scenario(load_scenario(None, ONE_DAY))
    burns = without.burns_m_s
    found = drift_safety(mission, burns, (), planned=True)
    assert [one.burn for one in found] == [1, 2, 3, 4]
    assert found[0].required is None
    assert found[1].high < found[1].required


def test_verification_integrates_means_of_drifts_again(monkeypatch):
    plan = planned(*ONE_DAY)
    solution = make_solution(plan)
    found = verify(plan.mission, solution)
    assert found.ok
    assert all(one.required for one in found.drifts[1:])
    assert found.drift_error_m < 0.01
    monkeypatch.setattr("scp_recon.mission.constraints.NODE_SHARE", 1.0)  # steps of an hour
    rough = Mission.from_scenario(plan.mission.scenario)
    assert _drift_error(rough, np.array(solution.nodes.state), plan.burns_m_s) > 1.0


def test_flights_miss_a_burn_on_request():
    plan = planned(*ONE_DAY)
    found, plain = sr.fly(plan, 200, miss=2), sr.fly(plan, 200)
    assert found.drift.required == 0.997
    assert found.drift.burn == 2
    assert found.model_copy(update={"drift": None}) == plain
    gates = sr.fly(plan, 200, miss=2, errors="gates").drift
    assert gates.closest_m != found.drift.closest_m  # drifts begin with the errors that were flown
    with pytest.raises(InputError, match=r"miss: got 5; .* 1 to 4"):
        sr.fly(plan, 200, miss=5)


def test_way_home_is_flown_after_missed_burn():
    plan = planned(*ONE_DAY)
    then = sr.fly(plan, 200, miss=2, then="return").then
    assert then.status == "converged"
    assert then.burn_times_s == plan.mission.scenario.burns.times_s[2:]
    assert then.total_dv_m_s == pytest.approx(0.0595, abs=2e-3)
    assert then.whole_flight.value > 0.97
    for options, words in (({}, "goes with miss"), ({"miss": 4}, "must leave a burn")):
        with pytest.raises(InputError, match=words):
            sr.fly(plan, 200, then="return", **options)


@pytest.mark.parametrize(
    ("entries", "words"),
    {
        "two burns": (("safety.missed_burns=2",), "safety.missed_burns: got 2"),
        "no miss": (("safety.drift_s=3600",), "has no effect without safety.missed_burns"),
        "inside": ((ONE_DAY[2], "safety.drift_radius_m=200"), "at least body.reference_radius_m"),
        "too long": ((ONE_DAY[2], "safety.drift_s=1e7"), r"must be at most 15\d{5} s"),
    }.values(),
)
def test_drifts_that_cannot_be_planned_are_refused(entries, words):
    with pytest.raises(InputError, match=words):
        Mission.from_scenario(load_scenario(None, entries))


def test_drifts_beyond_a_table_of_attitudes_are_refused():
    from experiments.missed_burns import scenario_of

    scenario = scenario_of("apophis", "missed")
    words = r"drift_s: got 700000 s; must be at most 554782 s, when the table of attitudes ends"
    with pytest.raises(InputError, match=words):
        Mission.from_scenario(scenario.replace({"safety.drift_s": 7e5}))
    Mission.from_scenario(scenario.replace({"safety.drift_s": 554_782.0}))


BINDING = (1, 2, 3, 4, 6, 8, 10, 11, 12, 14, 16, 17, 19, 20, 22, 23, 24, 26, 27, 28)
"""The first random scenarios whose plans spend all of the risk of a drift."""


@nightly
@pytest.mark.parametrize("number", BINDING)
def test_drifts_that_bind_are_safe_in_flight(number):
    """10,000 fresh flights of each miss, of a certified plan."""
    from experiments.solvers.cases import drawn

    _, changes = drawn(number)
    scenario = load_scenario().replace(changes)
    scenario = scenario.replace({"risk.allocation": "exact", "safety.missed_burns": 1})
    plan = sr.plan(scenario, starts=1)
    assert plan.status is Status.CONVERGED
    assert plan.certificate.certifies(scenario.risk.p_chance)
    names = [one.name for one in plan.mission.problem.drifts]
    assert min(abs(plan.final.margins[name].margin.min()) for name in names) < 1e-4
    for miss in (Miss(2), Miss(3), Miss(4)):
        config = Flyer(plan.mission, plan.burns_m_s, seed=99)
        safe = fly_drifts(config, [miss], config.first_draws(10_000))[0]
        assert safe.safe(plan.mission).sum() >= binom.ppf(0.001, 10_000, 0.997)
