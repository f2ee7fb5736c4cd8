"""Define the tables `[uncertainty]`, `[navigation]`, `[policy]` and `[in_flight]`.

They say how well states and burns are known, and how burns are corrected in flight.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from formulations.arrays import Array
from formulations.problem.controls import Cost
from scp_recon.scenario.fields import (
    Component,
    FlightTime,
    NonZeroVector,
    Section,
    Share,
    Sparse,
    Velocity,
    zero_or_at_least,
)

MATRIX_TOLERANCE = 1e-6
"""Tolerance of a covariance over the product of its two sigmas: rounding of printed digits."""

LEAST_EIGENVALUE = 1e-10
"""Least eigenvalue of a measurement's correlations: below, weights by the inverse lose all digits."""

LEAST_SIGMA, LARGEST_SIGMA = 1e-12, 1e12
"""In m or m/s, of a sigma that is not zero: squares of others are lost in rounding, or overflow."""


def _covariance(rows: tuple[tuple[float, ...], ...]) -> Any:
    """Validate a covariance: six by six, symmetric and positive semidefinite as correlations."""
    if [len(row) for row in rows] != 6 * [6]:
        raise ValueError("must have 6 rows of 6 numbers: three of position, three of velocity")
    check_covariance(rows)
    return rows


def check_covariance(rows: tuple[tuple[float, ...], ...]) -> None:
    """Validate that a square matrix is symmetric and positive semidefinite as correlations.

    Raises:
        ValueError: saying what it must be, and where it is not.
    """
    matrix = np.array(rows)
    variance = np.diag(matrix)
    if np.any(variance < 0.0):
        worst = int(np.argmin(variance))
        raise ValueError(
            f"must have no negative variance: entry {worst + 1},{worst + 1} is {variance[worst]:g}"
        )
    sigma = np.sqrt(variance)
    if np.any((sigma > 0.0) & (sigma < LEAST_SIGMA)):
        raise ValueError(f"must have sigmas that are 0 or at least {LEAST_SIGMA:g}")
    if np.any(matrix[(sigma == 0.0)[:, None] | (sigma == 0.0)]):
        raise ValueError("must have zeros beside a variance of zero")
    known = np.where(sigma > 0.0, sigma, 1.0)
    scaled = matrix / np.outer(known, known)
    apart = np.abs(scaled - scaled.T)
    if apart.max() > MATRIX_TOLERANCE:
        i, j = sorted(divmod(int(np.argmax(apart)), len(matrix)))
        raise ValueError(
            f"must be symmetric: entries {i + 1},{j + 1} and {j + 1},{i + 1} are "
            f"{matrix[i, j]:g} and {matrix[j, i]:g}"
        )
    least = _least_eigenvalue(scaled)
    if least < -MATRIX_TOLERANCE:
        raise ValueError(
            "must be positive semidefinite: the smallest eigenvalue of its correlations is "
            f"{least:.3g}, below -{MATRIX_TOLERANCE:g}"
        )


def _of_a_measurement(rows: tuple[tuple[float, ...], ...]) -> Any:
    """Validate a measurement's covariance, whose inverse is a weight."""
    matrix = np.array(rows)
    sigma = np.sqrt(np.diag(matrix))
    if not sigma.all() or _least_eigenvalue(matrix / np.outer(sigma, sigma)) < LEAST_EIGENVALUE:
        raise ValueError(
            "must be positive definite: no state is measured without an error; a sigma that hardly "
            "counts will do"
        )
    return rows


def _least_eigenvalue(matrix: Array) -> float:
    return float(np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[0])


ZeroOrSome = zero_or_at_least(LEAST_SIGMA)
Sigma = Annotated[float, Field(ge=0, le=LARGEST_SIGMA), ZeroOrSome]
MeasuredSigma = Annotated[float, Field(ge=LEAST_SIGMA, le=LARGEST_SIGMA)]
Sigmas = tuple[Sigma, Sigma, Sigma]
Matrix = Annotated[tuple[tuple[Component, ...], ...], AfterValidator(_covariance)]
MeasuredMatrix = Annotated[Matrix, AfterValidator(_of_a_measurement)]
FixedError = Annotated[float, Field(ge=0, le=1e6), ZeroOrSome]
SmallAngle = Annotated[float, Field(ge=0, le=0.2), ZeroOrSome]
"""In rad: beyond it pointing errors are not linear any more, by 2 %, and degrees were meant."""
Frame = Literal["j2000", "sun_north", "rtn", "body_fixed"]


