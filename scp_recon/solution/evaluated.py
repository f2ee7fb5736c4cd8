"""Burns that were given and not planned, in the form of a solution."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from formulations.program.merit import MeritFunction
from formulations.rows.deterministic import DeterministicRows
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.provenance import Provenance
from scp_recon.planning.stage import Stage
from scp_recon.scp.loop import Result, Timing
from scp_recon.scp.scvx import SCvx
from scp_recon.scp.status import Status
from scp_recon.solution.file import Solution
from scp_recon.solution.from_plan import make_solution

Array = npt.NDArray[np.float64]

NOT_OPTIMISED = "none"
"""The `algorithm` of a solution file whose burns were given and only evaluated."""


def evaluated(mission: Mission, burns_m_s: Array, init: str, message: str) -> Solution:
    """Given burns in the form of a solution: rolled out, with P3's margins, nothing optimised.

    Args:
        mission: what is flown.
        burns_m_s: shape (m, 3), J2000.
        init: where they come from, as the solution file says.
        message: what the solution file says of them.
    """
    lin = mission.dynamics.linearise(mission.problem, initial_guess.from_burns(mission, burns_m_s))
    merit = MeritFunction(mission.problem, DeterministicRows(mission.problem))
    # No iteration was allowed, which is what the status says of a plan that is none.
    result = Result(Status.MAX_ITERATIONS, lin, (), Timing())
    stage = Stage(init, result, merit, None, SCvx().feasible)
    provenance = Provenance(NOT_OPTIMISED, NOT_OPTIMISED, NOT_OPTIMISED, init, "none")
    solution = make_solution(Plan(mission, provenance, (stage,), stage, Timing(), 0.0))
    return solution.model_copy(update={"message": message})


def ballistic_arc(mission: Mission) -> Solution:
    """The two-impulse arc between the boundary positions, evaluated as it is."""
    burns = initial_guess.ballistic(mission).burns * mission.units.speed_m_s
    message = "Not a plan: the ballistic arc between the boundary positions, evaluated as it is."
    return evaluated(mission, burns, "ballistic", message)
