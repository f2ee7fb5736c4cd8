"""The conic solvers that CVXPY finds, their settings, and what their answers are worth."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import cvxpy as cp
from cvxpy.reductions.solvers.defines import SOLVER_MAP_CONIC

# With squares as cones: as a quadratic objective they keep Clarabel short of its tolerances.
_CONES_ONLY = {"use_quad_obj": False}

SETTINGS: dict[str, dict[str, Any]] = {
    "CLARABEL": {"tol_gap_abs": 1e-9, "tol_gap_rel": 1e-9, "tol_feas": 1e-9, **_CONES_ONLY},
    "ECOS": {"abstol": 1e-9, "reltol": 1e-9, "feastol": 1e-9},
    "QOCO": {"abstol": 1e-9, "reltol": 1e-9, **_CONES_ONLY},
    # A first-order method: it needs thousands of cheap iterations for what the others do in twenty.
    "SCS": {"eps_abs": 1e-8, "eps_rel": 1e-8, "max_iters": 200_000, **_CONES_ONLY},
}
"""Tighter than the solvers' defaults, so that late, small predicted reductions still mean something.
Other solvers run with their own defaults."""


@dataclass(frozen=True)
class Answer:
    """Value of the program in its variables.

    Attributes:
        value: of the objective.
        accurate: whether the solver vouches for its own tolerances. QOCO has no certificate of
            infeasibility and SCS may stop short of its tolerances: only what is accurate may end in
            a verdict.
        solver_s: seconds in the solver.
        canonicalise_s: seconds in CVXPY.
    """

    value: float
    accurate: bool
    solver_s: float
    canonicalise_s: float


def installed() -> tuple[str, ...]:
    """Conic solvers that CVXPY finds and that take second-order cones, Clarabel first."""
    found = [
        name
        for name in cp.installed_solvers()
        if name in SOLVER_MAP_CONIC
        and cp.SOC in SOLVER_MAP_CONIC[name].SUPPORTED_CONSTRAINTS
        and name != "ECOS_BB"  # ECOS for mixed integers, of which there are none
    ]
    return tuple(sorted(found, key=lambda name: (name != "CLARABEL", name)))


def solve(program: cp.Problem, solver: str, settings: dict[str, Any]) -> Answer:
    """Solve a parametrised program.

    Every subproblem has a buffer in every row and a bounded objective: one that is called infeasible
    or unbounded is one that the solver failed on, whatever it says.

    Args:
        program: with all its parameters set.
        solver: CVXPY's name of it.
        settings: besides those of `SETTINGS`.

    Raises:
        cp.SolverError: if the solver fails, or ends without an answer.
    """
    start = perf_counter()
    options = SETTINGS.get(solver, {}) | settings
    # An inaccurate answer is judged by the ratio test, not by a warning on the terminal.
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Solution may be inaccurate")
        # CVXPY's own canonicalisation of sparse parameters trips over its own advice.
        warnings.filterwarnings("ignore", message="Reading from a sparse CVXPY expression")
        try:
            value = program.solve(solver=solver, canon_backend="COO", **options)
        except MemoryError:
            raise
        except Exception as error:  # foreign code: whatever it raises is a failure to answer
            raise cp.SolverError(f"{solver}: {error}") from error
    if program.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        raise cp.SolverError(f"{solver} ended with status {program.status}")
    solver_s = program.solver_stats.solve_time or 0.0
    accurate = program.status == cp.OPTIMAL
    return Answer(float(value), accurate, solver_s, perf_counter() - start - solver_s)
