"""Resolve what a scenario describes: body, site, Sun, axes, boundary states, errors; units and grid.

J2000, body-centred, SI.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from formulations.arrays import Array
from formulations.linearisation.factor import factor_of
from formulations.problem.execution_errors import ComponentwiseErrors, ExecutionErrors, GatesErrors
from scp_recon.bodies.catalogue import GM_SUN_KM3_S2
from scp_recon.bodies.files import AttitudeTable
from scp_recon.errors import InputError
from scp_recon.mission.knowledge import Deviation
from scp_recon.mission.windows import Lighting
from scp_recon.physics.frames import Rotation, TabulatedRotation, sun_north_to_j2000, unit
from scp_recon.physics.geometry import Site
from scp_recon.physics.two_body import Companion, Orbit
from scp_recon.scenario.schema import Scenario


@dataclass(frozen=True)
class Units:
    """Units of the nondimensional problem.

    Attributes:
        length_m: the initial radius.
        time_s: the time that makes GM one.
    """

    length_m: float
    time_s: float

    @classmethod
    def of_orbit(cls, state: Array, gm: float) -> Units:
        """Units for a flight that starts at a state, shape (6,), with GM `gm`; SI."""
        length = float(np.linalg.norm(state[:3]))
        return cls(length, float(np.sqrt(length**3 / gm)))

    @property
    def speed_m_s(self) -> float:
        """Unit of velocity."""
        return self.length_m / self.time_s

    @property
    def state(self) -> Array:
        """Units of a state's six components."""
        return np.repeat([self.length_m, self.speed_m_s], 3)

    def tolerance(self, figure: float, unit: str) -> float:
        """A tolerance in "m" or "m/s", as large beside the units as a figure is in the default mission.

        Tolerances in other units, angles and shares, are the figure.
        """
        scale = {
            "m": self.length_m / DEFAULT.length_m,
            "m/s": self.speed_m_s / DEFAULT.speed_m_s,
        }
        return figure * scale.get(unit, 1.0)


DEFAULT = Units(1171.3081106182094, 18127.26687986026)
"""Units of the packaged scenario recon_b, for which tolerances in m and m/s are given."""

RK4_STEP_MAX_S = 240.0
"""Keeps the planner within a millimetre of an adaptive integration over the default flight."""

NODES_MAX = 3000
"""Beyond them a plan would take minutes and gigabytes."""


def make_grid(fixed_s: Sequence[float], step_max_s: float) -> Array:
    """Ascending node times, s: `fixed_s`, and between them even steps of at most `step_max_s`."""
    fixed = np.unique(fixed_s)
    parts = [
        np.linspace(a, b, max(1, int(np.ceil((b - a) / step_max_s - 1e-9))) + 1)[:-1]
        for a, b in itertools.pairwise(fixed)
    ]
    return np.concatenate([*parts, fixed[-1:]])


