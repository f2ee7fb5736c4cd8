"""Convex subproblems: convex, compiled once, exact at their iterate, and alike in every form."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from cvxpy.reductions.solvers.defines import SOLVER_MAP_CONIC
from cvxpy.reductions.solvers.solving_chain import SolvingChain
from hypothesis import example, given, settings
from hypothesis import strategies as st

from formulations.arrays import Array
from formulations.linearisation.condensation import CONDENSATIONS, Condensation, condense
from formulations.linearisation.linearisation import Linearisation, propagate_factor
from formulations.problem.flyby import FlybyProblem, Iterate
from formulations.program import condensed, lifted
from formulations.program.certificate import ConeProgram
from formulations.program.model import CompiledProgram, Model
from formulations.program.solvers import SOLVERS, Answer, FallbackSolver
from formulations.program.subproblem import DYNAMICS_WEIGHT, Subproblem, SubproblemError
from formulations.registry import FORMULATIONS, make_subproblem
from formulations.rows.cones import Rows
from formulations.rows.uniform import ChanceRows, DeterministicRows
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import Plan, plan
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.algorithms import SCvx
from scp_recon.scp.status import Status
from tests.helpers import constrain, generators, random_flyby, share_of_examples

from .support import every_row, need, tighten

CONDENSED = ["condensed", "frozen-stm", "frozen-covariance"]
FROZEN = ["frozen-stm", "frozen-covariance"]
WEIGHT = SCvx.weight


@dataclass(frozen=True)
class Case:
    """A mission with its plan, and iterates to look at."""

    mission: Mission
    plan: Plan

    @property
    def problem(self) -> FlybyProblem:
        return self.mission.problem

    @property
    def p2_rows(self) -> ChanceRows:
        rows = self.plan.final.merit.rows
        assert isinstance(rows, ChanceRows)
        return rows

    def rows(self, name: str) -> Rows:
        if name == "P3":
            return DeterministicRows(self.problem)
        return ChanceRows(self.problem, self.p2_rows.facets, self.p2_rows.included)

    def at(self, name: str) -> Linearisation:
        """Linearised at the guess or the solution of that name."""
        if name in ("P3", "P2"):
            return self.solved(name)
        if name == "missed":
            astray = 0.003 * np.random.default_rng(0).normal(size=(4, 3))  # m/s
            burns = self.solved("P3").iterate.burns * self.mission.units.speed_m_s + astray
            iterate = initial_guess.from_burns(self.mission, burns)
        else:
            iterate = getattr(initial_guess, name)(self.mission)
        start = self.problem.initial_state + np.r_[0.0, 0.0, 0.0, iterate.burns[0]]
        iterate = Iterate(iterate.burns, np.vstack([start, iterate.mean[1:]]))
        return self.mission.dynamics.linearise(self.problem, iterate)

    def solved(self, name: str) -> Linearisation:
        return next(stage.result.lin for stage in self.plan.stages if stage.name == name)


@pytest.fixture(scope="module")
def case() -> Case:
    mission = Mission.from_scenario(load_scenario(None, ("grid.step_max_s=450",)))
    found = plan(mission, initial_guess.cold(mission))
    assert [stage.result.status for stage in found.stages] == [Status.CONVERGED] * 2
    return Case(mission, found)


Build = Callable[[str, str], Subproblem]


@pytest.fixture(scope="module")
def build(case: Case) -> Build:
    """Subproblems by formulation and name, each compiled once."""
    built: dict[tuple[str, str], Subproblem] = {}

    def get(formulation: str, name: str) -> Subproblem:
        key = formulation, name
        if key not in built:
            built[key] = make_subproblem(case.problem, case.rows(name), formulation)
        return built[key]

    return get


# --- convex, and compiled once ------------------------------------------------------------------


def compiling(monkeypatch: pytest.MonkeyPatch) -> list[Model]:
    """The models that are compiled from now on; those of condensed forms with slots for all rows."""
    compiled: list[Model] = []

    def watch(model: Model) -> CompiledProgram:
        compiled.append(model)
        return CompiledProgram(model)

    for module in (condensed, lifted):
        monkeypatch.setattr(module, "CompiledProgram", watch)
    monkeypatch.setattr(condensed, "SLOTS", 128)
    condensed.compile_condensed.cache_clear()
    return compiled


@pytest.mark.parametrize("name", ["P3", "P2"])
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_programs_are_disciplined_convex_and_parametrised(
    case: Case, formulation: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = compiling(monkeypatch)
    subproblem = make_subproblem(case.problem, case.rows(name), formulation)
    subproblem.update(case.at("P3"))
    subproblem.solve(0.5, WEIGHT)
    (model,) = compiled
    assert model.program.is_dcp(dpp=True)


@pytest.mark.parametrize("name", ["P3", "P2"])
@pytest.mark.parametrize("formulation", ["condensed", "lifted"])
def test_programs_are_compiled_once_and_only_their_numbers_change(
    case: Case, formulation: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    models, applied, programs = compiling(monkeypatch), [], list[ConeProgram]()
    apply, solve = SolvingChain.apply, FallbackSolver.solve

    def count(self: SolvingChain, *args: object) -> object:
        applied.append(args)
        return apply(self, *args)

    def watch(self: FallbackSolver, program: ConeProgram) -> Answer:
        programs.append(program)
        return solve(self, program)

    monkeypatch.setattr(SolvingChain, "apply", count)
    monkeypatch.setattr(FallbackSolver, "solve", watch)
    subproblem, of = make_subproblem(case.problem, case.rows(name), formulation), []
    for around in ("ballistic", "P3", "P2"):
        subproblem.update(case.at(around))
        subproblem.solve(0.5, WEIGHT)
        of.append(programs[-1])
    assert len(models) == len(applied) == 1
    assert len(programs) >= 3
    for program in programs:
        assert program.form is programs[0].form
        assert np.array_equal(program.matrix.indices, programs[0].matrix.indices)
        assert np.array_equal(program.matrix.indptr, programs[0].matrix.indptr)
    norms = [np.linalg.norm(program.matrix.data) for program in of]
    assert norms[0] != norms[1] != norms[2]


# --- exact at the iterate -----------------------------------------------------------------------


@pytest.mark.parametrize("around", ["missed", "P3", "P2"])
@pytest.mark.parametrize("name", ["P3", "P2"])
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_without_a_step_the_model_predicts_the_nonlinear_merit(
    case: Case, build: Build, formulation: str, name: str, around: str
) -> None:
    subproblem, lin = build(formulation, name), case.at(around)
    assert np.abs(lin.defects[:-1]).max() < 1e-12  # a flown iterate; the model would close them
    subproblem.update(lin)
    merit = subproblem.merit(lin, WEIGHT)
    assert subproblem.solve(1e-12, WEIGHT).merit == pytest.approx(merit, rel=1e-6)


def breaking_every_limit(rng: np.random.Generator) -> Linearisation:
    """A flown iterate on the wrong side of every constraint, its burns too large and sunward."""
    flyby = constrain(rng, random_flyby(rng, nodes=7))
    swap = {"in": "out", "out": "in"}
    sunward = flyby.burns / np.linalg.norm(flyby.burns, axis=1, keepdims=True)
    sunward += 0.02 * rng.normal(size=sunward.shape)
    problem = replace(
        flyby.problem,
        constraints=tuple(replace(c, keep=swap[c.keep]) for c in flyby.problem.constraints),
        dv_max=0.5 * float(np.linalg.norm(flyby.burns, axis=1).min()),
        sun=sunward / np.linalg.norm(sunward, axis=1, keepdims=True) * rng.choice([-1.0, 1.0]),
        dv_cone=0.3,
        final_state=flyby.problem.final_state + 0.1,
    )
    return replace(flyby, problem=problem).perturbed(rng, 0.003, 0.0)


@pytest.mark.parametrize("name", ["P3", "P2"])
@pytest.mark.parametrize("formulation", ["condensed", "lifted"])
@settings(max_examples=share_of_examples(100, usual=2))
@given(st.integers(0, 2**32 - 1))
@example(1)  # a constraint on the last node, where the final state is missed
def test_without_a_step_the_model_predicts_what_breaking_every_limit_costs(
    formulation: str, name: str, seed: int
) -> None:
    lin = breaking_every_limit(np.random.default_rng(seed))
    subproblem = make_subproblem(lin.problem, every_row(lin, name), formulation)
    subproblem.update(lin)
    assert all(amount.sum() > 0.0 for amount in subproblem.merit.violations(lin).values())
    merit = subproblem.merit(lin, WEIGHT)
    assert subproblem.solve(1e-12, WEIGHT).merit == pytest.approx(merit, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "around"), [("P3", "missed"), ("P2", "missed"), ("P3", "P2"), ("P2", "P3")]
)
def test_the_predicted_merit_errs_quadratically_in_the_step(
    case: Case, build: Build, name: str, around: str
) -> None:
    subproblem, lin = build("condensed", name), case.at(around)
    subproblem.update(lin)
    errors = []
    for radius in (1e-3, 1e-4):
        step = subproblem.solve(radius, WEIGHT)
        mean = case.mission.dynamics.rollout(case.problem.initial_state, step.burns)
        flown = case.mission.dynamics.linearise(case.problem, Iterate(step.burns, mean))
        errors.append(abs(subproblem.merit(flown, WEIGHT) - step.merit))
    assert errors[0] > 1e-6 * subproblem.merit(lin, WEIGHT)  # so that an order can be observed
    assert np.log10(errors[0] / errors[1]) >= 1.8


@pytest.mark.parametrize("name", ["P3", "P2"])
def test_the_merit_is_the_total_delta_v_plus_the_weighted_violations(
    case: Case, build: Build, name: str
) -> None:
    subproblem, lin = build("condensed", name), case.at("cold")
    amounts = subproblem.merit.violations(lin)
    constraints = {c.name for c in case.problem.constraints}
    assert set(amounts) == {"dynamics", "dv_max", "dv_battery"} | constraints
    violation = DYNAMICS_WEIGHT * np.abs(lin.defects).sum()
    if name == "P3":
        for c in case.problem.constraints:
            inside = c.region.inside(lin.iterate.mean[c.nodes, :3])
            violation += np.maximum(-inside if c.keep == "in" else inside, 0.0).sum()
    else:
        facets, used = case.p2_rows.facets, case.p2_rows.included
        margin = facets.margin(lin.iterate.mean, lin.factor)[used]
        violation += np.maximum(-margin, 0.0).sum()
    # Burns of 1e-10 m/s are below every limit, but may lie in the battery's cone.
    assert subproblem.merit(lin, 1e3) == pytest.approx(1e3 * violation, rel=1e-6)
    assert subproblem.merit(lin, 0.0) == pytest.approx(lin.iterate.total_dv)


# --- every form of the same problem -------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "around"),
    [("P3", "cold"), ("P3", "ballistic"), ("P3", "P2"), ("P2", "ballistic"), ("P2", "P3")],
)
def test_lifted_and_condensed_have_the_same_solution(
    case: Case, name: str, around: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    tighten(monkeypatch)
    lin, speed = case.at(around), case.mission.units.speed_m_s
    steps = []
    for formulation in ("condensed", "lifted"):  # built here, with the tight tolerance
        subproblem = make_subproblem(case.problem, case.rows(name), formulation)
        subproblem.update(lin)
        steps.append(subproblem.solve(SCvx.initial_radius, WEIGHT))
    assert steps[1].merit == pytest.approx(steps[0].merit, rel=1e-6)
    assert speed * steps[1].burns == pytest.approx(speed * steps[0].burns, abs=1e-6)  # m/s


@pytest.mark.parametrize("name", ["P3", "P2"])
def test_lifted_and_condensed_agree_where_the_final_state_is_out_of_reach(
    case: Case, build: Build, name: str
) -> None:
    merits = []
    for formulation in ("condensed", "lifted"):
        subproblem = build(formulation, name)
        subproblem.update(case.at("missed"))
        merits.append(subproblem.solve(1e-3, WEIGHT).merit)
    assert merits[1] == pytest.approx(merits[0], rel=1e-6)


@pytest.mark.parametrize("name", ["P3", "P2"])
@settings(max_examples=share_of_examples(50, usual=4))
@given(generators, st.sampled_from([("in",), ("out",), ("in", "out")]))
def test_lifted_and_condensed_agree_on_random_flybys(
    name: str, rng: np.random.Generator, keeps: tuple[str, ...]
) -> None:
    lin = constrain(rng, random_flyby(rng, nodes=7), keeps).perturbed(rng, 0.1, 0.05)
    merits = []
    with pytest.MonkeyPatch.context() as patch:
        tighten(patch)
        for formulation in ("condensed", "lifted"):
            subproblem = make_subproblem(lin.problem, every_row(lin, name), formulation)
            subproblem.update(lin)
            merits.append(subproblem.solve(2.0, WEIGHT).merit)
    assert merits[1] == pytest.approx(merits[0], rel=1e-6)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_two_burns_on_linear_arcs_are_what_the_boundary_demands(formulation: str) -> None:
    flyby = random_flyby(np.random.default_rng(5), nodes=8, burns=2, curvature=0.0)
    problem = flyby.problem
    total = np.eye(6)
    for stm in flyby.waves.linear:
        total = stm @ total
    kick = np.eye(6)[:, 3:]
    drift = problem.final_state - total @ problem.initial_state
    burns = np.linalg.solve(np.hstack([total @ kick, kick]), drift).reshape(2, 3)
    # Away from the battery's cones, which would forbid the only solution.
    sun = np.cross(burns, [0.3, 0.5, -0.7])
    problem = replace(problem, sun=sun / np.linalg.norm(sun, axis=1, keepdims=True))
    subproblem = make_subproblem(problem, DeterministicRows(problem), formulation)
    lin = flyby.waves.linearise(problem, flyby.waves.rollout(problem, np.zeros((2, 3))))
    subproblem.update(lin)
    step = subproblem.solve(10.0, 100.0)
    assert step.burns == pytest.approx(burns, abs=1e-6)
    assert step.merit == pytest.approx(np.linalg.norm(burns, axis=1).sum(), rel=1e-6)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_p2_without_facets_near_binding_is_p3_without_constraints(
    case: Case, formulation: str
) -> None:
    unconstrained = replace(case.problem, constraints=())
    none = np.zeros_like(case.p2_rows.included)
    lin, merits = case.at("P3"), []
    for rows in (
        DeterministicRows(unconstrained),
        ChanceRows(case.problem, case.p2_rows.facets, none),
    ):
        subproblem = make_subproblem(case.problem, rows, formulation)
        subproblem.update(lin)
        merits.append(subproblem.solve(1.0, WEIGHT).merit)
    assert merits[1] == pytest.approx(merits[0], rel=1e-6)


@pytest.mark.parametrize("formulation", CONDENSED)
def test_p3_is_the_same_in_every_condensed_form(case: Case, build: Build, formulation: str) -> None:
    merits = []
    for other in ("condensed", formulation):
        subproblem = build(other, "P3")
        subproblem.update(case.at("ballistic"))
        merits.append(subproblem.solve(1.0, WEIGHT).merit)
    assert merits[1] == pytest.approx(merits[0], rel=1e-8)


def test_facets_left_out_are_missed_exactly_where_the_iterate_violates_them(case: Case) -> None:
    lin, facets = case.at("cold"), case.p2_rows.facets
    margin = facets.margin(lin.iterate.mean, lin.factor)
    violated = margin < -1e-6
    included = np.random.default_rng(0).uniform(size=len(margin)) < 0.5
    missed = ChanceRows(case.problem, facets, included).missed(lin, 1e-6)
    assert np.array_equal(missed, violated & ~included)
    assert missed.any()


# --- what is frozen -----------------------------------------------------------------------------


def frozen(kind: Condensation, lin: Linearisation) -> tuple[Array, ...]:
    """Mean and factor that a frozen form models for other burns than the iterate's."""
    s = kind(lin, np.arange(lin.problem.n_nodes), factor=True)
    burns = other_burns(lin)
    z = burns.ravel()
    return s.mean_constant + s.mean_jacobian @ z, s.factor_constant + s.factor_jacobian @ z


