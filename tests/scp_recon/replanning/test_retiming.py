"""Burns that are left of a flight move within the schedule's rules, to where the rest is cheaper."""

import numpy as np
import pytest

import scp_recon as sr
from scp_recon.replanning.flown import FlownPlan, predict

pytestmark = pytest.mark.usefixtures("fewer")


@pytest.mark.slow
def test_corrected_burns_of_the_rest_move_too():
    """The best times without uncertainty would be dearer than those given."""
    given = ['policy.kind="feedback"', "navigation.sigma_position_m=10", "navigation.lead_s=0"]
    exact = ['risk.allocation="exact"', 'risk.scope="flight"', "risk.p_chance=0.9"]
    plan = sr.plan(overrides=[*given, "navigation.sigma_velocity_m_s=5e-4", *exact])
    at_s = 3011.0
    off = np.array([30.0, -20.0, 25.0, 1e-3, -2e-3, 1e-3])
    state = predict(FlownPlan.of(plan), at_s, {}).state + off
    left, free = (sr.replan(plan, at_s, state, free_times=on) for on in (False, True))
    assert free.status is left.status
    assert free.mission.problem.feedback is not None
    assert free.cost_m_s < 0.98 * left.cost_m_s


@pytest.mark.slow
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
