"""Resolve what a scenario describes: body, site, Sun, axes, boundary states, errors, forces; units.

J2000, body-centred, SI.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from formulations.arrays import Array
from formulations.linearisation.factor import factor_of
from formulations.problem.execution_errors import ComponentwiseErrors, ExecutionErrors, GatesErrors
from scp_recon.bodies.catalogue import AU_KM, GM_SUN_KM3_S2, packaged_body
from scp_recon.bodies.files import AttitudeTable
from scp_recon.bodies.surface import Ellipsoid, Mesh
from scp_recon.display import exact
from scp_recon.errors import InputError, option
from scp_recon.mission.knowledge import Deviation
from scp_recon.mission.windows import Lighting
from scp_recon.physics.forces import ForceModel, cannonball_srp
from scp_recon.physics.frames import Rotation, TabulatedRotation, sun_north_to_j2000, unit
from scp_recon.physics.geometry import Site
from scp_recon.physics.harmonics import HarmonicField, PolyhedronField, TurningField
from scp_recon.physics.two_body import Companion, Orbit
from scp_recon.scenario.body import Body
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
        scale = {"m": self.length_m / DEFAULT.length_m, "m/s": self.speed_m_s / DEFAULT.speed_m_s}
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


TruthModel = Literal["planner", "harmonics", "polyhedron"]
"""Gravity with which flights are flown: the plan's, all harmonics, or the homogeneous solid's."""
HARMONICS_DEGREE = 8
"""Degree of the packaged field: the paper's ground truth."""
FIELD_BODY = "Bennu"
"""Body of the packaged field: Chesley et al. 2020."""
SAME_GM, SAME_J2 = 0.01, 0.1
"""How far a scenario's GM and J2 may be off the packaged field's, relative."""

ALONG = 1e-6
"""Sine of the angle between position and velocity below which they span no plane."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Geometry and forces of a scenario, which do not depend on its window; time zero is the epoch.

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

    @cached_property
    def planned(self) -> ForceModel:
        """Forces of the planner; with a deviation, with the parameters of its flights."""
        return self._deviating(forces_of(self, planned_field(self.scenario)))

    def forces(self, truth: TruthModel) -> ForceModel:
        """Forces of flights: the planner's, or with another gravity.

        Raises:
            InputError: if the body has no field, or its shape is not known.
        """
        if truth == "planner":
            return self.planned
        if truth == "harmonics":
            found = forces_of(self, self.harmonics)
        else:
            gm, solid = self.scenario.body.gm_m3_s2, self.solid
            field = PolyhedronField(gm, solid.vertices_m, solid.facets)
            turning, point = TurningField(field, self.rotation), forces_of(self, None)
            found = replace(point, gm=0.0, j2_strength=0.0, field=turning)
        return self._deviating(found)

    def _deviating(self, forces: ForceModel) -> ForceModel:
        return self.deviation.forces(forces, self.scenario) if self.deviation else forces

    def gravity_in_words(self, truth: TruthModel = "planner") -> str:
        """The gravity of the planner, or of flights, with its rotation and the companion."""
        body = self.scenario.body
        own = "point mass and J2" if body.j2 else "point mass"
        if truth == "harmonics":
            own = f"harmonics to degree {len(self.harmonics.c) - 1}"
        elif truth == "polyhedron":
            own = f"a homogeneous polyhedron of {len(self.solid.facets)} facets"
        elif body.planned_degree is not None:
            of = " of a homogeneous solid" if is_planned_as_solid(body) else ""
            own = f"harmonics{of} to degree {body.planned_degree}"
        if body.attitude is not None:
            own += " that tumble with the body"
        return own if body.companion is None else f"{own}, and the pull of {body.companion.name}"

    @cached_property
    def solid(self) -> Mesh:
        """The body as a homogeneous polyhedron; errors as `solid_of`."""
        return solid_of(self.scenario.body)

    @cached_property
    def harmonics(self) -> HarmonicField:
        """Field of the true dynamics, against which J2 is tested; errors as `truth_field`."""
        return truth_field(self.scenario)


def forces_of(scene: Scene, field: HarmonicField | None) -> ForceModel:
    """Forces with a gravity field, SI, J2000; without one that of a point mass and J2."""
    body, craft, sun = scene.scenario.body, scene.scenario.spacecraft, scene.scenario.sun
    tumbles = body.attitude is not None
    if tumbles and field is None:  # J2 has a closed form about a fixed axis alone
        field = HarmonicField.zonal(body.gm_m3_s2, body.reference_radius_m, body.j2)
    j2, radius = (body.j2, body.reference_radius_m) if field is None else (field.j2, field.radius)
    closed = (0,) if tumbles else (0, 2)
    return ForceModel(
        gm=body.gm_m3_s2,
        j2_strength=0.0 if tumbles else 1.5 * body.gm_m3_s2 * j2 * radius**2,
        pole=scene.rotation.pole.T,
        field=None if field is None else TurningField(field.beside(*closed), scene.rotation),
        companion=scene.companion,
        srp=cannonball_srp(
            scene.sun_direction(0.0),
            craft.srp_area_m2,
            craft.reflectivity_coefficient,
            craft.mass_kg,
            float(np.linalg.norm(sun.body_position_km)) / AU_KM,
            sun.solar_constant_w_m2,
        ),
    )


def planned_field(scenario: Scenario) -> HarmonicField | None:
    """The field to `body.planned_degree`, SI; None where the point mass and J2 are planned with.

    Raises:
        InputError: as `truth_field`, and if the body's field has no such degree.
    """
    body, degree = scenario.body, scenario.body.planned_degree
    if degree is None:
        return None
    if is_planned_as_solid(body):
        mesh = solid_of(body, PLANNED)
        return HarmonicField.of_solid(mesh, body.gm_m3_s2, body.reference_radius_m, degree)
    field = truth_field(scenario, PLANNED)
    most = len(field.c) - 1
    if degree > most:
        raise InputError(PLANNED, str(degree), f"must be at most {most}, the degree of the field")
    return field.up_to(degree)


PLANNED = "body.planned_degree"


def is_planned_as_solid(body: Body) -> bool:
    """Whether the planner's harmonics are those of the homogeneous solid, for lack of a field."""
    known = body.gravity is not None or packaged_body(body.name) is packaged_body(FIELD_BODY)
    return not known and (body.solid is not None or body.radii_m is not None)


