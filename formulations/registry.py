"""Which subproblem serves a formulation and a conic solver."""

from __future__ import annotations

from formulations.linearisation.condensation import CONDENSATIONS
from formulations.problem.flyby import FlybyProblem
from formulations.program.penalty import Penalty
from formulations.program.subproblem import Subproblem
from formulations.rows.cones import Rows

FORMULATIONS = ("condensed", "lifted", "frozen-stm", "frozen-covariance")


def make_subproblem(
    problem: FlybyProblem,
    rows: Rows,
    formulation: str = "condensed",
    solver: str = "CLARABEL",
    penalty: Penalty = "exact",
) -> Subproblem:
    """A subproblem in CVXPY, which takes a second to import and is imported here.

    Args:
        problem: the flyby problem.
        rows: its state constraints, those of P3 or of P2.
        formulation: one of `FORMULATIONS`.
        solver: one of `formulations.program.solvers.installed()`.
        penalty: how violations and steps are charged.
    """
    if formulation == "lifted":
        from formulations.program.lifted import LiftedSubproblem

        return LiftedSubproblem(problem, rows, penalty, solver)
    from formulations.program.condensed import CondensedSubproblem

    return CondensedSubproblem(problem, rows, penalty, solver, CONDENSATIONS[formulation])
