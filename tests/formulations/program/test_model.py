"""Convex programs: said plainly, of the iterate, radius and charge at hand; proofs of optimality."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from formulations.arrays import Array
from formulations.linearisation.linearisation import CONDENSATIONS, Linearisation
from formulations.program.solvers import GAP, ConeProgram, is_optimal, outside
from formulations.program.subproblem import SubproblemError
from formulations.registry import FORMULATIONS, make_subproblem
from tests.helpers import generators, share_of_examples, usually

from .support import (
    PENALTIES,
    charge_for,
    every_row,
    linearised,
    minimum,
    need,
    small,
    solve_plainly,
    tent,
    tighten,
)

KINDS = [*itertools.product(FORMULATIONS, ("P3", "P2"), PENALTIES)]
CASES = usually(KINDS[::3] + KINDS[1::3] + KINDS[2::3], len(KINDS) // 3)


@pytest.mark.slow
@pytest.mark.parametrize(("formulation", "name", "penalty"), CASES)
@settings(max_examples=share_of_examples(250, usual=1))
@given(generators)
def test_program_has_solution_of_its_plain_form(formulation, name, penalty, rng):
    """Row by row, in CVXPY."""
    lin = linearised(rng)
    rows = every_row(lin, name)
    charge = charge_for(penalty, rows, lin)
    with pytest.MonkeyPatch.context() as patch:
        tighten(patch)
        subproblem = make_subproblem(lin.problem, rows, formulation, penalty=penalty)
        subproblem.update(lin)
        step = subproblem.solve(0.8, charge)
    condensation = CONDENSATIONS.get(formulation, CONDENSATIONS["condensed"])
    plain = solve_plainly(lin, rows, 0.8, penalty, charge, condensation)
    # A minimum is known better than where it is. Where squares are charged the conic solver itself
    # is no better than this.
    rel = 1e-7 if penalty == "exact" else 1e-6
    assert minimum(step, lin, charge) == pytest.approx(plain.value, rel=rel, abs=1e-9)
    if penalty != "least":  # whose optimum is a set
        assert step.burns == pytest.approx(plain.burns, abs=1e-3)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("solver", ["CLARABEL", "ECOS"])
def test_dynamics_without_finite_derivatives_are_refused(formulation, solver):
    need(solver)
    lin = small()
    stm: Array = np.full_like(lin.arcs.stm, np.nan)
    broken = Linearisation(lin.problem, lin.iterate, replace(lin.arcs, stm=stm))
    subproblem = make_subproblem(lin.problem, every_row(lin, "P3", 4), formulation, solver)
    with (
        np.errstate(invalid="ignore"),
        pytest.raises(SubproblemError, match="finite derivatives"),
    ):
        subproblem.update(broken)


@given(generators, st.integers(0, 3), st.integers(0, 4), st.lists(st.integers(2, 5), max_size=3))
def test_outside_is_the_worst_of_all_cones(rng, zero, nonnegative, cones):
    y = rng.normal(size=zero + nonnegative + sum(cones))
    program = ConeProgram(
        np.zeros(1), sp.csc_array((len(y), 1)), np.zeros(len(y)), zero, nonnegative, tuple(cones)
    )
    short = [0.0, *(-y[zero : zero + nonnegative])]
    first = zero + nonnegative
    for dimension in cones:
        head, tail = y[first], y[first + 1 : first + dimension]
        short.append(float(np.sqrt(sum(tail**2)) - head))
        first += dimension
    assert outside(program, y) == pytest.approx(max(short), rel=1e-12)


@pytest.mark.parametrize(
    ("price", "size", "dx", "dz", "scale"),
    [
        # The gradient, against the largest price: a cost, or a multiplier.
        (1.0, 1.0, (0, 0, 0), (1, 0, 0, 0, 0), 1.0),
        (1e3, 1e-3, (0, 0, 0), (1, 0, 0, 0, 0), 1e3),
        (1e-3, 1.0, (0, 0, 0), (1, 0, 0, 0, 0), 1.0),
        # The equation, against the largest number: a bound here.
        (1.0, 1.0, (0, 0, 1), (0, 0, 0, 0, 0), 10.0),
        (1.0, 1e3, (0, 0, -1), (0, 0, 0, 0, 0), 1e4),
        (1.0, 1e-3, (0, 0, 1), (0, 0, 0, 0, 0), 1.0),
        # The second-order cone, where the cost hardly counts.
        (1e-4, 1.0, (-1, 0, 0), (0, 0, 0, 0, 0), 10.0),
        (1e-4, 1e-3, (-1, 0, 0), (0, 0, 0, 0, 0), 1.0),
        # A multiplier's sign, where the bound hardly counts.
        (1.0, 1e-3, (0, 0, 0), (0, -1, 0, -0.5, -0.5), 1.0),
        (1e3, 1e-4, (0, 0, 0), (0, -1, 0, -0.5, -0.5), 1e3),
        # The gap, against the cost where that is above one.
        (1.0, 0.1, (1, 0, 0), (0, 0, 0, 0, 0), 1.0),
        (1.0, 1e3, (1, 0, 0), (0, 0, 0, 0, 0), 1e3 * np.sqrt(2.0)),
    ],
)
def test_each_condition_is_held_to_its_tolerance(price, size, dx, dz, scale):
    program, x, z = tent(price, size)
    for share, optimal in ((0.9, True), (1.1, False)):
        step = share * GAP * scale
        assert is_optimal(program, x + step * np.array(dx), z + step * np.array(dz)) is optimal


def test_largest_value_and_price_bind_to_program():
    """Min x with x = y / 1000 and x >= 1; min x with x / 1000 >= 0."""
    matrix = sp.csc_array(np.array([[1.0, -1e-3], [-1.0, 0.0]]))
    program = ConeProgram(np.array([1.0, 0.0]), matrix, np.array([0.0, -1.0]), 1, 1, ())
    x, z = np.array([1.0, 1e3]), np.array([0.0, 1.0])
    assert is_optimal(program, x, z)
    for share, optimal in ((0.9, True), (1.1, False)):
        assert is_optimal(program, x + share * GAP * np.array([0.0, 1e6]), z) is optimal
    steep = ConeProgram(np.array([1.0]), sp.csc_array([[-1e-3]]), np.array([0.0]), 0, 1, ())
    assert is_optimal(steep, np.zeros(1), np.array([1e3 + 0.9]))
    assert not is_optimal(steep, np.zeros(1), np.array([1e3 + 1.1]))
    dear = ConeProgram(
        np.array([1e3, 0.0]), sp.csc_array(np.diag([-1e3, -1.0])), np.zeros(2), 0, 2, ()
    )
    assert is_optimal(dear, np.zeros(2), np.array([1.0 + 0.9e-6, 0.0]))
    assert not is_optimal(dear, np.zeros(2), np.array([1.0 + 1.1e-6, 0.0]))


def test_multipliers_outside_their_cone_prove_nothing():
    """Min x subject to -1 <= x <= 10: signs of multipliers make any gap close anywhere."""
    matrix, bound = sp.csc_array(np.array([[1.0], [-1.0]])), np.array([10.0, 1.0])
    program = ConeProgram(np.ones(1), matrix, bound, 0, 2, ())
    for x in (-8.0, 0.0, 5.0, 12.0):
        z0 = -(1.0 + x) / 11.0  # so that -b'z = x with z1 = 1 + z0
        assert -bound @ np.array([z0, 1.0 + z0]) == pytest.approx(x)
        assert not is_optimal(program, np.array([x]), np.array([z0, 1.0 + z0]))
    assert is_optimal(program, np.array([-1.0]), np.array([0.0, 1.0]))
