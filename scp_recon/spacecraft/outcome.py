"""What a flight says about its plan: modes, pointing, energy, and where it went."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from scp_recon.mission.schedule import Leg, Mode
from scp_recon.physics import geometry
from scp_recon.physics.frames import unit
from scp_recon.solution.file import Solution
from scp_recon.spacecraft.flight import Flight
from scp_recon.spacecraft.guidance import CONTROL_PERIOD_S

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class LegOutcome:
    """A mode as commanded and as flown against the rules, s.

    Attributes:
        leg: which.
        duration_s: how long it was commanded.
        required_s: least that the rules give it.
        settled_s: from its start until the attitude error stays below `STEADY_RAD` to its end, in
            delta-V mode to the burn; inf if never.
        attitude_s: what the rules allow for that.
    """

    leg: Leg
    duration_s: float
    required_s: float
    settled_s: float
    attitude_s: float

    @property
    def ok(self) -> bool:
        """Whether it was long enough; a control period is forgiven."""
        return self.duration_s >= self.required_s - CONTROL_PERIOD_S

    @property
    def settled_in_time(self) -> bool:
        """Whether the attitude was steady as early as the rules assume."""
        return self.settled_s <= self.attitude_s


STEADY_RAD = np.deg2rad(0.25)
"""Attitude error in steady state."""


def settling_time(error: Array, limit: float) -> float:
    """Time in s from which the errors, one a control period, stay below a limit; inf if never."""
    rough = np.flatnonzero(error >= limit)
    after = int(rough[-1]) + 1 if len(rough) else 0
    return after * CONTROL_PERIOD_S if after < len(error) else np.inf


def leg_outcomes(flight: Flight) -> list[LegOutcome]:
    """Every mode after the first burn, whose attitude is there from the start."""
    plan, error, times = flight.plan, attitude_error(flight), flight.times_s
    rules, window = plan.mission.scenario.schedule, plan.mission.schedule.window_s
    outcomes = []
    for leg in plan.legs[1:]:
        if leg.mode is Mode.SUN_POINTING:
            required = rules.attitude_s + rules.recharge_s
        elif leg.mode is Mode.OBSERVATION:
            required = rules.attitude_s + window[1] - window[0]
        else:
            required = rules.attitude_s + rules.heating_s
        burn = next((f.start_s for f in plan.firings if f.end_s == leg.end_s), leg.end_s)
        during = (times >= leg.start_s) & (times < burn)
        settled = settling_time(error[during], STEADY_RAD)
        duration = leg.end_s - leg.start_s
        outcomes.append(LegOutcome(leg, duration, required, settled, rules.attitude_s))
    return outcomes


@dataclass(frozen=True)
class Pointing:
    """Angles in rad.

    Attributes:
        attitude: between the commanded and the true attitude, shape (n,).
        estimate: between the estimated and the true one, shape (n,).
        burns: between each planned burn and the thrust when it starts, shape (m,).
        executed: between each planned burn and the velocity it gave, shape (m,); 0 if none.
        camera: between boresight and command at the samples of the window, shape (w,).
        site: between boresight and true line of sight to the site there, shape (w,).
    """

    attitude: Array
    estimate: Array
    burns: Array
    executed: Array
    camera: Array
    site: Array


def pointing(flight: Flight) -> Pointing:
    """How well the spacecraft pointed."""
    plan, vehicle = flight.plan, flight.plan.vehicle
    thrust = unit(vehicle.chemical_thruster.direction)
    starts = [round(firing.start_s / CONTROL_PERIOD_S) for firing in plan.firings]
    planned = np.array([firing.direction for firing in plan.firings])
    first, last = plan.mission.schedule.window_s
    window = (flight.times_s >= first) & (flight.times_s < last)
    camera = unit(vehicle.sensors.camera)
    boresight = flight.attitudes[window].apply(camera)
    mission, executed = plan.mission, geometry.angle(flight.burns_m_s, planned)
    track = geometry.track(mission.site, mission.rotation, flight.times_s[window])
    return Pointing(
        attitude=attitude_error(flight),
        estimate=_between(flight.estimates, flight.attitudes),
        burns=geometry.angle(flight.attitudes[starts].apply(thrust), planned),
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


def node_states(flight: Flight, solution: Solution) -> Array:
    """States at the solution's nodes, shape (n, 6); the last with its burn as an impulse."""
    nodes = np.array(solution.nodes.t_s)
    states = np.stack([np.interp(nodes, flight.times_s, x) for x in flight.states.T], axis=1)
    states[-1] = flight.terminal_state
    return states


def sigma_distance(flight: Flight, solution: Solution) -> Array:
    """Of the flown positions at the nodes from the mean in the planned covariance, shape (n,)."""
    return distance_in_sigmas(node_states(flight, solution)[:, :3], solution)


def distance_in_sigmas(positions: Array, solution: Solution) -> Array:
    """Mahalanobis distances from the planned mean, shape (..., nodes).

    A millimetre is added to the spread: a plan without uncertainty has none.

    Args:
        positions: at the solution's nodes, m, J2000, shape (..., nodes, 3).
        solution: plan.
    """
    error = positions - np.array(solution.nodes.state)[:, :3]
    covariance = np.array(solution.nodes.covariance)[:, :3, :3] + 1e-6 * np.eye(3)
    weighted = np.linalg.solve(covariance, error[..., None])[..., 0]
    return np.sqrt(np.einsum("...i,...i->...", error, weighted))


def state_of_charge(flight: Flight) -> Array:
    """Of each battery, shape (n, batteries)."""
    return flight.stored_wh / flight.plan.vehicle.battery.capacity_wh


def ledger_error(flight: Flight) -> float:
    """What is left of the energy balance, over the energy generated.

    Generated and taken from the batteries = consumed, lost, unused and short (negative).
    """
    hours = CONTROL_PERIOD_S / 3600.0
    generated = float(flight.panels_w[1:].sum()) * hours
    consumed = float(flight.consumed_w[1:].sum()) * hours
    other = float((flight.lost_w + flight.unused_w - flight.short_w)[1:].sum()) * hours
    stored = float((flight.stored_wh[-1] - flight.stored_wh[0]).sum())
    return (generated - consumed - other - stored) / generated