ALONG = 1e-6
"""Sine of the angle between position and velocity below which they span no plane."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Geometry of a scenario that does not depend on its window; time zero is the epoch.

    Attributes:
        scenario: with the data.
        rotation: of the body.
        site: on it, body-fixed.
        deviation: of what flights have in place of the scenario's parameters; None if they have these.
    """

    scenario: Scenario
    rotation: Rotation
    site: Site
    deviation: Deviation | None = None

    @classmethod
    def of(cls, scenario: Scenario) -> Scene:
        """The scene of a scenario.

        Raises:
            InputError: if a table of attitudes does not span the flight.
        """
        site = scenario.site
        rotation = rotation_of(scenario)
        rotation.body_to_j2000([scenario.start_s, scenario.duration_s])
        return cls(scenario, rotation, Site(np.array(site.position_body_m), unit(site.normal_body)))

    def sun_direction(self, time_s: npt.ArrayLike) -> Array:
        """Unit vectors from the body to the Sun, shape (..., 3).

        The body moves on a straight line: over ten hours the curvature of its orbit is 2e-5 rad of
        mostly radial displacement.
        """
        sun = self.scenario.sun
        position, velocity = np.array(sun.body_position_km), np.array(sun.body_velocity_km_s)
        return unit(-(position + np.multiply.outer(np.asarray(time_s, dtype=float), velocity)))

    @cached_property
    def companion(self) -> Companion | None:
        """The body's companion, if it has one."""
        given = self.scenario.body.companion
        if given is None:
            return None
        companion = Companion.of(given, self.scenario.epoch.tdb)
        return companion if self.deviation is None else self.deviation.companion(companion)

    @property
    def lighting(self) -> Lighting:
        """Lighting of the site over time."""
        return Lighting(self.site, self.rotation, self.sun_direction)

    def axes(self, frame: str) -> Array:
        """Rotation from "j2000", "sun_north" or "body_fixed" to J2000 at the epoch, shape (3, 3)."""
        if frame == "sun_north":
            return sun_north_to_j2000(self.sun_direction(0.0), self.rotation.pole)
        return self.rotation.body_to_j2000(0.0) if frame == "body_fixed" else np.eye(3)

    @cached_property
    def boundary_axes(self) -> Array:
        """Rotation from boundary.frame to J2000 at the epoch, shape (3, 3)."""
        return self.axes(self.scenario.boundary.frame)

    def beginning_at(self, state: Array) -> Scenario:
        """The scenario with another state at the first node, J2000, SI, shape (6,)."""
        flight, boundary = self.scenario.in_flight, self.scenario.boundary
        frame, which = (flight.frame, "") if flight else (boundary.frame, "initial_")
        matrix = self.axes(frame)
        given: dict[str, object] = {} if flight else {"home": None}
        given |= {
            f"{which}position_m": tuple((matrix.T @ state[:3]).tolist()),
            f"{which}velocity_m_s": tuple((matrix.T @ state[3:]).tolist()),
        }
        name, table = ("in_flight", flight) if flight else ("boundary", boundary)
        return self.scenario.model_copy(update={name: table.model_copy(update=given)})

    def boundary_state(self, which: str) -> Array:
        """The "initial" or "final" boundary state, shape (6,)."""
        boundary = self.scenario.boundary
        position = self.boundary_axes @ np.array(getattr(boundary, f"{which}_position_m"))
        velocity = self.boundary_axes @ np.array(getattr(boundary, f"{which}_velocity_m_s"))
        return np.concatenate([position, velocity])

    @cached_property
    def initial_state(self) -> Array:
        """State where planning begins, shape (6,): in flight, or before the first burn."""
        flight = self.scenario.in_flight
        if flight is None:
            return self.boundary_state("initial")
        axes = self.axes(flight.frame)
        return np.concatenate([axes @ flight.position_m, axes @ flight.velocity_m_s])

    def initial_factor(self, state: Array, *, signed: bool = False) -> Array:
        """Factor S of the covariance S S' where planning begins, m and m/s, shape (6, 6).

        A state in flight without a covariance of its own has the scenario's initial one. Radial,
        transverse and normal axes are those of the mean state, shape (6,). A share of the state's
        components is smooth in the state if `signed`, and covariance is the same.

        Raises:
            InputError: if the state has no plane to be normal to.
        """
        given, flight = self.scenario.uncertainty, self.scenario.in_flight
        matrix, frame, entry = given.initial_covariance, given.initial_frame, "uncertainty.initial"
        if flight is not None and flight.covariance is not None:
            matrix, frame, entry = (
                flight.covariance,
                flight.covariance_frame,
                "in_flight.covariance",
            )
        elif flight is not None and frame != "rtn":
            state = self.boundary_state("initial")
        if entry.startswith("uncertainty") and given.initial_sigma_fraction is not None:
            share = given.initial_sigma_fraction
            return np.diag(share * (state if signed else np.abs(state)))
        if matrix is not None:
            root = factor_of(np.array(matrix))
        else:
            assert given.initial_sigma_position_m is not None
            assert given.initial_sigma_velocity_m_s is not None
            root = np.diag([*given.initial_sigma_position_m, *given.initial_sigma_velocity_m_s])
        rtn = frame == "rtn"
        axes = _rtn_to_j2000(state, f"{entry}_frame") if rtn else self.axes(str(frame))
        return np.vstack([axes @ root[:3], axes @ root[3:]])

    @property
    def measurement_factor(self) -> Array:
        """Factor N of the covariance N N' of a state measured in flight, m and m/s, shape (6, 6)."""
        given = self.scenario.navigation
        if given.covariance is not None:
            return factor_of(np.array(given.covariance))
        return np.diag(np.repeat([given.sigma_position_m, given.sigma_velocity_m_s], 3))


