"""Hold a simulated flight, with its torques and its distance from the plan, and balance its power.

No motion depends on power, so panels, loads and batteries follow from what was flown. Batteries are
charged from the last to the first and discharged from the first, with losses by the efficiency in
either direction. Energies are sums of power times period.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from formulations.arrays import Array, Booleans
from scp_recon.mission.schedule import Mode
from scp_recon.monte_carlo.sampling import PolicyKind
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
        burn_error: of each burn's thrust, relative, shape (m,).
        dumps: number of dumps of the wheels' momentum.
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
    burn_error: Array
    dumps: int
    policy: PolicyKind = "open"
    miss: int | None = None

    @cached_property
    def power(self) -> Power:
        """Panels, loads and batteries, balanced in each control period."""
        return Power.of(self)

    @cached_property
    def burns_m_s(self) -> Array:
        """Executed burns, J2000, m/s: impulse over mass at the flown attitudes, shape (m, 3)."""
        directions = self.attitudes.apply(unit(self.plan.vehicle.chemical_thruster.direction))
        burns = np.zeros((len(self.plan.firings), 3))
        for i, firing in enumerate(self.plan.firings):
            if not firing.duration_s:
                continue
            first, last = np.searchsorted(self.times_s, [firing.start_s, firing.end_s])
            # A last burn that is commanded longer than it was planned outlasts what is recorded.
            flown = directions[first : last + 1]
            mean = 0.5 * (flown[:-1] + flown[1:]).mean(axis=0) if len(flown) > 1 else flown[0]
            burns[i] = np.linalg.norm(firing.dv_m_s) * (1.0 + self.burn_error[i]) * mean
        return burns

    @property
    def terminal_state(self) -> Array:
        """State at the planned end, with the last burn as an impulse, shape (6,)."""
        last = round(self.plan.firings[-1].start_s / CONTROL_PERIOD_S)
        return self.states[last] + np.concatenate([np.zeros(3), self.burns_m_s[-1]])

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


PERIOD_H = CONTROL_PERIOD_S / 3600.0


@dataclass(frozen=True, eq=False)
class Power:
    """Mean powers in the control periods that end at n samples, W, and the batteries' charge then.

    Attributes:
        panels_w: generation, shape (n, panels).
        consumed_w: by everything, shape (n,).
        stored_wh: charge of each battery, shape (n, batteries).
        lost_w, unused_w, short_w: in the batteries, while they are full, and while they are empty.
    """

    panels_w: Array
    consumed_w: Array
    stored_wh: Array
    lost_w: Array
    unused_w: Array
    short_w: Array

    @classmethod
    def of(cls, flight: Flight) -> Power:
        """The balance of a flight; in the asteroid's shadow, a cylinder, panels give nothing."""
        plan, battery = flight.plan, flight.plan.vehicle.battery
        sun, position = plan.mission.sun_direction(flight.times_s), flight.states[:, :3]
        along = np.einsum("ni,ni->n", position, sun)
        across = np.linalg.norm(position - along[:, None] * sun, axis=1)
        lit = (along >= 0.0) | (across >= plan.mission.scenario.body.reference_radius_m)
        panels = lit[:, None] * plan.panels.generation(flight.attitudes.inv().apply(sun))
        consumed = _consumed(flight)
        stored = np.empty((len(flight.times_s), battery.count))
        stored[0] = battery.capacity_wh * battery.initial_charge
        other = np.zeros((3, len(flight.times_s)))
        for k, net in enumerate((panels.sum(axis=1) - consumed)[1:], start=1):
            charge_w = stored[k - 1] / PERIOD_H
            room_w = battery.capacity_wh / PERIOD_H - charge_w
            flow, *other[:, k] = distribute(net, room_w, charge_w, battery.efficiency)
            stored[k] = stored[k - 1] + PERIOD_H * flow
        return cls(panels, consumed, stored, *other)

    @property
    def totals_wh(self) -> dict[str, float]:
        """Energies of the flight, Wh: generated, consumed, lost, unused and short."""
        powers = (self.panels_w, self.consumed_w, self.lost_w, self.unused_w, self.short_w)
        names = ("generated", "consumed", "lost", "unused", "short")
        sums = (PERIOD_H * float(power[1:].sum()) for power in powers)
        return dict(zip(names, sums, strict=True))

    @property
    def ledger_error(self) -> float:
        """Remainder of the energy balance, over the energy generated.

        Generated and taken from the batteries = consumed, lost, unused and short (negative).
        """
        total, stored = self.totals_wh, float((self.stored_wh[-1] - self.stored_wh[0]).sum())
        used = total["consumed"] + total["lost"] + total["unused"] - total["short"]
        return (total["generated"] - used - stored) / total["generated"]


def distribute(
    net: float, room: Array, charge: Array, efficiency: float
) -> tuple[Array, float, float, float]:
    """Distribute a surplus or deficit among b batteries, W: stored, lost, unused, short.

    `room` is the power that fills each battery within the period, `charge` the one that empties it,
    shape (b,) each, and the stored one is negative for discharging; the efficiency applies to charging
    and to discharging.
    """
    charging, rest = net >= 0.0, abs(net)
    limit, gain = (room, efficiency) if charging else (charge, 1.0 / efficiency)
    moved = np.zeros(len(limit))
    for i in range(len(limit))[:: -1 if charging else 1]:
        moved[i] = min(limit[i], rest * gain)
        rest -= moved[i] / gain
    lost = abs(float(moved.sum()) * (1.0 / gain - 1.0))
    return (moved, lost, rest, 0.0) if charging else (-moved, lost, 0.0, rest)


def _consumed(flight: Flight) -> Array:
    """Power drawn in the period that ends at each sample, W, shape (n,)."""
    plan, wheels = flight.plan, flight.plan.vehicle.wheels
    drawn, reserved = mode_loads(plan, flight.times_s)
    firing = np.any(flight.micro_on_s, axis=1) & ~reserved
    drawn = drawn + plan.vehicle.loads.attitude_control_w * firing
    speeds, powers = np.array(wheels.power_w).T
    spinning = np.interp(np.abs(flight.wheel_speeds_rad_s), speeds, powers) - powers[0]
    return np.concatenate([drawn[:1], drawn[:-1]]) + spinning.sum(axis=1)


def mode_loads(plan: FlightPlan, times_s: Array) -> tuple[Array, Booleans]:
    """Power drawn by the modes, W, and whether it holds the attitude control's, shape (n,) each.

    In sun-pointing mode attitude control draws its power only while micro-thrusters fire.
    """
    loads = plan.vehicle.loads
    power, reserved = np.full(len(times_s), loads.quiescent_w), times_s < 0.0
    for leg in plan.legs:
        during = (times_s >= leg.start_s) & (times_s < leg.end_s)
        reserved |= during & (leg.mode is not Mode.SUN_POINTING)
        power[during] += loads.payload_w * (leg.mode is Mode.OBSERVATION)
    for firing in plan.firings:
        warm = firing.start_s - plan.vehicle.chemical_thruster.heating_s
        power[(times_s >= warm) & (times_s < firing.start_s)] += loads.heater_w
        power[(times_s >= firing.start_s) & (times_s < firing.end_s)] += loads.firing_w
    return power + loads.attitude_control_w * reserved, reserved
