"""The SCP loop: it never gets worse, it ends as it says, and it survives its solver."""

import itertools
from collections.abc import Collection

import numpy as np
import pytest

from formulations.linearisation.linearisation import Linearisation
from formulations.program.condensed import CondensedSubproblem
from formulations.program.subproblem import Step, Subproblem, SubproblemError
from formulations.registry import make_subproblem
from formulations.rows.uniform import DeterministicRows
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import Plan
from scp_recon.scp.algorithms import SCvx
from scp_recon.scp.loop import Record, Result, run
from scp_recon.scp.status import Status
from tests.scp_recon.support import from_cold, mission_of


def ignore(_: Record) -> None:
    pass


@pytest.fixture(scope="module")
def p3(mission) -> Subproblem:
    return make_subproblem(mission.problem, DeterministicRows(mission.problem), "condensed")


@pytest.fixture(scope="module")
def cold(mission) -> Linearisation:
    return mission.dynamics.linearise(mission.problem, initial_guess.cold(mission))


@pytest.fixture(scope="module")
def optimum(default_plan) -> Result:
    """P3 from a cold start, undisturbed."""
    return default_plan.stages[0].result


@pytest.fixture(scope="module")
def infeasible() -> Plan:
    """Burns of at most 2 cm/s cannot reach the final state."""
    return from_cold(mission_of("burns.dv_max_m_s=0.02"), problem="P3")


@pytest.mark.parametrize("name", ["default_plan", "infeasible"])
def test_every_run_goes_by_its_rules(name, request):
    """Merit, trust region, last record; all but the guess is flown."""
    for stage in request.getfixturevalue(name).stages:
        records, lin = stage.result.records, stage.result.lin
        assert [record.k for record in records] == list(range(1, len(records) + 1))
        assert any(record.accepted for record in records)
        merit = None
        for record in records:
            # The conic solver keeps the bound to its accuracy, an absolute one.
            assert record.step <= record.trust_radius + 1e-6
            if record.accepted:
                assert record.actual > 0.0
                if merit is not None and record.merit < 10.0 * merit:  # else it was weighed anew
                    assert merit - record.merit == pytest.approx(record.actual, abs=1e-9)
            else:
                assert merit is None or record.merit >= merit - 1e-12
            merit = record.merit
        for record, after in itertools.pairwise(records):
            # With a new penalty weight, or to look again before a verdict.
            reset = after.trust_radius in (SCvx.initial_radius, SCvx.VERDICT_RADIUS)
            if record.actual < 0.01 * record.predicted and not reset:
                assert after.trust_radius < record.trust_radius
            if record.actual > 0.9 * record.predicted > 0.0 and not reset:
                assert after.trust_radius >= record.trust_radius
        last, violations = records[-1], stage.merit.violations(lin)
        assert np.abs(lin.defects[:-1]).max() < 1e-9
        assert last.total_dv == pytest.approx(lin.iterate.total_dv, rel=1e-12)
        assert last.max_defect == pytest.approx(violations.pop("dynamics").max(), abs=1e-15)
        worst = max(v.max(initial=0.0) for v in violations.values())
        assert last.max_violation == pytest.approx(worst)


def test_p2_ends_superlinearly(default_plan):
    # With the product rule's second-order term the model is exact to second order; the predicted
    # reductions, relative to the merit, then fall with at least the power 3/2 down to the tolerance.
    records = default_plan.stages[1].result.records
    assert all(record.accepted for record in records)
    predicted = [record.predicted / record.merit for record in records][-3:]
    assert len(predicted) == 3
    for now, after in itertools.pairwise(predicted):
        assert after <= max(now**1.5, 1e-6)
    for record in records[-3:]:  # reductions are known to the conic solver's 1e-8 of the merit
        noise = 1e-7 * record.merit
        assert record.actual == pytest.approx(record.predicted, rel=0.05, abs=noise)


