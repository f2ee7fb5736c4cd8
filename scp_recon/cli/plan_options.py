"""Options of how a plan is looked for: from where, by which method, and for what."""

from __future__ import annotations

import argparse

from formulations.registry import FORMULATIONS
from scp_recon.cli.options import SEED, int_between, number_between
from scp_recon.planning.method import ALGORITHM, FORMULATION, SOLVER
from scp_recon.planning.starts import STARTS_MAX, WORKERS_MAX
from scp_recon.scp.algorithms import ALGORITHMS


def add_starts(p: argparse.ArgumentParser) -> None:
    """From how many places to plan."""
    p.add_argument(
        "--starts",
        type=int_between(1, STARTS_MAX),
        metavar="K",
        help="plan from --init and from K - 1 random flights, list the distinct local optima and keep "
        "the best (default: 1)",
    )
    p.add_argument("--seed", type=SEED, metavar="S", help="of the random flights (default: 0)")
    p.add_argument(
        "--workers",
        type=int_between(1, WORKERS_MAX),
        metavar="N",
        help="processes for the starts; the plan does not depend on their number (default: 1)",
    )


def add_method(p: argparse.ArgumentParser) -> None:
    """How to plan."""
    p.add_argument(
        "--method",
        choices=("scp", "ipopt"),
        default="scp",
        help="sequential convex programming, or the nonlinear programs by IPOPT (default: scp)",
    )
    p.add_argument(
        "--formulation",
        metavar="NAME",
        help=f"with scp {', '.join(FORMULATIONS)} (default: {FORMULATION}); with ipopt printed, tuned, "
        "shooting (default: tuned)",
    )
    p.add_argument(
        "--algorithm",
        metavar="NAME",
        help=f"with scp {', '.join(ALGORITHMS)} (default: {ALGORITHM})",
    )
    p.add_argument(
        "--solver",
        metavar="NAME",
        help="with scp a conic solver that CVXPY finds: CLARABEL and SCS; ECOS and QOCO with the extra "
        f"[compare] (default: {SOLVER})",
    )


def add_objective(p: argparse.ArgumentParser) -> None:
    """The least delta-v, or the largest probability."""
    p.add_argument(
        "--objective",
        choices=("delta-v", "probability"),
        default="delta-v",
        help="with risk.allocation = exact, probability asks for the largest there is, whatever "
        "p_chance says (default: delta-v)",
    )
    p.add_argument(
        "--dv-budget",
        type=_budget,
        metavar="M_S",
        help="with --objective probability, most delta-v that the plan may cost, m/s (default: any)",
    )


def _budget(text: str) -> float | None:
    return None if text == "any" else number_between(1e-9, 1e6)(text)
