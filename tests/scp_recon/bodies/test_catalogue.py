"""The packaged bodies: what they hold, and how well their mean elements say where the Sun is."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scp_recon.bodies.catalogue import (
    DAY_S,
    GM_SUN_KM3_S2,
    OBLIQUITY,
    body_names,
    kepler,
    packaged_body,
)
from scp_recon.bodies.surface import angle_deg
from scp_recon.errors import InputError
from scp_recon.mission.checks import assumed
from scp_recon.mission.scene import Scene
from scp_recon.scenario.body import Body
from scp_recon.scenario.given import MERIDIAN, POLE, keys
from scp_recon.scenario.load import packaged_scenario

GOOD_TO_DEG = 0.01
BODIES = ("Apophis", "Bennu", "Didymos", "Eros", "Itokawa", "Ryugu")
SPIN = keys((*POLE, *MERIDIAN))


def test_the_documented_bodies_are_packaged_and_complete():
    assert body_names() == list(BODIES)
    for name in BODIES:
        body = packaged_body(name.upper())
        spin = {} if "pole_ra_deg" in body.entries else dict.fromkeys(SPIN, 0.0)
        entries = body.entries | {"radii_m": tuple(body.entries["radii_m"])} | spin
        Body.model_validate_json(json.dumps(entries))
    assert packaged_body("Ceres") is None
    assert packaged_body(5) is None


ELEMENTS = {
    ("Eros", 2_461_200.5): (0.5597046347, 0.222877963, 10.828544, 304.267971, 178.918132, 62.511566),
    ("Ryugu", 2_459_000.5): (0.759554734, 0.190301168, 5.881927, 251.578333, 211.485317, 193.637648),
    ("Itokawa", 2_459_000.5): (0.646881, 0.280116646, 1.621304, 69.080390, 162.814770, 187.632752),
}  # fmt: skip


@pytest.mark.parametrize(("name", "epoch"), ELEMENTS)
def test_bodies_are_where_jpls_elements_have_them(name, epoch):
    """Osculating elements: deg/day, e, deg."""
    days = epoch - 2_451_545.0
    osculating, moving = kepler(np.array([days, *ELEMENTS[name, epoch]]), days)
    position, velocity = packaged_body(name).heliocentric(days)
    assert angle_deg(position, osculating) < GOOD_TO_DEG
    np.testing.assert_allclose(velocity, moving, atol=0.01)


@pytest.mark.parametrize("name", BODIES)
def test_the_orbits_of_neighbouring_years_meet(name):
    body = packaged_body(name)
    for before, after in zip(body.elements[:-1], body.elements[1:], strict=True):
        border = 0.5 * (before[0] + after[0])
        assert after[0] - before[0] == pytest.approx(365.25)
        apart = angle_deg(kepler(before, border)[0], kepler(after, border)[0])
        # Ryugu passes the Earth in 2020 and 2033, which no Kepler orbit of a year follows so well.
        assert apart < (3.0 if name == "Ryugu" else 2.0) * GOOD_TO_DEG


@given(
    e=st.floats(0.0, 0.6),
    angles=st.tuples(st.floats(0.0, 90.0), *[st.floats(0.0, 360.0)] * 3),
    motion=st.floats(0.1, 2.0),
    # SPICE's propagation refuses times that are almost no number, such as 1e-319 s.
    days=st.floats(-400.0, 400.0).map(lambda days: round(days, 9)),
)
def test_kepler_agrees_with_spice(e, angles, motion, days, spice):
    a = (GM_SUN_KM3_S2 / (np.deg2rad(motion) / DAY_S) ** 2) ** (1.0 / 3.0)
    conic = [a * (1.0 - e), e, *np.deg2rad(angles), 0.0, GM_SUN_KM3_S2]
    ecliptic = spice.conics(conic, days * DAY_S)
    turn = spice.rotate(-OBLIQUITY, 1)
    position, velocity = kepler(np.array([0.0, motion, e, *angles]), days)
    np.testing.assert_allclose(position, turn @ ecliptic[:3], rtol=1e-8, atol=1e-8 * a)
    np.testing.assert_allclose(velocity, turn @ ecliptic[3:], rtol=1e-7, atol=1e-6)


@pytest.mark.parametrize("days", [-40_000.0, 4_000.0, 15_000.0])
def test_outside_the_span_the_years_are_told(days):
    bennu = packaged_body("Bennu")
    with pytest.raises(InputError, match="2012 to 2035"):
        bennu.heliocentric(days)


def test_assumed_entries_of_packaged_bodies_are_warned_about():
    scenario = packaged_scenario("didymos")
    found = {w.entry for w in assumed(Scene.of(scenario))}
    assert found == {"body.prime_meridian_deg", "body.j2", "body.companion.mean_anomaly_deg"}
    measured = Scene.of(scenario.replace({"body.j2": 0.09}))
    assert {w.entry for w in assumed(measured)} == found - {"body.j2"}
    tumbling = {w.entry for w in assumed(Scene.of(packaged_scenario("apophis")))}
    assert tumbling == {"body.gm_m3_s2", "body.j2", "body.attitude_file"}


def test_dimorphos_goes_round_as_after_the_impact():
    """In 11.3674 h, at Kepler's distance with Didymos' J2, in the plane of its equator."""
    scene = Scene.of(packaged_scenario("didymos"))
    orbit, body = scene.companion, scene.scenario.body
    assert orbit is not None
    assert 2.0 * np.pi / orbit.rate == pytest.approx(11.3674 * 3600.0)
    a, oblate = orbit.semi_major_axis, 1.5 * body.j2 * body.reference_radius_m**2
    pull = (body.gm_m3_s2 + orbit.gm) * (1.0 + oblate / a**2)
    assert orbit.rate**2 * a**3 == pytest.approx(pull, rel=1e-3)
    assert np.abs(orbit.axes @ scene.rotation.pole).max() < 1e-12
