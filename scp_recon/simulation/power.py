"""Balance panels, loads and batteries of a flight, from what was flown: no motion depends on power.

Batteries are charged from the last to the first and discharged from the first, with losses by the
efficiency in either direction. Energies are sums of power times period.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from formulations.arrays import Array, Booleans
from scp_recon.mission.schedule import Mode
from scp_recon.simulation.guidance import CONTROL_PERIOD_S, FlightPlan

if TYPE_CHECKING:
    from scp_recon.simulation.flight import Flight

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
