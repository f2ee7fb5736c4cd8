"""Whether body and site are those that were meant: gravity, spin, pole, position and normal."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.constants import G

from scp_recon.environment.catalogue import PackagedBody, packaged_body
from scp_recon.environment.surface import coordinates_of
from scp_recon.errors import InputError
from scp_recon.mission.checks.copied import check_inherited
from scp_recon.mission.checks.given import Given, angle_deg, between, packaged_tables
from scp_recon.physics.frames import Rotation, unit
from scp_recon.scenario.load import base_names
from scp_recon.scenario.warning import ScenarioWarning

SITE_RADII, SITE_RADII_REFUSED = (0.3, 2.0), (0.1, 5.0)
"""Of a surface point, in reference radii: an elongated body reaches beyond its mean radius."""
NORMAL_OFF_DEG = 30.0
"""Between a normal and the direction from the centre; an ellipsoid of axes 2 to 1 has up to 37 deg."""
DENSITY, DENSITY_REFUSED = (300.0, 8000.0), (3.0, 1e6)
"""kg/m^3: from the most porous comet to iron; a reference radius may be well above the body's own."""
RADIUS_MIN_M = 50.0
"""Below any body that has been flown to: Dimorphos has 75 m. In kilometres throughout, GM included, a
body is a smaller one of the same density."""
PERIOD_MIN_H, PERIOD_MAX_H, RUBBLE_RADIUS_M = 2.0, 2000.0, 150.0
"""Larger bodies that turn faster break up (Pravec & Harris 2000); hardly any turns slower."""
SAME_GM, SAME_J2, SAME_RADIUS, SAME_RATE, SAME_ANGLE_DEG = 0.05, 0.2, 0.2, 0.01, 2.0
"""How far a known body's figures may be off, relative but for pole and prime meridian."""
SAME_SITE_DEG = 5.0
"""How far from a packaged site, seen from the centre, another may be that has its name."""


def copied(given: Given) -> Iterator[ScenarioWarning]:
    """Entries taken from a packaged scenario that do not fit the others any more."""
    here = given.scenario.model_dump()
    for name in base_names():
        there = packaged_tables(name)
        check_inherited(there, here)
        if here["body"]["name"] == there["body"]["name"]:
            continue
        for table, entry in (("body", "gm_m3_s2"), ("body", "j2"), ("sun", "body_position_km")):
            value = here[table].get(entry)
            if value is not None and value == there[table].get(entry):
                yield ScenarioWarning.of(
                    f"{table}.{entry}",
                    f"that of {there['body']['name']}",
                    f"the body is {here['body']['name']}: give its own",
                )


def named_site(given: Given) -> Iterator[ScenarioWarning]:
    """A packaged site's name goes with its place."""
    here = given.scenario
    for name in base_names():
        there = packaged_tables(name)
        if (here.body.name, here.site.name) != (there["body"]["name"], there["site"]["name"]):
            continue
        place = there["site"]["position_body_m"]
        off = angle_deg(given.site.position_body, unit(place))
        if off > SAME_SITE_DEG:
            at, expected = (
                "latitude {:.1f} deg, longitude {:.1f} deg east".format(
                    *coordinates_of(np.array(x))
                )
                for x in (given.site.position_body, place)
            )
            yield ScenarioWarning.of(
                "site.name",
                f"{here.site.name} at {at}, {off:.0f} deg off",
                f"{here.site.name} is at {expected}; another place has another name",
            )
        return  # other packaged scenarios of that site have it at the same place


def known_body(given: Given) -> Iterator[ScenarioWarning]:
    """A packaged body's name goes with its gravity, radii, pole and spin."""
    body = given.scenario.body
    packaged = packaged_body(body.name)
    if packaged is None:
        return
    known = packaged.entries
    radius = known["reference_radius_m"]
    for entry, right, most in (
        ("gm_m3_s2", known["gm_m3_s2"], SAME_GM),
        ("reference_radius_m", radius, SAME_RADIUS),
        ("j2", known["j2"] * (radius / body.reference_radius_m) ** 2, SAME_J2),
        ("prime_meridian_rate_deg_day", known["prime_meridian_rate_deg_day"], SAME_RATE),
    ):
        value = getattr(body, entry)
        if abs(value - right) > most * abs(right):
            yield ScenarioWarning.of(
                f"body.{entry}", f"{value:g}", f"{known['name']} has {right:g}"
            )
    if body.radii_m is not None and not np.allclose(body.radii_m, known["radii_m"], SAME_RADIUS):
        yield ScenarioWarning.of(
            "body.radii_m",
            f"{list(body.radii_m)} m",
            f"{known['name']} has {known['radii_m']} m along x, y and z",
        )
    yield from _known_attitude(given, packaged)


