"""Read trajectories and bodies from SPICE kernels and tables; doubt trajectories of any source.

States must be in J2000 axes about the requested body: another frame or centre is refused. Other
doubts about a trajectory become warnings, which are kept with the plan.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, timedelta
from itertools import compress
from pathlib import Path

import numpy as np

from scp_recon.bodies.catalogue import DAY_S, J2000_TDB, PackagedBody
from scp_recon.bodies.kernels import number_of, read_gm, read_heliocentric, read_pck, read_states
from scp_recon.drafting.draft import Entry, Tables, Track
from scp_recon.errors import InputError, option
from scp_recon.files import read_text
from scp_recon.mission.mission import Mission
from scp_recon.physics.flow import propagate
from scp_recon.planning.initial_guess import read_table
from scp_recon.scenario.fields import ScenarioWarning

SPICE, CSV = (option(f"from_{form}") for form in ("spice", "csv"))
STEP_S, STATES_MAX = 30.0, 100_000
"""Step between states read from kernels, s."""
STATES, SUBSTEPS = 60, 20
"""Number of states propagated from each to the next; and steps of RK4 between two."""
PULL_OFF_MAX = 0.3
"""Largest median relative difference between the trajectory's change of velocity and the planner's."""
GAP_MAX = 10.0
"""Largest step, in usual steps, that is not a gap."""
SPREAD_MAX, APART_MAX = 0.5, 1e-3
"""Tolerances of positions against velocities, relative to the step and to the radius."""
LATE_MAX_S = 1.0
"""Tolerance of a trajectory's ends against the requested times, s."""
BESIDE_S, JUMP_MAX_M_S = 1.0, 1e-3
"""Time from an end within which a burn is sought, s, and the least jump that is a burn, m/s."""


def spice_track(meta: Path, spacecraft: int, body: int, span: tuple[datetime, datetime]) -> Track:
    """Read a spacecraft's track from kernels, between two dates in TDB.

    Raises:
        InputError: if the kernels cannot be read or do not cover the dates, or the dates do not ascend.
    """
    begin, end = span
    duration = (end - begin).total_seconds()
    count = int(np.ceil(duration / STEP_S)) + 1
    if not 1 < count <= STATES_MAX:
        raise InputError(
            option("end"),
            f"{duration:g} s after --from",
            f"must be later by {STEP_S:g} to {STEP_S * STATES_MAX:g} s",
        )
    times = np.linspace(0.0, duration, count)
    states = read_states([meta], spacecraft, body, _et(begin) + times, SPICE)
    doubts = tuple(jump_doubts(meta, spacecraft, body, (_et(begin), _et(end)), SPICE))
    source = f"from {meta.name}, spacecraft {spacecraft}"
    return Track(begin, times, states, source, doubts, entry=f"{SPICE} {meta}")


