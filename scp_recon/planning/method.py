"""Names of the methods of planning and limits of its options, without importing the planner."""

from __future__ import annotations

from typing import Literal, NamedTuple

from formulations.registry import FORMULATIONS
from scp_recon.errors import one_of, option
from scp_recon.scp.algorithms import ALGORITHMS

FORMULATION, ALGORITHM, SOLVER = "condensed", "scvx", "CLARABEL"
PROBLEMS = ("P2", "P3")
FACET_ROUNDS_MAX = 100
SETTLE: Literal["settle"] = "settle"
"""Facets are chosen again until no choice is cheaper: see `planning.settling`."""
FacetRounds = int | Literal["settle"]
AUTO: Literal["auto"] = "auto"
"""As many starts as pay: see `planning.starts`."""
NumberOfStarts = int | Literal["auto"]
STARTS_MAX, SEED_MAX = 1_000, 2**63 - 1


class ScpMethod(NamedTuple):
    """Names of formulation, algorithm and solver, checked; arguments of `planner.plan`."""

    formulation: str
    algorithm: str
    solver: str


def scp_method(
    formulation: str = FORMULATION,
    algorithm: str = ALGORITHM,
    solver: str = SOLVER,
) -> ScpMethod:
    """Check the names; a solver's may be in lower case.

    A solver must be one that CVXPY finds. That check imports all solvers, so it is left out for
    Clarabel.

    Raises:
        InputError: if a name is unknown.
    """
    one_of(option("formulation"), formulation, FORMULATIONS)
    one_of(option("algorithm"), algorithm, ALGORITHMS)
    name = solver.upper() if isinstance(solver, str) else solver
    if name != SOLVER:
        from formulations.program.solvers import installed

        one_of(option("solver"), name, installed())
    return ScpMethod(formulation, algorithm, name)
