"""The SCP loop and its algorithms: optima, accepted steps, flown steps, ends, solvers that fail."""

import itertools
from collections.abc import Collection
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from formulations.linearisation.linearisation import Linearisation, final_state_map, step_mean
from formulations.program.condensed import CondensedSubproblem
from formulations.program.subproblem import PenaltyParameters, Step, Subproblem, SubproblemError
from formulations.registry import make_subproblem
from formulations.rows.uniform import DeterministicRows
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import Plan
from scp_recon.scp import algorithms
from scp_recon.scp.algorithms import ALGORITHMS, PTR, SCvx, SCvxStar
from scp_recon.scp.loop import Algorithm, Record, Result, State, Timing, Trial, run
from scp_recon.scp.status import Status
from tests.helpers import usually
from tests.scenarios import COARSE
from tests.scp_recon.support import from_cold, mission_of

OTHERS = ["ptr", "scvx-star"]


def ignore(_: Record) -> None:
    pass


@pytest.fixture(scope="module")
def cold(mission) -> Linearisation:
    return mission.dynamics.linearise(mission.problem, initial_guess.cold(mission))


@pytest.fixture(scope="module")
def prox_run(mission, cold) -> Result:
    return p3_by(PTR(), mission, cold)


def p3_by(algorithm: Algorithm, mission: Mission, start: Linearisation) -> Result:
    rows = DeterministicRows(mission.problem)
    subproblem = make_subproblem(mission.problem, rows, penalty=algorithm.penalty)
    return run(subproblem, mission.dynamics, start, algorithm, ignore)


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHERS)
def test_every_algorithm_reaches_the_optimum_of_scvx(name, mission, default_plan):
    found = from_cold(mission, algorithm=name)
    for ours, theirs in zip(found.stages, default_plan.stages, strict=True):
        assert ours.result.status is Status.CONVERGED
        expected = theirs.result.lin.iterate.total_dv
        assert ours.result.lin.iterate.total_dv == pytest.approx(expected, rel=1e-4)
        # Of SCvx* the last correction of a flight moves covariances by 5e-7.
        last = ours.result.lin
        own = mission.dynamics.linearise(last.problem, last.iterate)
        assert np.abs(last.factor - own.factor).max() < 1e-14


@pytest.mark.slow
@pytest.mark.parametrize("name", usually(OTHERS, 1))
def test_unreachable_states_are_infeasible_with_least_violation(name):
    """Burns of at most 2 cm/s; what is violated is the burns' size, not the final state."""
    done = from_cold(mission_of("burns.dv_max_m_s=0.02", COARSE), problem="P3", algorithm=name)
    assert done.final.result.status is Status.INFEASIBLE
    violations = done.final.merit.violations(done.final.result.lin)
    assert violations["dv_max"].max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("name", ALGORITHMS)
def test_inaccurate_answers_end_without_a_verdict(name, mission, cold, monkeypatch):
    original = CondensedSubproblem.solve

    def solve(self: CondensedSubproblem, *arguments: float) -> Step:
        return replace(original(self, *arguments), accurate=False)

    monkeypatch.setattr(CondensedSubproblem, "solve", solve)
    result = p3_by(ALGORITHMS[name](max_iterations=25), mission, cold)
    assert result.status not in (Status.CONVERGED, Status.INFEASIBLE)


def test_an_inaccurate_large_step_is_not_final(mission, prox_run, monkeypatch):
    """From the optimum: a small step gains nothing, and neither would an unsure larger one."""
    original = CondensedSubproblem.solve

    def solve(self: CondensedSubproblem, radius: float, *charge: float) -> Step:
        return replace(original(self, radius, *charge), accurate=radius < 1e-3)

    monkeypatch.setattr(CondensedSubproblem, "solve", solve)
    result = p3_by(SCvx(initial_radius=1e-4), mission, prox_run.lin)
    assert result.status is Status.CONVERGED
    assert len(result.records) < 20


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_solver_that_always_fails_ends_the_run(name, mission, cold, monkeypatch):
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