def spice_body(
    meta: Path, name: str, known: PackagedBody | None, when: datetime
) -> tuple[int, float, Tables]:
    """Number, reference radius in m, and the tables `[body]` and `[sun]` of a body, from kernels.

    If the kernels lack GM, it is that of the packaged body of that name. No kernel has J2, so J2 is
    always that of the packaged body, or zero without one.

    Raises:
        InputError: if the kernels cannot be read or lack rotation, GM, size or heliocentric state.
    """
    number = known.entries["naif_id"] if known else number_of([meta], name, SPICE)
    if number is None:
        raise InputError(option("body"), name, f"must be a packaged body, or one that {meta} names")
    days = _et(when) / DAY_S
    try:
        rotation = read_pck(meta, number, days)
        position, velocity = read_heliocentric([meta], number, _et(when))
    except InputError as error:
        raise InputError(SPICE, error.given, error.allowed) from None
    gm, source = read_gm([meta], number, SPICE), f"from {meta.name}"
    packaged = known.entries if known else {}
    radii = rotation.radii_m or packaged.get("radii_m")
    if (gm is None and not packaged) or radii is None:
        lacking = f"BODY{number}_GM" if gm is None else f"BODY{number}_RADII"
        raise InputError(SPICE, str(meta), f"must hold {lacking}")
    radius = float(packaged.get("reference_radius_m", max(radii)))
    own = f"packaged, of {packaged['name']}" if packaged else "unknown here"
    gm, of_gm = (packaged["gm_m3_s2"], own) if gm is None else (gm, source)
    w0, w1, w2 = rotation.prime_meridian
    body: list[Entry] = [
        ("name", packaged.get("name", name), "as given"),
        ("naif_id", number, "NAIF's number"),
        ("gm_m3_s2", gm, f"m^3/s^2; {of_gm}"),
        ("j2", packaged.get("j2", 0.0), f"unnormalised, at reference_radius_m; {own}"),
        ("reference_radius_m", radius, f"m; {own if packaged else 'the largest of radii_m'}"),
        ("radii_m", list(radii), f"m, semi-axes body-fixed; {source if rotation.radii_m else own}"),
        ("pole_ra_deg", rotation.pole_ra_deg, f"deg, J2000; {source}"),
        ("pole_dec_deg", rotation.pole_dec_deg, f"deg, J2000; {source}"),
        ("prime_meridian_deg", w0, f"deg; {source}"),
        ("prime_meridian_rate_deg_day", w1, f"deg/day; {source}"),
        ("prime_meridian_acceleration_deg_day2", w2, f"deg/day^2; {source}"),
    ]
    how = f"J2000, body from the Sun at epoch.tdb; {source}"
    sun: list[Entry] = [
        ("state_tdb", when.isoformat(), "TDB to which the next two entries belong"),
        ("body_position_km", position, f"km, {how}"),
        ("body_velocity_km_s", velocity, f"km/s, {how}"),
        ("solar_constant_w_m2", 1361.0, "W/m^2 at 1 au"),
    ]
    return number, radius, {"body": body, "sun": sun}


def csv_track(path: Path, epoch: datetime) -> Track:
    """Read a table of states as for `--init`; `t_s` counts from the epoch, TDB.

    Raises:
        InputError: if the file cannot be read, or has a column `tdb` that says another epoch.
    """
    entry = f"{CSV} {path}"
    table = read_table(path, entry)
    begin = epoch + timedelta(seconds=float(table[0, 0]))
    lines = enumerate(read_text(path, CSV, "file").splitlines(), start=1)
    rows = {f"line {number}": line for number, line in lines if line and line[0] != "#"}
    if (said := next(csv.DictReader(rows.values())).get("tdb")) is not None:
        off = (begin - datetime.fromisoformat(said)).total_seconds()
        if abs(off) > LATE_MAX_S:
            raise InputError(
                option("epoch"),
                f"{epoch.isoformat()}, which puts the first row at {begin.isoformat()}",
                f"must be TDB, and {-off:.3f} s later: the row's own column tdb says {said}",
            )
    times, source = table[:, 0] - table[0, 0], f"from {path.name}"
    places = tuple(rows)[1:]
    return Track(begin, times, table[:, 1:], source, entry=entry, unit="m", where=places)


def cut(track: Track, begin: datetime | None, end: datetime | None) -> Track:
    """The part of a track between two times on it, from the first state within to the last.

    Raises:
        InputError: if fewer than two states are left, or times are not ascending.
    """
    low = 0.0 if begin is None else (begin - track.epoch).total_seconds()
    high = track.duration_s if end is None else (end - track.epoch).total_seconds()
    if np.any(np.diff(track.times_s) < 0.0):
        raise InputError("times", track.source, "must be ascending")
    inside = (track.times_s >= low - 1e-6) & (track.times_s <= high + 1e-6)
    times = track.times_s[inside]
    if len(times) < 2 or times[0] == times[-1]:
        raise InputError(
            f"{option('begin')}, {option('end')}",
            f"{low:g} to {high:g} s of {track.duration_s:g} s",
            "must have two states of the trajectory between them",
        )
    first, last = (track.epoch + timedelta(seconds=float(time)) for time in times[[0, -1]])
    doubts = (*track.doubts, *late_doubts(begin, end, (first, last)))
    return replace(
        track,
        epoch=first,
        times_s=times - times[0],
        states=track.states[inside],
        doubts=doubts,
        where=tuple(compress(track.where, inside)),
    )


def _et(when: datetime) -> float:
    """TDB seconds past J2000."""
    return (when - J2000_TDB).total_seconds()


