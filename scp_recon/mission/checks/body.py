"""Whether body and site are those that were meant: gravity, spin, pole, position and normal."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.constants import G

from scp_recon.environment.catalogue import packaged_body
from scp_recon.errors import InputError
from scp_recon.mission.checks.copied import check_inherited
from scp_recon.mission.checks.given import Given, angle_deg, between, packaged_tables
from scp_recon.physics.frames import Rotation
from scp_recon.scenario.load import base_names
from scp_recon.scenario.warning import ScenarioWarning

SITE_RADII, SITE_RADII_REFUSED = (0.3, 2.0), (0.1, 5.0)
"""Of a surface point, in reference radii: an elongated body reaches beyond its mean radius."""
NORMAL_OFF_DEG = 30.0
"""Between a normal and the direction from the centre; an ellipsoid of axes 2 to 1 has up to 37 deg."""
DENSITY, DENSITY_REFUSED = (300.0, 8000.0), (3.0, 1e6)
"""kg/m^3: from the most porous comet to iron; a reference radius may be well above the body's own."""
PERIOD_MIN_H, PERIOD_MAX_H, RUBBLE_RADIUS_M = 2.0, 2000.0, 150.0
"""Larger bodies that turn faster break up (Pravec & Harris 2000); hardly any turns slower."""
SAME_GM, SAME_RADIUS, SAME_POLE_DEG, SAME_RATE = 0.05, 0.2, 2.0, 0.01
"""How far a known body's figures may be off, relative but for the pole."""


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


def known_body(given: Given) -> Iterator[ScenarioWarning]:
    """A packaged body's name goes with its gravity, radius, pole and spin."""
    body = given.scenario.body
    packaged = packaged_body(body.name)
    if packaged is None:
        return
    known = packaged.entries
    for entry, most in (
        ("gm_m3_s2", SAME_GM),
        ("reference_radius_m", SAME_RADIUS),
        ("prime_meridian_rate_deg_day", SAME_RATE),
    ):
        value, right = getattr(body, entry), known[entry]
        if abs(value - right) > most * abs(right):
            yield ScenarioWarning.of(
                f"body.{entry}", f"{value:g}", f"{known['name']} has {right:g}"
            )
    pole = Rotation.from_iau(
        known["pole_ra_deg"], known["pole_dec_deg"], (0.0, 0.0, 0.0), given.scenario.epoch.tdb
    ).pole
    off = angle_deg(given.rotation.pole, pole)
    if off > SAME_POLE_DEG:
        yield ScenarioWarning.of(
            "body.pole_ra_deg",
            f"({body.pole_ra_deg:g}, {body.pole_dec_deg:g}) deg, {off:.1f} deg off",
            f"the pole of {known['name']} is at "
            f"({known['pole_ra_deg']:g}, {known['pole_dec_deg']:g}) deg",
        )


def density(given: Given) -> Iterator[ScenarioWarning]:
    """GM and radius make a density, which rock, ice and iron bound."""
    body = given.scenario.body
    volume = 4.0 / 3.0 * np.pi * body.reference_radius_m**3
    found = body.gm_m3_s2 / (G * volume)
    text = f"{body.gm_m3_s2:g}, a density of {found:.3g} kg/m^3"
    why = f"of a body of reference radius {body.reference_radius_m:g} m"
    yield from between("body.gm_m3_s2", found, text, why, DENSITY, DENSITY_REFUSED, "kg/m^3")


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


def site_normal(given: Given) -> Iterator[ScenarioWarning]:
    """A slope is seldom steep against the direction from the centre, and never overhanging."""
    off = angle_deg(given.site.position_body, given.site.normal_body)
    text = f"{off:.1f} deg off the direction from the centre to the site"
    if off >= 90.0:
        raise InputError("site.normal_body", text, "must point out of the body, below 90 deg")
    if off > NORMAL_OFF_DEG:
        expected = f"at most {NORMAL_OFF_DEG:g} deg would be no surprise"
        yield ScenarioWarning.of("site.normal_body", text, expected)
