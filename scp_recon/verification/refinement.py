"""Estimate the planner's integration error, and the grid that is fine enough where it is too large.

The planner takes steps of a fixed length, by default 232 s at most. Such steps are short enough
about Bennu. If a flight turns faster, they are too long, and the planner's path and covariances differ
from those of the verification.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import step_mean
from formulations.problem.flyby import Iterate
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import NODES_MAX
from scp_recon.planning.plan import Plan
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scp.status import Status
from scp_recon.verification import reintegration

ORDER = 4
"""Order of the Runge-Kutta scheme: steps of half the length err by a sixteenth."""
AIM = 0.5
"""Share of a limit that a finer grid should reach."""


class IntegrationError(NamedTuple):
    """Errors by the planner's steps.

    Attributes:
        covariance: largest relative one of a node's covariance.
        path_m: largest one of a node, m, velocities in the nondimensional problem's units.
    """

    covariance: float
    path_m: float


def integration_error(plan: Plan) -> IntegrationError:
    """Estimate a plan's integration errors from steps of half the length."""
    mission, at = plan.mission, plan.final.result.lin
    halves = replace(mission.flow, substeps=2 * mission.flow.substeps)
    dynamics = Dynamics(halves, mission.burn_nodes)
    burns, halved = at.iterate.burns, dynamics.linearise(at.problem, at.iterate)
    flown = dynamics.linearise(
        at.problem, Iterate(burns, step_mean(halved, burns), at.iterate.gains)
    )
    coarse, fine = (lin.factor @ lin.factor.transpose(0, 2, 1) for lin in (at, flown))
    apart = np.abs(flown.iterate.mean - at.iterate.mean).max() * mission.units.length_m
    known = 1.0 - 0.5**ORDER
    return IntegrationError(
        reintegration.relative_error(coarse, fine) / known, float(apart) / known
    )


def finer_step_s(mission: Mission, excess: float) -> float:
    """Longest spacing of nodes with half of the allowed integration error, s.

    Args:
        mission: on its present grid.
        excess: its error over the one allowed.
    """
    longest = float(np.diff(mission.times_s).max()) / mission.arc_substeps
    step = longest * (AIM / max(excess, AIM)) ** (1.0 / ORDER)
    return max(1.0, float(np.floor(step)))


def refined(plan: Plan) -> Mission | None:
    """The mission of a plan on a grid fine enough for re-integration, with a warning about it.

    None if the present grid is fine enough, if the plan has not converged, or if the finer grid
    would have too many nodes.
    """
    mission, limits = plan.mission, reintegration.limits_of(plan.mission)
    if plan.status is not Status.CONVERGED:
        return None
    error = integration_error(plan)
    of_covariances = error.covariance / limits["covariance_error"]
    excess = max(of_covariances, error.path_m / limits["max_defect"])
    if excess <= 1.0:
        return None
    step, before = finer_step_s(mission, excess), mission.scenario.grid.step_max_s
    if mission.scenario.duration_s / step > NODES_MAX or step >= before:
        return None
    said, limit = f"covariances err by {error.covariance:.1e}", f"{limits['covariance_error']:g}"
    if of_covariances < excess:
        said, limit = f"nodes err by {error.path_m:.1e} m", f"{limits['max_defect']:g} m"
    word = ScenarioWarning.of(
        "grid.step_max_s",
        f"{before:g} s, with which {said}",
        f"expected at most {limit}: planned again with {step:g} s",
    )
    return mission.changed({"grid.step_max_s": step}, word)