Interval = tuple[FlightTime, FlightTime]


class Gates(Section):
    """Gates' model of execution errors, 1 sigma; pointing per axis across the burn.

    C. R. Gates, "A simplified model of midcourse maneuver execution errors", JPL TR 32-504, 1963. The
    bias is a fraction of the magnitude that all burns have in common.
    """

    magnitude_fixed_m_s: FixedError
    """Error along a burn that does not grow with it, 1 sigma in m/s."""
    magnitude_proportional: Share
    """Error along a burn over its size, 1 sigma."""
    pointing_fixed_m_s: FixedError
    """Error across a burn that does not grow with it, 1 sigma of either axis in m/s."""
    pointing_proportional_rad: SmallAngle
    """Error of a burn's direction, 1 sigma of either axis in rad."""
    magnitude_bias: Share = 0.0
    """Error along the burns over their size that all have in common, 1 sigma."""


Way = tuple[str, ...]
"""Keys that say a quantity together."""


class OneWay(Sparse):
    """A table that says each of its quantities in one of several ways, and leaves the others out."""

    WAYS: ClassVar[Mapping[str, tuple[Way, ...]]] = {}
    """Ways to give each quantity."""
    REQUIRED: ClassVar[bool] = True
    """Whether each quantity has to be given."""

    @model_validator(mode="after")
    def _each_in_one_way(self) -> Self:
        for what, ways in self.WAYS.items():
            given = [
                w for w in ways if any(getattr(self, key) is not None for key in _own(w, ways))
            ]
            if len(given) > 1 or (self.REQUIRED and not given):
                either = ", or ".join(" with ".join(way) for way in ways)
                found = " and ".join(" with ".join(way) for way in given) or "nothing"
                raise ValueError(f"must give the {what} in one way, {either}; not {found}")
            missing = [key for way in given for key in way if getattr(self, key) is None]
            if missing:
                raise ValueError(f"must have {', '.join(missing)} too, for the {what}")
        return self

    @classmethod
    def without_other_ways(
        cls, base: Mapping[str, Any], changes: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Such a table of a base without the ways that the changes to it replace."""
        kept = dict(base)
        for ways in cls.WAYS.values():
            taken = [way for way in ways if _own(way, ways) & changes.keys()]
            if taken and any(_own(w, ways) & kept.keys() for w in ways if w not in taken):
                for key in {key for way in ways for key in way}:
                    kept.pop(key, None)
        return kept


def _own(way: Way, ways: tuple[Way, ...]) -> set[str]:
    """Keys that belong to this way alone."""
    return set(way) - {key for other in ways if other != way for key in other}


class Uncertainty(OneWay):
    """1-sigma errors of the initial state, in one of three ways, and of the burns, in one of two.

    The initial state: as a fraction of each J2000 component; or absolute, by component of a frame; or
    as a covariance in a frame, m and m/s. Velocities are relative to J2000 in every frame; only their
    axes are the frame's. A burn: as a fraction of each J2000 component, or by Gates' model.
    """

    WAYS: ClassVar[Mapping[str, tuple[Way, ...]]] = {
        "initial state's uncertainty": (
            ("initial_sigma_fraction",),
            ("initial_sigma_position_m", "initial_sigma_velocity_m_s", "initial_frame"),
            ("initial_covariance", "initial_frame"),
        ),
        "execution errors": (("execution_error",), ("gates",)),
    }

    initial_sigma_fraction: Share | None = None
    """1 sigma of each J2000 component of the initial state over its size."""
    initial_sigma_position_m: Sigmas | None = None
    """1 sigma of the initial position along the axes of initial_frame in m."""
    initial_sigma_velocity_m_s: Sigmas | None = None
    """1 sigma of the initial velocity along the axes of initial_frame in m/s."""
    initial_covariance: Matrix | None = None
    """Covariance of the initial state, six by six, position first, in m and m/s along initial_frame."""
    initial_frame: Frame | None = None
    """Axes of sigmas or covariance, at the epoch: rtn are radial, transverse and normal."""
    execution_error: Share | None = None
    """1 sigma of each J2000 component of a burn over its size."""
    gates: Gates | None = None
    """Execution errors by Gates' model, in the place of execution_error."""

    @model_validator(mode="after")
    def _fractions_have_axes(self) -> Self:
        if self.initial_frame is not None and self.initial_sigma_fraction is not None:
            raise ValueError("must have no initial_frame: a fraction is of the J2000 components")
        return self

    @classmethod
    def none(cls) -> Self:
        """No errors at all."""
        return cls(initial_sigma_fraction=0.0, execution_error=0.0)

    @property
    def errors(self) -> Literal["componentwise", "gates"]:
        """The model of the execution errors."""
        return "componentwise" if self.gates is None else "gates"

    @property
    def execution(self) -> str:
        """The execution errors in words."""
        if self.gates is None:
            return f"execution error {self.execution_error:g}"
        g = self.gates
        bias = f", bias {g.magnitude_bias:g}" if g.magnitude_bias else ""
        return (
            f"execution errors by Gates: magnitude {1e3 * g.magnitude_fixed_m_s:g} mm/s and "
            f"{g.magnitude_proportional:g}, pointing {1e3 * g.pointing_fixed_m_s:g} mm/s and "
            f"{g.pointing_proportional_rad:g} rad{bias}"
        )


class Contacts(OneWay):
    """Contacts with the ground, which bring data down and commands up, in place of one lead.

    By its end a contact brings down what was measured before it began. A burn uses the last contact
    that ends a turnaround before it; one that is commanded on board uses all data, as navigation.lead_s
    says. A contact that brings nothing new to a burn corrects nothing.
    """

    WAYS: ClassVar[Mapping[str, tuple[Way, ...]]] = {
        "times of contacts": (("windows_s",), ("every_s",))
    }

    windows_s: Annotated[tuple[Interval, ...], Field(min_length=1, max_length=1000)] | None = None
    """Beginning and end of each contact in s after the epoch, in order."""
    every_s: Annotated[float, Field(ge=60.0, le=1e7)] | None = None
    """From one contact to the next in s."""
    first_s: FlightTime | None = None
    """Beginning of the first contact in s after the epoch, with every_s; 0 if left out."""
    length_s: FlightTime | None = None
    """Length of a contact in s, with every_s; 0 if left out."""
    turnaround_s: FlightTime
    """From the end of a contact to the earliest burn that uses its data in s."""
    onboard: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)] | None = None
    """Numbers from 1 of burns that are commanded on board."""
    what_if_lost: Literal["any"] | None = None
    """With "any" a verification flies the plan without each contact, too: its burn is then commanded
    from earlier data."""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.windows_s is not None:
            if self.first_s is not None or self.length_s is not None:
                raise ValueError("must have first_s and length_s with every_s alone")
            bounds = [time for window in self.windows_s for time in window]
            if bounds != sorted(bounds):
                raise ValueError(
                    "windows_s must be in order, each with its beginning before its end"
                )
        elif self.every_s is not None and (self.length_s or 0.0) >= self.every_s:
            raise ValueError(f"length_s must be below every_s, {self.every_s:g} s")
        return self

    def last_before(self, time_s: float) -> tuple[float, float] | None:
        """The last contact, beginning and end, whose data a burn at a time can use, s."""
        latest = time_s - self.turnaround_s
        if self.windows_s is not None:
            return max((one for one in self.windows_s if one[1] <= latest), default=None)
        first, length, every = self.first_s or 0.0, self.length_s or 0.0, self.every_s or 0.0
        number = math.floor((latest - length - first) / every)
        begin = first + number * every
        return (begin, begin + length) if number >= 0 else None

    def past(self, shift_s: float) -> dict[str, Any]:
        """Entries of the contacts that begin at a time or later, in s after that time."""
        if self.windows_s is not None:
            later = [one for one in self.windows_s if one[0] >= shift_s]
            return {"windows_s": [(begin - shift_s, end - shift_s) for begin, end in later]}
        first, every = (self.first_s or 0.0) - shift_s, self.every_s or 1.0
        return {"first_s": first if first >= 0.0 else first % every}


