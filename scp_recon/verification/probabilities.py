"""Probabilities of the joint constraints by nonlinear flights, and whether they are what was asked."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from formulations.rows.exact import FLIGHT
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.monte_carlo.observation_time import joint_margins
from scp_recon.monte_carlo.sampling import sample_positions
from scp_recon.monte_carlo.whole_flight import SAFETY
from scp_recon.solution.file import Solution
from scp_recon.solution.risk import Risk
from scp_recon.solution.verdict import JointProbability

Array = npt.NDArray[np.float64]

SAMPLES, SEED = 10_000, 0
SAMPLED_PARTS_PER_ARC = 4
MARGIN_LIMIT = {"m": -0.5, "rad": -1e-3, "m/s": -1e-6}
"""Between nodes a constraint that binds at them may dip below by this much."""
LAW_ERROR, LAW_LOSS = 0.1, 0.5
"""Standard deviations between what the normal law says of a whole flight and the interval of nonlinear
flights. 0.054 was measured at most, on the default scenario for 0.70 to 0.999. Where flights certify a
plan its aim makes up for the difference, which may then be as large as the second."""
ERRORS = 5.0
"""Standard errors between what two samples of flights reach."""
BETWEEN = 0.05
"""Share of 1 - p that a certificate's flights may lose between the times that are looked at here."""


def shortfalls(
    mission: Mission, solution: Solution, probabilities: list[JointProbability]
) -> list[str]:
    """Probabilities less than asked, and a promise that they contradict.

    An exact plan spends what was asked and no more, so that flights refute it only where their upper
    limit is less. What stands behind it is its certificate, if it has one.
    """
    asked, risk = mission.scenario.risk, solution.risk
    if risk is None:
        return [f"P({p.name})" for p in probabilities if p.estimate < asked.p_chance]
    found = [f"P({p.name})" for p in probabilities if p.high < asked.p_chance]
    if risk.certificate is not None and risk.certificate.low < asked.p_chance:
        found.append("certificate")
    if risk.certificate is not None and not _bears_out(asked.p_chance, risk, probabilities):
        found.append("certificate")
    flown = next((p for p in probabilities if p.name == FLIGHT), None)
    if flown is not None:
        told, low, high = (
            float(ndtri(p)) for p in (min(risk.normal_law[0].probability), flown.low, flown.high)
        )
        off = max(low - told, told - high)
        if off > (LAW_ERROR if risk.certificate is None else LAW_LOSS):
            found.append("risk")
    return list(dict.fromkeys(found))


def _bears_out(asked: float, risk: Risk, probabilities: list[JointProbability]) -> bool:
    """Whether new flights reach what the certificate's flights are said to have reached."""
    certificate = risk.certificate
    assert certificate is not None
    named = [p for p in probabilities if p.name == FLIGHT] or probabilities
    flown, n = min(p.estimate for p in named), certificate.samples
    pooled = (certificate.reached * n + flown * SAMPLES) / (n + SAMPLES)
    error = np.sqrt((pooled * (1.0 - pooled) + 1.0 / SAMPLES) * (1.0 / n + 1.0 / SAMPLES))
    off = certificate.reached - flown
    return bool(-ERRORS * error - BETWEEN * (1.0 - asked) <= off <= ERRORS * error)


def joint_probabilities(mission: Mission, burns: Array) -> list[JointProbability]:
    """By Monte Carlo at the window's nodes and between them, and for safety at every node.

    And of whole flights, where they are what was asked.
    """
    window = mission.times_s[mission.window_nodes]
    step = np.diff(window)[:, None] / SAMPLED_PARTS_PER_ARC
    between = (window[:-1, None] + step * np.arange(1, SAMPLED_PARTS_PER_ARC)).ravel()
    observed = np.union1d(window, between)
    times = np.union1d(observed, mission.times_s)
    positions = sample_positions(mission, burns, times, SAMPLES, SEED)
    seen = np.searchsorted(times, observed)
    joint = joint_margins(mission, observed, positions[seen]) if len(observed) else {}
    radius = np.linalg.norm(positions, axis=2) - mission.scenario.safety.radius_min_m
    kept = {SAFETY: (times, holds(radius, "m"))}
    for name, margin in joint.items():
        kept[name] = observed, holds(margin, "m" if name == "site_distance" else "rad")
    found = [_worst(name, at, held) for name, (at, held) in kept.items()]
    if mission.scenario.risk.scope == "flight":
        every = np.logical_and.reduce([held.all(axis=0) for _, held in kept.values()])
        first = min(found, key=lambda one: one.estimate)
        found.append(_worst(FLIGHT, np.array([first.worst_t_s]), every[None]))
    return found


def holds(margin: Array, unit: str) -> npt.NDArray[np.bool_]:
    """Which flights hold a constraint, margins (times, flights).

    Where they spread by less than a binding mean may dip between nodes they are judged as the mean is:
    without uncertainty every flight is the mean.
    """
    limit = MARGIN_LIMIT[unit]
    allowed = np.where(margin.std(axis=1) < -limit, limit, 0.0)
    return np.asarray(margin >= allowed[:, None])


def _worst(name: str, times: Array, holds: npt.NDArray[np.bool_]) -> JointProbability:
    counts = holds.sum(axis=1)
    at = int(np.argmin(counts))
    estimate = proportion(int(counts[at]), holds.shape[1])
    return JointProbability(
        name=name,
        worst_t_s=float(times[at]),
        estimate=estimate.value,
        low=estimate.low,
        high=estimate.high,
    )
