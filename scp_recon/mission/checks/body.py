"""Checks of body and site against what is packaged of them, and against each other."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scp_recon.bodies.catalogue import PackagedBody, packaged_body
from scp_recon.bodies.surface import coordinates_of
from scp_recon.mission.scene import Scene
from scp_recon.physics.frames import Rotation
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.load import base_names, packaged_scenario
from scp_recon.scenario.resolution.agreement import angle_deg

J2_ENDS = 0.0, 0.5
"""At the reference radius; Itokawa, twice as long as thick, has half of the latter."""
J2_SHARE, J2_SLACK = 0.4, 0.01
"""How far J2 may be off that of a homogeneous ellipsoid, as a share of the larger one, and at least.

Bennu's is 20 % above, and Eros' 13 %; C20 normalised in the place of J2 is sqrt(5) times too small.
"""
SAME_GM, SAME_J2, SAME_RADIUS, SAME_RATE, SAME_ANGLE_DEG = 0.05, 0.2, 0.2, 0.01, 2.0
"""How far a known body's figures may be off, relative but for pole and prime meridian."""
SAME_SITE_DEG = 5.0
"""How far from a packaged site, seen from the centre, another may be that has its name."""


def named_site(scene: Scene) -> Iterator[ScenarioWarning]:
    """Warn of a packaged site's name 5 deg and more off its place, as seen from the centre."""
    here = scene.scenario
    for name in base_names():
        there = packaged_scenario(name)
        if (here.body.name, here.site.name) != (there.body.name, there.site.name):
            continue
        place = there.site.position_body_m
        off = angle_deg(scene.site.position_body, place)
        if off > SAME_SITE_DEG:
            at, expected = (
                "latitude {:.1f} deg, longitude {:.1f} deg east".format(
                    *coordinates_of(np.array(x))
                )
                for x in (scene.site.position_body, place)
            )
            yield ScenarioWarning.of(
                "site.name",
                f"{here.site.name} at {at}, {off:.0f} deg off",
                f"{here.site.name} is at {expected}; another place has another name",
            )
        return  # other packaged scenarios of that site have it at the same place


def known_body(scene: Scene) -> Iterator[ScenarioWarning]:
    """Warn of a packaged body's name with figures that are not its own.

    That is another GM (5 %), J2, radius or radii (20 %), spin (1 %), pole or prime meridian (2 deg), or
    a prime meridian of which two sources are more than that apart, as of Eros.
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
    yield from _known_attitude(scene, packaged)


def _known_attitude(scene: Scene, packaged: PackagedBody) -> Iterator[ScenarioWarning]:
    """Where a packaged body's pole and, if that is its own, its prime meridian are at the epoch."""
    body, tdb, known = scene.scenario.body, scene.scenario.epoch.tdb, packaged.entries
    pole = known["pole_ra_deg"], known["pole_dec_deg"]
    w0, w1, w2 = (
        known[f"prime_meridian_{key}"] for key in ("deg", "rate_deg_day", "acceleration_deg_day2")
    )
    right = Rotation.from_iau(*pole, (w0, w1, w2), tdb)
    off = angle_deg(scene.rotation.pole, right.pole)
    if off > SAME_ANGLE_DEG:
        yield ScenarioWarning.of(
            "body.pole_ra_deg",
            f"({body.pole_ra_deg:g}, {body.pole_dec_deg:g}) deg, {off:.1f} deg off",
            f"the pole of {known['name']} is at ({pole[0]:g}, {pole[1]:g}) deg",
        )
        return
    x = scene.rotation.body_to_j2000(0.0)[:, 0]
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
        minutes = np.deg2rad(apart) / abs(scene.rotation.rate) / 60.0
        yield ScenarioWarning.of(
            "body.prime_meridian_deg",
            f"a prime meridian of {known['name']}, of which two sources are {apart:.1f} deg apart at "
            "the epoch",
            f"the window may be {minutes:.0f} minutes off, until a measurement of its phase is given",
        )


def oblateness(scene: Scene) -> Iterator[ScenarioWarning]:
    """Warn of a J2 40 % and more off that of a homogeneous ellipsoid of `body.radii_m`.

    That is (a^2 + b^2 - 2 c^2) / (10 R^2) at a reference radius R. A packaged body's is known.
    """
    body = scene.scenario.body
    within = J2_ENDS[0] <= body.j2 <= J2_ENDS[1]  # which a row of `intervals` tells
    if body.radii_m is None or not within or packaged_body(body.name) is not None:
        return
    a, b, c = body.radii_m
    even = (a * a + b * b - 2.0 * c * c) / (10.0 * body.reference_radius_m**2)
    if abs(body.j2 - even) > max(J2_SHARE * max(body.j2, even), J2_SLACK):
        yield ScenarioWarning.of(
            "body.j2",
            f"{body.j2:g}",
            f"a homogeneous ellipsoid of body.radii_m has {even:.3g} at "
            f"{body.reference_radius_m:g} m; unnormalised, which is -sqrt(5) C20?",
        )


def site_angles(scene: Scene) -> Iterator[ScenarioWarning]:
    """Warn of a latitude within 1.57 and a longitude within 6.28 deg, as in radians."""
    site = scene.scenario.site
    latitude, longitude = site.latitude_deg, site.longitude_deg
    if latitude is None or longitude is None:
        return
    if 0.0 < abs(latitude) < 0.5 * np.pi and 0.0 < abs(longitude) < 2.0 * np.pi:
        yield ScenarioWarning.of(
            "site.latitude_deg",
            f"{latitude:g} deg, and longitude {longitude:g} deg",
            f"expected a latitude beyond {0.5 * np.pi:.2f} or a longitude beyond "
            f"{2.0 * np.pi:.2f} deg; degrees?",
        )
