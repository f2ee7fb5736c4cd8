"""Limits on the covariance after the last burn: worked out from a file's nodes, and from flights."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.sampling import fly_block
from scp_recon.solution.file import Solution
from scp_recon.solution.verdict import FinalSigma

Array = npt.NDArray[np.float64]

BLOCKS = 5
"""Of a thousand flights."""
ERRORS = 5.0
"""Standard errors by which flights may exceed a limit; beside that the law is first order:"""
LAW = 0.02
"""Of a sigma, by which nonlinear flights may differ from it."""
PARTS: tuple[tuple[str, slice, Literal["m", "m/s"]], ...] = (
    ("final_position_sigma", slice(0, 3), "m"),
    ("final_velocity_sigma", slice(3, 6), "m/s"),
)


def asked(mission: Mission) -> dict[str, float]:
    """The limits that a scenario has, m and m/s."""
    boundary = mission.scenario.boundary
    limits = boundary.final_sigma_position_m, boundary.final_sigma_velocity_m_s
    return {
        name: limit for (name, _, _), limit in zip(PARTS, limits, strict=True) if limit is not None
    }


def final_margins(mission: Mission, solution: Solution) -> dict[str, Array]:
    """Limits less the roots of the summed variances at the last node; none of P3. Shape (1,) each."""
    if solution.problem == "P3":
        return {}
    variances, limits = np.diag(np.array(solution.nodes.covariance[-1])), asked(mission)
    return {
        name: np.array([limits[name] - np.sqrt(max(float(variances[part].sum()), 0.0))])
        for name, part, _ in PARTS
        if name in limits
    }


def flown_sigmas(mission: Mission, burns: Array, seed: int) -> list[FinalSigma]:
    """The roots of nonlinear flights, with the standard error of their number."""
    limits, found = asked(mission), []
    if not limits:
        return []
    end = mission.times_s[-1:]
    blocks = [fly_block(mission, burns, end, number, seed=seed) for number in range(BLOCKS)]
    states = np.concatenate([flown.states[-1] for flown in blocks])
    for name, part, unit in PARTS:
        if name in limits:
            deviation = states[:, part] - states[:, part].mean(axis=0)
            squares = (deviation**2).sum(axis=1)
            sigma = float(np.sqrt(squares.mean()))
            error = float(squares.std() / np.sqrt(len(squares)) / (2.0 * sigma)) if sigma else 0.0
            found.append(
                FinalSigma(name=name, unit=unit, asked=limits[name], flown=sigma, error=error)
            )
    return found


def exceeded(found: list[FinalSigma]) -> list[str]:
    """Names of limits that flights refute."""
    return [s.name for s in found if s.flown - ERRORS * s.error > s.asked * (1.0 + LAW)]
