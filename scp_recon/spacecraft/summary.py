"""The summary of a simulated flight, as it stands in its file. SI, with angles in degrees."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from scp_recon.scenario.fields import Line
from scp_recon.solution.part import File, Part

SCHEMA = "scp_recon.simulation/1"

Count = Annotated[int, Field(ge=0)]
Vector = tuple[float, float, float]


class ModeOutcome(Part):
    """A mode against the schedule's rules; `settled_s` is null if it never was steady."""

    mode: Line
    start_s: float
    duration_s: float
    required_s: float
    ok: bool
    settled_s: float | None
    settled_in_time: bool


class FlownBurn(Part):
    """A burn as planned and as executed, J2000."""

    t_s: float
    duration_s: float
    planned_m_s: Vector
    executed_m_s: Vector
    pointing_deg: float
    executed_pointing_deg: float


class Angles(Part):
    """Mean and quantiles of an angle, degrees."""

    mean: float
    q50: float
    q95: float
    q997: Annotated[float, Field(alias="q99.7")]
    q100: float


class WindowPointing(Part):
    """Of the camera in the observation window: against its command, and against the site."""

    camera: Angles
    site: Angles


class Energy(Part):
    """Totals of the bus, Wh."""

    generated: float
    consumed: float
    lost: float
    unused: float
    short: float


class TerminalMiss(Part):
    """Distance from the planned final state."""

    position_m: float
    velocity_m_s: float


class FlightSummary(File):
    """What a simulated flight came to; the hashes are those of what was flown, null in older files."""

    vehicle: Line
    seed: Count
    plan_hash: Line | None = None
    inputs_sha256: Line | None = None
    modes: tuple[Line, ...]
    legs: tuple[ModeOutcome, ...]
    burns: tuple[FlownBurn, ...]
    window_pointing_deg: WindowPointing
    estimate_deg: Angles
    least_charge: float
    floor_charge: float
    energy_wh: Energy
    ledger_error: float
    dumps: Count
    terminal_miss: TerminalMiss
    within_3_sigma: float
    largest_sigma_distance: float

    def entries(self) -> dict[str, Any]:
        """What the file holds."""
        return {"schema": SCHEMA, **self.model_dump(mode="json", by_alias=True)}
