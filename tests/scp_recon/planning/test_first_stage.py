"""P3 from a guess that is no flight: what it begins without, and that it says so."""

from __future__ import annotations

import numpy as np
import pytest

from formulations.rows.uniform import DeterministicRows
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.planning.stages import contradicts_itself, without_parting_sets
from scp_recon.results.solution import make_solution
from scp_recon.scp.algorithms import ALGORITHMS
from scp_recon.scp.loop import Record
from scp_recon.scp.status import Status
from tests.scp_recon.support import flight_beyond

LOST = (0, 8)
"""Random guesses from which P3 with all its rows ends at its second optimum."""


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_random_guesses_end_at_the_better_optimum_at_the_first_try(
    algorithm: str, mission: Mission
) -> None:
    for seed in LOST:
        found = plan(mission, initial_guess.random(mission, seed), algorithm=algorithm)
        assert [stage.name for stage in found.stages] == ["P3.open", "P3", "P2"]
        assert found.status is Status.CONVERGED
        assert found.total_dv_m_s == pytest.approx(0.140135, rel=1e-4)


def test_what_holds_throughout_and_what_is_kept_in_stay(mission: Mission) -> None:
    names = {c.name for c in without_parting_sets(mission.problem).constraints}
    assert names == {"safety_radius", "site_distance_max", "emission_max"}
    kept = [c for c in mission.problem.constraints if c.name in names]
    assert list(without_parting_sets(mission.problem).constraints) == kept


def test_guesses_that_fly_or_claim_no_burns_begin_with_all_rows(
    mission: Mission, default_plan: Plan
) -> None:
    table = np.column_stack([default_plan.times_s, default_plan.states])
    coarse = np.vstack([table[::10], table[-1:]]) if (len(table) - 1) % 10 else table[::10]
    for guess in (
        initial_guess.cold(mission),
        initial_guess.ballistic(mission),
        initial_guess.circular(mission, -1.0),
        initial_guess.from_states(mission, coarse),
        flight_beyond(mission),
    ):
        assert not contradicts_itself(mission.dynamics.linearise(mission.problem, guess))
    for seed in range(10):
        guess = initial_guess.random(mission, seed)
        assert contradicts_itself(mission.dynamics.linearise(mission.problem, guess))


def test_a_flight_stays_on_its_side(mission: Mission) -> None:
    """Whoever gives a flight beyond the cone means that side."""
    found = plan(mission, flight_beyond(mission), problem="P3")
    assert [stage.name for stage in found.stages] == ["P3", "P3.held"]  # without its third burn
    assert found.total_dv_m_s == pytest.approx(0.159273, rel=1e-4)


def test_an_interrupted_opening_is_judged_by_all_rows(mission: Mission) -> None:
    def stop(_: str, record: Record) -> None:
        if record.k == 2:
            raise KeyboardInterrupt

    found = plan(mission, initial_guess.random(mission, 0), observe=stop)
    assert found.status is Status.INTERRUPTED
    assert found.final.name == "P3.open"
    rows = found.final.merit.rows
    assert isinstance(rows, DeterministicRows)
    assert {"emission_min", "phase_min"} <= found.final.margins.keys()
    assert make_solution(found).problem == "P3"
