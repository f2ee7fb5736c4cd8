"""Command attitudes from the nominal trajectory, the site and the Sun.

In delta-V mode the thruster's force points along the burn, in observation mode the camera at the site,
both rolled for the largest power. In sun-pointing mode, and where a burn is zero, the panels face the
Sun, and the camera points as near to the asteroid as that allows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from formulations.arrays import Array
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import Leg, Mode
from scp_recon.physics import geometry
from scp_recon.physics.frames import unit
from scp_recon.results.solution import Solution, require_whole_flight
from scp_recon.simulation.panels import SolarArray, align, irradiance
from scp_recon.simulation.vehicle import Vehicle


@dataclass(frozen=True)
class Firing:
    """A burn as commanded, J2000: a constant force for a whole number of control periods."""

    start_s: float
    duration_s: float
    dv_m_s: Array

    @property
    def end_s(self) -> float:
        """End of the firing, s."""
        return self.start_s + self.duration_s

    @property
    def direction(self) -> Array:
        """Unit vector of the force, J2000; any direction for a burn of zero."""
        return unit(self.dv_m_s) if np.any(self.dv_m_s) else np.array([1.0, 0.0, 0.0])


@dataclass(frozen=True)
class FlightPlan:
    """Commands of a flight, before departure or at a time in flight.

    Attitude modes are those of the schedule, but the attitude of a burn is kept to its end. The nominal
    path is the planned mean's positions, m, J2000.
    """

    mission: Mission
    vehicle: Vehicle
    firings: tuple[Firing, ...]
    legs: tuple[Leg, ...]
    nominal: tuple[CubicHermiteSpline, ...]

    @classmethod
    def of(cls, solution: Solution, mission: Mission, vehicle: Vehicle) -> FlightPlan:
        """Prepare a solution for flight.

        Raises:
            InputError: if the vehicle's thruster takes longer for a burn than the schedule has, or the
                plan begins in flight.
        """
        require_whole_flight(solution.scenario, "solution")
        return cls._of(solution.burns_m_s, mission, vehicle, _interpolate(solution))

    def with_burns(self, burns_m_s: Array) -> FlightPlan:
        """The same with other burns (m, 3), J2000, at the same times.

        Raises:
            InputError: as `of`.
        """
        return self._of(burns_m_s, self.mission, self.vehicle, self.nominal)

    @classmethod
    def _of(
        cls,
        burns_m_s: Array,
        mission: Mission,
        vehicle: Vehicle,
        nominal: tuple[CubicHermiteSpline, ...],
    ) -> FlightPlan:
        thrust, mass = vehicle.chemical_thruster.thrust_n, vehicle.mass.mass_kg
        firings = []
        for time, dv in zip(mission.scenario.burn_times_s, burns_m_s, strict=True):
            least = mass * float(np.linalg.norm(dv)) / thrust / CONTROL_PERIOD_S
            start = round(time / CONTROL_PERIOD_S) * CONTROL_PERIOD_S
            firings.append(Firing(start, math.ceil(least) * CONTROL_PERIOD_S, dv))
        legs = [Leg(Mode.DELTA_V, 0.0, firings[0].end_s)]
        for leg in mission.schedule.legs:
            late = next((f.end_s for f in firings if abs(f.start_s - leg.end_s) < 1.0), leg.end_s)
            if legs[-1].end_s >= late:
                took = f"a burn until {legs[-1].end_s:g} s"
                raise InputError(
                    "vehicle: chemical_thruster",
                    took,
                    f"must end before the mode at {late:g} s does",
                )
            legs.append(Leg(leg.mode, legs[-1].end_s, late))
        return cls(mission, vehicle, tuple(firings), tuple(legs), nominal)

    @property
    def end_s(self) -> float:
        """End of the last burn, s."""
        return self.legs[-1].end_s

    @cached_property
    def panels(self) -> SolarArray:
        """The vehicle's panels at the mission's distance from the Sun."""
        return SolarArray.of(self.vehicle, irradiance(self.mission.scenario))

    def position(self, time_s: Array) -> Array:
        """Nominal positions, m, J2000, shape (n, 3); constant after the last burn."""
        edges = [spline.x[0] for spline in self.nominal[1:]]
        index = np.searchsorted(edges, time_s, side="right")
        answer = np.empty((len(time_s), 3))
        for i, spline in enumerate(self.nominal):
            chosen = index == i
            answer[chosen] = spline(np.minimum(time_s[chosen], spline.x[-1]))
        return answer

    def attitudes(self, time_s: Array) -> Rotation:
        """Commanded attitudes, from the body to J2000, at ascending times."""
        matrices = np.empty((len(time_s), 3, 3))
        for leg in self.legs:
            last = leg is self.legs[-1]
            chosen = (time_s >= leg.start_s) & ((time_s < leg.end_s) | last)
            matrices[chosen] = self._leg_attitudes(leg, time_s[chosen])
        return Rotation.from_matrix(matrices)

    def _leg_attitudes(self, leg: Leg, time_s: Array) -> Array:
        """Attitudes of a leg, shape (n, 3, 3)."""
        sun = self.mission.sun_direction(time_s)
        position = self.position(time_s)
        camera = unit(self.vehicle.sensors.camera)
        firing = next(f for f in self.firings if f.end_s >= leg.end_s - CONTROL_PERIOD_S)
        idle = leg.mode is Mode.DELTA_V and not firing.duration_s
        if leg.mode is Mode.SUN_POINTING or idle:
            return align(unit(self.panels.best_direction()), sun, camera, -position)
        if leg.mode is Mode.DELTA_V:
            axis_body = unit(self.vehicle.chemical_thruster.direction)
            axis = np.broadcast_to(firing.direction, sun.shape)
        else:
            track = geometry.track(self.mission.site, self.mission.rotation, time_s)
            axis_body, axis = camera, unit(track.position - position)
        if not len(time_s):
            return np.empty((0, 3, 3))
        # One roll for the whole leg, so that the command is continuous.
        angle = float(np.median(geometry.angle(axis, sun)))
        return align(axis_body, axis, self.panels.best_roll(axis_body, angle), sun)


CONTROL_PERIOD_S = 1.0
"""Period in s with which sensors are read and actuators commanded."""


def _interpolate(solution: Solution) -> tuple[CubicHermiteSpline, ...]:
    """Positions between the nodes, in one piece from burn to burn: velocity jumps at burns."""
    times, states = np.array(solution.nodes.t_s), np.array(solution.nodes.state)
    at = np.searchsorted(times, [burn.t_s for burn in solution.burns])
    pieces = []
    for first, last, burn in zip(at[:-1], at[1:], solution.burns[1:], strict=True):
        velocity = states[first : last + 1, 3:].copy()
        velocity[-1] -= burn.dv_m_s
        rows = slice(first, last + 1)
        pieces.append(CubicHermiteSpline(times[rows], states[rows, :3], velocity))
    return tuple(pieces)
