"""Define the tables `[body]`, `[sun]`, `[site]`, `[boundary]` and `[design]`.

The tables say what the asteroid is, its rotation, gravity and Sun; where the site is, where a flight
begins and ends, and what a design may choose.
"""

from __future__ import annotations

import math
from itertools import pairwise
from operator import mul
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from formulations.arrays import Array
from scp_recon.scenario.fields import (
    Angle,
    Line,
    Name,
    NonZeroVector,
    Number,
    Positive,
    Section,
    Tdb,
    Vector,
    Velocity,
)

PERIOD_MIN_H = 0.01
"""Faster than any asteroid that has been seen turning."""
DEGREE_MAX = 20
"""Largest degree of a gravity field: a file's coefficients above it are left out."""
PLANNED_MAX = 8
"""Largest degree with which flights are planned: the paper's ground truth has no more."""
FACETS_MAX = 20_000
"""Largest number of facets of a solid: 10,000 flights about it take hours."""

Path = Annotated[Line, Field(min_length=1, max_length=4000)]
Degree = Annotated[int, Field(ge=1, le=DEGREE_MAX)]
Order = Annotated[int, Field(ge=0, le=DEGREE_MAX)]
Coefficient = Annotated[float, Field(ge=-1, le=1)]
Corner = Annotated[int, Field(ge=0, lt=FACETS_MAX)]


class GravityField(Section):
    """Spherical harmonics for the truth that the Monte Carlo flies."""

    reference_radius_m: Positive
    """Radius in m that the coefficients refer to."""
    coefficients: Annotated[
        tuple[tuple[Degree, Order, Coefficient, Coefficient], ...],
        Field(min_length=1, max_length=300),
    ]
    """Rows degree, order, C, S: fully normalised (4 pi), body-fixed."""

    @model_validator(mode="after")
    def _each_once(self) -> Self:
        pairs = [(n, m) for n, m, _, _ in self.coefficients]
        if len(set(pairs)) != len(pairs) or any(m > n for n, m in pairs):
            raise ValueError("must have each degree and order once, the order at most the degree")
        return self


TURN_MAX_DEG = 30.0
"""Between two attitudes of a table: beyond it a spline through them says little."""


class Attitude(Section):
    """Attitudes of a body that tumbles, between which it turns smoothly."""

    tdb_s: Annotated[tuple[Number, ...], Field(min_length=2, max_length=10_000)]
    """Times in s of TDB past J2000, ascending."""
    quaternions: Annotated[
        tuple[tuple[Number, Number, Number, Number], ...], Field(min_length=2, max_length=10_000)
    ]
    """Quaternions, scalar first, that turn body-fixed components into J2000."""

    @model_validator(mode="after")
    def _is_a_motion(self) -> Self:
        if len(self.tdb_s) != len(self.quaternions):
            raise ValueError("must have as many quaternions as times")
        least = math.cos(0.5 * math.radians(TURN_MAX_DEG)) * (1.0 - 2e-3)
        turns = [abs(sum(map(mul, a, b))) for a, b in pairwise(self.quaternions)]
        for rule, first, kept in (
            ("times in ascending order", 2, [a < b for a, b in pairwise(self.tdb_s)]),
            (
                "quaternions of length one, to 0.001",
                1,
                [abs(math.hypot(*q) - 1.0) <= 1e-3 for q in self.quaternions],
            ),
            (f"turns of at most {TURN_MAX_DEG:g} deg", 2, [turn >= least for turn in turns]),
        ):
            if not all(kept):
                raise ValueError(f"must have {rule}, as row {kept.index(False) + first} has not")
        return self


class Companion(Section):
    """A second body on a Kepler orbit about the first: it pulls, and flights keep away from it."""

    name: Name
    """Name of the companion."""
    gm_m3_s2: Annotated[float, Field(ge=1e-9, le=1e20)]
    """Gravitational parameter GM in m^3/s^2."""
    radius_m: Positive
    """Radius in m of the ball about its centre that holds it."""
    semi_major_axis_m: Positive
    """Semi-major axis in m of its orbit about the body's centre."""
    eccentricity: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Eccentricity of that orbit."""
    period_h: Annotated[float, Field(ge=0.01, le=1e6)]
    """Orbital period in h."""
    pole_ra_deg: Angle
    """Right ascension in deg, J2000, of the orbit's pole, about which it moves right-handed."""
    pole_dec_deg: Annotated[float, Field(ge=-90, le=90)]
    """Declination of the orbit's pole in deg, J2000."""
    periapsis_deg: Angle = 0.0
    """Angle in deg from the ascending node on J2000's equator to the periapsis."""
    mean_anomaly_deg: Angle
    """Mean anomaly in deg at epoch_tdb."""
    epoch_tdb: Tdb
    """TDB of the mean anomaly, such as 2022-09-26T23:15:33; no time zone."""


