"""A stage of planning: one run of the SCP or of IPOPT, with its margins in SI."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from formulations.problem.facets import Facets
from formulations.program.merit import MeritFunction
from formulations.rows.cones import Margins
from formulations.rows.deterministic import DeterministicRows
from formulations.rows.final_spread import FINAL_POSITION, FINAL_VELOCITY
from scp_recon.mission.mission import Mission
from scp_recon.scp.loop import Result

Array = npt.NDArray[np.float64]


Unit = Literal["m", "m/s", "sigma"]
"""Of a margin in SI; sigma is a standard deviation on the normal quantile scale."""

BURN_LIMITS = ("dv_max", "dv_battery")


def scale(mission: Mission, unit: Unit) -> float:
    """SI value of one nondimensional unit of a margin."""
    units = mission.units
    return {"m": units.length_m, "m/s": units.speed_m_s, "sigma": 1.0}[unit]


@dataclass(frozen=True, eq=False)
class Stage:
    """A run of the SCP, or of IPOPT, on one problem.

    Attributes:
        name: "P3", "P2", "P2.2" with the facets chosen a second time, ...; "P3b", "P2b", ... of those
            that began again at the ballistic arc, c and d at a turn about the body; "P3.open" leads to
            P3 from a guess that is no flight, "P2.node" and "P2.coarse" to a P2 of whole flights.
        result: how it ended and where.
        merit: what it minimised; it knows the constraints' margins.
        facets: of P2 with polytopes, else None.
        tolerance: violation that counted as none.
    """

    name: str
    result: Result
    merit: MeritFunction
    facets: Facets | None
    tolerance: float

    @property
    def problem(self) -> Literal["P3", "P2"]:
        """Without uncertainty, or with it."""
        return "P3" if isinstance(self.merit.rows, DeterministicRows) else "P2"

    def unit(self, constraint: str) -> Unit:
        """Unit of a constraint's margins in SI."""
        if constraint in (*BURN_LIMITS, FINAL_VELOCITY):
            return "m/s"
        if constraint == FINAL_POSITION:
            return "m"
        return "m" if self.merit.rows.unit == "length" else "sigma"

    @property
    def margins(self) -> dict[str, Margins]:
        """Margins by constraint, those of facets left out of the convex program included."""
        lin = self.result.lin
        margins = self.merit.margins(lin)
        if self.facets is not None:
            margin = self.facets.margin(lin.iterate.mean, lin.factor)
            for index, constraint in enumerate(self.merit.problem.constraints):
                rows = self.facets.constraint == index
                margins[constraint.name] = Margins(self.facets.node[rows], margin[rows])
        return margins

    @property
    def begun_again(self) -> bool:
        """Whether it began elsewhere because the guess led nowhere."""
        return self.name[2:3] in ("b", "c", "d")