class Landmarks(Section):
    """Pictures of mapped landmarks, from which the state at each cut-off is determined along the plan.

    A camera points to the body's centre, and its attitude is known. Landmarks lie evenly on the body,
    an ellipsoid if body.radii_m are given, else a sphere of reference_radius_m. A picture has lines of
    sight to those that are lit, visible and in the field. A burn uses the pictures up to its cut-off,
    the time of the last one. Errors of the map are the same in all pictures.
    """

    number: Annotated[int, Field(ge=3, le=100)]
    """Landmarks on the lit and visible side of the body, a half of it where the Sun is behind."""
    map_error_m: Annotated[float, Field(ge=1e-6, le=1e5)]
    """1 sigma of each component of a landmark's position in m, body-fixed and constant."""
    every_s: Annotated[float, Field(ge=60.0, le=1e7)]
    """From one picture to the next in s; the first one is taken at the epoch."""
    pixel_error: Annotated[float, Field(ge=1e-4, le=100.0)]
    """1 sigma of a landmark's place in a picture along each axis, in pixels."""
    field_of_view_deg: Annotated[float, Field(ge=0.01, le=120.0)]
    """Full angle of the camera's square field of view in deg."""
    pixels: Annotated[int, Field(ge=16, le=100_000)]
    """Pixels across the field."""

    def last_by(self, time_s: float) -> float:
        """The last picture at a time or before, s; infinitely early if there is none."""
        if time_s < 0.0:
            return -math.inf
        return self.every_s * math.floor(time_s / self.every_s * (1.0 + 1e-12))


