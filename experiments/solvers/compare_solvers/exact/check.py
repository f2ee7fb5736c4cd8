"""Judge burns independently: their cost, final state and probability.

The final state is flown in steps a quarter as long. At nodes the original limits are tested on many
draws of the normal law, by code that no search uses; for whole flights by the planner's own estimate,
but along directions that no search has seen.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri
from scipy.stats import qmc

from formulations.arrays import Array, Indices
from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.flyby import Iterate, factor_columns_used
from formulations.risk.directions import Directions
from formulations.rows.flight_probability import FlightProbability
from formulations.rows.node_probability import joint_events
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.observation_time import joint_margins

FINER = 4
SEED = 71
SETS, DRAWS, DIRECTIONS = 8, 8192, 2048
"""Independently scrambled sets, and what each has: draws at nodes, directions of flights."""
FIRST_DRAWS = 4096
"""Draws with which candidates for the worst node are found."""
UNLIKE = 5.0
"""Standard errors from the worst node up to which another can be it."""


class Checked(NamedTuple):
    """Results of the check of some burns.

    Attributes:
        total_dv_m_s: sum of the burns.
        violation_m: largest miss of a component of the final state or of a limit on the burns;
            velocities count as metres per unit of time.
        probability: at the worst node and constraint, or of whole flights, as the scenario requires.
        error: its standard error, from the sets.
    """

    total_dv_m_s: float
    violation_m: float
    probability: float
    error: float


def check(mission: Mission, burns_m_s: Array) -> Checked:
    """Judge burns, m/s, shape (m, 3)."""
    units, problem = mission.units, mission.problem
    burns = burns_m_s / units.speed_m_s
    finer = replace(mission.flow, substeps=FINER * mission.flow.substeps)
    fine = Dynamics(finer, mission.burn_nodes)
    end = fine.rollout(problem.initial_state, burns)[-1]
    miss = float(np.abs(end - problem.final_state).max())
    lin = rolled_out(mission, burns)
    limits = min(float(margin.min()) for margin in problem.burn_margins(burns).values())
    of = _worst_node if mission.scenario.risk.scope == "node" else _whole_flight
    p, error = of(mission, lin)
    return Checked(
        lin.iterate.total_dv * units.speed_m_s,
        max(miss, -limits) * units.length_m,
        p,
        error,
    )


def rolled_out(mission: Mission, burns: Array) -> Linearisation:
    """The flight of some burns, shape (m, 3)."""
    problem = mission.problem
    mean = mission.dynamics.rollout(problem.initial_state, burns)
    return mission.dynamics.linearise(problem, Iterate(burns, mean))


def _whole_flight(mission: Mission, lin: Linearisation) -> tuple[float, float]:
    """Probability by directions of other seeds than the planner's."""
    events = joint_events(mission.problem.constraints)
    nodes = np.unique(np.concatenate([event.nodes for event in events]))
    dimension = factor_columns_used(mission.problem, nodes)
    found = []
    for seed in range(SETS // 2):
        normal = _normal(dimension, DIRECTIONS, seed)
        directions = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        g = FlightProbability(events, Directions(directions, np.ones(len(directions))))(
            lin.iterate.mean[:, :3], lin.factor[:, :3]
        )
        found.append(float(ndtr(g.value)))
    return _mean(np.array(found))


def _worst_node(mission: Mission, lin: Linearisation) -> tuple[float, float]:
    """Least probability of any joint constraint at any node, by draws of each node's law."""
    first = _kept(mission, lin, np.arange(mission.problem.n_nodes), _normal(3, FIRST_DRAWS, SETS))
    worst = min(p.min() for _, p in first.values())
    most = worst + UNLIKE * np.sqrt(max(worst * (1.0 - worst), 1.0 / FIRST_DRAWS) / FIRST_DRAWS)
    sets = [_normal(3, DRAWS, seed) for seed in range(SETS)]
    candidates = {name: nodes[p <= most] for name, (nodes, p) in first.items()}
    nodes = np.unique(np.concatenate(list(candidates.values())))
    again = [_kept(mission, lin, nodes, draws) for draws in sets]
    found = [
        np.stack([one[name][1][np.isin(one[name][0], wanted)] for one in again])
        for name, wanted in candidates.items()
        if len(wanted)
    ]
    every = np.concatenate(found, axis=1)
    return _mean(every[:, np.argmin(every.mean(axis=0))])


def _kept(
    mission: Mission, lin: Linearisation, nodes: Indices, draws: Array
) -> dict[str, tuple[Indices, Array]]:
    """For each joint constraint its nodes among the given ones, and its probability there."""
    length, times = mission.units.length_m, mission.times_s[nodes]
    factor = lin.factor[nodes, :3]
    values, axes = np.linalg.eigh(factor @ factor.swapaxes(1, 2))
    root = axes * np.sqrt(np.maximum(values, 0.0))[:, None]
    at = length * (lin.iterate.mean[nodes, None, :3] + draws @ root.swapaxes(1, 2))
    safe = np.linalg.norm(at, axis=2) >= mission.scenario.safety.radius_min_m
    found = {"safety_radius": (nodes, safe.mean(axis=1))}
    seen = np.isin(nodes, mission.window_nodes)
    if seen.any():
        for name, margin in joint_margins(mission, times[seen], at[seen]).items():
            found[name] = nodes[seen], (margin >= 0.0).mean(axis=1)
    return found


def _normal(dimension: int, count: int, seed: int) -> Array:
    """Quasi-random standard normal vectors, shape (count, dimension)."""
    points = qmc.Sobol(dimension, scramble=True, rng=np.random.default_rng([SEED, seed]))
    return np.asarray(ndtri(points.random(count)))


def _mean(found: Array) -> tuple[float, float]:
    """Mean and its standard error."""
    return float(found.mean()), float(found.std(ddof=1) / np.sqrt(len(found)))
