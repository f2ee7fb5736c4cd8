"""Burns of a pass: how many, and the descent of their phases and times."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from formulations.nlp.program import Start
from formulations.nlp.solve import VARIANTS, NlpOutcome, solve_nlp
from scp_recon.mission.firing import HomePhases
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import make_schedule
from scp_recon.passes import design
from scp_recon.passes.design import other_counts, peaks, vanished
from scp_recon.passes.scan import scan
from scp_recon.passes.space import Pass, Space, settled, spaces_of
from scp_recon.passes.timing import Effort, PassResult, Timing
from scp_recon.planning.initial_guess import cold
from scp_recon.planning.ipopt import casadi_arcs
from scp_recon.planning.planner import Planner
from scp_recon.planning.primer import primer_history
from scp_recon.scp.algorithms import SCvx
from tests.scp_recon.passes.support import home_scenario
from tests.scp_recon.support import raising


@pytest.fixture(scope="module")
def space() -> Space:
    return spaces_of(home_scenario(design={"departure_s": [-500.0, 500.0]}))[0]


@pytest.fixture(scope="module")
def near(space) -> PassResult:
    at = Pass((np.deg2rad(155.0), 0.0), (0.0, 8000.0, 24_000.0, 34_842.0))
    mission = space.mission_of(at)
    plan = Planner(mission).plan(cold(mission))
    return Timing(space, 0).plan(at, plan.burns_m_s)


@pytest.mark.slow
def test_a_descent_ends_at_a_better_plannable_pass(space, near):
    seen: list[PassResult] = []
    best = Timing(space, 0).descend(near.at, near.burns_m_s, seen.append, Effort(1, 1e-4, 40))
    assert best.dv_m_s < 0.95 * near.dv_m_s
    assert best.dv_m_s <= min(seen[0].dv_m_s, seen[-1].dv_m_s)
    scenario = home_scenario(design={"departure_s": [-500.0, 500.0]})
    mission = Mission.from_scenario(settled(scenario, space, best.at))
    again = Planner(mission).plan(cold(mission))
    assert again.total_dv_m_s == pytest.approx(best.dv_m_s, rel=2e-3)


@pytest.mark.slow
def test_ipopt_finds_the_same_pass_from_home(space, near):
    """Phases, dates and times free, with the plan's facets and from its burns."""
    spans = space.time_spans
    home = HomePhases(space.ring, near.at.phases, space.phase_spans)
    mission = replace(near.mission, firing_spans_s=spans, home=home)
    problem, lin = mission.problem, near.stage.result.lin
    assert problem.firing is not None
    assert problem.firing.boundary is not None
    arcs, start = casadi_arcs(mission.flow), Start(lin.iterate, lin.factor)
    found = solve_nlp(problem, arcs, near.stage.facets, start, VARIANTS["shooting"])
    assert found.outcome is NlpOutcome.SOLVED
    own = Timing(space, 0).freed(near, 100)
    assert own.converged
    speed, unit = mission.units.speed_m_s, mission.units.time_s
    assert own.dv_m_s == pytest.approx(found.objective * speed, rel=1e-5)
    phases = problem.firing.phases(found.iterate.times)
    assert own.at.phases == pytest.approx(phases, abs=1e-3)
    free, burns = problem.firing.burns, found.iterate.burns
    fired = np.linalg.norm(burns[free], axis=1) > 1e-4  # when a burn of nothing is, is all the same
    times = found.iterate.times[: len(free)] * unit
    assert np.array(own.at.times_s)[free[fired]] == pytest.approx(times[fired], abs=1.0)


def test_given_times_leave_phases_to_move(near):
    space = spaces_of(home_scenario(design={"burn_times": "given"}))[0]
    at = Pass(near.at.phases, space.mission.scenario.burns.times_s)
    best = Timing(space, 0).descend(at, near.burns_m_s, lambda _: None, Effort(1, 1e-4, 40))
    assert best.converged
    assert best.at.times_s == pytest.approx(at.times_s, abs=1e-6)
    assert best.at.phases != at.phases


def test_an_interrupt_ends_map_and_descent(space, monkeypatch):
    """As soon as something is iterated."""
    monkeypatch.setattr(SCvx, "step", raising(KeyboardInterrupt()))
    times = (0.0, 8000.0, 24_000.0, 34_842.0)
    with pytest.raises(KeyboardInterrupt):
        scan(replace(space, times_s=times), lambda _: None)
    for certain in (False, True):
        with pytest.raises(KeyboardInterrupt):
            Timing(space, 0, certain).plan(Pass((2.7, 0.0), times), np.zeros((4, 3)))


PHASES = np.deg2rad(140.0), np.deg2rad(10.0)
GATES = {
    "uncertainty.gates": {
        "magnitude_fixed_m_s": 1e-5,
        "magnitude_proportional": 0.01,
        "pointing_fixed_m_s": 1e-5,
        "pointing_proportional_rad": 0.01,
    }
}


def near_of(last_s: float, changes: dict[str, Any] | None = None, **how: Any) -> PassResult:
    """A pass with three burns."""
    coarse = {"grid.step_max_s": 464.0, "burns.times_s": [0.0, 25_000.0, last_s]}
    space, *_ = spaces_of(home_scenario(coarse | (changes or {}), **how))
    return Timing(space, 0).plan(Pass(PHASES, space.times_s), np.zeros((3, 3)))


@pytest.fixture(scope="module")
def few() -> PassResult:
    return near_of(34_842.0)


@pytest.mark.slow
def test_burns_where_the_primer_exceeds_one_pay(few):
    found, space = few, few.space
    assert found.converged
    history = primer_history(found.mission, found.stage)
    assert history is not None
    tries = other_counts(found)
    assert 1 <= len(tries) <= len(peaks(history))
    for other in tries:
        assert len(other.space.time_spans) == 4
        assert other.at.phases == found.at.phases
        begin = other.at.times_s[0]
        make_schedule(
            tuple(time - begin for time in other.at.times_s),
            (space.window_s[0] - begin, space.window_s[1] - begin),
            space.mission.scenario.schedule,
        )
    before, after = (
        Timing(replace(one.space, phase_spans=((PHASES[0],) * 2, (PHASES[1],) * 2)), 0)
        .descend(one.at, one.burns_m_s, lambda _: None, Effort(1, 1e-4, 40))
        .dv_m_s
        for one in (found, tries[0])
    )
    assert before <= found.dv_m_s
    assert after < 0.99 * before


def test_another_burn_is_tried_once_given_room(few, monkeypatch):
    monkeypatch.setattr(design, "peaks", lambda _: [2_000.0, 2_500.0])
    (other,) = other_counts(few)
    assert other.at.times_s == pytest.approx((0.0, 6_600.0, 25_000.0, 34_842.0))
    monkeypatch.setattr(design, "BURNS_MAX", 3)
    assert other_counts(few) == []


def test_vanished_inner_burns_are_left_out():
    found = near_of(34_842.0)
    assert vanished(found) is None
    found.stage.result.lin.iterate.burns[1] = 0.0
    fewer = vanished(found)
    assert fewer.at.times_s == found.at.times_s[::2]
    assert fewer.space.time_spans == found.space.time_spans[::2]
    assert fewer.burns_m_s.shape == (2, 3)


def test_fixed_errors_have_one_burn_more_or_less():
    near = near_of(38_000.0, GATES, design={"arrival_s": [36_000.0, 52_000.0]})
    assert near.converged
    counts = sorted(len(other.at.times_s) for other in other_counts(near))
    assert counts == [2, 4, 4]
