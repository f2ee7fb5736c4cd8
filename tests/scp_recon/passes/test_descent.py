"""The derivative of the least delta-v: held against plans at either side."""

from __future__ import annotations

import numpy as np
import pytest

from scp_recon.mission.mission import Mission
from scp_recon.passes.descent import Near, PassResult, descend
from scp_recon.passes.scan import scan
from scp_recon.passes.setting import settled, spaces_of
from scp_recon.passes.space import Pass, Space
from scp_recon.planning.initial_guess import cold
from scp_recon.planning.planner import Planner
from scp_recon.scp.algorithms import SCvx
from scp_recon.scp.loop import Record
from tests.scp_recon.passes.support import home_scenario


@pytest.fixture(scope="module")
def space() -> Space:
    return spaces_of(home_scenario(design={"departure_s": [-500.0, 500.0]}))[0][0]


@pytest.fixture(scope="module")
def near(space: Space) -> Near:
    at = Pass((np.deg2rad(155.0), 0.0), (0.0, 8000.0, 24_000.0, 34_842.0))
    mission = space.mission_of(at)
    plan = Planner(mission).plan(cold(mission))
    return Near(space, at, plan.burns_m_s)


STEP = 1e-3


def test_multipliers_give_the_derivative_by_phases_and_times(space: Space, near: Near) -> None:
    first = near.first
    assert first.converged
    unit = first.mission.units.speed_m_s
    slope = unit * near.slope(first, np.ones(6, dtype=np.bool_))
    x = space.vector(first.at)
    for j in (0, 1, 2, 4, 5):
        step = STEP * np.eye(6)[j]
        ahead, behind = (near.plan(x + side * step).dv_m_s for side in (1.0, -1.0))
        assert slope[j] == pytest.approx((ahead - behind) / (2.0 * STEP), rel=2e-3, abs=1e-6)


def test_a_descent_is_never_worse_and_its_pass_can_be_planned_as_it_is(
    space: Space, near: Near
) -> None:
    seen: list[PassResult] = []
    best = descend(space, near.first.at, near.first.burns_m_s, seen.append, rounds_max=1)
    assert best.dv_m_s < 0.95 * near.first.dv_m_s
    assert best.dv_m_s <= min(seen[0].dv_m_s, seen[-1].dv_m_s)
    scenario = home_scenario(design={"departure_s": [-500.0, 500.0]})
    mission = Mission.from_scenario(settled(scenario, space, best.at))
    again = Planner(mission).plan(cold(mission))
    assert again.total_dv_m_s == pytest.approx(best.dv_m_s, rel=2e-3)


def test_times_that_are_all_given_leave_no_rules_to_keep(near: Near) -> None:
    space = spaces_of(home_scenario(design={"burn_times": "given"}))[0][0]
    at = Pass(near.first.at.phases, space.mission.scenario.burns.times_s)
    best = descend(space, at, near.first.burns_m_s, lambda _: None, rounds_max=1)
    assert best.converged
    assert best.at.times_s == pytest.approx(at.times_s, abs=1e-6)
    assert best.at.phases != at.phases


# --- Ctrl-C ends a design: a plan that it cut short does not count as a pass without one ------------


@pytest.fixture
def _interrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    """As soon as something is iterated."""

    def step(*_: object) -> Record:
        raise KeyboardInterrupt

    monkeypatch.setattr(SCvx, "step", step)


@pytest.mark.usefixtures("_interrupted")
def test_an_interrupt_ends_the_map_and_a_descent(space: Space) -> None:
    times = (0.0, 8000.0, 24_000.0, 34_842.0)
    with pytest.raises(KeyboardInterrupt):
        scan(space, times, lambda _: None)
    for certain in (False, True):
        with pytest.raises(KeyboardInterrupt):
            Near(space, Pass((2.7, 0.0), times), np.zeros((4, 3)), certain=certain)