class Solid(Section):
    """A homogeneous solid: closed, body-fixed, its facets turning outward."""

    vertices_m: Annotated[tuple[Vector, ...], Field(min_length=4, max_length=FACETS_MAX)]
    """Corners in m."""
    facets: Annotated[
        tuple[tuple[Corner, Corner, Corner], ...], Field(min_length=4, max_length=FACETS_MAX)
    ]
    """Three corners each, counted from 0."""


class Body(Section):
    """The asteroid: gravity and IAU rotation."""

    name: Name
    """Name. That of a packaged body (Apophis, Bennu, Didymos, Eros, Itokawa, Ryugu) gives what is
    left out."""
    gm_m3_s2: Annotated[float, Field(ge=1e-6, le=1e20)]
    """Gravitational parameter GM in m^3/s^2."""
    j2: Annotated[float, Field(ge=-1, le=1)]
    """Unnormalised J2 at reference_radius_m, about the spin pole."""
    reference_radius_m: Positive
    """Radius in m that J2 refers to; the flight stays outside it."""
    pole_ra_deg: Angle
    """Right ascension of the spin pole in deg, J2000."""
    pole_dec_deg: Annotated[float, Field(ge=-90, le=90)]
    """Declination of the spin pole in deg, J2000."""
    prime_meridian_deg: Angle
    """W0 in deg of the IAU's W = W0 + W1 d + W2 d^2, d in TDB days past J2000. Follows from
    prime_meridian_at_epoch_deg."""
    prime_meridian_rate_deg_day: Angle
    """W1 in deg/day. Follows from rotation_period_h."""
    prime_meridian_acceleration_deg_day2: Angle
    """W2 in deg/day^2; zero where a period is given instead."""
    rotation_period_h: Annotated[float, Field(ge=-1e6, le=1e6)] | None = None
    """Sidereal spin period in h: positive for right-handed about the pole, as the IAU defines an
    asteroid's pole, negative for the other way."""
    prime_meridian_at_epoch_deg: Angle | None = None
    """Angle W of the prime meridian at epoch.tdb in deg, in place of W0."""
    radii_m: tuple[Positive, Positive, Positive] | None = None
    """Semi-axes of the ellipsoid in m along body-fixed x, y, z: for sites by latitude and longitude,
    and to check positions and normals."""
    shape_file: Path | None = None
    """Shape model for the site: OBJ (with shape_unit), or SPICE DSK (.bds, extra [spice]); body-fixed,
    origin in the centre of mass. Relative to this file."""
    shape_unit: Literal["m", "km"] | None = None
    """Unit of the OBJ's coordinates, which the format does not tell."""
    pck_file: Path | None = None
    """SPICE text PCK (extra [spice]) that gives pole, prime meridian and radii of naif_id. Relative to
    this file."""
    naif_id: Annotated[int, Field(ge=1, le=99_999_999)] | None = None
    """NAIF's number of the body in kernels, 2101955 for Bennu."""
    attitude_file: Path | None = None
    """Attitudes of a body that tumbles, in place of pole and prime meridian: a table (.csv) with the
    header tdb_s,qw,qx,qy,qz (TDB past J2000; body-fixed to J2000, scalar first). Relative to this
    file."""
    attitude: Attitude | None = None
    """The attitudes themselves, as attitude_file gives them; pole and meridian follow at the epoch."""
    gravity_file: Path | None = None
    """Gravity field by degree and order, fully normalised: ICGEM .gfc or PDS SHA table (.sha, .tab).
    The Monte Carlo flies it; the planner its J2, or what planned_degree says. Relative to this file."""
    gravity: GravityField | None = None
    """The field itself, as gravity_file gives it."""
    solid_file: Path | None = None
    """Shape model taken as homogeneous, which `--truth polyhedron` flies in place of the ellipsoid
    radii_m: OBJ (with shape_unit), or SPICE DSK. Gives j2 and reference_radius_m where they are left
    out. Relative to this file."""
    solid: Solid | None = None
    """The solid itself, as solid_file gives it."""
    planned_degree: Annotated[int, Field(ge=2, le=PLANNED_MAX)] | None = None
    """Degree up to which the planner flies the body's gravity field, turning with the body, in place of
    j2; without it the point mass and j2 alone. Where no field is known it is that of the homogeneous
    solid or ellipsoid."""
    companion: Companion | None = None
    """A second body in orbit about this one; a packaged body's is given with its name."""

    @model_validator(mode="after")
    def _turns(self) -> Self:
        period = self.rotation_period_h
        if period is not None and abs(period) < PERIOD_MIN_H:
            raise ValueError(f"rotation_period_h must be at least {PERIOD_MIN_H:g} h either way")
        return self


