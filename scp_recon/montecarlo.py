"""Monte Carlo of the nonlinear dynamics with initial-state and execution errors."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.stats import binomtest

from scp_recon.flow import propagate
from scp_recon.mission import RK4_STEP_MAX_S, Mission

Array = npt.NDArray[np.float64]

BLOCK = 1000
"""Samples drawn from one seed, so that a sample does not depend on how many others are drawn."""


def sample_positions(
    mission: Mission, burns_m_s: Array, times_s: Array, samples: int, seed: int
) -> Array:
    """Positions of sampled flights, J2000, m, shape (times, samples, 3).

    The initial state is Gaussian about the mission's, and each burn component is executed as
    dv (1 + beta w) with w standard normal: Echigo et al., eq. (11).

    Args:
        mission: dynamics and uncertainty.
        burns_m_s: planned burns, shape (m, 3).
        times_s: ascending times within the flight at which to look.
        samples: number of flights.
        seed: of the random numbers.
    """
    blocks = [
        _fly_block(mission, burns_m_s, times_s, min(BLOCK, samples - first), [seed, first // BLOCK])
        for first in range(0, samples, BLOCK)
    ]
    return np.concatenate(blocks, axis=1)


def _fly_block(
    mission: Mission, burns_m_s: Array, times_s: Array, samples: int, seed: list[int]
) -> Array:
    draws = np.random.default_rng(seed).standard_normal((BLOCK, 6 + burns_m_s.size))[:samples]
    state = mission.initial_state + draws[:, :6] * mission.initial_sigma
    error = mission.scenario.uncertainty.execution_error
    burns = burns_m_s * (1.0 + error * draws[:, 6:].reshape(samples, *burns_m_s.shape))
    burn_at = dict(zip(mission.scenario.burns.times_s, range(len(burns_m_s)), strict=True))
    stops = np.union1d(np.append(times_s, mission.scenario.burns.times_s), mission.times_s)
    wanted = set(times_s.tolist())
    positions, now = [], 0.0
    for stop in stops.tolist():
        if stop > now:
            substeps = int(np.ceil((stop - now) / RK4_STEP_MAX_S))
            state = propagate(state, stop - now, mission.forces, substeps)
            now = stop
        if stop in burn_at:
            state[:, 3:] += burns[:, burn_at[stop]]
        if stop in wanted:
            positions.append(state[:, :3].copy())
    return np.stack(positions)


def proportion_interval(successes: int, samples: int, confidence: float) -> tuple[float, float]:
    """Clopper-Pearson interval of a probability."""
    interval = binomtest(successes, samples).proportion_ci(confidence, method="exact")
    return float(interval.low), float(interval.high)
