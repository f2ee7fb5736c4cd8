"""The primer's history of a plan: whether one more burn would help, at first order and locally.

A burn added at time t in direction u, small, changes the least total delta-v by (1 - p(t)'u) times its
size (`formulations.program.primer`). Of its directions count those that the battery allows, of its
times those at which the schedule's rules hold with all other burns kept. Where p'u is nowhere above
one, no small burn added to the plan makes it cheaper; nothing is said of large ones, nor of other
times for the burns that are there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from formulations.linearisation.linearisation import Linearisation
from formulations.program.multipliers import VANISHED, multipliers, slope_left
from formulations.program.primer import primer
from scp_recon.mission.legal_burns import legal_additions
from scp_recon.mission.mission import Mission
from scp_recon.planning.plan import Plan
from scp_recon.planning.stage import Stage
from scp_recon.scp.status import Status

Array = npt.NDArray[np.float64]

WORTH = 1e-3
"""Excess of the primer over one at which another burn is worth trying: converged plans stay below."""


@dataclass(frozen=True, eq=False)
class PrimerHistory:
    """The primer at the nodes of a plan's grid.

    Attributes:
        times_s: of the nodes, past the epoch, shape (n,).
        vector: p, J2000, without unit, shape (n, 3).
        allowed: largest p'u over directions u that the battery allows, shape (n,).
        legal: whether a burn may be added, shape (n,).
        residual: largest component of the Lagrangian's gradient by the burns: how far from optimal the
            plan is, or how far the multipliers are from its own.
    """

    times_s: Array
    vector: Array
    allowed: Array
    legal: npt.NDArray[np.bool_]
    residual: float


def primer_of(plan: Plan) -> PrimerHistory | None:
    """The history of a plan; None where `primer_history` has none, and where nothing was optimised."""
    return None if plan.provenance.method == "none" else primer_history(plan.mission, plan.final)


def primer_history(mission: Mission, stage: Stage) -> PrimerHistory | None:
    """The history at the end of a stage.

    Returns:
        None where it has not converged, where burns have errors that do not shrink with them, so that
        no small burn is like none, and of flights under way.
    """
    lin, merit = stage.result.lin, stage.merit
    converged = stage.result.status is Status.CONVERGED
    if not (converged and lin.problem.execution_errors.affine and _is_whole(mission, lin)):
        return None
    prices = multipliers(merit.problem, merit.rows, lin)
    vector = primer(merit.rows, lin, prices)
    sun = mission.sun_direction(mission.times_s)
    return PrimerHistory(
        mission.times_s,
        vector,
        allowed_part(vector, sun, lin.problem.dv_cone),
        legal_nodes(mission),
        slope_left(merit.problem, merit.rows, lin, prices),
    )


def _is_whole(mission: Mission, lin: Linearisation) -> bool:
    return mission.scenario.in_flight is None and bool(
        np.any(np.linalg.norm(lin.iterate.burns, axis=1) > VANISHED)
    )


def allowed_part(vector: Array, sun: Array, half_angle: float) -> Array:
    """Largest p'u over unit vectors u at least so far from the Sun line, either way, shape (n,).

    Args:
        vector: p, shape (n, 3).
        sun: unit vectors, shape (n, 3).
        half_angle: of the double cone, rad.
    """
    along = np.abs(np.einsum("ni,ni->n", vector, sun))
    across = np.linalg.norm(np.cross(vector, sun), axis=1)
    lacking = np.maximum(half_angle - np.arctan2(across, along), 0.0)
    return np.asarray(np.hypot(along, across) * np.cos(lacking))


def legal_nodes(mission: Mission) -> npt.NDArray[np.bool_]:
    """Nodes at which another burn may be, the others kept, shape (n,)."""
    scenario, times = mission.scenario, mission.times_s
    legal = np.zeros(len(times), dtype=np.bool_)
    window = mission.schedule.window_s
    for first, last in legal_additions(scenario.burns.times_s, window, scenario.schedule):
        legal |= (times >= first) & (times <= last)
    return legal