class Sun(Section):
    """Heliocentric state of the body at the epoch, J2000, and the solar constant at 1 au."""

    body_position_km: NonZeroVector
    """Position of the body from the Sun's centre at the epoch in km, J2000. Computed for packaged
    bodies, and from spk_files."""
    body_velocity_km_s: Velocity
    """Velocity of the body about the Sun at the epoch in km/s, J2000. Computed likewise."""
    state_tdb: Tdb | None = None
    """TDB to which this state and body.prime_meridian_at_epoch_deg belong. It has to be the epoch's, so
    that an epoch is not changed alone."""
    solar_constant_w_m2: Positive = 1361.0
    """Solar irradiance at 1 au in W/m^2."""
    spk_files: Annotated[tuple[Path, ...], Field(min_length=1, max_length=20)] | None = None
    """SPICE SPK kernels (extra [spice]) that hold body.naif_id and the Sun. Relative to this file."""


class SiteSection(Section):
    """The observed site; body-fixed."""

    name: Name
    """Name of the site, for tables and figures."""
    position_body_m: Vector
    """Position in m from the centre of mass, body-fixed. Follows from latitude and longitude."""
    normal_body: NonZeroVector
    """Outward normal, body-fixed, of any length. Follows from the shape where it is not given."""
    latitude_deg: Annotated[float, Field(ge=-90, le=90)] | None = None
    """Planetocentric latitude in deg: of the position vector above the equator, north positive."""
    longitude_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    """East longitude in deg from the prime meridian, body-fixed."""
    normal_radius_m: Positive | None = None
    """Average the normal over the facets of body.shape_file whose centre is this near, in m."""

    @model_validator(mode="after")
    def _both_coordinates(self) -> Self:
        if (self.latitude_deg is None) != (self.longitude_deg is None):
            raise ValueError("must have latitude_deg and longitude_deg together")
        return self


Phase = Annotated[float, Field(ge=-720, le=720)]
Moment = Annotated[float, Field(ge=-1e7, le=1e7)]
FULL_TURN_DEG = 360.0


