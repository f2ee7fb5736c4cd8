"""Convex subproblems: compiled once, exact at their iterate, wrong by the square of the step."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from cvxpy.reductions.solvers.solving_chain import SolvingChain
from hypothesis import example, given, settings
from hypothesis import strategies as st

from formulations.linearisation.linearisation import Linearisation
from formulations.problem.flyby import FlybyProblem, Iterate
from formulations.program import condensed
from formulations.program.certificate import ConeProgram
from formulations.program.model import CompiledProgram, Model
from formulations.program.solvers import SOLVERS, Answer, FallbackSolver
from formulations.program.subproblem import Subproblem, SubproblemError
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

from .support import every_row

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
        """Linearised at the ballistic guess, or at the solution of that name."""
        if name in ("P3", "P2"):
            return self.solved(name)
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


# --- compiled once ------------------------------------------------------------------


def compiling(monkeypatch: pytest.MonkeyPatch) -> list[Model]:
    """The models that are compiled from now on; those of condensed forms with slots for all rows."""
    compiled: list[Model] = []

    def watch(model: Model) -> CompiledProgram:
        compiled.append(model)
        return CompiledProgram(model)

    monkeypatch.setattr(condensed, "CompiledProgram", watch)
    monkeypatch.setattr(condensed, "SLOTS", 128)
    condensed.compile_condensed.cache_clear()
    return compiled


@pytest.mark.parametrize("name", ["P3", "P2"])
def test_programs_are_compiled_once_and_only_their_numbers_change(
    case: Case, name: str, monkeypatch: pytest.MonkeyPatch
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
    subproblem, of = make_subproblem(case.problem, case.rows(name)), []
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
@pytest.mark.parametrize("formulation", FORMULATIONS)
@settings(max_examples=share_of_examples(100, usual=1))
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


@pytest.mark.parametrize("name", ["P3", "P2"])
@settings(max_examples=share_of_examples(10))
@given(generators, st.integers(4, 8))
def test_the_predicted_merit_errs_quadratically_in_the_step(
    name: str, rng: np.random.Generator, facets: int
) -> None:
    keeps = [("in",), ("out",), ("in", "out")][int(rng.integers(3))]
    flyby = constrain(rng, random_flyby(rng, nodes=7), keeps)
    # A spread that counts, or its linearisation would not.
    wide = replace(flyby.problem, initial_factor=20.0 * flyby.problem.initial_factor)
    flyby = replace(flyby, problem=wide)
    lin = flyby.perturbed(rng, 0.1, 0.0)
    subproblem = make_subproblem(wide, every_row(lin, name, facets))
    subproblem.update(lin)
    errors = []
    for radius in (1e-2, 1e-4):
        step = subproblem.solve(radius, WEIGHT)
        flown = flyby.waves.linearise(wide, flyby.waves.rollout(wide, step.burns))
        errors.append(abs(subproblem.merit(flown, WEIGHT) - step.merit))
    # A ten-thousandth, but that the step may turn, and for the solver's tolerance; a model that
    # leaves out a derivative errs by a hundredth.
    assert errors[1] < 2e-3 * errors[0] + 1e-7 * subproblem.merit(lin, WEIGHT)


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


def test_facets_left_out_are_missed_exactly_where_the_iterate_violates_them(case: Case) -> None:
    lin, facets = case.at("ballistic"), case.p2_rows.facets
    margin = facets.margin(lin.iterate.mean, lin.factor)
    violated = margin < -1e-6
    included = np.random.default_rng(0).uniform(size=len(margin)) < 0.5
    missed = ChanceRows(case.problem, facets, included).missed(lin, 1e-6)
    assert np.array_equal(missed, violated & ~included)
    assert missed.any()


# --- what is frozen -----------------------------------------------------------------------------


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_only_frozen_models_promise_what_is_not_to_be_had_at_the_solution_of_p2(
    case: Case, build: Build, formulation: str
) -> None:
    promise = promised(case, build(formulation, "P2"))
    if formulation in FROZEN:
        assert promise >= 10.0 * SCvx.stationary
    else:
        assert promise <= SCvx.stationary


def promised(case: Case, subproblem: Subproblem) -> float:
    """Reduction of the merit, relative, that the model predicts within a unit radius."""
    lin = case.at("P2")
    subproblem.update(lin)
    merit = subproblem.merit(lin, WEIGHT)
    return (merit - subproblem.solve(1.0, WEIGHT).merit) / merit


# --- penalty ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["P3", "P2"])
def test_at_convergence_every_buffer_is_zero_and_a_larger_weight_changes_nothing(
    case: Case, build: Build, name: str
) -> None:
    lin, subproblem = case.at(name), build("condensed", name)
    assert max(v.max(initial=0.0) for v in subproblem.merit.violations(lin).values()) <= 1e-8
    subproblem.update(lin)
    for weight in (WEIGHT, 10.0 * WEIGHT):
        step = subproblem.solve(1.0, weight)
        assert step.merit == pytest.approx(lin.iterate.total_dv, rel=1e-6)
        assert np.linalg.norm(step.burns, axis=1).sum() == pytest.approx(step.merit, rel=1e-7)
    if name == "P2":  # below the multipliers it is not exact
        assert subproblem.solve(1.0, 1e-2).merit < 0.9 * lin.iterate.total_dv


# --- trust region and failures ------------------------------------------------------------------


@pytest.mark.parametrize("name", ["P3", "P2"])
def test_the_trust_region_bounds_every_component_and_a_larger_one_promises_no_less(
    case: Case, build: Build, name: str
) -> None:
    lin, subproblem, merits = case.at("ballistic"), build("condensed", name), []
    subproblem.update(lin)
    for radius in (1e-3, 0.03, 0.1, 1.0):
        step = subproblem.solve(radius, WEIGHT)
        moved = np.abs(step.burns - lin.iterate.burns).max()
        assert moved <= radius * (1.0 + 1e-4)
        if radius <= 0.1:  # the guess is far: it binds
            assert moved == pytest.approx(radius, rel=1e-4)
        merits.append(step.merit)
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


@pytest.mark.parametrize("formulation", ["condensed", "lifted"])
@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ("it broke down", r"^it broke down; so did I$"),
        (Answer(np.full(1, np.nan), "good", True, 0.0), "no finite burns"),
        (Answer(np.full(1, 1e300), "good", True, 0.0), "no finite burns"),
    ],
)
def test_solvers_that_fail_or_give_no_finite_answer_raise_our_own_error(
    case: Case, formulation: str, answer: Answer | str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripted(monkeypatch, answer, other="so did I")
    subproblem = make_subproblem(case.problem, case.rows("P3"), formulation)
    subproblem.update(case.at("P3"))
    with pytest.raises(SubproblemError, match=words) as caught:
        subproblem.solve(1.0, WEIGHT)
    assert isinstance(caught.value.__cause__, ValueError)


@pytest.mark.parametrize("formulation", ["condensed", "lifted"])
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
