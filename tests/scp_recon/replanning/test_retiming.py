"""Burns that are left of a flight move within the schedule's rules, to where the rest is cheaper."""

import pytest

import scp_recon as sr
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.replanning.flown import FlownPlan, predict

pytestmark = pytest.mark.usefixtures("fewer")


@pytest.mark.slow
def test_free_times_make_the_rest_cheaper(default_plan):
    at_s = 2000.0
    given = {"at_s": at_s, "state": predict(FlownPlan.of(default_plan), at_s, {}).state}
    left, free = (sr.replan(default_plan, **given, free_times=on) for on in (False, True))
    assert free.total_dv_m_s < 0.995 * left.total_dv_m_s
    times, before = free.mission.scenario.burns.times_s, left.mission.scenario.burns.times_s
    assert (times[0], times[-1]) == (before[0], before[-1])
    assert times[1:-1] != before[1:-1]
    assert Mission.from_scenario(free.mission.scenario).schedule.legs  # which keeps every rule
    assert sr.verify(free).ok


def test_the_last_burn_alone_cannot_move(default_plan):
    at_s = 26_000.0
    state = predict(FlownPlan.of(default_plan), at_s, {}).state
    with pytest.raises(InputError, match=r"free_times: got only burn 4 .*; needs another burn"):
        sr.replan(default_plan, at_s, state, free_times=True)
