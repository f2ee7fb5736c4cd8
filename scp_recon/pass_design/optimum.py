"""How the least delta-v changes with phases and times, by the multipliers of its constraints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from formulations.linearisation.linearisation import Linearisation, step_mean
from formulations.problem.flyby import FlybyProblem, Iterate
from formulations.program.multipliers import multipliers
from scp_recon.mission.mission import Mission
from scp_recon.pass_design.space import Space
from scp_recon.planning.stage import Stage

Array = npt.NDArray[np.float64]

DIFFERENCE = 1e-6
"""Step of the derivatives by phase (rad) and time; the flown deviation has an error of its square."""


def slope(
    space: Space, mission: Mission, stage: Stage, x: Array, free: npt.NDArray[np.bool_]
) -> Array:
    """Derivative of the least delta-v by x, nondimensional, shape (2 + m,); zero where not free.

    By the envelope theorem it is that of the Lagrangian with burns and multipliers kept. Only what the
    flight misses and violates depends on x then, and flying the same burns from elsewhere, or at other
    times, tells it. Fiacco, Introduction to Sensitivity and Stability Analysis, 1983, section 3.4.

    Args:
        space: of x.
        mission: of `Space.moved`, that was planned.
        stage: converged, with the constraints of the mission's grid.
        x: where.
        free: which components, shape (2 + m,).
    """
    lin, merit = stage.result.lin, stage.merit
    prices = multipliers(merit.problem, merit.rows, lin)
    base, found = float(prices @ merit.excess(lin)), np.zeros(len(x))
    for j in np.flatnonzero(free):
        step = DIFFERENCE * np.eye(len(x))[j]
        flown = reflown(space.moved(mission, space.at(x + step)), lin)
        found[j] = (float(prices @ merit.excess(flown)) - base) / DIFFERENCE
    return found


def reflown(mission: Mission, lin: Linearisation) -> Linearisation:
    """The same burns flown in a mission that hardly differs, its defects closed to first order."""
    problem, dynamics, iterate = boundary_of(mission, lin), mission.dynamics, lin.iterate
    mean = iterate.mean.copy()
    mean[0] = problem.initial_state
    mean[0, 3:] += iterate.burns[0]
    near = dynamics.linearise(problem, Iterate(iterate.burns, mean))
    return dynamics.linearise(problem, Iterate(iterate.burns, step_mean(near, iterate.burns)))


def boundary_of(mission: Mission, lin: Linearisation) -> FlybyProblem:
    """The problem of an iterate with a mission's boundary, its constraints kept."""
    units = mission.units
    return replace(
        lin.problem,
        initial_state=mission.initial_state / units.state,
        final_state=mission.final_state / units.state,
        initial_factor=mission.initial_factor / units.state[:, None],
    )