class Navigation(OneWay):
    """Measurement of the state before each burn, at a cut-off, with errors independent of all others.

    The errors are 1-sigma figures, the same along every axis; a covariance; or those of pictures of
    landmarks, in place of both. Without them nothing is measured: the lead alone counts, of plans that
    are made again in flight.
    """

    WAYS: ClassVar[Mapping[str, tuple[Way, ...]]] = {
        "measurement's errors": (
            ("sigma_position_m", "sigma_velocity_m_s"),
            ("covariance",),
            ("landmarks",),
        )
    }
    REQUIRED: ClassVar[bool] = False

    lead_s: FlightTime = 3600.0
    """From the cut-off to its burn in s, which is the least time that a decision takes in flight."""
    sigma_position_m: MeasuredSigma | None = None
    """1 sigma of the measured position along each axis in m."""
    sigma_velocity_m_s: MeasuredSigma | None = None
    """1 sigma of the measured velocity along each axis in m/s."""
    covariance: MeasuredMatrix | None = None
    """Covariance of the measured state, six by six, position first, in m and m/s, J2000."""
    estimate_parameters: bool | None = None
    """Whether the filter estimates the uncertain parameters of `knowledge` with the state, the default;
    or considers their errors without estimating them (Schmidt)."""
    landmarks: Landmarks | None = None
    """Pictures from which the state is determined."""
    contacts: Contacts | None = None
    """When data come down and commands go up; any time if left out."""

    @property
    def measures(self) -> bool:
        """Whether anything is measured."""
        given = self.sigma_position_m, self.covariance, self.landmarks
        return any(one is not None for one in given)


class Policy(Section):
    """Whether burns act on what is learnt in flight, and what a plan that does so makes least."""

    kind: Literal["open", "feedback"] = "open"
    """With "open" all burns are fixed before departure. With "feedback" each that has a cut-off in the
    flight is its nominal value and gains times the deviation estimated there."""
    cost: Cost = "dv99"
    """Sum of the burns' sizes that a plan with feedback makes least: its own, the mean, or the 99 %
    quantile."""


class InFlight(Section):
    """State of a flight under way, after the burns flown; the other tables are those before the flight.

    Times count from the epoch of the scenario. Burns at or before the state's time are flown, and the
    state is after them. Axes are those at the epoch; velocities are relative to J2000 in every frame.
    """

    at_s: FlightTime
    """Time of the state in s after the epoch."""
    frame: Literal["j2000", "sun_north"] = "j2000"
    """Axes of the state."""
    position_m: NonZeroVector
    """Mean position in m, body-centred, in in_flight.frame."""
    velocity_m_s: Velocity
    """Mean velocity in m/s, in in_flight.frame."""
    covariance: Matrix | None = None
    """Covariance of the state, six by six, in m and m/s; the initial state's if left out."""
    covariance_frame: Literal["j2000", "sun_north", "rtn"] = "j2000"
    """Axes of the covariance: rtn are radial, transverse and normal of the state."""
    flown_m_s: Annotated[tuple[Velocity, ...], Field(min_length=1, max_length=64)]
    """Burns flown so far in m/s, J2000: as planned, or as measured."""