def test_a_tenth_of_predicted_reduction_accepts_a_step(prox_run):
    records = prox_run.records
    assert not all(record.accepted for record in records)
    for record, after in itertools.pairwise(records[1:]):
        assert record.accepted == (record.actual > 0.1 * record.predicted)
        factor = PTR.GROW if record.accepted else PTR.SHRINK
        expected = min(factor * record.trust_radius, PTR.FREE)
        assert after.merit <= record.merit
        assert after.trust_radius == pytest.approx(expected)


def test_multipliers_price_the_final_state(mission, cold, prox_run):
    """Moving the final state by d changes the least delta-v by -l'd, to first order."""
    algorithm = SCvxStar()
    rows = DeterministicRows(mission.problem)
    subproblem = make_subproblem(mission.problem, rows, penalty="augmented")
    state = algorithm.init(subproblem, cold)

    for k in itertools.count(1):
        state, record = algorithm.step(subproblem, mission.dynamics, state, k, Timing())
        if algorithm.terminate(subproblem, state, record):
            break
    step = np.zeros(6)
    step[4] = 1e-3
    moved = replace(mission.problem, final_state=mission.problem.final_state + step)
    again = make_subproblem(moved, DeterministicRows(moved), penalty="proximal")
    start = mission.dynamics.linearise(moved, prox_run.lin.iterate)
    result = run(again, mission.dynamics, start, PTR(), ignore)
    change = result.lin.iterate.total_dv - prox_run.lin.iterate.total_dv
    assert change == pytest.approx(-state.charge.multipliers[:6] @ step, rel=0.05)


STEP = 0.1


def at(burns: float, *, flown: bool = True) -> Any:
    """A linearisation of which only the burns are known."""
    iterate = SimpleNamespace(burns=np.full((2, 3), burns), total_dv=1.0)
    return SimpleNamespace(
        is_dynamically_feasible=flown,
        iterate=iterate,
        controls=iterate.burns.ravel(),
        problem=SimpleNamespace(controls=lambda burns, *_: burns.ravel()),
    )


class Merit:
    """Of a problem without constraints, at an iterate with nothing violated."""

    def violations(self, _: object) -> dict[str, Any]:
        return {"dynamics": np.zeros((1, 6)), "rows": np.zeros(1)}

    def cost(self, _: object) -> float:
        return 1.0

    def excess(self, _: object) -> Any:
        return np.zeros(7)

    def __call__(self, *_: object) -> float:
        return 1.0


STUB = SimpleNamespace(merit=Merit())


@pytest.mark.parametrize("flown", [True, False])
@pytest.mark.parametrize("actual", [-1e3, -1e-12, 0.0, 0.2, 3.0])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_enough_reduction_or_a_guess_accepts_a_step(monkeypatch, name, actual, flown):
    """Of the promise, a reduction by one; from a guess whatever it leads to."""
    answer = Step(np.full((2, 3), STEP), 0.0, 0.0, 0.0)
    trial = Trial(answer, at(STEP), 1.0 - actual, 1.0, actual, STEP)
    monkeypatch.setattr(algorithms, "trial_step", lambda *_: trial)
    before = State(at(0.0, flown=flown), 1.0, 1.0, PenaltyParameters(10.0, multipliers=np.zeros(7)))
    after, record = ALGORITHMS[name]().step(STUB, None, before, 2, Timing())
    assert record.accepted == (after.lin is trial.lin) == (actual > 0.0 or not flown)
    if flown:
        assert after.merit == pytest.approx(1.0 - max(actual, 0.0))
        assert actual > 0.0 or after.radius < before.radius


