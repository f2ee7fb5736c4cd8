"""The rows of the observation-time table: who designs the burns, and what the paper prints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from experiments.observation_table.as_flown import as_flown_burns, flown_guess
from formulations.problem.flyby import Iterate
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import plan
from scp_recon.solution.evaluated import ballistic_arc, evaluated
from scp_recon.solution.file import Solution
from scp_recon.solution.from_plan import make_solution
from scp_recon.solution.read import read_solution

Array = npt.NDArray[np.float64]
Guess = Callable[[Mission], Iterate]

VARIANT = "tuned"
"""How the nonlinear programs are written down for IPOPT."""


@dataclass(frozen=True)
class Printed:
    """A row of the paper's table of observation times (Echigo et al., arXiv 2412.06816)."""

    name: str
    mean_s: float
    worst_1_sigma_s: float


PRINTED_WINDOW_S = 3397.0
"""Length of the window, and every row's observation time without uncertainty."""

PRINTED_CLOSEST_M = 667.24
"""Distance from the centre at the 0.003 quantile, of "the solution trajectory" of either start."""

OSIRIS_REX = Printed("OSIRIS-REx", 2930.0, 2785.0)
WARM = Printed("Proposed Method with Warm Start", 3043.0, 3017.0)
COLD = Printed("Proposed Method with Cold Start", 3271.0, 3397.0)


@dataclass(frozen=True)
class Row:
    """One row.

    Attributes:
        key: name of its folder.
        label: what it is.
        role: "reference" stands for the practice that the planner is compared with.
        printed: what the paper prints in this place.
        design: finds the burns.
        init: where it begins, as its solution file says.
        anew: whether to find them in every run, because a file of the user's may have changed.
    """

    key: str
    label: str
    role: Literal["reference", "planned"]
    printed: Printed
    design: Callable[[Mission], Solution]
    init: str
    anew: bool = False

    def began_elsewhere(self, folder: Path) -> bool:
        """Whether the folder holds a design that did not begin where this row's does."""
        try:
            return read_solution(folder).init != self.init
        except InputError:  # nothing of use is there
            return False


@dataclass(frozen=True)
class Start:
    """An initial guess, and its name in the solution file."""

    init: str
    guess: Guess


def rows(*, ipopt: bool = True, as_flown: tuple[Path, Path] | None = None) -> tuple[Row, ...]:
    """The table's rows in its order.

    Args:
        ipopt: whether to plan by IPOPT too.
        as_flown: the flight's kernel and where to write the states read from it. The warm rows then
            start from the flight, as the paper's do; else from the ballistic arc.
    """
    cold, warm = Start("cold", initial_guess.cold), Start("warm", initial_guess.ballistic)
    label, anew = "warm start", as_flown is not None
    if as_flown:
        warm = Start("as_flown", partial(flown_guess, *as_flown))
        label = "warm start from the flight"
    found = [
        Row(
            "ballistic",
            "OSIRIS-REx surrogate: ballistic two-impulse arc",
            "reference",
            OSIRIS_REX,
            ballistic_arc,
            "ballistic",
        ),
        Row(
            "p3",
            "OSIRIS-REx surrogate: P3 design, no uncertainty",
            "reference",
            OSIRIS_REX,
            partial(_scp, "P3", cold),
            cold.init,
        ),
    ]
    designs: dict[str, Callable[[Start, Mission], Solution]] = {"SCP": partial(_scp, "P2")}
    if ipopt:
        designs["IPOPT"] = _ipopt
    for name, design in designs.items():
        key, by_warm, by_cold = name.lower(), partial(design, warm), partial(design, cold)
        found += [
            Row(f"{key}_warm", f"{name}, {label}", "planned", WARM, by_warm, warm.init, anew),
            Row(f"{key}_cold", f"{name}, cold start", "planned", COLD, by_cold, cold.init),
        ]
    if as_flown:
        given = partial(_as_flown, *as_flown)
        label = "OSIRIS-REx as flown (SPK)"
        found.append(Row("as_flown", label, "reference", OSIRIS_REX, given, warm.init, anew))
    return tuple(found)


def _as_flown(kernel: Path, table: Path, mission: Mission) -> Solution:
    burns, distance_m = as_flown_burns(mission, kernel, table)
    message = (
        f"Not a plan: impulses fitted to {kernel.name}, "
        f"which they follow within {distance_m:.1f} m in the observation window."
    )
    return evaluated(mission, burns, "as_flown", message)


def _scp(problem: Literal["P3", "P2"], start: Start, mission: Mission) -> Solution:
    return make_solution(plan(mission, start.guess(mission), problem=problem, init=start.init))


def _ipopt(start: Start, mission: Mission) -> Solution:
    """The one place that knows the reference solver."""
    from scp_recon.planning import ipopt  # by CasADi, which takes a second to import

    found = ipopt.plan(mission, start.guess(mission), variant=VARIANT, init=start.init)
    return make_solution(found)
