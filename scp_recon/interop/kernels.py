"""Write SPICE kernels of a plan: SPK of path and body, CK of the attitude, and text kernels.

SPK type 13, cubic Hermite, has one segment per coast: at a burn's epoch SPICE returns the state
after it. CK type 3 has one segment per mode. Within a mode SPICE turns evenly between attitudes.
The slew between modes is left out, because the controller chooses it. A mode begins a microsecond
early, so that its first instant belongs to it. Needs the extra [spice].

The meta-kernel (NAME.tm) alone gives SPICE the plan's bodies, times and frames. The body's
rotation, size and orbit are those of the planner. If a mission has better kernels of its own, load
them after the plan's.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from formulations.arrays import Array
from scp_recon.bodies.kernels import spice_alone
from scp_recon.errors import option
from scp_recon.interop.export import MARGIN_S, Export, heading, maker
from scp_recon.mission.schedule import Leg
from scp_recon.scenario.time_scales import (
    EB,
    FIRST_TAI_MINUS_UTC_S,
    K_S,
    LEAPS,
    M0,
    M1,
    TT_MINUS_TAI_S,
)
from scp_recon.simulation.guidance import FlightPlan

Segment = tuple[Any, ...]
"""Arguments of one of `WRITERS` after the file's handle."""
WRITERS = {"spk": "spkw13", "ck": "ckw03"}
"""SPICE's functions that write a segment."""

TICKS_PER_S = 1_000_000
"""Ticks per second of the spacecraft's clock, which runs with TDB."""
CLOCK_STARTS_S = -86_400.0
"""Start of the clock in s past the scenario's epoch, so that no reading is negative."""
STRING_MAX = 70
"""Characters per string in a kernel; SPICE allows 80."""
MONTHS = {1: "JAN", 7: "JUL"}
PUBLIC_FRAMES, PUBLIC_COUNT = 1_400_000, 600_000
"""First of the frame numbers that anyone may use, and how many there are."""
SUN, CUBIC = 10, 3
WITHIN_RAD, STEP_MAX_S = 1e-6, 60.0
"""Largest error of even turns between neighbouring attitudes, and longest step."""
TICK_S = 1.0 / TICKS_PER_S


def path_segments(export: Export) -> Iterator[Segment]:
    """Segments of an SPK of the spacecraft about the body, km and km/s, J2000."""
    for number, coast in enumerate(export.coasts):
        et, burn = export.et(coast.times_s), export.burns_flown + number
        name = f"AFTER BURN {burn}" if number else f"BEFORE BURN {burn + 1}"
        states = np.ascontiguousarray(coast.states / 1e3)
        ids = export.spacecraft, export.body, "J2000"
        yield (*ids, et[0], et[-1], name, CUBIC, len(et), states, et)


def body_segments(export: Export) -> Iterator[Segment]:
    """The segment of an SPK of the body about the Sun on the planner's straight line; likewise."""
    sun = export.mission.scenario.sun
    times = np.array([-MARGIN_S, export.coasts[-1].times_s[-1]])
    position, velocity = np.array(sun.body_position_km), np.array(sun.body_velocity_km_s)
    states = np.hstack([position + np.outer(times, velocity), np.tile(velocity, (2, 1))])
    et = export.et(times)
    yield export.body, SUN, "J2000", et[0], et[-1], "STRAIGHT LINE", CUBIC, len(et), states, et


def attitude_segments(export: Export, flight: FlightPlan) -> Iterator[Segment]:
    """Segments of a CK of the vehicle's commanded attitude and rates, from the first burn on."""
    for leg in flight.legs:
        times = command_times(flight, leg)
        times = np.append(times[0], times)
        to_axes = commanded(flight, leg, times).inv().as_quat(scalar_first=True)
        clock = ticks(times)
        clock[0] -= 1.0  # so that its first instant, however it is rounded, has this mode
        if leg is flight.legs[-1]:  # whose end no next one takes over
            clock[-1] += 1.0
        about = clock[0], clock[-1], attitude_id(export), "J2000", True, leg.mode.upper()
        yield (*about, len(times), clock, to_axes, _rates(flight, leg, times), 1, clock[:1])


