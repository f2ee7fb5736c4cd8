"""Command attitudes from the nominal trajectory, the site and the Sun, rolled for the panels' power.

In delta-V mode the thruster's force points along the burn, in observation mode the camera at the site,
both rolled for the largest power. In sun-pointing mode, and where a burn is zero, the panels face the
Sun, and the camera points as near to the asteroid as that allows.

The power of panels with normals n_i and peak powers p_i under a Sun in the direction s is
sum_i p_i max(0, n_i . s) = max over subsets S of (sum_S p_i n_i) . s: the support function of a
zonotope. A maximum over rotations is therefore a maximum over the sums of subsets, in closed form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicHermiteSpline, PPoly
from scipy.spatial.transform import Rotation

from formulations.arrays import Array
from scp_recon.bodies.catalogue import AU_KM
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import Leg, Mode
from scp_recon.physics import geometry
from scp_recon.physics.frames import unit
from scp_recon.results.solution import Solution, require_whole_flight
from scp_recon.scenario.schema import Scenario
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
    nominal: PPoly

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
        nominal: PPoly,
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
        return self.nominal(np.minimum(time_s, self.nominal.x[-1]))

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


def _interpolate(solution: Solution) -> PPoly:
    """Cubics between the nodes through positions and velocities, which jump at burns."""
    times, states = np.array(solution.nodes.t_s), np.array(solution.nodes.state)
    at = np.searchsorted(times, [burn.t_s for burn in solution.burns])
    pieces = []
    for first, last, burn in zip(at[:-1], at[1:], solution.burns[1:], strict=True):
        velocity = states[first : last + 1, 3:].copy()
        velocity[-1] -= burn.dv_m_s
        rows = slice(first, last + 1)
        pieces.append(CubicHermiteSpline(times[rows], states[rows, :3], velocity))
    edges = [*(piece.x[:-1] for piece in pieces), pieces[-1].x[-1:]]
    return PPoly(np.concatenate([piece.c for piece in pieces], axis=1), np.concatenate(edges))


@dataclass(frozen=True)
class SolarArray:
    """At most 16 flat panels on a rigid body, under a given Sun.

    `normals` point out of the cells, body frame, shape (n, 3); `peak_w` is the power with the Sun
    along each, W.
    """

    normals: Array
    peak_w: Array

    @classmethod
    def of(cls, vehicle: Vehicle, irradiance_w_m2: float) -> SolarArray:
        """A vehicle's panels; p_i = irradiance x area x packing x efficiency."""
        cells = vehicle.panels.packing * vehicle.panels.efficiency
        panels = vehicle.panels.panel
        areas_m2 = np.array([panel.area_m2 for panel in panels])
        return cls(unit([panel.normal for panel in panels]), irradiance_w_m2 * cells * areas_m2)

    def generation(self, sun_body: Array) -> Array:
        """Power of each panel, W, (..., n), for unit vectors to the Sun, body frame, (..., 3)."""
        return self.peak_w * np.maximum(0.0, sun_body @ self.normals.T)

    @cached_property
    def _sums(self) -> Array:
        """Sum of p_i n_i over every subset, shape (2^n, 3)."""
        chosen = np.arange(2 ** len(self.normals))[:, None] >> np.arange(len(self.normals)) & 1
        return chosen @ (self.peak_w[:, None] * self.normals)

    def best_direction(self) -> Array:
        """Body direction of largest power when it faces the Sun; its length is that power, W."""
        sums = self._sums
        return sums[np.argmax(np.linalg.norm(sums, axis=1))]

    def best_about(self, axis_body: Array, sun_angle: Array) -> Array:
        """Largest power, W, over all rotations about an axis that is held in space.

        The unit axis (3,) is in the body frame; angles between it and the Sun are in rad, of any shape.
        With the subset's sum split into N along the axis and M across it, the Sun at an angle t from
        the axis gives N cos t + |M| sin t once M is turned to the Sun.
        """
        along, across = self._split(axis_body)
        angle = np.asarray(sun_angle)[..., None]
        power = along * np.cos(angle) + np.linalg.norm(across, axis=1) * np.sin(angle)
        return power.max(axis=-1)

    def best_roll(self, axis_body: Array, sun_angle: float) -> Array:
        """Unit vector across the axis that the best rotation turns to the Sun's side, shape (3,).

        Any vector across will do, and one is returned, where no panel faces away from the axis.
        """
        along, across = self._split(axis_body)
        size = np.linalg.norm(across, axis=1)
        best = int(np.argmax(along * np.cos(sun_angle) + size * np.sin(sun_angle)))
        if size[best] == 0.0:
            other = np.cross(axis_body, np.eye(3)[np.argmin(np.abs(axis_body))])
            return other / np.linalg.norm(other)
        return across[best] / size[best]

    def _split(self, axis_body: Array) -> tuple[Array, Array]:
        along = self._sums @ axis_body
        return along, self._sums - along[:, None] * axis_body


def irradiance(scenario: Scenario) -> float:
    """Power of sunlight per area at the asteroid, W/m^2; over a flight it changes by 1e-4."""
    distance_au = float(np.linalg.norm(scenario.sun.body_position_km)) / AU_KM
    return scenario.sun.solar_constant_w_m2 / distance_au**2


def align(axis_body: Array, axis: Array, side_body: Array, side: Array) -> Array:
    """Attitude with one body axis along a direction and another turned as far as possible to a second.

    The TRIAD construction; exact in the first pair.

    Args:
        axis_body: unit vector, body frame, shape (3,).
        axis: where it is to point, unit vectors in the inertial frame, shape (..., 3).
        side_body: vector not parallel to `axis_body`, body frame, shape (3,).
        side: where its part across the axis is to point, shape (..., 3). Where it is parallel to the
            axis any rotation about it is as good, and one is returned.

    Returns:
        Matrices from the body to the inertial frame, shape (..., 3, 3).
    """
    axis = np.asarray(axis)
    return _triad(axis, np.asarray(side)) @ _triad(axis_body, side_body).T


def _triad(axis: Array, side: Array) -> Array:
    """Orthonormal columns: the axis, the part of `side` across it, their cross product."""
    across = side - np.einsum("...i,...i->...", side, axis)[..., None] * axis
    size = np.linalg.norm(across, axis=-1, keepdims=True)
    # Without a part across the axis the coordinate axis farthest from it stands in.
    spare = np.eye(3)[np.argmin(np.abs(axis), axis=-1)]
    spare = spare - np.einsum("...i,...i->...", spare, axis)[..., None] * axis
    across = np.where(size > PARALLEL * np.linalg.norm(side, axis=-1, keepdims=True), across, spare)
    across = across / np.linalg.norm(across, axis=-1, keepdims=True)
    return np.stack([axis, across, np.cross(axis, across)], axis=-1)


PARALLEL = 1e-12
"""Sine of the angle below which two directions count as parallel."""
