"""What goes to the conic solver directly is the program that CVXPY writes."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import scipy.sparse as sp
from formulations.direct import DirectSubproblem
from formulations.modelled import ModelledSubproblem
from hypothesis import given, settings

from formulations import conic, direct, interior_point
from formulations.condensations import CONDENSATIONS
from formulations.facets import Polytopes, choose_facets
from formulations.lifting import Linearisation, condense
from formulations.penalty import Charge, Penalty
from formulations.polytopes import ball
from formulations.program.solvers import (
    SOLVERS,
    Answer,
    Clarabel,
    ConeProgram,
    Recovering,
    is_optimal,
)
from formulations.program.subproblem import Step, Subproblem, SubproblemError
from formulations.rows import P2Rows, P3Rows, Rows
from tests.helpers import constrain, generators, random_flyby

PENALTIES: tuple[Penalty, ...] = get_args(Penalty)
TIGHT = 1e-11
"""Of the conic solver, where two programs for the same problem are compared and not its accuracy."""


@pytest.fixture(autouse=True)
def tight(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interior_point, "TOLERANCE", TIGHT)
    settings_ = dict.fromkeys(conic.SETTINGS["CLARABEL"], TIGHT)
    monkeypatch.setitem(conic.SETTINGS, "CLARABEL", settings_)


def linearised(rng: np.random.Generator, keeps: tuple[str, ...] = ("in", "out")) -> Linearisation:
    """A random flyby of four burns with constraints after each of them."""
    flyby = constrain(rng, random_flyby(rng, nodes=8, burns=4), keeps)
    return flyby.perturbed(rng, 0.1, 0.05)


def every_row(lin: Linearisation, name: str) -> Rows:
    if name == "P3":
        return P3Rows(lin.problem)
    facets = choose_facets(lin.problem, Polytopes(ball(8), 4), lin.iterate.mean, lin.factor)
    return P2Rows(lin.problem, facets, np.ones(len(facets.node), dtype=np.bool_))


def charge_for(penalty: Penalty, rows: Rows, lin: Linearisation) -> Charge:
    if penalty == "augmented":
        count = 6 + 3 * lin.problem.n_burns + rows.count
        return Charge(20.0, multipliers=np.linspace(0.0, 2.0, count))
    return Charge(10.0, prox=0.7 if penalty == "proximal" else 0.0)


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("name", ["P3", "P2"])
@pytest.mark.parametrize("formulation", CONDENSATIONS)
@settings(max_examples=5)
@given(generators)
def test_the_direct_program_has_the_modelled_programs_solution(
    formulation: str, name: str, penalty: Penalty, rng: np.random.Generator
) -> None:
    lin = linearised(rng)
    rows = every_row(lin, name)
    charge, steps = charge_for(penalty, rows, lin), []
    for kind in (DirectSubproblem, ModelledSubproblem):
        subproblem = kind(lin.problem, rows, formulation, penalty=penalty)
        subproblem.update(lin)
        steps.append(subproblem.solve(0.8, charge))
    # A minimum is known better than where it is; the proximal term is part of what is minimised.
    proximal = [0.5 * charge.prox * ((s.burns - lin.iterate.burns) ** 2).sum() for s in steps]
    found, modelled = (step.merit + extra for step, extra in zip(steps, proximal, strict=True))
    # Where squares are charged the conic solver itself is no better than this.
    assert found == pytest.approx(modelled, rel=1e-7 if penalty == "exact" else 1e-6)
    assert steps[0].burns == pytest.approx(steps[1].burns, abs=1e-3)


@pytest.mark.parametrize("name", ["P3", "P2"])
def test_an_updated_program_is_a_new_one(name: str) -> None:
    """The solver keeps its factorisation's pattern; nothing else may be left of the last numbers."""
    rng = np.random.default_rng(2)
    first = linearised(rng)
    moved = replace(first.iterate, burns=first.iterate.burns + 0.05 * rng.normal(size=(4, 3)))
    flyby = Linearisation(first.problem, moved, first.arcs)
    rows = every_row(first, name)
    used, fresh = (DirectSubproblem(first.problem, rows) for _ in range(2))
    used.update(first)
    used.solve(0.3, 5.0)
    for subproblem in (used, fresh):
        subproblem.update(flyby)
    assert used.solve(0.8, 10.0).merit == pytest.approx(fresh.solve(0.8, 10.0).merit, rel=1e-9)