def binary(export: Export, kind: Literal["spk", "ck"], segments: Iterable[Segment]) -> bytes:
    """The content of an SPK or a CK.

    Raises:
        InputError: if spiceypy is missing.
        OSError: if there is no room for a temporary file.
    """
    lines = heading(export)
    with spice_alone(option("format")) as spice, TemporaryDirectory() as folder:
        file = Path(folder) / kind
        try:
            room = sum(len(line) + 1 for line in lines)
            handle = getattr(spice, f"{kind}opn")(str(file), maker(), room)
            try:
                spice.dafac(handle, lines)
                for segment in segments:
                    getattr(spice, WRITERS[kind])(handle, *segment)
            finally:
                spice.dafcls(handle)
        except spice.SpiceyError as error:
            raise OSError(f"{kind.upper()}: {error.short}") from None
        return file.read_bytes()


def commanded(flight: FlightPlan, leg: Leg, times: Array) -> Rotation:
    """Commanded attitudes of a mode, from the vehicle's axes to J2000; its end a tick early."""
    return flight.attitudes(np.clip(times, leg.start_s, leg.end_s - TICK_S))


def command_times(flight: FlightPlan, leg: Leg) -> Array:
    """Times from a mode's start to its end, s, as dense as its rotation needs."""
    count = max(int(np.ceil((leg.end_s - leg.start_s) / STEP_MAX_S)), 1)
    while True:
        times = np.linspace(leg.start_s, leg.end_s, count + 1)
        at = commanded(flight, leg, times)
        middle = commanded(flight, leg, 0.5 * (times[:-1] + times[1:]))
        half = Rotation.from_rotvec(0.5 * (at[1:] * at[:-1].inv()).as_rotvec()) * at[:-1]
        if float((half * middle.inv()).magnitude().max()) <= WITHIN_RAD:
            return times
        count *= 2


def _rates(flight: FlightPlan, leg: Leg, times: Array) -> Array:
    """Angular velocities of the axes, J2000, rad/s, shape (n, 3), by differences of a second."""
    early = np.maximum(times - 0.5, leg.start_s)
    late = np.minimum(times + 0.5, leg.end_s - TICK_S)
    turned = commanded(flight, leg, late) * commanded(flight, leg, early).inv()
    return turned.as_rotvec() / (late - early)[:, None]


def frame_names(export: Export) -> tuple[str, str]:
    """Names of the spacecraft's and the body's axes in the frame kernel."""
    return f"SC{abs(export.spacecraft)}_AXES", f"B{export.body}_FIXED"


def attitude_id(export: Export) -> int:
    """Number of the spacecraft's axes in a CK."""
    return 1000 * export.spacecraft


def leap_seconds(export: Export) -> str:
    """Text of the LSK: leap seconds."""
    dates: list[float | str] = []
    for offset, (year, month) in enumerate(LEAPS, start=FIRST_TAI_MINUS_UTC_S):
        dates += [float(offset), f"@{year}-{MONTHS[month]}-1"]
    entries = {
        "DELTET/DELTA_T_A": TT_MINUS_TAI_S,
        "DELTET/K": K_S,
        "DELTET/EB": EB,
        "DELTET/M": (M0, M1),
        "DELTET/DELTA_AT": dates,
    }
    return _kernel("LSK", export, entries, "Leap seconds by the IERS's Bulletin C 52 of 2016.")


def body_constants(export: Export) -> str:
    """Text of the PCK: the planner's rotation, gravitational parameter and size."""
    body, of = export.mission.scenario.body, f"BODY{export.body}"
    radii = body.radii_m or (body.reference_radius_m,) * 3
    entries = {
        f"{of}_POLE_RA": (body.pole_ra_deg, 0.0, 0.0),
        f"{of}_POLE_DEC": (body.pole_dec_deg, 0.0, 0.0),
        f"{of}_PM": (
            body.prime_meridian_deg,
            body.prime_meridian_rate_deg_day,
            body.prime_meridian_acceleration_deg_day2,
        ),
        f"{of}_RADII": [radius / 1e3 for radius in radii],
        f"{of}_GM": body.gm_m3_s2 / 1e9,
    }
    return _kernel("PCK", export, entries, "Angles in deg, deg/day, deg/day^2; km; km^3/s^2.")


