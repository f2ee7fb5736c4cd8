"""A cone program as arrays, and a test that proves an answer optimal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from formulations.arrays import Array

GAP = 1e-6
"""Largest relative error in the proof of a verdict."""


@dataclass(frozen=True)
class ConeProgram:
    """min q'x  subject to  b - A x in {0}^zero x R+^nonnegative x Q^d1 x Q^d2 x ...

    Attributes:
        cost: q.
        matrix: A, with column-wise sorted entries.
        bound: b.
        zero: rows of the zero cone.
        nonnegative: rows of the non-negative cone.
        second_order: dimensions of the second-order cones.
        form: CVXPY's parametric form from which it was evaluated, if any.
    """

    cost: Array
    matrix: sp.csc_array
    bound: Array
    zero: int
    nonnegative: int
    second_order: tuple[int, ...]
    form: Any = None


def is_optimal(program: ConeProgram, x: Array, z: Array, gap: float = GAP) -> bool:
    """Whether multipliers z prove x optimal, to the tolerance `gap`, whatever the solver's status.

    Weak duality: with q + A'z = 0 and z in the dual cones no x' with b - A x' in the cones has
    q'x' < -b'z.
    """
    primal, dual = float(program.cost @ x), -float(program.bound @ z)
    gradient = program.cost + program.matrix.T @ z
    slack = program.bound - program.matrix @ x
    prices = max(1.0, float(np.abs(program.cost).max()), float(np.abs(z).max()))
    sizes = max(1.0, float(np.abs(program.bound).max()), float(np.abs(x).max()))
    return bool(
        np.abs(gradient).max() <= gap * prices
        and np.abs(slack[: program.zero]).max(initial=0.0) <= gap * sizes
        and outside(program, slack) <= gap * sizes
        and outside(program, z) <= gap * prices
        and abs(primal - dual) <= gap * max(1.0, abs(primal))
    )


def outside(program: ConeProgram, y: Array) -> float:
    """Distance of y from the non-negative and second-order cones, which are their own duals."""
    first = program.zero + program.nonnegative
    worst = float((-y[program.zero : first]).max(initial=0.0))
    if not program.second_order:
        return worst
    heads = np.cumsum([0, *program.second_order[:-1]])
    tails = y[first:] ** 2
    tails[heads] = 0.0
    excess = np.sqrt(np.add.reduceat(tails, heads)) - y[first:][heads]
    return max(worst, float(excess.max()))
