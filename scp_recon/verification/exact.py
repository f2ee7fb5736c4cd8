"""Whether what an exact plan says of its risk follows from its own nodes, by means of its own.

At each node the original limits are judged for points of the normal law that the file says; they share
no code with the rows of the planner. The probability of a whole flight, and what a certificate says was
reached, are held against the flights of the Monte Carlo: see `probabilities`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr, ndtri

from formulations.rows.exact import FLIGHT
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.certifying import FIRST_SEED, flights_needed
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.monte_carlo.observation_time import joint_margins
from scp_recon.monte_carlo.whole_flight import SAFETY
from scp_recon.scp.status import Status
from scp_recon.solution.file import Solution
from scp_recon.solution.risk import EventProbability, Risk
from scp_recon.solution.times import TIME_ERROR_S
from scp_recon.verification.final_sigmas import final_margins

Array = npt.NDArray[np.float64]

POINTS, SEED = 2**15, 7
"""Of a scrambled Sobol net. On plans per node for 0.70, 0.90 and 0.99 it errs by 4e-4 at most, where as
many draws have a standard error of up to 2.5e-3; the planner's quadrature is good to 1e-6."""
ERRORS = 2.0
"""Standard errors of as many draws that it may err by; 0.9 was measured."""
FEW = 3.0 / POINTS
"""In the tails, where a point counts for more than what it stands for."""
SAME_PROBABILITY, BURN_ERROR = 1e-9, 1e-8
SIGMA_ERROR = 1e-6
"""Of a stored margin of the final covariance, m or m/s."""
SLACK = 2e-5
"""Standard deviations by which what has converged may miss its aim: twice what counts as none."""


def exact_inconsistencies(
    mission: Mission, solution: Solution, burn_margins: dict[str, Array]
) -> list[str]:
    """Parts that contradict each other, by name.

    Args:
        mission: the solution's.
        solution: an exact P2's.
        burn_margins: limits on the burns, worked out from them, m/s.
    """
    risk, asked = solution.risk, mission.scenario.risk
    if risk is None or (risk.scope, risk.asked) != (asked.scope, asked.p_chance):
        return ["risk"]
    found = []
    if not _is_law(mission, solution, risk) or not _is_promise(risk):
        found.append("risk")
    finals = final_margins(mission, solution)
    if not _are_results(solution, risk, burn_margins, finals):
        found.append("constraints")
    converged = solution.status == Status.CONVERGED.value.name
    if converged and (solution.violation.by_constraint or not _is_kept(solution)):
        found.append("violation")
    return found


def _is_law(mission: Mission, solution: Solution, risk: Risk) -> bool:
    """Whether the normal law's probabilities are those of the nodes' means and covariances."""
    told = {event.name: event for event in risk.normal_law}
    if len(told) != len(risk.normal_law):
        return False
    if risk.scope == "flight" and told.keys() == {FLIGHT}:
        return len(told[FLIGHT].probability) == 1
    expected = node_probabilities(mission, solution)
    return told.keys() == expected.keys() and all(
        np.array_equal(told[name].t_s, times) and _agree(told[name], probability)
        for name, (times, probability) in expected.items()
    )


def _agree(told: EventProbability, expected: Array) -> bool:
    p = np.array(told.probability)
    return bool(np.all(np.abs(p - expected) <= FEW + ERRORS * np.sqrt(p * (1.0 - p) / POINTS)))


def node_probabilities(mission: Mission, solution: Solution) -> dict[str, tuple[Array, Array]]:
    """Times and probabilities of each joint constraint, by points of the nodes' normal laws."""
    from scipy.stats import qmc  # half a second to import

    times = np.array(solution.nodes.t_s)
    mean = np.array(solution.nodes.state)[:, :3]
    covariance = np.array(solution.nodes.covariance)[:, :3, :3]
    values, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(values, 0.0))[:, None]
    draws = ndtri(qmc.Sobol(3, scramble=True, rng=SEED).random(POINTS))
    first, last = mission.observed_s or (np.inf, np.inf)
    window = (times >= first) & (times <= last)

    def positions(nodes: npt.NDArray[np.bool_]) -> Array:
        return np.asarray(mean[nodes, None] + draws @ root[nodes].swapaxes(1, 2))

    everywhere = np.ones(len(times), dtype=bool)
    safe = np.linalg.norm(positions(everywhere), axis=2) >= mission.scenario.safety.radius_min_m
    seen = joint_margins(mission, times[window], positions(window)) if window.any() else {}
    kept = {name: (times[window], (margin >= 0.0).mean(axis=1)) for name, margin in seen.items()}
    return {SAFETY: (times, safe.mean(axis=1)), **kept}


def _is_promise(risk: Risk) -> bool:
    """Whether what is promised is aimed at, or certified by flights that may do so.

    A plan without a certificate aims at what was asked, or higher. A certified one aims at whatever its
    flights needed: less than was asked where they reach more than the law says.
    """
    reached = risk.certificate
    if reached is None:
        return risk.aim >= risk.asked - SAME_PROBABILITY
    kept = proportion(round(reached.reached * reached.samples), reached.samples)
    told = (reached.reached, reached.low, reached.high)
    same = np.allclose(told, kept, rtol=0.0, atol=1e-9)
    try:
        enough = reached.samples >= flights_needed(risk.asked)
    except InputError:  # no flights certify so much
        return False
    unseen = reached.seed >= FIRST_SEED
    return bool(same) and enough and unseen and reached.reached <= reached.at_nodes


def _is_kept(solution: Solution) -> bool:
    """Whether the probabilities are what was aimed at."""
    return all(c.worst_margin >= -SLACK for c in solution.constraints if c.kind == "joint")


def _are_results(
    solution: Solution, risk: Risk, burn_margins: dict[str, Array], finals: dict[str, Array]
) -> bool:
    """Whether each constraint is told once, with its kind, its unit and its smallest margin."""
    stored = {c.name: c for c in solution.constraints}
    told = {event.name: event for event in risk.normal_law}
    if len(stored) != len(solution.constraints) or stored.keys() != {
        *told,
        *burn_margins,
        *finals,
    }:
        return False
    for name, margin in finals.items():
        if stored[name].kind != "covariance" or stored[name].facets != 0:
            return False
        if abs(stored[name].worst_margin - margin[0]) > SIGMA_ERROR:
            return False
    for name, margin in burn_margins.items():
        burn = stored[name]
        if (burn.kind, burn.unit, burn.facets) != ("burn", "m/s", 0):
            return False
        if abs(burn.worst_margin - margin.min()) > BURN_ERROR:
            return False
    for name, event in told.items():
        joint, probability = stored[name], np.array(event.probability)
        if (joint.kind, joint.unit, joint.facets) != ("joint", "sigma", 0):
            return False
        there = np.abs(np.array(event.t_s) - joint.worst_t_s) <= TIME_ERROR_S
        least = np.array([probability.min(), probability[there].min(initial=np.inf)])
        promised = float(ndtr(joint.worst_margin + ndtri(risk.aim)))
        if np.abs(promised - least).max() > SAME_PROBABILITY:
            return False
    return True