def frames(export: Export) -> str:
    """Text of the FK: the spacecraft's axes by the CK, the body's by the PCK, both bodies' names."""
    craft, fixed = frame_names(export)
    number = attitude_id(export)
    body_frame = PUBLIC_FRAMES + export.body % PUBLIC_COUNT
    entries = {
        f"FRAME_{craft}": number,
        f"FRAME_{number}_NAME": craft,
        f"FRAME_{number}_CLASS": 3,
        f"FRAME_{number}_CLASS_ID": number,
        f"FRAME_{number}_CENTER": export.spacecraft,
        f"CK_{number}_SCLK": export.spacecraft,
        f"CK_{number}_SPK": export.spacecraft,
        f"FRAME_{fixed}": body_frame,
        f"FRAME_{body_frame}_NAME": fixed,
        f"FRAME_{body_frame}_CLASS": 2,
        f"FRAME_{body_frame}_CLASS_ID": export.body,
        f"FRAME_{body_frame}_CENTER": export.body,
        f"OBJECT_{export.body}_FRAME": fixed,
        "NAIF_BODY_NAME": (
            _name(export.mission.scenario.name),
            _name(export.mission.scenario.body.name),
        ),
        "NAIF_BODY_CODE": (export.spacecraft, export.body),
    }
    return _kernel("FK", export, entries, f"{craft}: the vehicle's axes. {fixed}: body-fixed.")


def clock(export: Export) -> str:
    """Text of the SCLK: microseconds of TDB from a day before the scenario's epoch on."""
    of = f"_{abs(export.spacecraft)}"
    start = float(export.et(np.array([CLOCK_STARTS_S]))[0])
    entries = {
        "SCLK_KERNEL_ID": "@2000-JAN-1",
        f"SCLK_DATA_TYPE{of}": 1,
        f"SCLK01_TIME_SYSTEM{of}": 1,
        f"SCLK01_N_FIELDS{of}": 2,
        f"SCLK01_MODULI{of}": (1e10, TICKS_PER_S),
        f"SCLK01_OFFSETS{of}": (0, 0),
        f"SCLK01_OUTPUT_DELIM{of}": 1,
        f"SCLK_PARTITION_START{of}": 0.0,
        f"SCLK_PARTITION_END{of}": 1e10 * TICKS_PER_S,
        f"SCLK01_COEFFICIENTS{of}": (0.0, start, 1.0),
    }
    return _kernel("SCLK", export, entries, "Seconds and microseconds of TDB.")


def ticks(times_s: np.ndarray) -> np.ndarray:
    """Encoded clock of times in s past the scenario's epoch."""
    return np.round((times_s - CLOCK_STARTS_S) * TICKS_PER_S)


def meta_kernel(export: Export, names: Sequence[str]) -> str:
    """Text of the meta-kernel that loads files of these names from its folder."""
    parts: list[float | str] = []
    for name in names:
        path = f"$HERE/{name}"
        pieces = [path[i : i + STRING_MAX] for i in range(0, len(path), STRING_MAX)]
        parts += [f"{piece}+" for piece in pieces[:-1]] + pieces[-1:]
    entries = {"PATH_VALUES": ".", "PATH_SYMBOLS": "HERE", "KERNELS_TO_LOAD": parts}
    words = "furnsh this one alone, with its folder as the current one;"
    return _kernel(
        "MK", export, entries, words, "from elsewhere put that folder in place of the point."
    )


def _name(name: str) -> str:
    """A name in letters, digits and underscores, short enough for SPICE."""
    return re.sub(r"[^A-Z0-9]+", "_", name.upper()).strip("_")[:36] or "UNNAMED"


def _kernel(kind: str, export: Export, entries: Mapping[str, Any], *words: str) -> str:
    lines = [f"KPL/{kind}", "", *heading(export), *words, "", "\\begindata", ""]
    for key, value in entries.items():
        values = [value] if isinstance(value, str | int | float) else value
        shown = [_shown(item) for item in values]
        if len(shown) == 1:
            lines.append(f"{key} = {shown[0]}")
        else:
            lines += [f"{key} = (", *(f"  {item}" for item in shown), ")"]
    return "\n".join([*lines, "", "\\begintext", ""])


def _shown(value: object) -> str:
    if isinstance(value, str):
        return value if value.startswith("@") else "'{}'".format(value.replace("'", "''"))
    return repr(value)