def _known_attitude(given: Given, packaged: PackagedBody) -> Iterator[ScenarioWarning]:
    """Where a packaged body's pole and, if that is its own, its prime meridian are at the epoch."""
    body, tdb, known = given.scenario.body, given.scenario.epoch.tdb, packaged.entries
    pole = known["pole_ra_deg"], known["pole_dec_deg"]
    w0, w1, w2 = (
        known[f"prime_meridian_{key}"] for key in ("deg", "rate_deg_day", "acceleration_deg_day2")
    )
    right = Rotation.from_iau(*pole, (w0, w1, w2), tdb)
    off = angle_deg(given.rotation.pole, right.pole)
    if off > SAME_ANGLE_DEG:
        yield ScenarioWarning.of(
            "body.pole_ra_deg",
            f"({body.pole_ra_deg:g}, {body.pole_dec_deg:g}) deg, {off:.1f} deg off",
            f"the pole of {known['name']} is at ({pole[0]:g}, {pole[1]:g}) deg",
        )
        return
    x = given.rotation.body_to_j2000(0.0)[:, 0]
    ahead = angle_deg(x, right.body_to_j2000(0.0)[:, 0])
    apart = 0.0
    if packaged.other_meridian is not None:
        other = Rotation.from_iau(*pole, packaged.other_meridian, tdb).body_to_j2000(0.0)[:, 0]
        apart = angle_deg(other, right.body_to_j2000(0.0)[:, 0])
        ahead = min(ahead, angle_deg(x, other))
    if ahead > SAME_ANGLE_DEG:
        yield ScenarioWarning.of(
            "body.prime_meridian_deg",
            f"a prime meridian that is {ahead:.1f} deg off at the epoch",
            f"W of {known['name']} is {w0:g} + {w1:.10g} d + {w2:g} d^2 deg",
        )
    elif apart > SAME_ANGLE_DEG:
        minutes = np.deg2rad(apart) / abs(given.rotation.rate) / 60.0
        yield ScenarioWarning.of(
            "body.prime_meridian_deg",
            f"a prime meridian of {known['name']}, of which two sources are {apart:.1f} deg apart at "
            "the epoch",
            f"the window may be {minutes:.0f} minutes off, until a measurement of its phase is given",
        )


def density(given: Given) -> Iterator[ScenarioWarning]:
    """GM and radius make a density, which rock, ice and iron bound."""
    body = given.scenario.body
    volume = 4.0 / 3.0 * np.pi * body.reference_radius_m**3
    found = body.gm_m3_s2 / (G * volume)
    text = f"{body.gm_m3_s2:g}, a density of {found:.3g} kg/m^3"
    why = f"of a body of reference radius {body.reference_radius_m:g} m"
    yield from between("body.gm_m3_s2", found, text, why, DENSITY, DENSITY_REFUSED, "kg/m^3")


def size(given: Given) -> Iterator[ScenarioWarning]:
    """Nobody has flown to a body of a few metres."""
    radius = given.scenario.body.reference_radius_m
    if radius < RADIUS_MIN_M:
        yield ScenarioWarning.of(
            "body.reference_radius_m",
            f"{radius:g} m",
            f"{RADIUS_MIN_M:g} m and more would be no surprise; all of it in metres?",
        )


def spin(given: Given) -> Iterator[ScenarioWarning]:
    """A body without strength breaks up below two hours, and none is known that hardly turns."""
    body = given.scenario.body
    rate = abs(given.rotation.rate)
    hours = 2.0 * np.pi / rate / 3600.0 if rate else np.inf
    entry, text = "body.prime_meridian_rate_deg_day", f"{body.prime_meridian_rate_deg_day:g}"
    if hours < PERIOD_MIN_H and body.reference_radius_m > RUBBLE_RADIUS_M:
        expected = f"a body above {RUBBLE_RADIUS_M:g} m breaks up below {PERIOD_MIN_H:g} h"
        yield ScenarioWarning.of(entry, f"{text}, a turn in {hours:.3g} h", expected)
    if hours > PERIOD_MAX_H:
        expected = f"hardly a body takes more than {PERIOD_MAX_H:g} h; degrees a day?"
        yield ScenarioWarning.of(entry, f"{text}, a turn in {hours:.3g} h", expected)


def site_position(given: Given) -> Iterator[ScenarioWarning]:
    """A site is on the surface."""
    radius = given.scenario.body.reference_radius_m
    distance = float(np.linalg.norm(given.site.position_body))
    text, why = f"{distance:g} m from the centre", f"as the reference radius is {radius:g} m"
    edges, refused = (
        (low * radius, high * radius) for low, high in (SITE_RADII, SITE_RADII_REFUSED)
    )
    yield from between("site.position_body_m", distance, text, why, edges, refused, "m")


def site_angles(given: Given) -> Iterator[ScenarioWarning]:
    """Latitude and longitude that could both be in radians likely are: one site of 1000 is there."""
    site = given.scenario.site
    latitude, longitude = site.latitude_deg, site.longitude_deg
    if latitude is None or longitude is None:
        return
    if 0.0 < abs(latitude) < 0.5 * np.pi and 0.0 < abs(longitude) < 2.0 * np.pi:
        yield ScenarioWarning.of(
            "site.latitude_deg",
            f"{latitude:g} deg, and longitude {longitude:g} deg",
            f"a latitude beyond {0.5 * np.pi:.2f} or a longitude beyond {2.0 * np.pi:.2f} deg would be "
            "no surprise; degrees?",
        )


def site_normal(given: Given) -> Iterator[ScenarioWarning]:
    """A slope is seldom steep against the direction from the centre, and never overhanging.

    Where there is a shape, the scenario has held the normal to that.
    """
    off = angle_deg(given.site.position_body, given.site.normal_body)
    text = f"{off:.1f} deg off the direction from the centre to the site"
    if off >= 90.0:
        raise InputError("site.normal_body", text, "must point out of the body, below 90 deg")
    if off > NORMAL_OFF_DEG and given.scenario.body.radii_m is None:
        expected = f"at most {NORMAL_OFF_DEG:g} deg would be no surprise"
        yield ScenarioWarning.of("site.normal_body", text, expected)