def test_rough_end_flies_alike_with_earlier_derivatives(cold, mission):
    def ended(*, rough: bool) -> Linearisation:
        p3 = make_subproblem(mission.problem, DeterministicRows(mission.problem), "condensed")
        return run(p3, mission.dynamics, cold, SCvx(max_iterations=3), ignore, rough=rough).lin

    whole, rough = ended(rough=False), ended(rough=True)
    assert np.array_equal(whole.iterate.mean, rough.iterate.mean)
    assert np.abs(rough.defects[:-1]).max() < 1e-9
    assert 0.0 < np.abs(whole.arcs.stm - rough.arcs.stm).max() < 1e-6


def raising(monkeypatch, error: BaseException, at: Collection[int]) -> None:
    """Have some of the solver's calls, by number, end so."""
    original, calls = CondensedSubproblem.solve, itertools.count(1)

    def solve(self: CondensedSubproblem, radius: float, weight: float) -> Step:
        if next(calls) in at:
            raise error
        return original(self, radius, weight)

    monkeypatch.setattr(CondensedSubproblem, "solve", solve)


@pytest.mark.parametrize("failing", [{1}, {2, 3, 4}])
def test_occasional_solver_failures_are_survived(p3, cold, mission, monkeypatch, failing):
    raising(monkeypatch, SubproblemError("just this once"), failing)
    result = run(p3, mission.dynamics, cold, SCvx(), ignore)
    assert result.status is Status.CONVERGED
    assert {record.k for record in result.records if record.failure} == failing
    # The smaller first step may lead to another local optimum, but to one.
    last = result.records[-1]
    assert max(last.max_violation, last.max_defect) <= SCvx.feasible


def answering(monkeypatch, step: float, merit: float) -> None:
    """Have the solver answer with a share of the radius as step, and with one merit."""

    def solve(self: CondensedSubproblem, radius: float, *_: float) -> Step:
        return Step(self._at.iterate.burns + step * radius, merit, 0.0, 0.0)

    monkeypatch.setattr(CondensedSubproblem, "solve", solve)


@pytest.mark.parametrize("within", [False, True])
def test_limit_and_interrupt_keep_the_last_iteration(p3, cold, mission, monkeypatch, within):
    limited = run(p3, mission.dynamics, cold, SCvx(max_iterations=3), ignore)

    def ctrl_c(record: Record) -> None:
        if record.k == 3 and not within:
            raise KeyboardInterrupt

    raising(monkeypatch, KeyboardInterrupt(), {4} if within else ())
    result = run(p3, mission.dynamics, cold, SCvx(), ctrl_c)
    assert (limited.status, result.status) == (Status.MAX_ITERATIONS, Status.INTERRUPTED)
    for found in (limited, result):
        assert len(found.records) == 3
        merits = [record.merit for record in found.records]
        assert p3.merit(found.lin, SCvx.weight) == pytest.approx(min(merits))
        assert found.lin.iterate.total_dv == pytest.approx(found.records[-1].total_dv)


def test_an_inaccurate_answer_proves_no_stationarity(
    p3, mission, default_plan, optimum, monkeypatch
):
    """The convex model contains the iterate itself, so its optimum cannot be above the merit.

    An answer that is, by far more than the tolerance, is wrong. P2's solution is feasible for P3
    and a third more expensive than the optimum: nothing may call it converged.
    """
    start = default_plan.final.result.lin
    assert start.iterate.total_dv > 1.2 * optimum.lin.iterate.total_dv
    answering(monkeypatch, 0.0, p3.merit(start, SCvx.weight) + 0.1)
    result = run(p3, mission.dynamics, start, SCvx(), ignore)
    assert result.status is not Status.CONVERGED


def test_a_tiny_trust_region_proves_no_stationarity(p3, mission, default_plan, optimum):
    start = default_plan.final.result.lin
    result = run(p3, mission.dynamics, start, SCvx(initial_radius=1e-5), ignore)
    if result.status is Status.CONVERGED:
        assert result.lin.iterate.total_dv == pytest.approx(optimum.lin.iterate.total_dv, rel=1e-5)
    assert len(result.records) > 3


def test_an_unknown_name_is_refused():
    with pytest.raises(ValueError, match="'done'"):
        Status.named("done")
