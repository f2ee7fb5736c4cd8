"""Hold a simulated flight, with torques and charge, and its distance from the plan."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from formulations.arrays import Array
from scp_recon.monte_carlo.sampling import PolicyKind
from scp_recon.physics.frames import unit
from scp_recon.results.solution import Solution
from scp_recon.simulation.guidance import CONTROL_PERIOD_S, FlightPlan
from scp_recon.simulation.power import Power


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
    burns_m_s: Array
    dumps: int
    terminal_state: Array
    policy: PolicyKind = "open"
    miss: int | None = None

    @cached_property
    def power(self) -> Power:
        """Panels, loads and batteries, balanced in each control period."""
        return Power.of(self)

    @cached_property
    def attitude_error(self) -> Array:
        """Angles between the commanded and the true attitude, rad, shape (n,)."""
        return np.asarray((self.commands.inv() * self.attitudes).magnitude())

    @property
    def wheel_torque(self) -> Array:
        """Torque of the wheels' motors in each control period, N m, body frame, shape (n, 3)."""
        wheels, speeds = self.plan.vehicle.wheels, self.wheel_speeds_rad_s
        change = np.diff(speeds, axis=0, append=speeds[-1:])
        return -wheels.inertia_kg_m2 / CONTROL_PERIOD_S * change @ unit(wheels.axes)

    @property
    def thruster_torque(self) -> Array:
        """Mean torque of the micro-thrusters, at nominal thrust; as `wheel_torque`."""
        micro = self.plan.vehicle.micro_thrusters
        each = np.cross(micro.offsets_m, micro.thrust_n * unit(micro.directions))
        return self.micro_on_s / CONTROL_PERIOD_S @ each

    @property
    def state_of_charge(self) -> Array:
        """State of charge of each battery, 0 to 1, shape (n, batteries)."""
        return self.power.stored_wh / self.plan.vehicle.battery.capacity_wh

    def node_states(self, solution: Solution) -> Array:
        """States at the solution's nodes, shape (n, 6); the last with its burn as an impulse."""
        nodes = np.array(solution.nodes.t_s)
        states = np.stack([np.interp(nodes, self.times_s, x) for x in self.states.T], axis=1)
        states[-1] = self.terminal_state
        return states

    def sigma_distance(self, solution: Solution) -> Array:
        """Distance of flown positions at the nodes from the planned mean, in sigmas, shape (n,)."""
        return distance_in_sigmas(self.node_states(solution)[:, :3], solution)


def distance_in_sigmas(positions: Array, solution: Solution) -> Array:
    """Mahalanobis distances of positions (..., nodes, 3), m, J2000, from the mean; (..., nodes).

    Mean and covariance are the plan's. A millimetre is added to the spread: a plan without uncertainty
    has none.
    """
    error = positions - np.array(solution.nodes.state)[:, :3]
    covariance = np.array(solution.nodes.covariance)[:, :3, :3] + 1e-6 * np.eye(3)
    weighted = np.linalg.solve(covariance, error[..., None])[..., 0]
    return np.sqrt(np.einsum("...i,...i->...", error, weighted))
