"""Solve cone programs, and prove answers optimal.

A solver is built once per program and takes new numbers in place.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any, ClassVar, NamedTuple, Protocol

import clarabel
import numpy as np
import scipy.sparse as sp

from formulations.arrays import Array

TOLERANCE = 1e-9
"""Tighter than Clarabel's 1e-8, so that late, small predicted reductions still mean something."""


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


class Answer(NamedTuple):
    """A solver's answer: variables x (n,), and multipliers z (rows,) that prove them optimal.

    `accurate` if the solver reports its tolerances met; `seconds` include set-up or update.
    """

    x: Array
    status: str
    accurate: bool
    solver_s: float
    multipliers: Array | None = None


class ConicSolver(Protocol):
    """A solver of programs that differ in their numbers alone."""

    def solve(self, program: ConeProgram) -> Answer:
        """Solve; raises ValueError if there is no answer."""


class Clarabel:
    """Goulart & Chen, "Clarabel: an interior-point solver for conic programs", 2024.

    A program's matrix has room for rows that are empty now. Its zeros are left out, because a
    factorisation would fill them: half of the time, two thirds with gains. The solver is built
    again where the entries that are not zero have other places.
    """

    def __init__(self) -> None:
        self._solver: Any = None
        self._places: Any = None

    def solve(self, program: ConeProgram) -> Answer:
        """See `ConicSolver`."""
        a, start = sp.csc_matrix(program.matrix, copy=True), perf_counter()
        a.eliminate_zeros()
        places, before = (a.indptr, a.indices), self._places
        if before is None or not all(map(np.array_equal, places, before)):
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
                p, program.cost, a, program.bound, cones, settings
            )
            self._places = places
        else:
            self._solver.update(q=program.cost, A=a.data, b=program.bound)
        result = self._solver.solve()
        seconds = perf_counter() - start
        status = str(result.status)
        if status not in ("Solved", "AlmostSolved"):
            raise ValueError(f"CLARABEL ended with status {status}")
        x, z = np.array(result.x), np.array(result.z)
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
        result = self._solver.solve()
        seconds = perf_counter() - start
        if result.status not in ("QOCO_SOLVED", "QOCO_SOLVED_INACCURATE"):
            raise ValueError(f"QOCO ended with status {result.status}")
        multipliers = np.concatenate([result.y, result.z]) if z else np.array(result.z)
        accurate = result.status == "QOCO_SOLVED"
        return Answer(np.array(result.x), result.status, accurate, seconds, multipliers)


HUGE = 1e30
"""Values above it count as diverged: nondimensional variables are of order one."""


def numeric_form(program: ConeProgram) -> Any:
    """CVXPY's form of a program, without parameters."""
    from cvxpy.reductions.dcp2cone.cone_matrix_stuffing import ParamConeProg

    form = program.form
    cost = sp.csc_array(np.r_[program.cost, 0.0][:, None])
    both = sp.hstack([-program.matrix, sp.csc_array(program.bound[:, None])])
    tensor = sp.csc_array(both.reshape((-1, 1), order="F"))
    known = form.variables, form.var_id_to_col, form.constraints
    return ParamConeProg(cost, form.x, tensor, *known, [], {}, formatted=True)


