"""Conic solvers, fed with a program's matrices: built once, updated with numbers afterwards."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any, NamedTuple

import clarabel
import numpy as np
import scipy.sparse as sp

from formulations.regions import Array

TOLERANCE = 1e-9
"""Tighter than Clarabel's 1e-8, so that late, small predicted reductions still mean something."""


@dataclass(frozen=True)
class ConeProgram:
    """min 1/2 x'P x + q'x  subject to  b - A x in {0}^zero x R+^nonnegative x Q^d1 x Q^d2 x ...

    Attributes:
        quadratic: P, diagonal.
        cost: q.
        matrix: A, with column-wise sorted entries.
        bound: b.
        zero: rows of the zero cone.
        nonnegative: rows of the non-negative cone.
        second_order: dimensions of the second-order cones.
    """

    quadratic: sp.csc_array
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


class ConicSolver(ABC):
    """A solver of programs that differ in their numbers only."""

    def __init__(self) -> None:
        self._solver: Any = None

    def solve(self, program: ConeProgram) -> Answer:
        """Solve, updating what the last program built.

        A solver keeps the equilibration of the numbers that it was built with. Where that does not
        serve the new ones it is built again.

        Raises:
            ValueError: if there is no answer; the message has the solver's word for it.
        """
        kept = self._solver is not None
        answer = self._run(program, build=not kept)
        if kept and not answer.accurate:
            tried, answer = answer.solver_s, self._run(program, build=True)
            answer = answer._replace(solver_s=answer.solver_s + tried)
        if len(answer.x) == 0:
            raise ValueError(f"{type(self).__name__.upper()} ended with status {answer.status}")
        return answer

    @abstractmethod
    def _run(self, program: ConeProgram, *, build: bool) -> Answer:
        """Build or update, and solve; no variables where the solver has no answer."""


class Clarabel(ConicSolver):
    """Goulart & Chen, "Clarabel: an interior-point solver for conic programs", 2024."""

    def _run(self, program: ConeProgram, *, build: bool) -> Answer:
        p, a = program.quadratic, program.matrix
        if build:
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
            self._solver = clarabel.DefaultSolver(
                sp.csc_matrix(p), program.cost, sp.csc_matrix(a), program.bound, cones, settings
            )
        else:
            self._solver.update(P=p.data, q=program.cost, A=a.data, b=program.bound)
        start = perf_counter()
        found = self._solver.solve()
        seconds = perf_counter() - start  # its own figure counts its set-up every time
        status = str(found.status)
        x = np.array(found.x if status in ("Solved", "AlmostSolved") else [])
        return Answer(x, status, status == "Solved", seconds)


class Qoco(ConicSolver):
    """Chari & Acikmese, "QOCO: a quadratic objective conic optimizer", 2025.

    It has no certificate of infeasibility; the subproblems need none, as they are always feasible.
    """

    def _run(self, program: ConeProgram, *, build: bool) -> Answer:
        p, q, z = program.quadratic, program.cost, program.zero
        a, g = sp.csc_array(program.matrix[:z]), sp.csc_array(program.matrix[z:])
        b, h = program.bound[:z], program.bound[z:]
        if build:
            self._solver = importlib.import_module("qoco").QOCO()
            sizes = len(q), len(h), z
            matrices = p if p.nnz else None, q, a if z else None, b if z else None, g, h
            cones = program.nonnegative, len(program.second_order), np.array(program.second_order)
            self._solver.setup(*sizes, *matrices, *cones, abstol=TOLERANCE, reltol=TOLERANCE)
        else:
            self._solver.update_vector_data(c=q, b=b if z else None, h=h)
            self._solver.update_matrix_data(
                P=p.data if p.nnz else None, A=a.data if z else None, G=g.data
            )
        found = self._solver.solve()
        status = found.status
        x = np.array(found.x if status in ("QOCO_SOLVED", "QOCO_SOLVED_INACCURATE") else [])
        return Answer(x, status, status == "QOCO_SOLVED", found.solve_time_sec)


SOLVERS: dict[str, Callable[[], ConicSolver]] = {"CLARABEL": Clarabel, "QOCO": Qoco}
