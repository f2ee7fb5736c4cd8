"""SCvx, PTR and SCvx* end at the same optimum, and none of them claims what it cannot know."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from formulations.linearisation.linearisation import Linearisation
from formulations.program.condensed import CondensedSubproblem
from formulations.program.subproblem import Step, SubproblemError
from formulations.registry import make_subproblem
from formulations.rows.uniform import DeterministicRows
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import Plan, plan
from scp_recon.scp.algorithms import ALGORITHMS, PTR, SCvx, SCvxStar
from scp_recon.scp.loop import Algorithm, Record, Result, Timing, run
from scp_recon.scp.status import Status
from tests.scenarios import COARSE
from tests.scp_recon.support import mission_of

OTHERS = ["ptr", "scvx-star"]


def ignore(_: Record) -> None:
    pass


@pytest.fixture(scope="module")
def cold(mission: Mission) -> Linearisation:
    return mission.dynamics.linearise(mission.problem, initial_guess.cold(mission))


@pytest.fixture(scope="module")
def prox_run(mission: Mission, cold: Linearisation) -> Result:
    return p3_by(PTR(), mission, cold)


def p3_by(algorithm: Algorithm, mission: Mission, start: Linearisation) -> Result:
    rows = DeterministicRows(mission.problem)
    subproblem = make_subproblem(mission.problem, rows, penalty=algorithm.penalty)
    return run(subproblem, mission.dynamics, start, algorithm, ignore)


@pytest.mark.parametrize("name", OTHERS)
def test_every_algorithm_reaches_the_optimum_of_scvx(
    name: str, mission: Mission, default_plan: Plan
) -> None:
    found = plan(mission, initial_guess.cold(mission), algorithm=name)
    for ours, theirs in zip(found.stages, default_plan.stages, strict=True):
        assert ours.result.status is Status.CONVERGED
        expected = theirs.result.lin.iterate.total_dv
        assert ours.result.lin.iterate.total_dv == pytest.approx(expected, rel=1e-4)
        # Of SCvx* the last correction of a flight moves covariances by 5e-7.
        last = ours.result.lin
        own = mission.dynamics.linearise(last.problem, last.iterate)
        assert np.abs(last.factor - own.factor).max() < 1e-14


@pytest.mark.parametrize("name", OTHERS)
def test_what_cannot_be_reached_is_infeasible_with_the_least_violation(name: str) -> None:
    """Burns of at most 2 cm/s; what is violated is the burns' size, not the final state."""
    mission = mission_of("burns.dv_max_m_s=0.02", COARSE)
    done = plan(mission, initial_guess.cold(mission), problem="P3", algorithm=name)
    assert done.final.result.status is Status.INFEASIBLE
    violations = done.final.merit.violations(done.final.result.lin)
    assert violations["dv_max"].max() > 0.1


@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_answer_that_the_solver_does_not_vouch_for_ends_in_no_verdict(
    name: str, mission: Mission, cold: Linearisation, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = CondensedSubproblem.solve

    def solve(self: CondensedSubproblem, *arguments: float) -> Step:
        return replace(original(self, *arguments), accurate=False)

    monkeypatch.setattr(CondensedSubproblem, "solve", solve)
    result = p3_by(ALGORITHMS[name](max_iterations=25), mission, cold)
    assert result.status not in (Status.CONVERGED, Status.INFEASIBLE)


def test_where_the_solver_vouches_for_small_steps_alone_it_is_asked_twice(
    mission: Mission, prox_run: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the optimum: a small step gains nothing, and neither would an unsure larger one."""
    original = CondensedSubproblem.solve

    def solve(self: CondensedSubproblem, radius: float, *charge: float) -> Step:
        return replace(original(self, radius, *charge), accurate=radius < 1e-3)

    monkeypatch.setattr(CondensedSubproblem, "solve", solve)
    result = p3_by(SCvx(initial_radius=1e-4), mission, prox_run.lin)
    assert result.status is Status.CONVERGED
    assert len(result.records) < 20


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_solver_that_always_fails_ends_the_run(
    name: str, mission: Mission, cold: Linearisation, monkeypatch: pytest.MonkeyPatch
) -> None:
    def solve(*_: object) -> Step:
        raise SubproblemError("no answer")

    monkeypatch.setattr(CondensedSubproblem, "solve", solve)
    result = p3_by(ALGORITHMS[name](), mission, cold)
    assert result.status is Status.SOLVER_FAILED
    assert result.lin is cold
    assert all(record.failure == "no answer" for record in result.records)
    radii = [record.trust_radius for record in result.records]
    assert all(after < before for before, after in itertools.pairwise(radii))
    assert len(radii) >= 2


# --- PTR ----------------------------------------------------------------------------------------


def test_a_step_is_taken_for_a_tenth_of_its_promise_and_moves_the_soft_radius(
    prox_run: Result,
) -> None:
    records = prox_run.records
    assert not all(record.accepted for record in records)
    for record, after in itertools.pairwise(records[1:]):
        assert record.accepted == (record.actual > 0.1 * record.predicted)
        factor = PTR.GROW if record.accepted else PTR.SHRINK
        expected = min(factor * record.trust_radius, PTR.FREE)
        assert after.merit <= record.merit
        assert after.trust_radius == pytest.approx(expected)


# --- SCvx* --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "algorithm",
    [*map(PTR, (0.03, 30.0)), SCvxStar(weight=1.0), SCvxStar(weight=1e4)],
    ids=["ptr of a small radius", "of a large one", "scvx-star of a small weight", "a large one"],
)
def test_the_first_radius_and_weight_are_no_matter_of_life_and_death(
    algorithm: Algorithm, mission: Mission, cold: Linearisation, prox_run: Result
) -> None:
    result = p3_by(algorithm, mission, cold)
    assert result.status is Status.CONVERGED
    expected = prox_run.lin.iterate.total_dv
    assert result.lin.iterate.total_dv == pytest.approx(expected, rel=1e-4)


def test_multipliers_end_at_the_price_of_the_final_state(
    mission: Mission, cold: Linearisation, prox_run: Result
) -> None:
    """Moving the final state by d changes the least delta-v by -l'd, to first order."""
    algorithm = SCvxStar()
    rows = DeterministicRows(mission.problem)
    subproblem = make_subproblem(mission.problem, rows, penalty="augmented")
    state = algorithm.init(subproblem, cold)

    for k in itertools.count(1):
        state, record = algorithm.step(subproblem, mission.dynamics, state, k, Timing())
        if algorithm.terminate(subproblem, state, record):
            break
    assert state.charge.multipliers is not None
    step = np.zeros(6)
    step[4] = 1e-3
    moved = replace(mission.problem, final_state=mission.problem.final_state + step)
    again = make_subproblem(moved, DeterministicRows(moved), penalty="proximal")
    start = mission.dynamics.linearise(moved, prox_run.lin.iterate)
    result = run(again, mission.dynamics, start, PTR(), ignore)
    change = result.lin.iterate.total_dv - prox_run.lin.iterate.total_dv
    assert change == pytest.approx(-state.charge.multipliers[:6] @ step, rel=0.05)


def test_ptr_begun_at_an_optimum_ends_there(mission: Mission, prox_run: Result) -> None:
    """What is left to gain is lost in the merit's rounding, and so is what a step gains."""
    nearer = p3_by(replace(PTR(), stationary=1e-9), mission, prox_run.lin)
    again = p3_by(PTR(), mission, nearer.lin)
    assert again.status is Status.CONVERGED
    assert len(again.records) <= 4