class HomeOrbit(Section):
    """A circle about the body with two-body speed, on which a pass begins and ends."""

    radius_m: Positive
    """Radius of the home orbit in m, from the body's centre."""
    normal: NonZeroVector
    """Normal of its plane in boundary.frame, of any length; the terminator's in sun_north is [1, 0, 0].
    Phases count right-handed about it from the part of +Y in the plane (of +Z where +Y is normal)."""
    sense: Literal["right_handed", "left_handed"] = "right_handed"
    """Whether the spacecraft flies towards growing phases or the other way."""
    flown: bool = False
    """Whether it is one revolution flown under the mission's forces, from the circle's state at phase 0
    and the epoch on, instead of the circle. A design alone can tell its states."""
    ephemeris_file: Line | None = None
    """File of one revolution at least that stands in place of the circle, about body.name: a table of
    states (.csv, as --init takes it), a CCSDS OEM (.oem), or a SPICE kernel or meta-kernel
    (extra [spice]; read from the epoch on). The first revolution counts. Its phases count about normal,
    sense has to be its own, and its distances lie within a factor of 2 of radius_m. A design alone can
    tell its states. Relative to this file."""
    spacecraft_id: int | None = None
    """NAIF's number of the spacecraft in a kernel."""
    departure_deg: tuple[Phase, Phase] = (0.0, FULL_TURN_DEG)
    """Least and greatest phase of departure in deg; equal where it is not free."""
    arrival_deg: tuple[Phase, Phase] = (0.0, FULL_TURN_DEG)
    """Least and greatest phase of arrival in deg; equal where it is not free."""

    @field_validator("departure_deg", "arrival_deg")
    @classmethod
    def _one_turn(cls, span: tuple[float, float]) -> tuple[float, float]:
        if not span[0] <= span[1] <= span[0] + FULL_TURN_DEG:
            raise ValueError(f"must ascend by at most {FULL_TURN_DEG:g} deg")
        return span

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if self.flown and self.ephemeris_file is not None:
            raise ValueError("flown must be left out beside ephemeris_file")
        if self.spacecraft_id is not None and self.ephemeris_file is None:
            raise ValueError("spacecraft_id must be left out without ephemeris_file")
        return self

    @property
    def is_free(self) -> bool:
        """Whether a design has to choose its phases."""
        return (
            self.flown
            or self.ephemeris_file is not None
            or any(low < high for low, high in (self.departure_deg, self.arrival_deg))
        )

    def state(self, phase_rad: float, gm: float) -> Array:
        """Position and velocity in boundary.frame, m and m/s, shape (6,), with the speed sqrt(GM / r).

        Args:
            phase_rad: phase on the orbit.
            gm: of the body, m^3/s^2.
        """
        axis = np.array(self.normal) / np.linalg.norm(self.normal)
        zero = np.eye(3)[2 if abs(axis[1]) > ALONG else 1]
        first = zero - (zero @ axis) * axis
        first /= np.linalg.norm(first)
        second, c, s = np.cross(axis, first), np.cos(phase_rad), np.sin(phase_rad)
        speed = np.sqrt(gm / self.radius_m) * (1.0 if self.sense == "right_handed" else -1.0)
        position, ahead = c * first + s * second, c * second - s * first
        return np.concatenate([self.radius_m * position, speed * ahead])


ALONG = 0.999999
"""Component of the normal from which on +Y has no part in the plane worth the name."""


class Boundary(Section):
    """Mean states before the first and after the last burn, body-centred."""

    frame: Literal["sun_north", "j2000"]
    """Axes of the four vectors, at the epoch for all of them; origin in the body."""
    initial_position_m: NonZeroVector
    """Mean position before the first burn in m, in boundary.frame."""
    initial_velocity_m_s: Velocity
    """Mean velocity before the first burn in m/s, in boundary.frame."""
    final_position_m: NonZeroVector
    """Mean position after the last burn in m, in boundary.frame."""
    final_velocity_m_s: Velocity
    """Mean velocity after the last burn in m/s, in boundary.frame."""
    final_sigma_position_m: Positive | None = None
    """Largest root of the summed variances of the position after the last burn in m, if limited."""
    final_sigma_velocity_m_s: Positive | None = None
    """Largest root of the summed variances of the velocity after the last burn in m/s, if limited."""
    home: HomeOrbit | None = None
    """Home orbit, in place of the four states, which follow from it: at the beginnings of its spans."""


class Design(Section):
    """Quantities that `python -m scp_recon design` may choose besides the phases of boundary.home.

    Without boundary.home the states hold at the epoch and at the last of burns.times_s, and burns alone
    move.
    """

    departure_s: tuple[Moment, Moment] | None = None
    """Earliest and latest first burn in s past epoch.tdb; the epoch itself if left out."""
    arrival_s: tuple[Moment, Moment] | None = None
    """Earliest and latest last burn in s past epoch.tdb; that of burns.times_s if left out."""
    burn_times: Literal["free", "given"] = "free"
    """Whether the burns between are moved within the schedule's rules, or stay as in burns.times_s."""

    @field_validator("departure_s", "arrival_s")
    @classmethod
    def _ascending(cls, span: tuple[float, float] | None) -> tuple[float, float] | None:
        if span is not None and span[0] > span[1]:
            raise ValueError("must ascend")
        return span
