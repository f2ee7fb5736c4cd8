"""Run every check of a mission: units, axes, and entries that contradict each other.

An entry that can also be computed is checked against the computed value. Values that no flight about
a small body can have, such as kilometres in place of metres, are refused before any work. Unlikely
values become warnings, which stand in `solution.json` and above every verdict and change no exit
status. A quantity held to an interval is a row of `intervals`; every other check is a function.

No check can detect:

- a wrong probability;
- wrong axes of the boundary states, unless they lead into the shadow (`solve` shows distance,
  latitude, climb, plane, and angle off the Sun);
- a wrong prime meridian, pole, spin, Sun or normal of a body that is not packaged (`solve` shows the
  sense of rotation, distance and season of the Sun);
- UTC in place of TDB, unless `epoch.utc` is given too (every table of burns has both scales);
- a small body wholly in kilometres.

If `base` names a complete file, no entry of another date or body is inherited.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import reduce
from operator import attrgetter, getitem
from typing import Any

import numpy as np

from formulations.arrays import Array
from scp_recon.bodies.catalogue import DAY_S, J2000_TDB, packaged_body
from scp_recon.bodies.surface import angle_deg, coordinates_of, direction_of
from scp_recon.display import digits, exact
from scp_recon.errors import InputError
from scp_recon.mission.constraints import check_drifts
from scp_recon.mission.feedback import check_feedback, uncorrected_burns, useless_measurement
from scp_recon.mission.intervals import INTERVALS, PLANNER_INTERVALS, STATE_INTERVALS
from scp_recon.mission.knowledge import FAR, Deviation, Uncertain, check_knowledge
from scp_recon.mission.scene import Scene, planned_field
from scp_recon.mission.schedule import check_in_flight
from scp_recon.mission.windows import SCAN_STEP_S, Lighting, Window
from scp_recon.physics.frames import Rotation
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.given import COORDINATES, MERIDIAN, POLE, STATE, keys
from scp_recon.scenario.load import base_names, packaged_scenario
from scp_recon.scenario.schema import Scenario

Check = Callable[[Scene], Iterator[ScenarioWarning]]
SAME_GM, SAME_J2, SAME_RADIUS, SAME_RATE, SAME_ANGLE_DEG = 0.05, 0.2, 0.2, 0.01, 2.0
"""How far a known body's figures may be off, relative but for pole and prime meridian."""
SAME_SITE_DEG = 5.0
"""How far from a packaged site, seen from the centre, another may be that has its name."""


def named_site(scene: Scene) -> Iterator[ScenarioWarning]:
    """Warn of a packaged site's name 5 deg or more off that site, seen from the centre."""
    here = scene.scenario
    for name in base_names():
        there = packaged_scenario(name)
        if (here.body.name, here.site.name) != (there.body.name, there.site.name):
            continue
        places = scene.site.position_body, np.array(there.site.position_body_m)
        off = angle_deg(*places)
        if off > SAME_SITE_DEG:
            words = "latitude {:.1f} deg, longitude {:.1f} deg east"
            at, expected = (words.format(*coordinates_of(place)) for place in places)
            given = f"{here.site.name} at {at}, {off:.0f} deg off"
            expected = f"{here.site.name} is at {expected}; another place has another name"
            yield ScenarioWarning.of("site.name", given, expected)
        return  # other packaged scenarios of that site have it at the same place


def known_body(scene: Scene) -> Iterator[ScenarioWarning]:
    """Warn of a packaged body's name with another body's figures.

    Compared are GM (to 5 %), J2, radius and radii (20 %), spin (1 %), pole and prime meridian (2
    deg).
    """
    body = scene.scenario.body
    packaged = packaged_body(body.name)
    if packaged is None:
        return
    known = packaged.entries
    radius = known["reference_radius_m"]
    for entry, right, most in (
        ("gm_m3_s2", known["gm_m3_s2"], SAME_GM),
        ("reference_radius_m", radius, SAME_RADIUS),
        ("j2", known["j2"] * (radius / body.reference_radius_m) ** 2, SAME_J2),
        ("prime_meridian_rate_deg_day", known.get("prime_meridian_rate_deg_day"), SAME_RATE),
    ):
        value = getattr(body, entry)
        if right is not None and abs(value - right) > most * abs(right):  # None where it tumbles
            yield ScenarioWarning.of(
                f"body.{entry}", exact(value), f"{known['name']} has {right:g}"
            )
    if body.radii_m is not None and not np.allclose(body.radii_m, known["radii_m"], SAME_RADIUS):
        expected = f"{known['name']} has {known['radii_m']} m along x, y and z"
        yield ScenarioWarning.of("body.radii_m", f"{list(body.radii_m)} m", expected)
    if body.attitude is None and "pole_ra_deg" in known:
        yield from _known_attitude(scene, known)


