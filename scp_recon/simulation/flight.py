"""Hold a simulated flight, and measure its errors against the plan: pointing, position, energy."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from formulations.arrays import Array
from scp_recon.monte_carlo.sampling import PolicyKind
from scp_recon.physics import geometry
from scp_recon.physics.frames import unit
from scp_recon.results.solution import Solution
from scp_recon.simulation.guidance import CONTROL_PERIOD_S, FlightPlan


class Actuators(IntEnum):
    """Actuators that control the attitude."""

    THRUSTERS = 1
    WHEELS = 2
    BOTH = 3


@dataclass(frozen=True)
class Flight:
    """A simulated flight, sampled once in a control period.

    Attributes:
        plan: commands of the flight.
        times_s: shape (n,).
        states: position and velocity, m and m/s, J2000, shape (n, 6).
        attitudes, commands, estimates: from the body to J2000.
        rates_rad_s: of the body, in its frame, shape (n, 3).
        in_use: `Actuators` that control the attitude, shape (n,).
        wheel_speeds_rad_s: shape (n, wheels).
        micro_on_s: on-time of each micro-thruster in the period, shape (n, thrusters).
        panels_w: generation, shape (n, panels).
        consumed_w, lost_w, unused_w, short_w: balance of the bus, shape (n,).
        stored_wh: charge of each battery, shape (n, batteries).
        burns_m_s: executed, J2000, shape (m, 3).
        dumps: number of dumps of the wheels' momentum.
        terminal_state: at the planned end, with the last burn as an impulse, shape (6,).
        policy: that commanded the burns.
        miss: number of the burn that did not happen, if one did not.
    """

    plan: FlightPlan
    times_s: Array
    states: Array
    attitudes: Rotation
    commands: Rotation
    estimates: Rotation
    rates_rad_s: Array
    in_use: npt.NDArray[np.int8]
    wheel_speeds_rad_s: Array
    micro_on_s: Array
    panels_w: Array
    consumed_w: Array
    lost_w: Array
    unused_w: Array
    short_w: Array
    stored_wh: Array
    burns_m_s: Array
    dumps: int
    terminal_state: Array
    policy: PolicyKind = "open"
    miss: int | None = None


@dataclass(frozen=True)
class Pointing:
    """Angles in rad.

    Attributes:
        estimate: between the estimated and the true attitude, shape (n,).
        burns: between each planned burn and the thrust when it starts, shape (m,); 0 if it is none.
        executed: between each planned burn and the velocity it gave, shape (m,); 0 if none.
        camera: between boresight and command at the samples of the window, shape (w,).
        site: between boresight and true line of sight to the site there, shape (w,).
    """

    estimate: Array
    burns: Array
    executed: Array
    camera: Array
    site: Array


def pointing(flight: Flight) -> Pointing:
    """Compute the pointing errors of a flight, rad."""
    plan, vehicle = flight.plan, flight.plan.vehicle
    thrust = unit(vehicle.chemical_thruster.direction)
    starts = [round(firing.start_s / CONTROL_PERIOD_S) for firing in plan.firings]
    planned = np.array([firing.direction for firing in plan.firings])
    first, last = plan.mission.schedule.window_s
    window = (flight.times_s >= first) & (flight.times_s < last)
    camera = unit(vehicle.sensors.camera)
    boresight = flight.attitudes[window].apply(camera)
    mission, executed = plan.mission, geometry.angle(flight.burns_m_s, planned)
    thrusting = geometry.angle(flight.attitudes[starts].apply(thrust), planned)
    track = geometry.track(mission.site, mission.rotation, flight.times_s[window])
    return Pointing(
        estimate=_between(flight.estimates, flight.attitudes),
        burns=np.where([firing.duration_s > 0.0 for firing in plan.firings], thrusting, 0.0),
        executed=np.where(flight.burns_m_s.any(axis=1), executed, 0.0),
        camera=geometry.angle(boresight, flight.commands[window].apply(camera)),
        site=geometry.angle(track.position - flight.states[window, :3], boresight),
    )


def attitude_error(flight: Flight) -> Array:
    """Angles between the commanded and the true attitude, rad, shape (n,)."""
    return _between(flight.commands, flight.attitudes)


def _between(first: Rotation, second: Rotation) -> Array:
    """Angles between attitudes, rad, shape (n,)."""
    return np.asarray((first.inv() * second).magnitude())


def wheel_torque(flight: Flight) -> Array:
    """Torque of the wheels' motors on the body in each control period, N m, its frame, shape (n, 3)."""
    wheels, speeds = flight.plan.vehicle.wheels, flight.wheel_speeds_rad_s
    change = np.diff(speeds, axis=0, append=speeds[-1:])
    return -wheels.inertia_kg_m2 / CONTROL_PERIOD_S * change @ unit(wheels.axes)


def thruster_torque(flight: Flight) -> Array:
    """Mean torque of the micro-thrusters on the body, at nominal thrust; as `wheel_torque`."""
    micro = flight.plan.vehicle.micro_thrusters
    each = np.cross(micro.offsets_m, micro.thrust_n * unit(micro.directions))
    return flight.micro_on_s / CONTROL_PERIOD_S @ each


def settling_time(error: Array, limit: float) -> float:
    """Time in s from which the errors, one a control period, stay below a limit; inf if never."""
    rough = np.flatnonzero(error >= limit)
    after = int(rough[-1]) + 1 if len(rough) else 0
    return after * CONTROL_PERIOD_S if after < len(error) else np.inf


def node_states(flight: Flight, solution: Solution) -> Array:
    """States at the solution's nodes, shape (n, 6); the last with its burn as an impulse."""
    nodes = np.array(solution.nodes.t_s)
    states = np.stack([np.interp(nodes, flight.times_s, x) for x in flight.states.T], axis=1)
    states[-1] = flight.terminal_state
    return states


def sigma_distance(flight: Flight, solution: Solution) -> Array:
    """Distance of flown positions at the nodes from the planned mean, in sigmas, shape (n,)."""
    return distance_in_sigmas(node_states(flight, solution)[:, :3], solution)


def distance_in_sigmas(positions: Array, solution: Solution) -> Array:
    """Mahalanobis distances of positions (..., nodes, 3), m, J2000, from the mean; (..., nodes).

    Mean and covariance are the plan's. A millimetre is added to the spread: a plan without uncertainty
    has none.
    """
    error = positions - np.array(solution.nodes.state)[:, :3]
    covariance = np.array(solution.nodes.covariance)[:, :3, :3] + 1e-6 * np.eye(3)
    weighted = np.linalg.solve(covariance, error[..., None])[..., 0]
    return np.sqrt(np.einsum("...i,...i->...", error, weighted))


def state_of_charge(flight: Flight) -> Array:
    """State of charge of each battery, 0 to 1, shape (n, batteries)."""
    return flight.stored_wh / flight.plan.vehicle.battery.capacity_wh


def ledger_error(flight: Flight) -> float:
    """Remainder of the energy balance, over the energy generated.

    Generated and taken from the batteries = consumed, lost, unused and short (negative).
    """
    hours = CONTROL_PERIOD_S / 3600.0
    generated = float(flight.panels_w[1:].sum()) * hours
    consumed = float(flight.consumed_w[1:].sum()) * hours
    other = float((flight.lost_w + flight.unused_w - flight.short_w)[1:].sum()) * hours
    stored = float((flight.stored_wh[-1] - flight.stored_wh[0]).sum())
    return (generated - consumed - other - stored) / generated
