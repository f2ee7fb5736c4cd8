"""Which facets the convex program of P2 begins with: the others are checked after it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import Facets, included_rows
from scp_recon.mission.mission import Mission


def screened(
    mission: Mission, facets: Facets, lin: Linearisation, clearance_m: float, nodes_max: int
) -> npt.NDArray[np.bool_]:
    """Facets that take part in the program of P2 to begin with, shape (facets,).

    Args:
        mission: of the facets.
        facets: all of them.
        lin: where they are looked at.
        clearance_m: distance from binding beyond which they stay out.
        nodes_max: nodes that they may be at, those nearest to binding.
    """
    margin = facets.margin(lin.iterate.mean, lin.factor)
    return included_rows(facets, margin, clearance_m / mission.units.length_m, nodes_max)
