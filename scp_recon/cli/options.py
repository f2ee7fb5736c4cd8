"""Options of commands: texts become numbers where they are some; what a number may be, `api` says."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

from formulations.registry import FORMULATIONS
from scp_recon.api.options import METHODS, OBJECTIVES, PlanOptions
from scp_recon.planning.method import ALGORITHM, FORMULATION, PROBLEMS, SOLVER
from scp_recon.scp.algorithms import ALGORITHMS

WHOLE = re.compile(r"[+-]?[0-9]{1,20}")
"""Longer ones are beyond every bound, and slow to read."""


def whole(text: str) -> int | str:
    """A type of option: a whole number; a text that is none goes on, to be refused with its bounds."""
    return int(text) if WHOLE.fullmatch(text) else text


def number(text: str) -> float | str:
    """A type of option: a number; a text that is none goes on, to be refused with its bounds."""
    try:
        return float(text)
    except ValueError:
        return text


def numbers(text: str) -> tuple[float, ...] | str:
    """A type of option: numbers with commas; a text that is none goes on, to be refused."""
    found = tuple(number(word) for word in text.split(","))
    return tuple(x for x in found if isinstance(x, float)) if _are_numbers(found) else text


def _are_numbers(found: tuple[object, ...]) -> bool:
    return all(isinstance(x, float) for x in found)


def int_between(low: int, high: int, words: str = "") -> Callable[[str], int]:
    """A type of option: whole numbers within bounds, named in `words` if these are shorter."""

    def parse(text: str) -> int:
        found = whole(text)
        if isinstance(found, str) or not low <= found <= high:
            allowed = words or f"{low} to {high}"
            raise argparse.ArgumentTypeError(f"got {text!r}; must be a whole number from {allowed}")
        return found

    return parse


def named_folder(text: str) -> Path:
    """A type of option: a folder, which has a name."""
    if not text:
        raise argparse.ArgumentTypeError("got ''; must be a folder")
    return Path(text)


def add_plan(p: argparse.ArgumentParser, metavar: str = "DIR") -> None:
    """The plan that something is done with."""
    p.add_argument(
        "plan", type=Path, metavar=metavar, help="folder with a solution.json, or the file"
    )


def add_seed(p: argparse.ArgumentParser, of: str) -> None:
    """The seed of random numbers."""
    p.add_argument("--seed", type=whole, default=0, metavar="S", help=f"of {of} (default: 0)")


def add_vehicle(p: argparse.ArgumentParser, where: str = "") -> None:
    """The spacecraft."""
    p.add_argument(
        "--vehicle",
        type=Path,
        metavar="FILE",
        help=f"vehicle as TOML{where} (default: the packaged DARE)",
    )


def add_where(p: argparse.ArgumentParser, what: str) -> None:
    """Where many things are done: processes here, or a cluster."""
    p.add_argument("--workers", type=whole, metavar="N", help=f"{what} (default: 1)")
    p.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="in their place the Dask cluster of this scheduler, e.g. tcp://127.0.0.1:8786; needs "
        "[cluster]",
    )


def add_overrides(p: argparse.ArgumentParser, example: str = ", e.g. risk.p_chance=0.8") -> None:
    """Entries of the scenario, one by one."""
    p.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="PATH=VALUE",
        dest="overrides",
        help=f"override one entry of the scenario{example}; may be repeated",
    )


def add_out(p: argparse.ArgumentParser, files: str = "solution.json") -> None:
    """The folder of a run."""
    p.add_argument(
        "--out",
        type=named_folder,
        metavar="DIR",
        help=f"folder for {files} (default: runs/NAME/UTC with the scenario's name, to which "
        "runs/latest then points); a verified plan there is overwritten only by a verified one",
    )


def add_certify(p: argparse.ArgumentParser) -> None:
    """Whether exact risk is certified."""
    p.add_argument(
        "--certify",
        type=_yes_or_no,
        metavar="yes|no",
        help="with risk.allocation = exact, fly the plan and plan again until the lower limit of the "
        "probability reached is what was required (default: yes)",
    )


def _yes_or_no(text: str) -> bool:
    if text not in ("yes", "no"):
        raise argparse.ArgumentTypeError(f"got {text!r}; must be yes or no")
    return text == "yes"


def add_plan_options(p: argparse.ArgumentParser) -> None:
    """All that `PlanOptions` has."""
    p.add_argument(
        "--problem",
        metavar="|".join(PROBLEMS),
        default="P2",
        help="with uncertainty, or without it (default: P2)",
    )
    p.add_argument(
        "--starts",
        type=whole,
        metavar="K",
        help="plan from --init and from K - 1 random flights, list the distinct local optima and keep "
        "the best (default: 1)",
    )
    p.add_argument("--seed", type=whole, metavar="S", help="of the random flights (default: 0)")
    p.add_argument(
        "--workers",
        type=whole,
        metavar="N",
        help="processes for the starts; the plan does not depend on their number (default: 1)",
    )
    p.add_argument(
        "--method",
        metavar="|".join(METHODS),
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
    p.add_argument(
        "--facet-rounds",
        type=whole,
        default=0,
        metavar="N",
        help="choose the facets again at the solution and solve again, up to N times (default: 0; what "
        "is infeasible is tried again in any case)",
    )
    p.add_argument(
        "--objective",
        metavar="|".join(OBJECTIVES),
        default="delta-v",
        help="with risk.allocation = exact, probability asks for the largest there is, whatever "
        "p_chance says (default: delta-v)",
    )
    p.add_argument(
        "--dv-budget",
        dest="dv_budget_m_s",
        type=lambda text: None if text == "any" else number(text),
        metavar="M_S",
        help="with --objective probability, most delta-v that the plan may cost, m/s (default: any)",
    )
    add_certify(p)


def plan_options(options: argparse.Namespace) -> PlanOptions:
    """How a command is to plan.

    Raises:
        InputError: if an option is out of its range, or goes not with another.
    """
    return PlanOptions(
        **{field.name: getattr(options, field.name) for field in fields(PlanOptions)}
    )