def assumed(scene: Scene) -> Iterator[ScenarioWarning]:
    """Warn of a packaged body's entries that are assumed without a measurement."""
    body = scene.scenario.body
    packaged = packaged_body(body.name)
    if packaged is None:
        return
    for entry, text in packaged.assumed.items():
        value = attrgetter(entry)(body)
        if value == reduce(getitem, entry.split("."), packaged.entries):
            name = packaged.entries["name"]
            given = exact(value) if isinstance(value, float) else f"that of {name}"
            yield ScenarioWarning.of(f"body.{entry}", f"{given}, which is assumed", text)


def _known_attitude(scene: Scene, known: Mapping[str, Any]) -> Iterator[ScenarioWarning]:
    """Compare pole and, if that agrees, prime meridian at the epoch with the packaged body's."""
    body, name = scene.scenario.body, known["name"]
    pole_ra, pole_dec, *meridian = (known[key] for key in keys((*POLE, *MERIDIAN)))
    right = Rotation.from_iau(pole_ra, pole_dec, tuple(meridian), scene.scenario.epoch.tdb)
    off = angle_deg(scene.rotation.pole, right.pole)
    ahead = angle_deg(*(one.body_to_j2000(0.0)[:, 0] for one in (scene.rotation, right)))
    if off > SAME_ANGLE_DEG:
        given, entry, hint = (body.pole_ra_deg, body.pole_dec_deg), POLE[0], ""
        for turned, angle in enumerate(POLE):
            ra, dec = (np.rad2deg(x) if i == turned else x for i, x in enumerate(given))
            if angle_deg(direction_of(dec, ra), right.pole) <= SAME_ANGLE_DEG:
                entry, hint = angle, "; degrees?"
        yield ScenarioWarning.of(
            entry,
            f"({exact(given[0])}, {exact(given[1])}) deg, {off:.1f} deg off",
            f"the pole of {name} is at ({pole_ra:g}, {pole_dec:g}) deg{hint}",
        )
    elif ahead > SAME_ANGLE_DEG:
        yield ScenarioWarning.of(
            "body.prime_meridian_deg",
            f"a prime meridian that is {ahead:.1f} deg off at the epoch",
            "W of {} is {:g} + {:.10g} d + {:g} d^2 deg".format(name, *meridian),
        )


def angles_in_radians(scene: Scene) -> Iterator[ScenarioWarning]:
    """Warn of a site or a pole within 1.57 deg one way and 6.28 deg the other: radians, probably."""
    for entry, other in (COORDINATES, POLE[::-1]):
        north, east = (attrgetter(name)(scene.scenario) for name in (entry, other))
        if north is None or east is None:
            continue
        if 0.0 < abs(north) < 0.5 * np.pi and 0.0 < abs(east) < 2.0 * np.pi:
            given = f"{exact(north)} deg, and {other.partition('.')[2]} {exact(east)} deg"
            expected = f"expected more than {0.5 * np.pi:.2f} or {2.0 * np.pi:.2f} deg; degrees?"
            yield ScenarioWarning.of(entry, given, expected)


@contextmanager
def hinting(scene: Scene) -> Iterator[None]:
    """Context in which a refusal that angles in radians may have led to begins with these.

    Raises:
        InputError: that of the context, behind the angles' entry and what is expected of it.
    """
    try:
        yield
    except InputError as error:
        hint = next(angles_in_radians(scene), None)
        if hint is None or not error.entry.startswith(("site.", "body.", "observation", "burns.")):
            raise
        raise InputError(hint.entry, hint.given, f"{hint.expected}\n{error}") from None


SAME_PLACE_DEG = 0.5
"""How far a known body may be off its orbit, for each year outside the elements' span: mean motions
change by 4e-4 deg/day."""


def known_orbit(scene: Scene) -> Iterator[ScenarioWarning]:
    """Warn of a packaged body off its orbit, before or after the years of its packaged elements.

    The tolerance is 0.5 deg, and as much again for each year outside these, in the directions of place
    and of motion. Within the years both are computed.
    """
    scenario, packaged = scene.scenario, packaged_body(scene.scenario.body.name)
    days = (scenario.epoch.tdb - J2000_TDB).total_seconds() / DAY_S
    if packaged is None or packaged.covers(days):
        return
    (begin, end), (first, last) = packaged.span, packaged.years
    beyond, year = (begin - days, first) if days < begin else (days - end, last)
    most = SAME_PLACE_DEG * max(1.0, beyond / 365.25)
    for key, computed in zip(keys(STATE), packaged.extrapolated(days), strict=True):
        if (off := angle_deg(getattr(scenario.sun, key), computed)) > most:
            given = f"{off:.1f} deg off that of {scenario.body.name} on its orbit of {year}, at "
            expected = f"expected at most {most:.1f} deg; is it that of the epoch?"
            when = f"{scenario.epoch.tdb:%Y-%m-%d}"
            yield ScenarioWarning.of(f"sun.{key}", given + when, expected)


