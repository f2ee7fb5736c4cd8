"""Define the tables `[boundary]` and `[design]`: ends of a flight, and free quantities of a design."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from formulations.arrays import Array
from scp_recon.scenario.fields import Line, NonZeroVector, Positive, Section, Velocity

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