class ByCvxpy:
    """Any other solver, by CVXPY's name and interface; it starts from its last answer if it can."""

    SETTINGS: ClassVar[dict[str, dict[str, Any]]] = {
        "ECOS": {"abstol": TOLERANCE, "reltol": TOLERANCE, "feastol": TOLERANCE},
        # A first-order method: it needs thousands of cheap iterations for what the others do in twenty.
        "SCS": {"eps_abs": 1e-8, "eps_rel": 1e-8, "max_iters": 200_000},
    }

    def __init__(self, name: str) -> None:
        from cvxpy.reductions.solvers.defines import SOLVER_MAP_CONIC

        self._name, self._interface = name, SOLVER_MAP_CONIC[name]
        self._settings = self.SETTINGS.get(name, {})
        self._interface.import_solver()
        self._last: dict[str, Any] = {}

    def solve(self, program: ConeProgram) -> Answer:
        """See `ConicSolver`."""
        form = numeric_form(program)
        data, inverse = self._interface.apply(form)
        start = perf_counter()
        raw = self._interface.solve_via_data(data, True, False, dict(self._settings), self._last)
        seconds = perf_counter() - start
        solution = self._interface.invert(raw, inverse)
        if solution.status not in ("optimal", "optimal_inaccurate"):
            raise ValueError(f"{self._name} ended with status {solution.status}")
        x = np.asarray(solution.primal_vars[form.x.id]).ravel()
        duals = [np.ravel(solution.dual_vars[constraint.id]) for constraint in form.constraints]
        accurate = solution.status == "optimal"
        return Answer(x, solution.status, accurate, seconds, np.concatenate(duals))


SOLVERS: dict[str, Callable[[], ConicSolver]] = {"CLARABEL": Clarabel, "QOCO": Qoco}
"""Solvers that are kept and updated in place."""


def installed() -> tuple[str, ...]:
    """Installed conic solvers for second-order cones, by CVXPY's names, Clarabel first."""
    import cvxpy as cp
    from cvxpy.reductions.solvers.defines import SOLVER_MAP_CONIC

    names = [
        name
        for name in cp.installed_solvers()
        if name in SOLVER_MAP_CONIC
        and cp.SOC in SOLVER_MAP_CONIC[name].SUPPORTED_CONSTRAINTS
        and name != "ECOS_BB"  # ECOS for mixed integers, of which there are none
    ]
    return tuple(sorted(names, key=lambda name: (name != "CLARABEL", name)))


def _built(name: str) -> ConicSolver:
    return SOLVERS[name]() if name in SOLVERS else ByCvxpy(name)


class FallbackSolver:
    """A conic solver with fallbacks: rebuild it, then try the others whose numbers can be updated.

    A solver keeps the equilibration of the numbers that it was built with. If it fails with new
    numbers, it is built again. A solver is foreign code, so three things count as a failure: any
    exception, numbers that are not finite, and an "accurate" answer whose multipliers do not prove
    it optimal. After a failure of all solvers the algorithm shrinks the trust region. A solver that
    is not in `SOLVERS` has no fallbacks: it is there for comparison.

    Raises:
        ModuleNotFoundError: if the solver is not installed.
    """

    def __init__(self, name: str) -> None:
        self._name, self._kept = name, _built(name)

    def forget(self) -> None:
        """Build the solver again at the next call, for a program with another sparsity."""
        self._kept = _built(self._name)

    def solve(self, program: ConeProgram, gap: float = GAP) -> Answer:
        """See `ConicSolver`. An inaccurate answer counts if no solver has a better one.

        An accurate answer is proved optimal to the tolerance `gap`.
        """
        failures: dict[str, str] = {}
        answer = self._ask(self._name, self._kept, program, gap, failures)
        solver_s = answer.solver_s if answer else 0.0
        others = [name for name in SOLVERS if name != self._name]
        for name in (self._name, *others) if self._name in SOLVERS else ():
            if answer is not None and answer.accurate:
                break
            try:
                solver = _built(name)
            except ModuleNotFoundError:  # the other one, which need not be installed
                continue
            self._kept = solver if name == self._name else self._kept
            other = self._ask(name, solver, program, gap, failures)
            solver_s += other.solver_s if other else 0.0
            answer = other if answer is None or (other and other.accurate) else answer
        if answer is None:
            raise ValueError("; ".join(failures.values()))
        return answer._replace(solver_s=solver_s)

    def _ask(
        self,
        name: str,
        solver: ConicSolver,
        program: ConeProgram,
        gap: float,
        failures: dict[str, str],
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
        if answer.accurate and z is not None and not is_optimal(program, answer.x, z, gap):
            failures[name] = (
                f"{name} ended with status {answer.status}, but does not prove it optimal"
            )
            return None
        return answer
