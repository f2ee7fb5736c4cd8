"""Which subproblem serves a formulation and a conic solver."""

from __future__ import annotations

from functools import partial
from typing import Protocol

from formulations.linearisation.condensation import CONDENSATIONS
from formulations.problem.flyby import FlybyProblem
from formulations.program.penalty import Penalty
from formulations.program.subproblem import Subproblem
from formulations.rows.cones import Rows

FORMULATIONS = ("condensed", "lifted", "frozen-stm", "frozen-covariance")


class SubproblemMaker(Protocol):
    """Makes subproblems of one formulation."""

    def __call__(
        self, problem: FlybyProblem, rows: Rows, penalty: Penalty, solver: str
    ) -> Subproblem:
        """A subproblem.

        Args:
            problem: the flyby problem.
            rows: its state constraints, those of P3 or of P2.
            penalty: how violations and steps are charged.
            solver: one of `formulations.program.solvers.installed()`.
        """
        ...


def subproblem_maker(formulation: str) -> SubproblemMaker:
    """What makes a formulation's subproblems. CVXPY takes a second to import, so it is imported here.

    Args:
        formulation: one of `FORMULATIONS`.
    """
    if formulation == "lifted":
        from formulations.program.lifted import LiftedSubproblem

        return LiftedSubproblem
    from formulations.program.condensed import CondensedSubproblem

    return partial(CondensedSubproblem, condensation=CONDENSATIONS[formulation])


def make_subproblem(
    problem: FlybyProblem,
    rows: Rows,
    formulation: str = "condensed",
    solver: str = "CLARABEL",
    penalty: Penalty = "exact",
) -> Subproblem:
    """A subproblem of a formulation: see `SubproblemMaker`."""
    return subproblem_maker(formulation)(problem, rows, penalty, solver)