def solid_of(body: Body, needed_by: str = option("truth", "polyhedron")) -> Mesh:
    """The body as a homogeneous polyhedron: that of `body.solid_file`, else the ellipsoid's.

    Raises:
        InputError: if the body has neither.
    """
    if body.solid is not None:
        return Mesh(np.array(body.solid.vertices_m), np.array(body.solid.facets, dtype=np.intp))
    if body.radii_m is None:
        allowed = f"must name a shape model, or body.radii_m be given, for {needed_by}"
        raise InputError("body.solid_file", "nothing", allowed)
    return Ellipsoid(np.array(body.radii_m)).tessellated(HALVINGS)


HALVINGS = 3
"""Halvings of an octahedron for an ellipsoid: 512 facets. Of Itokawa's, at 500 m, 3e-4 of the pull is
lost by that."""


def truth_field(scenario: Scenario, needed_by: str = option("truth", "harmonics")) -> HarmonicField:
    """The field of `body.gravity_file` in full, else that of the packaged body to degree 8; SI.

    Raises:
        InputError: if the body has neither, or its GM, reference radius or J2 differs from the
            packaged field's.
    """
    body = scenario.body
    if body.gravity is not None:
        rows = body.gravity.coefficients
        degree = max(n for n, _, _, _ in rows)
        return HarmonicField.of_rows(body.gm_m3_s2, body.gravity.reference_radius_m, degree, rows)
    if packaged_body(body.name) is packaged_body(FIELD_BODY):
        known = packaged_body(FIELD_BODY)
        assert known is not None
        for entry, share in (("gm_m3_s2", SAME_GM), ("reference_radius_m", 0.0), ("j2", SAME_J2)):
            given, own = getattr(body, entry), known.entries[entry]
            if abs(given - own) > share * own:
                within = f"within {100 * share:g} % of " if share else ""
                needs = f"must be {within}{own:g}: the packaged gravity field is {FIELD_BODY}'s"
                raise InputError(needed_by, f"body.{entry} {exact(given)}", needs)
        return HarmonicField.bennu(body.gm_m3_s2, HARMONICS_DEGREE)
    needs = f"must name a gravity field (.gfc, or a PDS SHA table) for {needed_by}"
    raise InputError("body.gravity_file", f"nothing for {body.name}", needs)


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
