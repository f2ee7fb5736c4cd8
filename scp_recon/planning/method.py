"""How to plan, by names: what the command line and the front door accept, checked in one place."""

from __future__ import annotations

from typing import NamedTuple

from formulations.registry import FORMULATIONS
from scp_recon.errors import InputError, one_of, shortened
from scp_recon.scp.algorithms import ALGORITHMS

FORMULATION, ALGORITHM, SOLVER = "condensed", "scvx", "CLARABEL"
PROBLEMS = ("P2", "P3")
FACET_ROUNDS_MAX = 100


class ScpMethod(NamedTuple):
    """Sequential convex programming by names that are known; arguments of `planner.plan`."""

    formulation: str
    algorithm: str
    solver: str


def scp_method(
    formulation: str = FORMULATION,
    algorithm: str = ALGORITHM,
    solver: str = SOLVER,
    *,
    prefix: str = "",
) -> ScpMethod:
    """Check the names; a solver's may be in small letters.

    Args:
        formulation: one of `FORMULATIONS`.
        algorithm: one of `ALGORITHMS`.
        solver: a conic solver that CVXPY finds; it is imported to ask, but for Clarabel.
        prefix: what messages put before an argument's name, as "--" on the command line.

    Raises:
        InputError: if one is not known.
    """
    one_of(f"{prefix}formulation", formulation, FORMULATIONS)
    one_of(f"{prefix}algorithm", algorithm, ALGORITHMS)
    name = solver.upper() if isinstance(solver, str) else solver
    if name != SOLVER:
        from formulations.program.solvers import installed

        one_of(f"{prefix}solver", name, installed())
    return ScpMethod(formulation, algorithm, name)


def check_exact(method: str, formulation: str, facet_rounds: int, prefix: str = "") -> None:
    """Refuse what probabilities of the sets themselves do not go with.

    Args:
        method: "scp" or "ipopt".
        formulation: of the convex subproblem.
        facet_rounds: further choices of facets, of which there are none.
        prefix: what messages put before an argument's name.

    Raises:
        InputError: if it is not the condensed form by sequential convex programming.
    """
    for name, given, only in (
        ("method", method, "scp"),
        ("formulation", formulation, FORMULATION),
        ("facet-rounds" if prefix else "facet_rounds", facet_rounds, 0),
    ):
        if given != only:
            raise InputError(
                f"{prefix}{name}", shortened(given), f"must be {only} with risk.allocation = exact"
            )
