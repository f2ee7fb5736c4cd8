"""SPICE's binary kernels of a plan: SPK of path and body, CK of the attitude that is commanded.

SPK type 13, cubic Hermite, one segment a coast: at a burn's epoch SPICE answers with the state after
it, just before it with one that leads there. CK type 3, one segment a mode: within a mode SPICE turns
evenly between attitudes, and nothing spans the slew from one mode's attitude to the next one's, which
is the controller's; a mode begins a microsecond early, so that its first instant is its own. Needs
the extra [spice].
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from scp_recon.errors import needing
from scp_recon.exchange.heading import Export, heading, maker
from scp_recon.exchange.kernel_texts import TICKS_PER_S, attitude_id, ticks
from scp_recon.exchange.path import MARGIN_S
from scp_recon.mission.schedule import Leg
from scp_recon.spacecraft.guidance import FlightPlan

Array = npt.NDArray[np.float64]

SUN, CUBIC = 10, 3
WITHIN_RAD, STEP_MAX_S = 1e-6, 60.0
"""Even turns between neighbouring attitudes are so near to what is commanded; and the longest step."""
TICK_S = 1.0 / TICKS_PER_S


def write_spk(export: Export, path: Path) -> None:
    """The spacecraft about the body, km and km/s, J2000.

    Raises:
        InputError: if spiceypy is missing.
        OSError: if it cannot be written.
    """
    spice = needing_spice()

    def fill(handle: int) -> None:
        for number, coast in enumerate(export.path.coasts):
            et, burn = export.et(coast.times_s), export.burns_flown + number
            spice.spkw13(
                handle, export.ids.spacecraft, export.ids.body, "J2000",
                et[0], et[-1], f"AFTER BURN {burn}" if number else f"BEFORE BURN {burn + 1}",
                CUBIC, len(et), np.ascontiguousarray(coast.states / 1e3), et,
            )  # fmt: skip

    _write(path, export, spice.spkopn, spice.spkcls, fill)


def write_body_spk(export: Export, path: Path) -> None:
    """The body about the Sun as the planner has it: on a straight line, km and km/s, J2000.

    Raises:
        InputError: if spiceypy is missing.
        OSError: if it cannot be written.
    """
    spice, sun = needing_spice(), export.mission.scenario.sun
    times = np.array([-MARGIN_S, export.path.coasts[-1].times_s[-1]])
    position, velocity = np.array(sun.body_position_km), np.array(sun.body_velocity_km_s)
    states = np.hstack([position + np.outer(times, velocity), np.tile(velocity, (2, 1))])

    def fill(handle: int) -> None:
        et = export.et(times)
        spice.spkw13(
            handle, export.ids.body, SUN, "J2000", et[0], et[-1], "STRAIGHT LINE",
            CUBIC, len(et), states, et,
        )  # fmt: skip

    _write(path, export, spice.spkopn, spice.spkcls, fill)


def write_ck(export: Export, flight: FlightPlan, path: Path) -> None:
    """The attitude that is commanded, of the vehicle's axes, and its rates, from the first burn on.

    Raises:
        InputError: if spiceypy is missing.
        OSError: if it cannot be written.
    """
    spice = needing_spice()

    def fill(handle: int) -> None:
        for leg in flight.legs:
            times = command_times(flight, leg)
            times = np.append(times[0], times)
            to_axes = np.ascontiguousarray(commanded(flight, leg, times).inv().as_matrix())
            clock = ticks(times)
            clock[0] -= 1.0  # so that its first instant, however it is rounded, has this mode
            if leg is flight.legs[-1]:  # whose end no next one takes over
                clock[-1] += 1.0
            spice.ckw03(
                handle, clock[0], clock[-1], attitude_id(export), "J2000", True, leg.mode.upper(),
                len(times), clock, np.array([spice.m2q(matrix) for matrix in to_axes]),
                _rates(flight, leg, times), 1, clock[:1],
            )  # fmt: skip

    _write(path, export, spice.ckopn, spice.ckcls, fill)


def commanded(flight: FlightPlan, leg: Leg, times: Array) -> Rotation:
    """Attitudes of a mode, from the vehicle's axes to J2000; at its end those of a tick before."""
    return flight.attitudes(np.clip(times, leg.start_s, leg.end_s - TICK_S))


def command_times(flight: FlightPlan, leg: Leg) -> Array:
    """From a mode's start to its end, as dense as its turning needs, s."""
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


def _write(
    path: Path,
    export: Export,
    begin: Callable[[str, str, int], int],
    end: Callable[[int], None],
    fill: Callable[[int], None],
) -> None:
    """Beside the target first, and then in its place."""
    spice, beside = needing_spice(), path.with_name(f".{uuid4().hex}")
    lines = heading(export)
    try:
        handle = begin(str(beside), maker(), sum(len(line) + 1 for line in lines))
        try:
            spice.dafac(handle, lines)
            fill(handle)
        except BaseException:
            spice.dafcls(handle)
            raise
        end(handle)
        beside.replace(path)
    except spice.SpiceyError as error:
        raise OSError(f"{path}: {error.short}") from None
    finally:
        beside.unlink(missing_ok=True)


def needing_spice(entry: str = "--format") -> Any:
    """The module spiceypy.

    Raises:
        InputError: if there is none.
    """
    with needing(entry, "spice", "spiceypy"):
        import spiceypy
    return spiceypy
