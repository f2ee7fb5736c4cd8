"""Conic solvers, fed with a program's matrices: built once, updated with numbers afterwards."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import clarabel
import numpy as np
import scipy.sparse as sp

from formulations.regions import Array

TOLERANCE = 1e-9
"""Tighter than Clarabel's 1e-8, so that late, small predicted reductions still mean something."""


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
    """

    cost: Array
    matrix: sp.csc_array
    bound: Array
    zero: int
    nonnegative: int
    second_order: tuple[int, ...]


class Answer(NamedTuple):
    """Variables, the solver's word for them, whether it vouches for its tolerances, its seconds."""

    x: Array
    status: str
    accurate: bool
    solver_s: float


class ConicSolver(Protocol):
    """A solver of programs that differ in their numbers only."""

    def solve(self, program: ConeProgram) -> Answer:
        """Solve; raises ValueError where there is no answer."""
        ...


class Clarabel:
    """Goulart & Chen, "Clarabel: an interior-point solver for conic programs", 2024."""

    def __init__(self) -> None:
        self._solver: Any = None

    def solve(self, program: ConeProgram) -> Answer:
        """See `ConicSolver`."""
        a = program.matrix
        if self._solver is None:
            settings = clarabel.DefaultSettings()
            settings.verbose = False
            settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = TOLERANCE
            settings.presolve_enable = False  # or its data could not be updated
            settings.max_threads = 1
            cones = [
                *([clarabel.ZeroConeT(program.zero)] if program.zero else []),
                clarabel.NonnegativeConeT(program.nonnegative),
                *map(clarabel.SecondOrderConeT, program.second_order),
            ]
            p = sp.csc_matrix((len(program.cost),) * 2)
            self._solver = clarabel.DefaultSolver(
                p, program.cost, sp.csc_matrix(a), program.bound, cones, settings
            )
        else:
            self._solver.update(q=program.cost, A=a.data, b=program.bound)
        found = self._solver.solve()
        status = str(found.status)
        if status not in ("Solved", "AlmostSolved"):
            raise ValueError(f"CLARABEL ended with status {status}")
        return Answer(np.array(found.x), status, status == "Solved", found.solve_time)


class Qoco:
    """Chari & Acikmese, "QOCO: a quadratic objective conic optimizer", 2025.

    It has no certificate of infeasibility; the subproblems need none, as they are always feasible.
    """

    def __init__(self) -> None:
        self._solver: Any = None

    def solve(self, program: ConeProgram) -> Answer:
        """See `ConicSolver`."""
        q, z = program.cost, program.zero
        a, g = sp.csc_array(program.matrix[:z]), sp.csc_array(program.matrix[z:])
        b, h = program.bound[:z], program.bound[z:]
        if self._solver is None:
            self._solver = importlib.import_module("qoco").QOCO()
            sizes = len(q), len(h), z
            matrices = None, q, a if z else None, b if z else None, g, h
            cones = program.nonnegative, len(program.second_order), np.array(program.second_order)
            self._solver.setup(*sizes, *matrices, *cones, abstol=TOLERANCE, reltol=TOLERANCE)
        else:
            self._solver.update_vector_data(c=q, b=b if z else None, h=h)
            self._solver.update_matrix_data(P=None, A=a.data if z else None, G=g.data)
        found = self._solver.solve()
        if found.status not in ("QOCO_SOLVED", "QOCO_SOLVED_INACCURATE"):
            raise ValueError(f"QOCO ended with status {found.status}")
        accurate = found.status == "QOCO_SOLVED"
        return Answer(np.array(found.x), found.status, accurate, found.solve_time_sec)


SOLVERS: dict[str, Callable[[], ConicSolver]] = {"CLARABEL": Clarabel, "QOCO": Qoco}
