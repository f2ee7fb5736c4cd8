"""Initial guesses: the paper's cold start, the ballistic surrogate, turns, and given burns."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_bvp

from formulations.problem.flyby import Iterate
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.physics.flow import propagate
from scp_recon.physics.forces import acceleration

Array = npt.NDArray[np.float64]

COLD_BURN_M_S = 1e-10
"""Every component of every burn: Echigo et al., section VI."""


def cold(mission: Mission) -> Iterate:
    """States on the straight line from the initial to the final one, burns next to nothing."""
    states = mission.initial_state + _fraction(mission)[:, None] * (
        mission.final_state - mission.initial_state
    )
    burns = np.full((len(mission.burn_nodes), 3), COLD_BURN_M_S)
    return nondimensional(mission, burns, states)


def _fraction(mission: Mission) -> Array:
    """Of the time from the first node to the last, shape (n,)."""
    times = mission.times_s
    return (times - times[0]) / (times[-1] - times[0])


def ballistic(mission: Mission, entry: str = "init") -> Iterate:
    """Two impulses, at the first and the last burn, joined by the arc of least total delta-v.

    A flight that is under way coasts to its first burn. Both ways round the body are tried; each is a
    boundary-value problem for the planner's forces, started from a circular sweep of the direction. A
    surrogate for a flown trajectory.

    Args:
        mission: gives the boundary states.
        entry: what messages call it.

    Raises:
        InputError: if neither boundary-value problem can be solved, or there are not two burns.
    """
    if len(mission.burn_nodes) < 2:
        raise InputError(entry, "warm", "one burn joins no two positions; use cold")
    candidates = [iterate for way in (1.0, -1.0) if (iterate := _two_impulses(mission, way))]
    if not candidates:
        raise InputError(entry, "warm", "no ballistic arc joins the boundary positions; use cold")
    return min(candidates, key=lambda iterate: iterate.total_dv)


def circular(mission: Mission, way: float) -> Iterate:
    """A steady turn from the initial to the final position, burns next to nothing.

    It never comes nearer to the body than its ends, as a straight line may.

    Args:
        mission: gives the boundary states.
        way: 1 for the shorter way round the body, -1 for the longer.
    """
    ends = mission.initial_state, mission.final_state
    position = _circular_positions(mission, ends, way, _fraction(mission)).T
    velocity = np.gradient(position, mission.times_s, axis=0)
    burns = np.full((len(mission.burn_nodes), 3), COLD_BURN_M_S)
    return nondimensional(mission, burns, np.hstack([position, velocity]))


def _circular_positions(
    mission: Mission, ends: tuple[Array, Array], way: float, fraction: Array
) -> Array:
    """A steady turn about the body and change of radius, shape (3, n), at fractions of it (n,)."""
    radii = [float(np.linalg.norm(state[:3])) for state in ends]
    first, last = (state[:3] / radius for state, radius in zip(ends, radii, strict=True))
    normal = way * np.cross(first, last)
    if np.linalg.norm(normal) < 1e-9:  # (anti)parallel: any plane will do, take one with the pole
        normal = way * np.cross(first, mission.forces.pole)
    across = np.cross(normal / np.linalg.norm(normal), first)
    sweep = np.arctan2(last @ across, last @ first) % (2.0 * np.pi)
    turned = np.outer(first, np.cos(sweep * fraction)) + np.outer(across, np.sin(sweep * fraction))
    return np.interp(fraction, [0, 1], radii) * turned


def _two_impulses(mission: Mission, way: float) -> Iterate | None:
    first, times = mission.burn_nodes[0], mission.times_s
    coast = _coast(mission)
    start, end = coast[-1], mission.final_state
    duration, forces = times[-1] - times[first], mission.forces
    mesh = np.linspace(0.0, 1.0, 41)
    position = _circular_positions(mission, (start, end), way, mesh)
    length, time = mission.units.length_m, duration
    scaled = forces.in_units(length, time)
    guess = np.vstack([position / length, np.gradient(position / length, mesh, axis=1)])

    def rate(_: Array, y: Array) -> Array:
        return np.vstack([y[3:], np.stack(acceleration(y[0], y[1], y[2], scaled))])

    def boundary(ya: Array, yb: Array) -> Array:
        return np.concatenate([ya[:3] - start[:3] / length, yb[:3] - end[:3] / length])

    solution = solve_bvp(rate, boundary, mesh, guess, tol=1e-8, max_nodes=20_000)
    if not solution.success:
        return None
    states = solution.sol((times[first:] - times[first]) / duration).T
    states = np.vstack([coast[:-1], states * np.repeat([length, length / time], 3)])
    burns = np.zeros((len(mission.burn_nodes), 3))
    burns[0] = states[first, 3:] - start[3:]
    burns[-1] = end[3:] - states[-1, 3:]
    burns[1:-1] = COLD_BURN_M_S
    states[-1, 3:] = end[3:]
    return nondimensional(mission, burns, states)


def _coast(mission: Mission) -> Array:
    """States at the nodes up to the first burn, before it, shape (n, 6)."""
    states = [mission.initial_state]
    for duration in np.diff(mission.times_s[: mission.burn_nodes[0] + 1]):
        states.append(propagate(states[-1], duration, mission.forces, mission.arc_substeps))
    return np.array(states)


def random(mission: Mission, seed: int) -> Iterate:
    """A path that obeys nothing: the straight line bent by three random sines, and random burns.

    Amplitudes of 600 m, 300 m and 200 m and burns of 5 cm/s in every component, 1 sigma: the path may
    lead through the body, and its velocities are those of the bent line.
    """
    return bent(mission, np.random.default_rng(seed), bend_m=600.0, burn_m_s=0.05)


def bent(mission: Mission, rng: np.random.Generator, bend_m: float, burn_m_s: float) -> Iterate:
    """The straight line bent by three random sines, and random burns.

    Args:
        mission: gives the boundary states.
        rng: draws; the bend first, then the burns.
        bend_m: amplitude of the first sine in every component, m, 1 sigma; the next have a half and a
            third of it.
        burn_m_s: of the burns in every component, m/s, 1 sigma.
    """
    fraction = _fraction(mission)
    phase = np.pi * fraction[:, None] * np.arange(1, 4)
    bend = rng.normal(scale=bend_m, size=(3, 3)) / np.arange(1, 4)[:, None]
    position = mission.initial_state[:3] + np.outer(
        fraction, mission.final_state[:3] - mission.initial_state[:3]
    )
    position += np.sin(phase) @ bend
    velocity = np.gradient(position, mission.times_s, axis=0)
    velocity[-1] = mission.final_state[3:]
    burns = rng.normal(scale=burn_m_s, size=(len(mission.burn_nodes), 3))
    return nondimensional(mission, burns, np.hstack([position, velocity]))


def from_burns(mission: Mission, burns_m_s: Array, entry: str = "init") -> Iterate:
    """Roll given burns out, shape (m, 3) in m/s.

    Raises:
        InputError: if there are not as many as the scenario has firing times.
    """
    if burns_m_s.shape != (len(mission.burn_nodes), 3):
        raise InputError(
            entry,
            f"{len(burns_m_s)} burns",
            f"must have {len(mission.burn_nodes)} as the scenario has to plan",
        )
    burns = burns_m_s / mission.units.speed_m_s
    return Iterate(burns, mission.dynamics.rollout(mission.problem.initial_state, burns))


def nondimensional(mission: Mission, burns_m_s: Array, states: Array) -> Iterate:
    """An iterate from burns (m, 3) and states (n, 6) in SI."""
    return Iterate(burns_m_s / mission.units.speed_m_s, states / mission.units.state)
