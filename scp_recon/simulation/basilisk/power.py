"""Build the electrical system: Basilisk's panels, loads and batteries, joined by a bus.

Basilisk's battery has no efficiency, and several have no order. The bus here charges from the last
battery to the first and discharges from the first, with losses by the efficiency in either direction.
Energies are sums of power times period.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from Basilisk.architecture import astroConstants, messaging, sysModel
from Basilisk.simulation import simpleBattery, simplePowerSink, simpleSolarPanel
from Basilisk.utilities import macros

from formulations.arrays import Array
from scp_recon.mission.schedule import Mode
from scp_recon.physics.frames import unit
from scp_recon.simulation.basilisk.control import Firer
from scp_recon.simulation.basilisk.plant import Plant
from scp_recon.simulation.guidance import CONTROL_PERIOD_S, FlightPlan


@dataclass(frozen=True)
class Flow:
    """A period's net power by where it goes, W; `stored` has shape (b,), negative for discharging."""

    stored: Array
    lost: float
    unused: float
    short: float


def distribute(net: float, room: Array, charge: Array, efficiency: float) -> Flow:
    """Distribute a surplus or deficit among batteries, W.

    `room` is the power that fills each battery within the period, `charge` the one that empties it,
    shape (b,) each; the efficiency applies to charging and to discharging.
    """
    stored = np.zeros(len(room))
    rest = abs(net)
    if net >= 0.0:
        for i in reversed(range(len(room))):
            stored[i] = min(room[i], rest * efficiency)
            rest -= stored[i] / efficiency
        gone = float(stored.sum())
        return Flow(stored, gone / efficiency - gone, rest, 0.0)
    for i in range(len(room)):
        stored[i] = -min(charge[i], rest / efficiency)
        rest += stored[i] * efficiency
    gone = -float(stored.sum())
    return Flow(stored, gone - gone * efficiency, 0.0, rest)


def mode_loads(plan: FlightPlan, times_s: Array) -> Array:
    """Power drawn by the modes, W, shape (n,), without micro-thrusters in sun-pointing mode."""
    loads = plan.vehicle.loads
    power = np.full(len(times_s), loads.quiescent_w)
    for leg in plan.legs:
        during = (times_s >= leg.start_s) & (times_s < leg.end_s)
        if leg.mode is not Mode.SUN_POINTING:
            power[during] += loads.attitude_control_w
        if leg.mode is Mode.OBSERVATION:
            power[during] += loads.payload_w
    for firing in plan.firings:
        warm = firing.start_s - plan.vehicle.chemical_thruster.heating_s
        power[(times_s >= warm) & (times_s < firing.start_s)] += loads.heater_w
        power[(times_s >= firing.start_s) & (times_s < firing.end_s)] += loads.firing_w
    return power


