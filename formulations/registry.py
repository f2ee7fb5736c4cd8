"""Make the subproblem of a formulation for a conic solver."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from formulations.linearisation.condensation import CONDENSATIONS
from formulations.problem.flyby import FlybyProblem
from formulations.program.subproblem import Penalty, Subproblem
from formulations.rows.cones import Rows

FORMULATIONS = ("condensed", "lifted", "frozen-stm", "frozen-covariance")


SubproblemMaker = Callable[[FlybyProblem, Rows, Penalty, str], Subproblem]
"""Makes a subproblem of one formulation from the problem, its state constraints (of P3 or P2), the
penalty for violations and steps, and a solver: one of `formulations.program.solvers.installed()`."""


def subproblem_maker(formulation: str) -> SubproblemMaker:
    """The maker of subproblems of one of `FORMULATIONS`.

    CVXPY takes a second to import, so it is imported here.
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