def other_burns(lin: Linearisation) -> Array:
    return lin.iterate.burns + np.random.default_rng(3).normal(size=lin.iterate.burns.shape)


@settings(max_examples=20)
@given(generators)
def test_frozen_stm_moves_the_factor_with_the_burns_by_the_iterates_stms(
    rng: np.random.Generator,
) -> None:
    lin = random_flyby(rng).perturbed(rng, 0.2, 0.1)
    expected = propagate_factor(
        lin.problem, lin.problem.legs.compose(lin.arcs.stm), other_burns(lin)
    )
    assert frozen(CONDENSATIONS["frozen-stm"], lin)[1] == pytest.approx(
        expected, rel=1e-9, abs=1e-11
    )


@settings(max_examples=20)
@given(generators)
def test_frozen_covariance_keeps_the_iterates_factor_whatever_the_burns(
    rng: np.random.Generator,
) -> None:
    lin = random_flyby(rng).perturbed(rng, 0.2, 0.1)
    assert np.array_equal(frozen(CONDENSATIONS["frozen-covariance"], lin)[1], lin.factor)


@pytest.mark.parametrize("formulation", FROZEN)
@settings(max_examples=20)
@given(generators)
def test_frozen_forms_model_the_mean_in_full(formulation: str, rng: np.random.Generator) -> None:
    lin = random_flyby(rng).perturbed(rng, 0.2, 0.1)
    s = condense(lin)
    expected = s.mean_constant + s.mean_jacobian @ other_burns(lin).ravel()
    assert frozen(CONDENSATIONS[formulation], lin)[0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("formulation", ["condensed", "lifted"])
def test_the_full_model_promises_nothing_at_the_solution_of_p2(
    case: Case, build: Build, formulation: str
) -> None:
    assert promised(case, build(formulation, "P2")) <= SCvx.stationary


@pytest.mark.parametrize("formulation", FROZEN)
def test_frozen_models_promise_what_is_not_to_be_had_at_the_solution_of_p2(
    case: Case, build: Build, formulation: str
) -> None:
    assert promised(case, build(formulation, "P2")) >= 10.0 * SCvx.stationary


def promised(case: Case, subproblem: Subproblem) -> float:
    """Reduction of the merit, relative, that the model predicts within a unit radius."""
    lin = case.at("P2")
    subproblem.update(lin)
    merit = subproblem.merit(lin, WEIGHT)
    return (merit - subproblem.solve(1.0, WEIGHT).merit) / merit


# --- penalty ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["P3", "P2"])
def test_at_convergence_every_buffer_is_zero(case: Case, build: Build, name: str) -> None:
    lin, subproblem = case.at(name), build("condensed", name)
    assert max(v.max(initial=0.0) for v in subproblem.merit.violations(lin).values()) <= 1e-8
    subproblem.update(lin)
    step = subproblem.solve(1.0, WEIGHT)
    buffers = step.merit - np.linalg.norm(step.burns, axis=1).sum()
    assert buffers == pytest.approx(0.0, abs=1e-7 * step.merit)


@pytest.mark.parametrize("name", ["P3", "P2"])
def test_the_penalty_is_exact_at_convergence_a_larger_weight_changes_nothing(
    case: Case, build: Build, name: str
) -> None:
    lin, subproblem = case.at(name), build("condensed", name)
    subproblem.update(lin)
    for weight in (WEIGHT, 2.0 * WEIGHT, 10.0 * WEIGHT):
        step = subproblem.solve(1.0, weight)
        assert step.merit == pytest.approx(lin.iterate.total_dv, rel=1e-6)


def test_a_weight_below_the_multipliers_is_not_exact(case: Case, build: Build) -> None:
    lin, subproblem = case.at("P2"), build("condensed", "P2")
    subproblem.update(lin)
    assert subproblem.solve(1.0, 1e-2).merit < 0.9 * lin.iterate.total_dv


# --- trust region and failures ------------------------------------------------------------------


@pytest.mark.parametrize("name", ["P3", "P2"])
@pytest.mark.parametrize("radius", [1e-3, 0.1])
def test_no_component_of_a_burn_moves_by_more_than_the_radius(
    case: Case, build: Build, name: str, radius: float
) -> None:
    lin, subproblem = case.at("ballistic"), build("condensed", name)
    subproblem.update(lin)
    step = subproblem.solve(radius, WEIGHT).burns - lin.iterate.burns
    assert np.abs(step).max() == pytest.approx(radius, rel=1e-4)  # the guess is far: it binds


def test_a_larger_trust_region_never_promises_less(case: Case, build: Build) -> None:
    subproblem = build("condensed", "P3")
    subproblem.update(case.at("ballistic"))
    merits = [subproblem.solve(radius, WEIGHT).merit for radius in (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)]
    assert all(after <= before * (1.0 + 1e-8) for before, after in itertools.pairwise(merits))
    assert merits[-1] < merits[0]


class Scripted:
    """A conic solver with one answer."""

    def __init__(self, answer: Answer | str) -> None:
        self._answer = answer

    def solve(self, program: ConeProgram) -> Answer:
        if isinstance(self._answer, str):
            raise ValueError(self._answer)
        return self._answer._replace(x=np.full(len(program.cost), self._answer.x[0]))


def scripted(monkeypatch: pytest.MonkeyPatch, answer: Answer | str, other: str) -> None:
    """One solver with this answer, however often it is built, and another that fails."""
    monkeypatch.setitem(SOLVERS, "CLARABEL", lambda _: Scripted(answer))
    monkeypatch.setitem(SOLVERS, "QOCO", lambda _: Scripted(other))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_solvers_that_fail_raise_our_own_error_with_their_words(
    case: Case, formulation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripted(monkeypatch, "it broke down", other="so did I")
    subproblem = make_subproblem(case.problem, case.rows("P3"), formulation)
    subproblem.update(case.at("P3"))
    with pytest.raises(SubproblemError, match=r"^it broke down; so did I$") as caught:
        subproblem.solve(1.0, WEIGHT)
    assert isinstance(caught.value.__cause__, ValueError)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_solvers_without_a_finite_answer_raise_our_own_error(
    case: Case, formulation: str, value: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripted(monkeypatch, Answer(np.full(1, value), "good", True, 0.0), other="no")
    subproblem = make_subproblem(case.problem, case.rows("P3"), formulation)
    subproblem.update(case.at("P3"))
    with pytest.raises(SubproblemError, match="no finite burns"):
        subproblem.solve(1.0, WEIGHT)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_solver_behind_cvxpy_that_fails_raises_our_own_error_with_its_words(
    case: Case, formulation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    need("ECOS")

    def fail(*_: object) -> None:
        raise RuntimeError("it broke down")

    monkeypatch.setattr(SOLVER_MAP_CONIC["ECOS"], "solve_via_data", fail)
    subproblem = make_subproblem(case.problem, case.rows("P3"), formulation, "ECOS")
    subproblem.update(case.at("P3"))
    with pytest.raises(SubproblemError, match=r"^it broke down$"):
        subproblem.solve(1.0, WEIGHT)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_step_is_as_accurate_as_its_answer(
    case: Case, formulation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = Answer(np.full(1, 0.125), "poor", False, 0.0)
    monkeypatch.setattr(condensed, "MISSED", np.inf)
    for accurate in (False, True):
        scripted(monkeypatch, answer._replace(accurate=accurate), other="no")
        subproblem = make_subproblem(case.problem, case.rows("P3"), formulation)
        subproblem.update(case.at("ballistic"))
        step = subproblem.solve(1.0, WEIGHT)
        assert step.accurate is accurate
        assert np.array_equal(step.burns, np.full((4, 3), 0.125))
