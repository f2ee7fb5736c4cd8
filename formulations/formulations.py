"""Which subproblem serves a formulation and a conic solver."""

from __future__ import annotations

from formulations.condensations import CONDENSATIONS
from formulations.direct import DirectSubproblem
from formulations.interior_point import SOLVERS
from formulations.penalty import Penalty
from formulations.problem import FlybyProblem
from formulations.rows import Rows
from formulations.subproblem import Subproblem

FORMULATIONS = ("condensed", "lifted", "frozen-stm", "frozen-covariance")


def is_direct(formulation: str, solver: str) -> bool:
    """Whether no modelling layer is needed."""
    return formulation in CONDENSATIONS and solver in SOLVERS


def make_subproblem(
    problem: FlybyProblem,
    rows: Rows,
    formulation: str = "condensed",
    solver: str = "CLARABEL",
    penalty: Penalty = "exact",
) -> Subproblem:
    """Without a modelling layer where that is possible, in CVXPY otherwise.

    Args:
        problem: the flyby problem.
        rows: its state constraints, those of P3 or of P2.
        formulation: one of `FORMULATIONS`.
        solver: name of a CVXPY conic solver.
        penalty: how violations and steps are charged.
    """
    if is_direct(formulation, solver):
        return DirectSubproblem(problem, rows, formulation, solver, penalty)
    from formulations.modelled import ModelledSubproblem  # CVXPY takes a second to import

    return ModelledSubproblem(problem, rows, formulation, solver, penalty)