@pytest.mark.parametrize("name", ["P3", "P2"])
@pytest.mark.parametrize("penalty", PENALTIES)
def test_conic_solvers_agree(name: str, penalty: Penalty) -> None:
    pytest.importorskip("qoco", reason="QOCO is not installed")
    lin = linearised(np.random.default_rng(4))
    rows = every_row(lin, name)
    merits = []
    for solver in SOLVERS:
        subproblem = DirectSubproblem(lin.problem, rows, solver=solver, penalty=penalty)
        for radius in (0.1, 0.8):  # built, then updated
            subproblem.update(lin)
            merits.append(subproblem.solve(radius, charge_for(penalty, rows, lin)).merit)
    assert merits[2:] == pytest.approx(merits[:2], rel=1e-6)


# --- reductions leave the solution unchanged ----------------------------------------------------


@given(generators)
def test_triangular_factors_preserve_every_facets_deviation(rng: np.random.Generator) -> None:
    lin = linearised(rng, ("in",))
    rows = every_row(lin, "P2")
    assert isinstance(rows, P2Rows)
    s = condense(lin, rows.nodes)
    z = lin.iterate.burns.ravel() + 0.3 * rng.normal(size=12)
    carried = rows.carried
    at = np.searchsorted(rows.nodes, carried.node)
    mean = s.mean_constant[at, :3] + s.mean_jacobian[at, :3] @ z
    factor = s.factor_constant[at, :3] + s.factor_jacobian[at, :3] @ z
    deviation = np.linalg.norm(np.einsum("mi,mic->mc", carried.normal, factor), axis=1)
    room = carried.offset - np.einsum("mi,mi->m", carried.normal, mean)
    seen = np.zeros(rows.count, dtype=int)
    for cones in rows.cones(lin, s):
        p = cones.values.shape[2]
        y = cones.values @ z[:p] + cones.constants
        seen[cones.rows] += 1
        assert y[:, 0] == pytest.approx(room[cones.rows], rel=1e-9, abs=1e-9)
        spread = np.abs(carried.quantile[cones.rows]) * deviation[cones.rows]
        assert np.linalg.norm(y[:, 1:], axis=1) == pytest.approx(spread, rel=1e-9, abs=1e-12)
        assert not np.any(np.tril(cones.values[:, 1:], -1))
    assert np.all(seen == 1)


@pytest.mark.parametrize("near", [-np.inf, 0.0, 0.2])
@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("name", ["P3", "P2"])
@settings(max_examples=10)
@given(generators)
def test_rows_that_are_left_out_change_nothing(
    name: str, penalty: Penalty, near: float, rng: np.random.Generator
) -> None:
    lin = linearised(rng)
    rows = every_row(lin, name)
    charge, steps = charge_for(penalty, rows, lin), []
    with pytest.MonkeyPatch.context() as patch:
        for room in (near, np.inf):
            patch.setattr(direct, "NEAR", room)
            subproblem = DirectSubproblem(lin.problem, rows, penalty=penalty)
            subproblem.update(lin)
            steps.append(subproblem.solve(0.5, charge))
    moved = [0.5 * charge.prox * ((s.burns - lin.iterate.burns) ** 2).sum() for s in steps]
    some, every = (step.merit + extra for step, extra in zip(steps, moved, strict=True))
    assert some == pytest.approx(every, rel=1e-7 if penalty == "exact" else 1e-6)


def test_rows_far_from_binding_are_left_out_and_come_back(monkeypatch: pytest.MonkeyPatch) -> None:
    lin = linearised(np.random.default_rng(7))
    rows, sizes = every_row(lin, "P2"), []
    attempt = DirectSubproblem._attempt

    def count(self: DirectSubproblem, radius: float, charge: Charge) -> Step:
        sizes.append(int(self._active.sum()))
        return attempt(self, radius, charge)

    monkeypatch.setattr(DirectSubproblem, "_attempt", count)
    monkeypatch.setattr(direct, "NEAR", -np.inf)
    subproblem = DirectSubproblem(lin.problem, rows)
    subproblem.update(lin)
    subproblem.solve(0.5, 10.0)
    assert sizes[0] == 0
    assert sizes == sorted(set(sizes))
    assert 0 < sizes[-1] < rows.count