def orbit_of_body(scene: Scene) -> Orbit:
    """The body's osculating orbit about the Sun at the epoch; km."""
    sun = scene.scenario.sun
    return Orbit.of(sun.body_position_km, sun.body_velocity_km_s, GM_SUN_KM3_S2)


def rotation_of(scenario: Scenario) -> Rotation:
    """The rotation of a scenario's body: uniform, or by its table of attitudes."""
    body, tdb = scenario.body, scenario.epoch.tdb
    if (given := body.attitude) is not None:
        table = AttitudeTable(np.array(given.tdb_s), np.array(given.quaternions))
        return TabulatedRotation.from_table(table, tdb)
    meridian = (
        body.prime_meridian_deg,
        body.prime_meridian_rate_deg_day,
        body.prime_meridian_acceleration_deg_day2,
    )
    return Rotation.from_iau(body.pole_ra_deg, body.pole_dec_deg, meridian, tdb)


def _rtn_to_j2000(state: Array, entry: str) -> Array:
    """Radial, transverse (towards the velocity) and normal axes of a state, as columns."""
    radial, momentum = unit(state[:3]), np.cross(state[:3], state[3:])
    size = np.linalg.norm(state[:3]) * np.linalg.norm(state[3:])
    if np.linalg.norm(momentum) <= ALONG * size:
        needs = "must be another frame: the velocity points along the position or is zero"
        raise InputError(entry, "rtn", needs)
    normal = unit(momentum)
    return np.stack([radial, np.cross(normal, radial), normal], axis=1)


def execution_errors(scenario: Scenario, speed_m_s: float = 1.0) -> ExecutionErrors:
    """The model of the burns' errors, for burns in units of a speed."""
    gates, fraction = scenario.uncertainty.gates, scenario.uncertainty.execution_error
    if gates is None:
        assert fraction is not None
        return ComponentwiseErrors(fraction)
    return GatesErrors(
        magnitude_fixed=gates.magnitude_fixed_m_s,
        magnitude_proportional=gates.magnitude_proportional,
        pointing_fixed=gates.pointing_fixed_m_s,
        pointing_proportional=gates.pointing_proportional_rad,
        magnitude_bias=gates.magnitude_bias,
    ).in_units(speed_m_s)


def errors_of_kind(scenario: Scenario, kind: str | None) -> ExecutionErrors:
    """The scenario's model for burns in m/s, or, of the same size, "componentwise" or "gates".

    Raises:
        InputError: if componentwise errors are required of a scenario with Gates' errors.
    """
    own = execution_errors(scenario)
    if kind is None or kind == scenario.uncertainty.errors:
        return own
    if isinstance(own, ComponentwiseErrors):
        # The isotropic counterpart: a magnitude error of beta, and a pointing error of beta rad.
        return GatesErrors(0.0, own.fraction, 0.0, own.fraction)
    raise InputError(
        "errors", repr(kind), "must be 'gates', or not given: the scenario's errors are Gates'"
    )
