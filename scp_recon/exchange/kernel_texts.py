"""Text kernels that go with a plan's binary ones: leap seconds, rotation, frames, clock, and the list.

With the list (NAME.tm) alone SPICE knows the plan's bodies, times and frames. Rotation, size and the
body's way about the Sun are those that the planner used. A mission's own kernels may know better: load
them after the plan's.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from scp_recon.exchange.heading import Export, heading
from scp_recon.physics.time_scales import (
    EB,
    FIRST_TAI_MINUS_UTC_S,
    K_S,
    LEAPS,
    M0,
    M1,
    TT_MINUS_TAI_S,
)

Value = float | str | Sequence[float | str]

TICKS_PER_S = 1_000_000
"""Of the spacecraft's clock, which runs with TDB."""
CLOCK_STARTS_S = -86_400.0
"""Past the scenario's epoch: a clock counts no negative seconds."""
STRING_MAX = 70
"""Characters of a string in a kernel: 80 at most."""
MONTHS = {1: "JAN", 7: "JUL"}
PUBLIC_FRAMES, PUBLIC_COUNT = 1_400_000, 600_000
"""From here on so many frame numbers are free for anyone."""


def frame_names(export: Export) -> tuple[str, str]:
    """Of the spacecraft's axes and of the body's, in the frame kernel."""
    return f"SC{abs(export.ids.spacecraft)}_AXES", f"B{export.ids.body}_FIXED"


def attitude_id(export: Export) -> int:
    """Of the spacecraft's axes in a CK."""
    return 1000 * export.ids.spacecraft


def leap_seconds(export: Export) -> str:
    """LSK."""
    dates: list[float | str] = []
    for i, (year, month) in enumerate(LEAPS):
        dates += [float(FIRST_TAI_MINUS_UTC_S + i), f"@{year}-{MONTHS[month]}-1"]
    entries: dict[str, Value] = {
        "DELTET/DELTA_T_A": TT_MINUS_TAI_S,
        "DELTET/K": K_S,
        "DELTET/EB": EB,
        "DELTET/M": (M0, M1),
        "DELTET/DELTA_AT": dates,
    }
    return _kernel("LSK", export, entries, ["Leap seconds by the IERS's Bulletin C 52 of 2016."])


def body_constants(export: Export) -> str:
    """PCK: the planner's rotation, gravitational parameter and size."""
    body, of = export.mission.scenario.body, f"BODY{export.ids.body}"
    radii = body.radii_m or (body.reference_radius_m,) * 3
    entries: dict[str, Value] = {
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
    return _kernel("PCK", export, entries, ["Angles in deg, deg/day, deg/day^2; km; km^3/s^2."])


def frames(export: Export) -> str:
    """FK: the spacecraft's axes by the CK, the body's by the PCK, and the names of both bodies."""
    craft, fixed = frame_names(export)
    ids, number, body_frame = (
        export.ids,
        attitude_id(export),
        PUBLIC_FRAMES + export.ids.body % PUBLIC_COUNT,
    )
    entries: dict[str, Value] = {
        f"FRAME_{craft}": number,
        f"FRAME_{number}_NAME": craft,
        f"FRAME_{number}_CLASS": 3,
        f"FRAME_{number}_CLASS_ID": number,
        f"FRAME_{number}_CENTER": ids.spacecraft,
        f"CK_{number}_SCLK": ids.spacecraft,
        f"CK_{number}_SPK": ids.spacecraft,
        f"FRAME_{fixed}": body_frame,
        f"FRAME_{body_frame}_NAME": fixed,
        f"FRAME_{body_frame}_CLASS": 2,
        f"FRAME_{body_frame}_CLASS_ID": ids.body,
        f"FRAME_{body_frame}_CENTER": ids.body,
        f"OBJECT_{ids.body}_FRAME": fixed,
        "NAIF_BODY_NAME": (_name(export.mission.scenario.name), _name(_body(export))),
        "NAIF_BODY_CODE": (ids.spacecraft, ids.body),
    }
    return _kernel("FK", export, entries, [f"{craft}: the vehicle's axes. {fixed}: body-fixed."])


def clock(export: Export) -> str:
    """SCLK: a clock that counts microseconds of TDB from a day before the scenario's epoch on."""
    of = f"_{abs(export.ids.spacecraft)}"
    start = float(export.et(np.array([CLOCK_STARTS_S]))[0])
    entries: dict[str, Value] = {
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
    return _kernel("SCLK", export, entries, ["Seconds and microseconds of TDB."])


def ticks(times_s: np.ndarray) -> np.ndarray:
    """Encoded clock of times past the scenario's epoch."""
    return np.round((times_s - CLOCK_STARTS_S) * TICKS_PER_S)


def meta_kernel(export: Export, files: Sequence[Path]) -> str:
    """MK: loads files, by their full paths."""
    parts: list[float | str] = []
    for file in files:
        path = str(file.resolve())
        pieces = [path[i : i + STRING_MAX] for i in range(0, len(path), STRING_MAX)]
        parts += [f"{piece}+" for piece in pieces[:-1]] + pieces[-1:]
    return _kernel("MK", export, {"KERNELS_TO_LOAD": parts}, ["furnsh this one alone."])


def _body(export: Export) -> str:
    return export.mission.scenario.body.name


def _name(name: str) -> str:
    """Letters, digits and underscores, short enough for SPICE."""
    return re.sub(r"[^A-Z0-9]+", "_", name.upper()).strip("_")[:36] or "UNNAMED"


def _kernel(kind: str, export: Export, entries: Mapping[str, Value], words: Sequence[str]) -> str:
    lines = [f"KPL/{kind}", "", *heading(export), *words, "", "\\begindata", ""]
    for key, value in entries.items():
        values = [value] if isinstance(value, str | int | float) else value
        shown = [_shown(item) for item in values]
        if len(shown) == 1:
            lines.append(f"{key} = {shown[0]}")
        else:
            lines += [f"{key} = (", *(f"  {item}" for item in shown), ")"]
    return "\n".join([*lines, "", "\\begintext", ""])


def _shown(value: float | str) -> str:
    if isinstance(value, str):
        return value if value.startswith("@") else "'{}'".format(value.replace("'", "''"))
    return repr(value)