# --- failures -----------------------------------------------------------------------------------


class Scripted:
    """A conic solver with given answers, one after the other."""

    built = 0

    def __init__(self, answers: list[Answer | str]) -> None:
        self._answers = answers
        Scripted.built += 1

    def solve(self, _: ConeProgram) -> Answer:
        answer = self._answers.pop(0)
        if isinstance(answer, str):
            raise ValueError(answer)
        return answer


GOOD, POOR = Answer(np.ones(400), "good", True, 0.0), Answer(np.ones(400), "poor", False, 0.0)
PROGRAM = ConeProgram(np.ones(1), sp.csc_array((0, 1)), np.zeros(0), 0, 0, ())


def scripted(monkeypatch: pytest.MonkeyPatch, *answers: Answer | str, other: str = "no") -> None:
    """One solver with these answers, however often it is built, and another that fails."""
    script = list(answers)
    monkeypatch.setattr(Scripted, "built", 0)
    monkeypatch.setitem(SOLVERS, "CLARABEL", lambda: Scripted(script))
    monkeypatch.setitem(SOLVERS, "QOCO", lambda: Scripted([other]))


@pytest.mark.parametrize("second", [POOR, "it broke down"])
def test_a_solver_that_its_old_scaling_does_not_serve_is_built_again(
    second: Answer | str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripted(monkeypatch, GOOD, second, GOOD)
    solver = Recovering("CLARABEL")
    solver.solve(PROGRAM)
    assert Scripted.built == 1
    assert solver.solve(PROGRAM).accurate
    assert Scripted.built == 2


@pytest.mark.parametrize("again", [POOR, "it broke down"])
def test_an_inaccurate_answer_is_one_and_says_so(
    again: Answer | str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripted(monkeypatch, POOR, again)
    assert not Recovering("CLARABEL").solve(PROGRAM).accurate


def test_solvers_that_fail_raise_our_own_error_with_their_words(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scripted(monkeypatch, "it broke down", "it broke down", other="so did I")
    with pytest.raises(SubproblemError, match="it broke down; so did I"):
        some_subproblem().solve(1.0, 10.0)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_solvers_without_a_finite_answer_raise_our_own_error(
    value: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = GOOD._replace(x=np.full(400, value))
    scripted(monkeypatch, answer, answer)
    with pytest.raises(SubproblemError, match="no finite burns"):
        some_subproblem().solve(1.0, 10.0)


def some_subproblem() -> Subproblem:
    lin = linearised(np.random.default_rng(1))
    subproblem = DirectSubproblem(lin.problem, P3Rows(lin.problem))
    subproblem.update(lin)
    return subproblem


def small_program() -> tuple[ConeProgram, Answer]:
    """Min t subject to t >= ||(x - 1, x + 1)||, x <= 10, and y = x; optimal at x = 0."""
    cost = np.array([1.0, 0.0, 0.0])
    matrix = sp.csc_array(
        np.array([[0, 1, -1], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, -1, 0]], dtype=float)
    )
    program = ConeProgram(cost, matrix, np.array([0.0, 10.0, 0.0, -1.0, 1.0]), 1, 1, (3,))
    return program, Clarabel().solve(program)


@pytest.mark.parametrize("solver", SOLVERS)
def test_multipliers_prove_an_optimum(solver: str) -> None:
    if solver == "QOCO":
        pytest.importorskip("qoco", reason="QOCO is not installed")
    program, _ = small_program()
    answer = SOLVERS[solver]().solve(program)
    assert answer.x == pytest.approx([np.sqrt(2.0), 0.0, 0.0], abs=1e-4)
    assert answer.multipliers is not None
    assert is_optimal(program, answer.x, answer.multipliers)


@pytest.mark.parametrize(
    ("dx", "dz"),
    [
        ((0.1, 0.0, 0.0), (0.0,) * 5),  # dearer than it has to be
        ((-0.1, 0.0, 0.0), (0.0,) * 5),  # outside the second-order cone
        ((0.0, 0.0, 0.1), (0.0,) * 5),  # off the equality
        ((10.0, 11.0, 11.0), (0.0,) * 5),  # beyond the bound
        ((0.0,) * 3, (0.0, 0.0, 0.1, 0.0, 0.0)),  # a gradient that does not vanish
        ((0.0,) * 3, (0.0, -0.1, 0.0, 0.1, 0.0)),  # a negative multiplier
    ],
)
def test_nothing_else_is_taken_for_an_optimum(dx: tuple[float, ...], dz: tuple[float, ...]) -> None:
    program, answer = small_program()
    assert answer.multipliers is not None
    assert not is_optimal(program, answer.x + np.array(dx), answer.multipliers + np.array(dz))


def test_multipliers_outside_their_cone_prove_nothing() -> None:
    """Min x subject to -1 <= x <= 10: signs of multipliers make any gap close anywhere."""
    matrix, bound = sp.csc_array(np.array([[1.0], [-1.0]])), np.array([10.0, 1.0])
    program = ConeProgram(np.ones(1), matrix, bound, 0, 2, ())
    for x in (-8.0, 0.0, 5.0, 12.0):
        z0 = -(1.0 + x) / 11.0  # so that -b'z = x with z1 = 1 + z0
        assert -bound @ np.array([z0, 1.0 + z0]) == pytest.approx(x)
        assert not is_optimal(program, np.array([x]), np.array([z0, 1.0 + z0]))
    assert is_optimal(program, np.array([-1.0]), np.array([0.0, 1.0]))


def test_an_answer_that_its_multipliers_do_not_prove_is_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    program, right = small_program()
    assert right.multipliers is not None
    wrong = right._replace(x=right.x + 0.1)
    scripted(monkeypatch, wrong, right)
    assert Recovering("CLARABEL").solve(program).x is right.x
    scripted(monkeypatch, wrong, wrong)
    with pytest.raises(ValueError, match="proves nothing by it; no"):
        Recovering("CLARABEL").solve(program)


def test_where_a_solver_stays_inaccurate_another_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    better = POOR._replace(status="better", accurate=True)
    scripted(monkeypatch, POOR, POOR)
    monkeypatch.setitem(SOLVERS, "QOCO", lambda: Scripted([better]))
    assert Recovering("CLARABEL").solve(PROGRAM).status == "better"


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_program_without_a_solution_has_no_answer(solver: str) -> None:
    if solver == "QOCO":
        pytest.importorskip("qoco", reason="QOCO is not installed")
    matrix = sp.csc_array(np.array([[1.0], [-1.0]]))
    program = ConeProgram(np.ones(1), matrix, np.array([-1.0, -1.0]), 0, 2, ())
    with pytest.raises(ValueError, match=f"{solver} ended with status"):
        SOLVERS[solver]().solve(program)


def some_program(rng: np.random.Generator, zero: int) -> ConeProgram:
    """The lowest point of a ball within a box, on a plane through both if `zero` is 1."""
    plane, sides = rng.uniform(0.5, 1.0, (zero, 3)), np.diag(rng.uniform(0.5, 1.0, 3))
    matrix = np.vstack([plane, sides, -sides, np.zeros((1, 3)), -np.eye(3)])
    bound = np.concatenate([plane @ rng.uniform(-0.2, 0.2, 3), np.ones(6), [1.1], np.zeros(3)])
    return ConeProgram(rng.normal(size=3), sp.csc_array(matrix), bound, zero, 6, (4,))


@pytest.mark.parametrize("zero", [0, 1])
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_solver_with_new_numbers_answers_as_a_new_one(solver: str, zero: int) -> None:
    if solver == "QOCO":
        pytest.importorskip("qoco", reason="QOCO is not installed")
    rng = np.random.default_rng(7)
    kept = SOLVERS[solver]()
    for _ in range(5):
        program = some_program(rng, zero)
        updated, new = kept.solve(program), SOLVERS[solver]().solve(program)
        assert updated.x == pytest.approx(new.x, abs=1e-5)
        assert updated.accurate == (updated.status in ("Solved", "QOCO_SOLVED"))
        assert "solved" in updated.status.lower()
        assert 0.0 <= updated.solver_s < 1.0
        slack = program.bound - program.matrix @ updated.x
        assert np.abs(slack[:zero]).max(initial=0.0) < 1e-6
        assert slack[zero : zero + 6].min() > -1e-6
