"""The table `[in_flight]`: where a flight is that is under way, and what it has flown."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from scp_recon.scenario.fields import FlightTime, NonZeroVector, Section, Velocity
from scp_recon.scenario.uncertainty import Matrix


class InFlight(Section):
    """State after the burns that have been flown; all else stays as it was before the flight.

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
