"""Where a flight begins and ends, and how well its first state is known: J2000, m and m/s."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scp_recon.mission.uncertainty import factor_in_flight, initial_factor
from scp_recon.physics.frames import Rotation, sun_north_to_j2000, unit
from scp_recon.scenario.schema import Scenario

Array = npt.NDArray[np.float64]


def sun_direction(scenario: Scenario, time_s: npt.ArrayLike) -> Array:
    """Unit vectors from the body to the Sun, J2000, shape (..., 3).

    The body moves on a straight line: over ten hours the curvature of its orbit is 2e-5 rad of
    mostly radial displacement.
    """
    position = np.array(scenario.sun.body_position_km)
    velocity = np.array(scenario.sun.body_velocity_km_s)
    return unit(-(position + np.multiply.outer(np.asarray(time_s, dtype=float), velocity)))


def state_axes(scenario: Scenario, rotation: Rotation, frame: str) -> Array:
    """From a frame of states to J2000, at the epoch, shape (3, 3)."""
    if frame == "j2000":
        return np.eye(3)
    return sun_north_to_j2000(sun_direction(scenario, 0.0), rotation.pole)


def boundary_axes(scenario: Scenario, rotation: Rotation) -> Array:
    """`state_axes` of the boundary states."""
    return state_axes(scenario, rotation, scenario.boundary.frame)


def first_state(scenario: Scenario, rotation: Rotation) -> Array:
    """Where planning begins: in flight, or before the first burn."""
    flight = scenario.in_flight
    if flight is None:
        return boundary_state(scenario, rotation, "initial")
    matrix = state_axes(scenario, rotation, flight.frame)
    return np.concatenate([matrix @ flight.position_m, matrix @ flight.velocity_m_s])


def first_factor(scenario: Scenario, rotation: Rotation, state: Array) -> Array:
    """Factor S, where S S' is the covariance there, shape (6, 6).

    In flight the scenario's initial one, unless another is given: its figures, in axes of the state if
    they are radial, transverse and normal.
    """
    sun, flight = sun_direction(scenario, 0.0), scenario.in_flight
    given = factor_in_flight(scenario, state, rotation, sun)
    if given is not None:
        return given
    if flight is not None and scenario.uncertainty.initial_frame != "rtn":
        state = boundary_state(scenario, rotation, "initial")
    return initial_factor(scenario, state, rotation, sun)


def boundary_state(scenario: Scenario, rotation: Rotation, which: str) -> Array:
    """The state, shape (6,), that is "initial" or "final"."""
    boundary = scenario.boundary
    matrix = state_axes(scenario, rotation, boundary.frame)
    position = matrix @ np.array(getattr(boundary, f"{which}_position_m"))
    velocity = matrix @ np.array(getattr(boundary, f"{which}_velocity_m_s"))
    return np.concatenate([position, velocity])
