"""Decide whether flights keep the limits on their position, at given times and between them.

One rule serves certification, verification and every count of flights: a flight keeps a limit whose
margin is not negative. Flights that are certain (`is_certain`) have one path, and are judged like the
plan's mean, which may violate a limit between nodes by `MEAN_TOLERANCE`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from formulations.arrays import Array, Booleans, Indices
from scp_recon.mission.constraints import COMPANION, SAFETY, safety_margins
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import errors_of_kind
from scp_recon.monte_carlo.observation_time import ALL, SCIENCE, joint_margins
from scp_recon.planning.initial_guess import from_burns

Kept = dict[str, tuple[Array, Booleans]]
"""By joint constraint the times at which it counts, s, shape (k,), and whether flights keep it there,
shape (k, flights)."""

EVERYWHERE = SAFETY, COMPANION
"""Joint constraints that count throughout the flight; all others count in the window."""
OUTSIDE = 1e-3
"""Margin a second outside the flight's own window: only its sign counts."""
MEAN_TOLERANCE = {"m": 0.5, "rad": 1e-3}
"""Amount by which the mean may violate a limit between nodes, where it binds at nodes; at the default
mission's scale."""


def is_certain(mission: Mission, burns_m_s: Array, errors: str | None = None) -> bool:
    """Whether flights spread by less than the mean's tolerance all the way, by the linearised flow.

    Corrections, which narrow the spread, are left out. Nothing that flights can show tells one such
    flight from another, so that probabilities are 1 or 0, by the one path that all fly.

    Args:
        mission: that is flown.
        burns_m_s: planned, J2000, shape (m, 3).
        errors: of the burns; the scenario's if None.
    """
    if mission.uncertain.count:  # a site or a pole that is uncertain spreads no path
        return False
    model = errors_of_kind(mission.scenario, errors).in_units(mission.units.speed_m_s)
    problem = replace(mission.problem.open_loop, execution_errors=model)
    lin = mission.dynamics.linearise(problem, from_burns(mission, burns_m_s))
    widest = np.linalg.norm(lin.factor[:, :3], ord=2, axis=(1, 2)).max()
    return bool(widest * mission.units.length_m < allowed(mission, SAFETY))


def limit_margins(
    mission: Mission,
    times_s: Array,
    position: Array,
    observed: Indices | Booleans | slice,
    everywhere: Indices | slice = slice(None),
    *,
    certain: bool = False,
) -> dict[str, tuple[Array, Array]]:
    """Times at which each joint constraint counts, s, shape (k,), and its margins, shape (k, flights).

    Args:
        mission: that is flown.
        times_s: ascending, shape (n,).
        position: J2000, m, shape (n, flights, 3).
        observed: which times count for the limits of the observation.
        everywhere: which times count for safety distances.
        certain: whether the flights are; the mean's tolerance is then added.
    """
    clear = safety_margins(mission.scene, times_s[everywhere], position[everywhere])
    found = {name: (times_s[everywhere], margin) for name, margin in clear.items()}
    if len(window := times_s[observed]):
        seen = joint_margins(mission, window, position[observed])
        found |= {name: (window, in_own_window(mission, window, m)) for name, m in seen.items()}
    if certain:
        found = {
            name: (at, margin + allowed(mission, name)) for name, (at, margin) in found.items()
        }
    return found


def in_own_window(mission: Mission, times_s: Array, margin: Array) -> Array:
    """Margins (k,) or (k, flights), positive outside each flight's own window where edges move."""
    if mission.deviation is None or mission.edges.sigmas_s is None:
        return margin
    first, last = mission.own_edges_s
    time = times_s.reshape(-1, *[1] * (margin.ndim - 1))
    return np.maximum(margin, OUTSIDE * np.maximum(first - time, time - last))


def allowed(mission: Mission, name: str) -> float:
    """The mean's tolerance in a joint constraint of a mission, m or rad."""
    unit = "m" if name in (*EVERYWHERE, "site_distance") else "rad"
    return mission.units.tolerance(MEAN_TOLERANCE[unit], unit)


def kept_limits(margins: dict[str, tuple[Array, Array]], *, at_once: bool = False) -> Kept:
    """Whether flights keep each joint constraint of `limit_margins`, and the observation's at once."""
    kept = {name: (at, np.asarray(margin >= 0.0)) for name, (at, margin) in margins.items()}
    if at_once and kept.keys() >= set(SCIENCE):
        at, _ = kept[SCIENCE[0]]
        kept[ALL] = at, np.logical_and.reduce([kept[name][1] for name in SCIENCE])
    return kept