def pull_doubts(mission: Mission, track: Track) -> Iterator[ScenarioWarning]:
    """Warn of a trajectory with another acceleration: about another body, or in rotating axes.

    States are propagated to later ones by the planner's forces; half of them must arrive with about the
    trajectory's change of velocity. Fixed but wrong axes cannot be detected.
    """
    chosen = np.unique(np.linspace(0, len(track.times_s) - 1, STATES + 1).astype(int))
    times, states = track.times_s[chosen], track.states[chosen]
    took = np.diff(times)
    later = took > 0.0
    begin = times[:-1][later]
    arrived = propagate(states[:-1][later], took[later], mission.forces, SUBSTEPS, begin)
    gained = np.linalg.norm((states[1:] - states[:-1])[later, 3:], axis=1)
    off = np.linalg.norm(arrived[:, 3:] - states[1:][later, 3:], axis=1)
    share = float(np.median(off) / max(float(np.median(gained)), 1e-12))
    if not share <= PULL_OFF_MAX:
        yield ScenarioWarning.of(
            "trajectory",
            f"{track.source}, whose change of velocity differs by {100.0 * share:.3g} % from that by "
            f"{mission.scenario.body.name} and sunlight",
            f"expected below {100.0 * PULL_OFF_MAX:g} %: body, inertial axes, m and s?",
        )


def step_doubts(track: Track) -> Iterator[ScenarioWarning]:
    """Warn of a gap, and of positions that do not agree with the velocities."""
    times, position, velocity = track.times_s, track.states[:, :3], track.states[:, 3:]
    took = np.diff(times)
    usual, k = float(np.median(took[took > 0.0])), int(np.argmax(took))
    if took[k] > GAP_MAX * usual:
        yield ScenarioWarning.of(
            "trajectory",
            f"{track.source}, without a state from {times[k]:g} to {times[k + 1]:g} s",
            f"expected the usual step, {usual:.3g} s",
        )
    way = 0.5 * (velocity[1:] + velocity[:-1]) * took[:, None]
    off = np.linalg.norm(np.diff(position, axis=0) - way, axis=1)
    speed = np.linalg.norm(velocity, axis=1)
    allowed = SPREAD_MAX * np.maximum(speed[1:], speed[:-1]) * took
    off -= allowed + APART_MAX * np.linalg.norm(position[1:], axis=1)
    off[took > GAP_MAX * usual] = 0.0
    if off.max() > 0.0:
        k = int(np.argmax(off))
        yield ScenarioWarning.of(
            "trajectory",
            f"{track.source}, whose positions jump between {times[k]:g} and {times[k + 1]:g} s",
            "expected positions that agree with the velocities",
        )


def late_doubts(
    begin: datetime | None, end: datetime | None, got: tuple[datetime, datetime]
) -> Iterator[ScenarioWarning]:
    """Warn of a trajectory that does not begin and end at the requested times (TDB)."""
    for entry, wanted, found in (("--from", begin, got[0]), ("--to", end, got[1])):
        off = 0.0 if wanted is None else (found - wanted).total_seconds()
        if abs(off) > LATE_MAX_S:
            yield ScenarioWarning.of(
                entry,
                f"a time {abs(off):.3f} s {'before' if off > 0.0 else 'after'} the nearest state",
                "the trajectory is taken from state to state: the plan "
                f"{'begins' if entry == '--from' else 'ends'} at that one",
            )


def jump_doubts(
    meta: Path, spacecraft: int, body: int, ends: tuple[float, float], entry: str
) -> Iterator[ScenarioWarning]:
    """Warn of a burn just outside of a trajectory's ends, TDB seconds past J2000."""
    for flag, at, out in (("--from", ends[0], -BESIDE_S), ("--to", ends[1], BESIDE_S)):
        beside = at + out * np.array([1.0, 0.5, 0.0])
        try:
            outside, between, here = read_states([meta], spacecraft, body, beside, entry)[:, 3:]
        except InputError:  # they have nothing there
            continue
        jump = float(np.linalg.norm(2.0 * between - outside - here))
        if jump > JUMP_MAX_M_S:
            side, beyond = ("before", "earlier") if out < 0.0 else ("after", "later")
            yield ScenarioWarning.of(
                flag,
                f"a time with a jump of {jump:.4f} m/s within {BESIDE_S:g} s {side} it",
                f"the boundary state is without it: {BESIDE_S:g} s {beyond} if that is a burn of the "
                "plan",
            )