def later_end(before: Scenario, after: Scenario) -> Iterator[ScenarioWarning]:
    """Warn of added burns that end the flight later than it did before; once it is over they must."""
    old, new = before.burns.times_s, after.burns.times_s
    if len(new) > len(old) and new[-1] > old[-1] > after.start_s:
        yield ScenarioWarning.of(
            "burns.times_s",
            f"a last burn at {exact(new[-1])} s, {digits(new[-1] - old[-1])} s later than before",
            f"the flight reaches its final state then; expected added burns before {exact(old[-1])} s",
        )


CHECKS: tuple[Check, ...] = (
    *(row.check for row in INTERVALS),
    known_body,
    assumed,
    angles_in_radians,
    named_site,
    known_orbit,
)
"""Checks before the window is known, in the order of checking; a further one is listed here."""
STATE_CHECKS: tuple[Check, ...] = (
    *(row.check for row in STATE_INTERVALS),
    uncorrected_burns,
    useless_measurement,
)
"""Checks of the state where planning begins, and of the burns that are left."""
WINDOW_SLACK = 0.05
"""Slack of the lighting limits, deg or h: room for a window given to the nearest second."""


def check_plannable(scene: Scene) -> None:
    """Refuse what no plan can be made of, or with which planning would never end or overflow.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    scenario = scene.scenario
    if scenario.boundary.home is not None and scenario.boundary.home.is_free:
        raise InputError(
            "boundary.home",
            "a home orbit that is flown, or has free phases",
            "must be a circle with departure_deg and arrival_deg fixed here; "
            "python -m scp_recon design finds the rest, and writes a scenario of its own",
        )
    for row in PLANNER_INTERVALS:
        tuple(row.check(scene))
    check_in_flight(scenario)
    check_feedback(scenario)
    check_drifts(scene)
    check_knowledge(scene.scenario)
    planned_field(scenario)


def check_scene(scene: Scene) -> tuple[ScenarioWarning, ...]:
    """Run every check of `CHECKS`.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    return tuple(found for check in CHECKS for found in check(scene))


def check_state(scene: Scene) -> tuple[ScenarioWarning, ...]:
    """Run every check of `STATE_CHECKS` on the state where planning begins, and on the burns left."""
    return tuple(found for check in STATE_CHECKS for found in check(scene))


def check_window(scene: Scene, window: Window) -> tuple[ScenarioWarning, ...]:
    """Refuse a window in which the site is dark at any time; warn of a given one beyond its limits.

    The limits are those of incidence and local solar time under `[observation]`, with a slack of
    0.05 deg or h. A computed window keeps them.

    Raises:
        InputError: if the site is dark at some time; names the window if given, else the limit.
    """
    limits, entry, lighting = scene.scenario.observation, "observation.window_s", scene.lighting
    computed, (first, last) = limits.window_s is None, window
    times = np.linspace(first, last, int(np.ceil((last - first) / SCAN_STEP_S)) + 1)
    angles, hours = np.rad2deg(lighting.incidence(times)), lighting.local_solar_time(times)
    worst, given = float(angles.max()), f"[{digits(first)}, {digits(last)}] s"
    at = float(times[np.argmax(angles)])
    if worst >= 90.0:
        dark = f"{given}, in which incidence reaches {worst:.1f} deg at {at:.0f} s"
        limit = f"the limit is {exact(limits.incidence_max_deg)} deg"
        if computed:
            dark = f"{exact(limits.incidence_max_deg)} deg, which makes a window of {dark}"
        entry = "observation.incidence_max_deg" if computed else entry
        raise InputError(entry, dark, f"must keep the site in the light, below 90 deg; {limit}")
    if computed:
        return ()
    found = []
    how, uncertain = "", Uncertain.of(scene.scenario)
    if uncertain.count:

        def incidence(one: Deviation) -> Array:
            site, rotation = one.site(scene.site), one.rotation(scene.rotation)
            return Lighting(site, rotation, scene.sun_direction).incidence(times)

        spread = np.rad2deg(FAR * np.linalg.norm(uncertain.slopes(incidence), axis=-1))
        how = f", with {FAR:g} sigma of knowledge," if spread.any() else ""
        worst, at = float((angles + spread).max()), float(times[np.argmax(angles + spread)])
    if worst > limits.incidence_max_deg + WINDOW_SLACK:
        text = f"{given}, in which incidence{how} reaches {worst:.1f} deg at {at:.0f} s"
        expected = f"observation.incidence_max_deg is {exact(limits.incidence_max_deg)} deg"
        found.append(ScenarioWarning.of(entry, text, expected))
    low, high = limits.local_solar_time_min_h, limits.local_solar_time_max_h
    if hours.min() < low - WINDOW_SLACK or hours.max() > high + WINDOW_SLACK:
        text = f"{given}, in which it is {hours.min():.2f} to {hours.max():.2f} h local solar time"
        expected = f"observation.local_solar_time_min_h and _max_h are {low:g} and {high:g} h"
        found.append(ScenarioWarning.of(entry, text, expected))
    return tuple(found)
