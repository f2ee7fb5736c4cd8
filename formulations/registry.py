"""Make the subproblem of a formulation for a conic solver."""

from __future__ import annotations

from formulations.linearisation.linearisation import CONDENSATIONS
from formulations.problem.flyby import FlybyProblem
from formulations.program.subproblem import Penalty, Subproblem
from formulations.rows.cones import Rows

FULL = ("condensed", "lifted")
"""The full linearisation, eliminated or as variables: what takes every kind of risk and limit."""

FORMULATIONS = (*FULL, "frozen-stm", "frozen-covariance")


def make_subproblem(
    problem: FlybyProblem,
    rows: Rows,
    formulation: str = "condensed",
    solver: str = "CLARABEL",
    penalty: Penalty = "exact",
) -> Subproblem:
    """Make a subproblem of one of `FORMULATIONS`, for a solver of `program.solvers.installed()`.

    The rows are the state constraints, of P3 or P2; the penalty is for violations and steps. CVXPY
    takes a second to import, so it is imported here.

    Raises:
        ValueError: if a frozen formulation is asked for firing times as controls.
    """
    if problem.firing is not None and formulation not in FULL:
        raise ValueError(f"free firing times go with the formulations {' and '.join(FULL)} alone")
    if formulation == "lifted":
        from formulations.program.lifted import LiftedSubproblem

        return LiftedSubproblem(problem, rows, penalty, solver)
    from formulations.program.condensed import CondensedSubproblem

    return CondensedSubproblem(problem, rows, penalty, solver, CONDENSATIONS[formulation])
