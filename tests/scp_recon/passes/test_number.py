"""The number of burns: trials are legal, and help where the primer says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scp_recon.mission.schedule import make_schedule
from scp_recon.passes import design
from scp_recon.passes.descent import Near, descend
from scp_recon.passes.design import other_counts, peaks, vanished
from scp_recon.passes.setting import spaces_of
from scp_recon.passes.space import Pass, Space
from scp_recon.planning.primer import primer_history
from scp_recon.scenario.schema import Scenario
from tests.scp_recon.passes.support import home_scenario

PHASES = np.deg2rad(140.0), np.deg2rad(10.0)
COARSE = {"grid.step_max_s": 464.0}
GATES = {
    "uncertainty.gates": {
        "magnitude_fixed_m_s": 1e-5,
        "magnitude_proportional": 0.01,
        "pointing_fixed_m_s": 1e-5,
        "pointing_proportional_rad": 0.01,
    }
}


def near_of(scenario: Scenario) -> tuple[Space, Near]:
    space, times = spaces_of(scenario)[0]
    return space, Near(space, Pass(PHASES, times), np.zeros((len(times), 3)))


@pytest.fixture(scope="module")
def few() -> tuple[Space, Near]:
    return near_of(home_scenario(COARSE | {"burns.times_s": [0.0, 25_000.0, 34_842.0]}))


def test_a_burn_is_tried_where_the_primer_exceeds_one_and_makes_the_pass_cheaper(
    few: tuple[Space, Near],
) -> None:
    space, near = few
    found = near.first
    assert found.converged
    history = primer_history(found.mission, found.stage)
    assert history is not None
    tries = other_counts(space, found)
    assert 1 <= len(tries) <= len(peaks(history))
    for other in tries:
        assert other.space.n_burns == 4
        assert other.at.phases == found.at.phases
        begin = other.at.times_s[0]
        make_schedule(
            tuple(time - begin for time in other.at.times_s),
            (space.window_s[0] - begin, space.window_s[1] - begin),
            space.mission.scenario.schedule,
        )
    before, after = (
        descend(
            replace(one.space, phase_spans=((PHASES[0],) * 2, (PHASES[1],) * 2)),
            one.at,
            one.burns_m_s,
            lambda _: None,
            rounds_max=1,
        ).dv_m_s
        for one in (design.Candidate(space, found.at, found.burns_m_s), tries[0])
    )
    assert before <= found.dv_m_s
    assert after < 0.99 * before


def test_there_are_eight_burns_at_most(
    few: tuple[Space, Near], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(design, "BURNS_MAX", 3)
    assert other_counts(few[0], few[1].first) == []


def test_inner_burns_that_have_vanished_are_left_out_with_their_rules() -> None:
    space, near = near_of(home_scenario(COARSE | {"burns.times_s": [0.0, 25_000.0, 34_842.0]}))
    found = near.first
    assert vanished(space, found) is None
    found.stage.result.lin.iterate.burns[1] = 0.0
    fewer = vanished(space, found)
    assert fewer is not None
    assert fewer.at.times_s == (found.at.times_s[0], found.at.times_s[-1])
    assert fewer.space.time_spans == (space.time_spans[0], space.time_spans[-1])
    assert fewer.burns_m_s.shape == (2, 3)


def test_where_errors_do_not_shrink_one_more_and_one_less_is_tried() -> None:
    changes = COARSE | GATES | {"burns.times_s": [0.0, 25_000.0, 38_000.0]}
    space, near = near_of(home_scenario(changes, design={"arrival_s": [36_000.0, 52_000.0]}))
    assert near.first.converged
    counts = sorted(other.space.n_burns for other in other_counts(space, near.first))
    assert counts == [2, 4, 4]
