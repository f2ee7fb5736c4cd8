"""Primer history of a plan: whether one more burn would help, at first order and locally.

A small burn added at time t in direction u changes the least total delta-v by (1 - p(t)'u) times
its size (`formulations.program.multipliers`). Directions count if the battery allows them, times if
the schedule's rules hold with all other burns kept. If p'u is nowhere above one, no small
additional burn makes the plan cheaper. The primer says nothing about large burns, or about other
times of present burns.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from formulations.arrays import Array
from formulations.program.multipliers import VANISHED, multipliers, primer, slope_left
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import legal_additions
from scp_recon.planning.plan import Plan, Stage
from scp_recon.scenario.fields import Number
from scp_recon.scp.status import Status

WORTH = 1e-3
"""Excess of the primer over one at which another burn is worth trying: converged plans stay below."""


@dataclass(frozen=True)
class PrimerHistory:
    """The primer at the nodes of a plan's grid: a local certificate, at first order.

    If `allowed` exceeds one at no `legal` time, no small added burn makes the plan cheaper.

    Attributes:
        t_s: times of the nodes past the epoch, n of them.
        vector: p, J2000, without unit, n of them.
        allowed: largest p'u over directions u that the battery allows, n of them.
        legal: whether a burn may be added, n of them.
        residual: largest component of the Lagrangian's gradient by the burns: how far from optimal the
            plan is, or how far the multipliers are from its own.
    """

    t_s: list[Number]
    vector: list[tuple[Number, Number, Number]]
    allowed: list[Number]
    legal: list[bool]
    residual: Annotated[float, Field(ge=0)]

    def __post_init__(self) -> None:
        """Refuse columns that do not fit together."""
        columns = self.t_s, self.vector, self.allowed, self.legal
        if len({len(column) for column in columns}) != 1 or not self.t_s:
            raise ValueError("primer must have columns of one length")
        if any(b <= a for a, b in itertools.pairwise(self.t_s)):
            raise ValueError("primer.t_s must ascend")


def primer_of(plan: Plan) -> PrimerHistory | None:
    """The history of a plan; None as of `primer_history`, and if nothing was optimised."""
    return None if plan.provenance.method == "none" else primer_history(plan.mission, plan.final)


def primer_history(mission: Mission, stage: Stage) -> PrimerHistory | None:
    """The history at the end of a stage.

    Returns:
        None if the stage has not converged, if execution errors do not shrink with the burns (a
            small burn is then not like no burn), and for flights under way.
    """
    lin, merit = stage.result.lin, stage.merit
    if (
        stage.result.status is not Status.CONVERGED
        or mission.scenario.in_flight is not None
        or not lin.problem.execution_errors.affine
        or not np.any(np.linalg.norm(lin.iterate.burns, axis=1) > VANISHED)
    ):
        return None
    prices = multipliers(merit.problem, merit.rows, lin)
    vector, times = primer(merit.rows, lin, prices), mission.times_s
    sun, legal = mission.sun_direction(times), np.zeros(len(times), dtype=np.bool_)
    rules, kept = mission.scenario.schedule, mission.kept_window_s
    for first, last in legal_additions(mission.scenario.burns.times_s, kept, rules):
        legal |= (times >= first) & (times <= last)
    return PrimerHistory(
        times.tolist(),
        [(x, y, z) for x, y, z in vector.tolist()],
        allowed_part(vector, sun, lin.problem.dv_cone).tolist(),
        legal.tolist(),
        slope_left(merit.problem, merit.rows, lin, prices),
    )


def allowed_part(vector: Array, sun: Array, half_angle: float) -> Array:
    """Largest p'u over unit vectors u at least `half_angle` off the Sun line, either way, shape (n,).

    Takes p and unit vectors to the Sun, shape (n, 3) each, and the double cone's half-angle, rad.
    """
    along = np.abs(np.einsum("ni,ni->n", vector, sun))
    across = np.linalg.norm(np.cross(vector, sun), axis=1)
    lacking = np.maximum(half_angle - np.arctan2(across, along), 0.0)
    return np.asarray(np.hypot(along, across) * np.cos(lacking))
