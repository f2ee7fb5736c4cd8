"""The proof that an answer is optimal, and answers that it does not prove."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st

from formulations.program.certificate import GAP, ConeProgram, is_optimal, outside
from tests.helpers import generators

from .support import tent


@given(generators, st.integers(0, 3), st.integers(0, 4), st.lists(st.integers(2, 5), max_size=3))
def test_outside_is_the_worst_of_all_cones(
    rng: np.random.Generator, zero: int, nonnegative: int, cones: list[int]
) -> None:
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


@pytest.mark.parametrize("price", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_the_proof_of_an_optimum_holds_in_any_units(price: float, size: float) -> None:
    program, x, z = tent(price, size)
    assert is_optimal(program, x, z)


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
def test_each_condition_is_held_to_its_tolerance(
    price: float, size: float, dx: tuple[float, ...], dz: tuple[float, ...], scale: float
) -> None:
    program, x, z = tent(price, size)
    for share, optimal in ((0.9, True), (1.1, False)):
        step = share * GAP * scale
        assert is_optimal(program, x + step * np.array(dx), z + step * np.array(dz)) is optimal


def test_the_largest_number_may_be_a_variable_and_the_largest_price_a_multiplier() -> None:
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


def test_multipliers_outside_their_cone_prove_nothing() -> None:
    """Min x subject to -1 <= x <= 10: signs of multipliers make any gap close anywhere."""
    matrix, bound = sp.csc_array(np.array([[1.0], [-1.0]])), np.array([10.0, 1.0])
    program = ConeProgram(np.ones(1), matrix, bound, 0, 2, ())
    for x in (-8.0, 0.0, 5.0, 12.0):
        z0 = -(1.0 + x) / 11.0  # so that -b'z = x with z1 = 1 + z0
        assert -bound @ np.array([z0, 1.0 + z0]) == pytest.approx(x)
        assert not is_optimal(program, np.array([x]), np.array([z0, 1.0 + z0]))
    assert is_optimal(program, np.array([-1.0]), np.array([0.0, 1.0]))
