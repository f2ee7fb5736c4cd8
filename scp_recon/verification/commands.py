"""Check the commands of corrected burns by draws: the probability of each limit, and the cost.

The corrections are jointly normal, with the covariance that the verification's own recursion gives.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.special import ndtri

from formulations.arrays import Array
from scp_recon.mission.mission import Mission
from scp_recon.physics import geometry
from scp_recon.results.facts import BurnLimit
from scp_recon.results.solution import Solution
from scp_recon.verification.consistency import ERRORS, FEW, POINTS, SEED

NO_BURN_M_S = 1e-6
"""Size below which a burn needs no attitude."""
SIGMA_ERROR = 1e-5
"""Relative tolerance of a correction's standard deviation."""
MEAN_ERROR, DV99_ERROR = 0.02, 0.1
"""Standard deviations of the total delta-v by which its mean and quantile over other draws may differ:
twice to three times what was measured."""
SAME_M_S = 1e-8
"""Tolerance of velocities in a file."""


def commanded(solution: Solution, covariance: Array) -> Array:
    """Draws of the corrected burns, m/s, shape (POINTS, k, 3), for the corrections' covariance."""
    from scipy.stats import qmc  # half a second to import

    values, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(values, 0.0))
    draws = ndtri(qmc.Sobol(len(root), scramble=True, rng=SEED).random(POINTS))
    nominal = solution.burns_m_s[[correction.burn for correction in solution.corrections]]
    return np.asarray(nominal + (draws @ root.T).reshape(POINTS, -1, 3))


def burn_limits(mission: Mission, solution: Solution, burns: Array) -> Iterator[BurnLimit]:
    """Probabilities that corrected burns (draws, k, 3) keep their size and stay out of the cones."""
    cone = np.deg2rad(mission.scenario.battery.delta_v_cone_deg)
    times = np.array([solution.burns[c.burn].t_s for c in solution.corrections])
    suns, first = mission.sun_direction(times), 1 + mission.scenario.burns_flown
    for j, correction in enumerate(solution.corrections):
        size = np.linalg.norm(burns[:, j], axis=1)
        angle = geometry.angle(burns[:, j], suns[j])
        kept = {
            "dv_max": size <= mission.scenario.burns.dv_max_m_s,
            "dv_battery": (np.minimum(angle, np.pi - angle) >= cone) | (size <= NO_BURN_M_S),
        }
        for name, those in kept.items():
            share = float(those.mean())
            yield BurnLimit(first + correction.burn, name, float(times[j]), share)


def is_kept(limit: BurnLimit, required: float) -> bool:
    """Whether a limit is kept with the required probability, within the accuracy of the draws."""
    p = limit.probability
    return p + FEW + ERRORS * np.sqrt(p * (1.0 - p) / POINTS) >= required


def wrong_costs(solution: Solution, covariance: Array, burns: Array) -> Iterator[str]:
    """Names of figures in a file's policy that do not follow from its corrections."""
    stored = solution.policy
    assert stored is not None
    sigmas = np.sqrt(np.diag(covariance).reshape(-1, 3).sum(axis=1))
    given = np.array([correction.sigma_m_s for correction in stored.corrections])
    if np.any(np.abs(given - sigmas) > SIGMA_ERROR * sigmas + SAME_M_S):
        yield "policy.corrections"
    fixed = np.delete(solution.burns_m_s, [c.burn for c in solution.corrections], axis=0)
    total = np.linalg.norm(fixed, axis=1).sum() + np.linalg.norm(burns, axis=2).sum(axis=1)
    spread = float(total.std())
    if abs(stored.mean_m_s - total.mean()) > MEAN_ERROR * spread + SAME_M_S:
        yield "policy.mean_m_s"
    if abs(stored.dv99_m_s - np.quantile(total, 0.99)) > DV99_ERROR * spread + SAME_M_S:
        yield "policy.dv99_m_s"