@pytest.mark.parametrize(("dv_max", "verdict"), [(0.1, Status.INFEASIBLE), (10.0, None)])
def test_infeasibility_is_judged_by_the_merits_limits(dv_max, verdict):
    """Above two burns of that size no plan can be; the iterate's own problem has other limits."""
    algorithm = algorithms.SCvx()
    subproblem: Any = SimpleNamespace(
        merit=SimpleNamespace(problem=SimpleNamespace(n_burns=2, dv_max=dv_max))
    )
    lin: Any = SimpleNamespace(problem=SimpleNamespace(n_burns=2, dv_max=1.0))
    charge = PenaltyParameters(algorithm.weight_max)
    state = State(lin, 1.0, 1.0, charge, stationary=True)
    record = Record(1, 1.0, 0.0, 0.0, True, 1.0, 0.2, 0.1, 0.0, 0.0, 0.0)
    assert algorithm.terminate(subproblem, state, record) is verdict


@pytest.fixture(scope="module")
def optimum(default_plan) -> Linearisation:
    return default_plan.final.result.lin


@pytest.mark.parametrize("size", [1e-4, 1e-2, 0.1])
def test_a_flown_step_reaches_the_linear_final_state(mission, optimum, size):
    change = np.random.default_rng(5).normal(scale=size, size=optimum.iterate.burns.shape)
    # Only steps that keep the final state of the linear model are proposed near a solution.
    jacobian = final_state_map(optimum)[1]
    change -= (np.linalg.pinv(jacobian) @ jacobian @ change.ravel()).reshape(change.shape)
    burns = optimum.iterate.burns + change
    promised = step_mean(optimum, burns)[-1]
    flown = mission.dynamics.close_defects(optimum, burns)
    assert np.abs(flown.defects[:-1]).max() < 1e-11
    np.testing.assert_allclose(flown.iterate.mean[-1], promised, rtol=0.0, atol=1e-9)
    # The correction is of second order in the step.
    assert np.abs(flown.iterate.burns - burns).max() < 100.0 * size**2


@pytest.mark.parametrize("size", [0.3, 3.0, 30.0, None])
def test_large_steps_end_dynamically_exact(mission, optimum, size):
    """From a flight, or from the straight line to the final state."""
    start, problem = optimum, mission.problem
    if size is None:
        start = mission.dynamics.linearise(problem, initial_guess.cold(mission))
        constant, jacobian = final_state_map(start)
        burns = np.linalg.lstsq(jacobian, problem.final_state - constant)[0].reshape(-1, 3)
    else:
        burns = optimum.iterate.burns + size
    flown = mission.dynamics.close_defects(start, burns)
    assert np.abs(flown.defects[:-1]).max() < 1e-9


@pytest.fixture(scope="module")
def p3(mission) -> Subproblem:
    return make_subproblem(mission.problem, DeterministicRows(mission.problem), "condensed")


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


def test_an_inaccurate_answer_proves_no_stationarity(p3, mission, default_plan, monkeypatch):
    """The convex model contains the iterate itself, so its optimum cannot be above the merit.

    An answer that is, by far more than the tolerance, is wrong. P2's solution is feasible for P3
    and a third more expensive than the optimum: nothing may call it converged.
    """
    start = default_plan.final.result.lin
    assert start.iterate.total_dv > 1.2 * default_plan.stages[0].result.lin.iterate.total_dv
    answering(monkeypatch, 0.0, p3.merit(start, SCvx.weight) + 0.1)
    result = run(p3, mission.dynamics, start, SCvx(), ignore)
    assert result.status is not Status.CONVERGED


def test_a_tiny_trust_region_proves_no_stationarity(p3, mission, default_plan):
    start = default_plan.final.result.lin
    result = run(p3, mission.dynamics, start, SCvx(initial_radius=1e-5), ignore)
    if result.status is Status.CONVERGED:
        assert result.lin.iterate.total_dv == pytest.approx(
            default_plan.stages[0].result.lin.iterate.total_dv, rel=1e-5
        )
    assert len(result.records) > 3


def test_an_unknown_name_is_refused():
    with pytest.raises(ValueError, match="'done'"):
        Status.named("done")