class Bus(sysModel.SysModel):
    """Balances panels, loads and batteries once per control period, and records the energies."""

    def __init__(self, plan: FlightPlan, plant: Plant, firer: Firer, times_s: Array) -> None:
        super().__init__()
        self.firer = firer
        n, battery = len(times_s), plan.vehicle.battery
        self.generated = np.zeros((n, len(plan.vehicle.panels.panel)))
        self.consumed, self.lost = np.zeros(n), np.zeros(n)
        self.unused, self.short = np.zeros(n), np.zeros(n)
        self.stored_wh = np.zeros((n, battery.count))
        self.panels = _panels(plan, plant)
        self._panel_powers = [panel.nodePowerOutMsg.addSubscriber() for panel in self.panels]
        self.loads = simplePowerSink.SimplePowerSink()
        self._load_power = self.loads.nodePowerOutMsg.addSubscriber()
        self.batteries, self._flows = [], []
        for _ in range(battery.count):
            store = simpleBattery.SimpleBattery()
            store.storageCapacity = battery.capacity_wh * HOUR_S
            store.storedCharge_Init = battery.capacity_wh * battery.initial_charge * HOUR_S
            flow = messaging.PowerNodeUsageMsg().write(messaging.PowerNodeUsageMsgPayload())
            store.addPowerNodeToModel(flow)
            self.batteries.append(store)
            self._flows.append(flow)
        self._charges = [store.batPowerOutMsg.addSubscriber() for store in self.batteries]
        self._times_s = times_s
        self.follow(plan)
        self._speeds = plant.wheels.rwSpeedOutMsg.addSubscriber()
        self._wheel_curve = np.array(plan.vehicle.wheels.power_w).T

    def follow(self, plan: FlightPlan) -> None:
        """Take up a plan with other burns."""
        self.plan, times = plan, self._times_s
        self._scheduled = mode_loads(plan, times)
        self._reserved = np.zeros(len(times), dtype=bool)
        for leg in plan.legs:
            if leg.mode is not Mode.SUN_POINTING:
                self._reserved |= (times >= leg.start_s) & (times < leg.end_s)

    def models(self) -> list[sysModel.SysModel]:
        """All modules in the order of their execution."""
        return [*self.panels, _Loads(self), self.loads, self, *self.batteries]

    def demand(self, k: int) -> float:
        """Consumption in the period that ends at sample k, W."""
        last = max(k - 1, 0)
        power = self._scheduled[last]
        if not self._reserved[last] and self.firer.on_time_s[last].any():
            power += self.plan.vehicle.loads.attitude_control_w
        speeds = np.abs(self._speeds().wheelSpeeds[: len(self.plan.vehicle.wheels.axes)])
        drawn = np.interp(speeds, *self._wheel_curve) - self._wheel_curve[1, 0]
        return float(power + drawn.sum())

    def UpdateState(self, now: int) -> None:  # noqa: N802, D102 -- as Basilisk names it
        k = round(now * macros.NANO2SEC / CONTROL_PERIOD_S)
        battery = self.plan.vehicle.battery
        self.generated[k] = [read().netPower for read in self._panel_powers]
        self.consumed[k] = -self._load_power().netPower
        if k == 0:
            self.stored_wh[0] = battery.capacity_wh * battery.initial_charge
            return
        charge = np.array([read().storageLevel for read in self._charges]) / CONTROL_PERIOD_S
        self.stored_wh[k - 1] = charge * CONTROL_PERIOD_S / HOUR_S
        room = battery.capacity_wh * HOUR_S / CONTROL_PERIOD_S - charge
        net = float(self.generated[k].sum() - self.consumed[k])
        flow = distribute(net, room, charge, battery.efficiency)
        self.lost[k], self.unused[k], self.short[k] = flow.lost, flow.unused, flow.short
        for message, power in zip(self._flows, flow.stored.tolist(), strict=True):
            message.write(messaging.PowerNodeUsageMsgPayload(netPower=power), now)

    def close(self) -> None:
        """Record the charge after the last period."""
        self.stored_wh[-1] = [read().storageLevel / HOUR_S for read in self._charges]


HOUR_S = 3600.0


class _Loads(sysModel.SysModel):
    """Sets the sink to the present demand."""

    def __init__(self, bus: Bus) -> None:
        super().__init__()
        self.bus = bus

    def UpdateState(self, now: int) -> None:  # noqa: N802 -- as Basilisk names it
        k = round(now * macros.NANO2SEC / CONTROL_PERIOD_S)
        self.bus.loads.nodePowerOut = -self.bus.demand(k)


def _panels(plan: FlightPlan, plant: Plant) -> list[simpleSolarPanel.SimpleSolarPanel]:
    """Panels with areas scaled from Basilisk's solar constant to the scenario's."""
    panels, sun = plan.vehicle.panels, plan.mission.scenario.sun
    models = []
    for panel in panels.panel:
        model = simpleSolarPanel.SimpleSolarPanel()
        model.nHat_B = [[x] for x in unit(panel.normal).tolist()]
        model.panelArea = panel.area_m2 * sun.solar_constant_w_m2 / astroConstants.SOLAR_FLUX_EARTH
        model.panelEfficiency = panels.efficiency * panels.packing
        model.stateInMsg.subscribeTo(plant.hub.scStateOutMsg)
        model.sunInMsg.subscribeTo(plant.surroundings.sun)
        model.sunEclipseInMsg.subscribeTo(plant.surroundings.shadow)
        models.append(model)
    return models
