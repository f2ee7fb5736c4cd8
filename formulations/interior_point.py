"""Conic solvers, fed with a program's matrices: built once, updated with numbers afterwards."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
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
    """What a solver has to say.

    Attributes:
        x: variables.
        status: the solver's word for them.
        accurate: whether it vouches for its tolerances.
        solver_s: seconds spent in it, with the set-up or update of its data.
        multipliers: z of the constraints, by which it can be held to its word.
    """

    x: Array
    status: str
    accurate: bool
    solver_s: float
    multipliers: Array | None = None


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
        a, start = program.matrix, perf_counter()
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
        seconds = perf_counter() - start
        status = str(found.status)
        if status not in ("Solved", "AlmostSolved"):
            raise ValueError(f"CLARABEL ended with status {status}")
        x, z = np.array(found.x), np.array(found.z)
        return Answer(x, status, status == "Solved", seconds, z)


class Qoco:
    """Chari & Acikmese, "QOCO: a quadratic objective conic optimizer", 2025.

    It has no certificate of infeasibility; the subproblems need none, as they are always feasible.
    """

    def __init__(self) -> None:
        self._qoco = importlib.import_module("qoco")
        self._solver: Any = None

    def solve(self, program: ConeProgram) -> Answer:
        """See `ConicSolver`."""
        q, z = program.cost, program.zero
        a, g = sp.csc_array(program.matrix[:z]), sp.csc_array(program.matrix[z:])
        b, h = program.bound[:z], program.bound[z:]
        start = perf_counter()
        if self._solver is None:
            self._solver = self._qoco.QOCO()
            sizes = len(q), len(h), z
            matrices = None, q, a if z else None, b if z else None, g, h
            cones = program.nonnegative, len(program.second_order), np.array(program.second_order)
            self._solver.setup(*sizes, *matrices, *cones, abstol=TOLERANCE, reltol=TOLERANCE)
        else:
            self._solver.update_vector_data(c=q, b=b if z else None, h=h)
            self._solver.update_matrix_data(P=None, A=a.data if z else None, G=g.data)
        found = self._solver.solve()
        seconds = perf_counter() - start
        if found.status not in ("QOCO_SOLVED", "QOCO_SOLVED_INACCURATE"):
            raise ValueError(f"QOCO ended with status {found.status}")
        multipliers = np.concatenate([found.y, found.z]) if z else np.array(found.z)
        accurate = found.status == "QOCO_SOLVED"
        return Answer(np.array(found.x), found.status, accurate, seconds, multipliers)


GAP, HUGE = 1e-6, 1e30
"""Largest relative error in the proof of a verdict; no nondimensional variable is as huge."""


def is_optimal(program: ConeProgram, x: Array, z: Array) -> bool:
    """Whether multipliers z prove x optimal: a verdict rests on this arithmetic, not on a status.

    Weak duality: with q + A'z = 0 and z in the dual cones no x' whose b - A x' is in the cones has
    q'x' < -b'z. All of it holds here to `GAP`.
    """
    primal, dual = float(program.cost @ x), -float(program.bound @ z)
    gradient = program.cost + program.matrix.T @ z
    slack = program.bound - program.matrix @ x
    prices = max(1.0, float(np.abs(program.cost).max()), float(np.abs(z).max()))
    sizes = max(1.0, float(np.abs(program.bound).max()), float(np.abs(x).max()))
    return bool(
        np.abs(gradient).max() <= GAP * prices
        and np.abs(slack[: program.zero]).max(initial=0.0) <= GAP * sizes
        and outside(program, slack) <= GAP * sizes
        and outside(program, z) <= GAP * prices
        and abs(primal - dual) <= GAP * max(1.0, abs(primal))
    )


def outside(program: ConeProgram, y: Array) -> float:
    """How far y is from the non-negative and second-order cones, which are their own duals."""
    first = program.zero + program.nonnegative
    worst = float((-y[program.zero : first]).max(initial=0.0))
    if not program.second_order:
        return worst
    heads = np.cumsum([0, *program.second_order[:-1]])
    tails = y[first:] ** 2
    tails[heads] = 0.0
    excess = np.sqrt(np.add.reduceat(tails, heads)) - y[first:][heads]
    return max(worst, float(excess.max()))


class Recovering:
    """A solver with others behind it.

    A solver keeps the equilibration of the numbers that it was built with: where that does not serve
    the new ones, or it fails, it is built again. Where it is still no better the others are asked. A
    solver is foreign code: whatever it raises is a failure to answer, as is a number that is not
    finite, or an answer called accurate that its multipliers do not prove optimal. What is left after
    that, the algorithm answers with a smaller trust region.

    Args:
        name: a key of `SOLVERS`.

    Raises:
        ModuleNotFoundError: if that solver is not installed.
    """

    def __init__(self, name: str) -> None:
        self._name, self._kept = name, SOLVERS[name]()

    def solve(self, program: ConeProgram) -> Answer:
        """See `ConicSolver`. An inaccurate answer is one where nobody gives a better."""
        failures: dict[str, str] = {}
        answer = self._ask(self._name, self._kept, program, failures)
        solver_s = answer.solver_s if answer else 0.0
        for name in (self._name, *(name for name in SOLVERS if name != self._name)):
            if answer is not None and answer.accurate:
                break
            try:
                solver = SOLVERS[name]()
            except ModuleNotFoundError:  # the other one, which need not be installed
                continue
            self._kept = solver if name == self._name else self._kept
            other = self._ask(name, solver, program, failures)
            solver_s += other.solver_s if other else 0.0
            answer = other if answer is None or (other and other.accurate) else answer
        if answer is None:
            raise ValueError("; ".join(failures.values()))
        return answer._replace(solver_s=solver_s)

    def _ask(
        self, name: str, solver: ConicSolver, program: ConeProgram, failures: dict[str, str]
    ) -> Answer | None:
        try:
            answer = solver.solve(program)
        except (KeyboardInterrupt, MemoryError):
            raise
        except BaseException as error:  # a panic in Rust is no Exception
            failures[name] = str(error)
            return None
        if not np.abs(answer.x).max() < HUGE:
            failures[name] = "the conic solver gave no finite burns"
            return None
        z = answer.multipliers
        if answer.accurate and z is not None and not is_optimal(program, answer.x, z):
            failures[name] = f"{name} ended with status {answer.status} and proves nothing by it"
            return None
        return answer


SOLVERS: dict[str, Callable[[], ConicSolver]] = {"CLARABEL": Clarabel, "QOCO": Qoco}
