"""Missions that are hardly what was meant: refused, or warned about in so many words."""

import re
from datetime import timedelta
from typing import Any, get_args

import numpy as np
import pytest

from formulations.rows.flight_probability import PROBABILITY_MAX
from scp_recon.bodies.catalogue import J2000_TDB, packaged_body
from scp_recon.bodies.surface import angle_deg
from scp_recon.errors import InputError
from scp_recon.mission import checks as known
from scp_recon.mission.checks import check_plannable, check_scene
from scp_recon.mission.intervals import INTERVALS, PLANNER_INTERVALS, STATE_INTERVALS
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import Scene
from scp_recon.physics.two_body import two_body
from scp_recon.scenario.load import validate_scenario
from scp_recon.scenario.schema import Scenario
from tests import reliability
from tests.scp_recon.support import file_of, mission_of, refusal

ELSEWHERE = [-91.0, 81.0, 181.0]
LATER = "2020-03-21T20:33:17"
SUN_M = [1.51e11, -4.9e9, -3.4e9]
SUN_M_S = [-4300.0, 26811.0, 15168.0]
SUN, SUN_S = [1.51e8, -4.9e6, -3.4e6], [-4.3, 26.8, 15.2]
INWARD = [0.4, -0.5, -0.7]
SITE_KM = [0.0914, 0.0817, 0.1811]
SITE, NORMAL, PLACE, SPEED = (
    *("site.position_body_m", "site.normal_body"),
    *("sun.body_position_km", "sun.body_velocity_km_s"),
)
NEAR_SITE = {"observation.site_distance_min_m": 0.5, "observation.site_distance_max_m": 0.74}
IN_THE_DARK = {
    "observation.window_s": [20_000.0, 24_000.0],
    "burns.times_s": [0.0, 8000.0, 30_000.0, 34_842.0],
}
FAR_ENOUGH = "observation.site_distance_max_m"
REFUSED = [
    # changes of a file copied for a body of which nothing is computed
    ({SITE: ELSEWHERE, NORMAL: INWARD}, NORMAL, "must point outward"),
    ({PLACE: SUN_M}, PLACE, "0.1 to 50 au"),
    ({SPEED: SUN_M_S}, SPEED, "km/s"),
    # Thousandths in the place of the unit.
    *(
        ({entry: value}, entry, words)
        for entry, value, words in (
            ("boundary.initial_velocity_m_s", [-4.7, -16.7, 27.8], "m/s (10 times the speed"),
            ("boundary.final_velocity_m_s", [0.3, 49.6, -45.7], "in metres per second"),
            ("boundary.initial_position_m", [7e4, -1.1e6, 4e5], "in metres"),
            ("boundary.final_position_m", [2e4, 1.1e6, -1.4e5], "times the nearer end"),
        )
    ),
    ({"safety.radius_min_m": 0.5}, "safety.radius_min_m", "at least 290 m"),
    ({SITE: SITE_KM}, SITE, "29 to 1450 m"),
    ({"body.reference_radius_m": 0.29}, "body.gm_m3_s2", "kg/m^3"),
    (NEAR_SITE, FAR_ENOUGH, "outside the safety radius"),
    (IN_THE_DARK, "observation.window_s", "incidence reaches 136.0 deg"),
]


CONTRADICTING = [
    # and of one copied for Bennu, of which Sun and surface are known
    *[(NORMAL, INWARD), (NORMAL, [0.1, 0.8, 0.3]), (SITE, SITE_KM), ("epoch.tdb", LATER)],
    *[(PLACE, SUN_M), (SPEED, [0.0, 0.0, 0.0])],
]


@pytest.mark.parametrize(
    ("name", "changes", "entry", "words"),
    [
        *(("Other", *row) for row in REFUSED),
        *(
            (None, {entry: value}, PLACE if entry == "epoch.tdb" else entry, "must agree with")
            for entry, value in CONTRADICTING
        ),
    ],
)
def test_impossible_or_contradicting_entries_are_refused(name, changes, entry, words, scenario):
    error = refusal(lambda: Mission.from_scenario(file_of(scenario, changes, name)))
    assert error.entry == entry
    assert words in str(error)
    reliability.count(reliability.BAD_INPUTS)


RADII = [283.065, 271.215, 249.72]
BEGIN, END = "boundary.initial_position_m", "boundary.final_position_m"
SHADOW = "off the axis of the body's shadow: "
WARNED = [
    ({NORMAL: [0.1, 0.8, 0.3]}, NORMAL, "off the direction from the centre: "),
    *(
        ({entry: value}, entry, words)
        for entry, value, words in (
            ("body.gm_m3_s2", 0.5, "73.3 kg/m^3"),
            ("boundary.initial_velocity_m_s", [0.0, 1e-5, 0.0], "escape"),
            (END, [0.0, 1e5, 0.0], "(100 reference radii)"),
            (END, [-1128.7, 19.9, -140.9], SHADOW),
            (BEGIN, [-1096.3, 70.2, 200.0], SHADOW),
            ("burns.dv_max_m_s", 200.0, "m/s, not mm/s?"),
            ("burns.dv_min_m_s", 0.15, "(0.5 times burns.dv_max_m_s)"),
            ("uncertainty.execution_error", 0.0008, "0.0008 of a burn"),
            ("uncertainty.execution_error", 0.8, "not in per cent"),
            ("battery.delta_v_cone_deg", 0.4067, "0.4067 deg"),
            ("observation.site_distance_min_m", 0.5, "0.5 (the largest"),
            ("spacecraft.reflectivity_coefficient", 112.7, "0.5 to 2"),
            ("schedule.heating_s", 30.0, "seconds?"),
            ("body.j2", -0.0431, "unnormalised"),
            ("body.radii_m", RADII[::-1], "turn about the shortest"),
            ("sun.solar_constant_w_m2", 1.361, "1.361"),
            (SPEED, [0.0, 0.0, 0.0], "eccentricity of the orbit: 1"),
        )
    ),
    ({"spacecraft.mass_kg": 0.178}, "spacecraft.srp_area_m2", "m^2/kg"),
    ({"spacecraft.mass_kg": 178e3}, "spacecraft.srp_area_m2", "kilograms, not grams?"),
    ({"body.radii_m": RADII, "body.j2": 0.0193}, "body.j2", "homogeneous ellipsoid"),
    ({"body.radii_m": RADII, "body.reference_radius_m": 170.0}, "body.radii_m", "no diameters?"),
    ({"body.radii_m": RADII, "body.gm_m3_s2": 1.6}, "body.radii_m", "packaged: 299 kg/m^3"),
    ({"epoch.tdb": "2120-01-21T01:56:24", PLACE: SUN, SPEED: SUN_S}, "epoch.tdb", "2000: 120"),
]


@pytest.mark.parametrize(("changes", "entry", "words"), WARNED)
def test_what_is_unlikely_is_warned_about(changes, entry, words, scenario):
    warnings = Mission.from_scenario(file_of(scenario, changes, name="Other")).warnings
    assert [w for w in warnings if w.entry == entry and words in w.given + w.expected]
    assert all(str(w).isprintable() and str(w).startswith(w.entry) for w in warnings)
    reliability.count(reliability.BAD_INPUTS)


def eros(scenario: Scenario, latitude: float = 10.0, year: int | None = None, **body: Any) -> Scene:
    """Eros and its Sun, known besides Bennu, in the place of this."""
    tables = scenario.model_dump(mode="json", exclude_none=True)
    tables |= {
        "body": {"name": "Eros", **body},
        "sun": {"solar_constant_w_m2": 1361.0},
        "site": {"name": "There", "latitude_deg": latitude, "longitude_deg": 10.0},
    }
    if year is not None:
        tables["epoch"] = {"tdb": f"{year}-06-01T00:00:00"}
    return Scene.of(validate_scenario(tables))


def test_wrong_figures_of_a_packaged_body_are_warned(scenario):
    (warning,) = mission_of("body.gm_m3_s2=4.0").warnings
    assert str(warning) == "body.gm_m3_s2: got 4; Bennu has 4.89045"
    # C20 as fields have it, normalised; the right J2 at another radius; axes in another order.
    for entry, value, told in (
        ("body.j2", "0.01926", "body.j2"),
        ("body.reference_radius_m", "246.0", "body.j2"),
        ("body.radii_m", f"{RADII[::-1]}", "body.radii_m"),
    ):
        assert {w.entry for w in mission_of(f"{entry}={value}").warnings} == {told}
    # A number beside its name makes it no other body.
    numbered = file_of(scenario, {"body.name": "(101955) Bennu", "body.gm_m3_s2": 40.0})
    said = [str(w) for w in Mission.from_scenario(numbered).warnings if "Bennu has" in w.expected]
    assert said == ["body.gm_m3_s2: got 40; Bennu has 4.89045"]
    scene = eros(scenario, gm_m3_s2=4.46e5, pole_ra_deg=17.232, pole_dec_deg=11.363)
    assert [w.entry for w in known.known_body(scene)] == ["body.pole_ra_deg"]
    assert list(known.known_orbit(scene)) == []


SWAPPED = "site.latitude_deg=41.8", "site.longitude_deg=55.9"
WINDOW, HOUR = "observation.window_s", "observation.local_solar_time_max_h"


@pytest.mark.parametrize(
    ("overrides", "entry", "words"),
    [
        # Ten degrees back; the schedule has room for the 430 s that the window comes later.
        (["body.prime_meridian_deg={back}"], "body.prime_meridian_deg", "10.0 deg off"),
        (["body.prime_meridian_deg={round}"], "", ""),
        (SWAPPED, "site.name", "latitude 55.9 deg, longitude 41.8 deg east"),
        ((*SWAPPED, 'site.name="Elsewhere"'), "", ""),
        ([f"{WINDOW}=[13140, 17200]", f"{HOUR}=16"], WINDOW, "reaches 68.6 deg at 17200 s.*60 deg"),
        ([f"{WINDOW}=[13200, 16500]", f"{HOUR}=11"], WINDOW, "local solar time.* 8 and 11 h"),
    ],
)
def test_only_the_changed_entry_is_warned_about(overrides, entry, words, scenario):
    right = scenario.body.prime_meridian_deg
    changes = [one.format(back=right - 10.0, round=right + 361.0) for one in overrides]
    warnings = mission_of(*changes).warnings
    assert [warning.entry for warning in warnings] == ([entry] if entry else [])
    assert all(re.search(words, str(warning)) for warning in warnings)


SITE_AT = "site.latitude_deg", "site.longitude_deg"
POLE_AT = "body.pole_dec_deg", "body.pole_ra_deg"


@pytest.mark.parametrize(
    ("entries", "north", "east", "told"),
    [
        *((SITE_AT, *row) for row in ((0.976, 0.73, 1), (-1.2, -3.0, 1), (0.0, 0.73, 0))),
        *((SITE_AT, *row) for row in ((0.976, 41.8, 0), (55.9, 0.73, 0))),
        (POLE_AT, -1.0535, 1.4916, 1),
        (POLE_AT, -1.0535, 85.46, 1),
    ],
)
def test_angles_in_radians_are_warned_about(entries, north, east, told, scenario):
    scene = Scene.of(scenario.replace(dict(zip(entries, (north, east), strict=True))))
    warnings = [w for w in check_scene(scene) if w.entry == entries[0]]
    assert len(warnings) == told
    assert all("degrees?" in w.expected for w in warnings)


@pytest.mark.parametrize(
    ("meridian", "told"),
    [
        ((), ""),
        ((326.07, 1639.38864745, 0.0), "5.6 deg off"),
        ((300.0, 1639.389232, 0.0), "26.1 deg off"),
    ],
)
def test_other_meridian_of_eros_is_warned_about(meridian, told, scenario):
    """The IAU's rate differs from NEAR's, which is called an assumption."""
    keys = [f"prime_meridian_{key}" for key in ("deg", "rate_deg_day", "acceleration_deg_day2")]
    scene = eros(scenario, year=2026, **dict(zip(keys, meridian, strict=False)))
    (warning,) = (*known.known_body(scene), *known.assumed(scene))
    assert warning.entry == "body.prime_meridian_deg"
    assert (told or "is assumed") in warning.given


def test_slopes_of_a_long_body_raise_no_warning(scenario):
    """On Eros' ellipsoid at 30 deg north the normal is 46 deg off the direction from the centre."""
    scene = eros(scenario, latitude=30.0)
    assert angle_deg(scene.site.position_body, scene.site.normal_body) > 45.0
    # Nor is the distance to the site, which lies outside the safety radius.
    rows = [row for row in INTERVALS if row.entries in (NORMAL, FAR_ENOUGH)]
    assert [list(row.check(scene)) for row in rows] == [[], [], []]


@pytest.mark.parametrize(("carried_days", "told"), [(0.0, True), (730.5, False), (700.0, True)])
def test_sun_outside_the_elements_span_is_checked(carried_days, told, scenario):
    """Two years past its elements, with the Sun of their last day, or carried on as far as that."""
    bennu = packaged_body("Bennu")
    last = bennu.span[1] - 1.0
    position, velocity = bennu.heliocentric(last)
    motion = two_body(tuple(position), tuple(velocity), (-86_400.0, 86_400.0 * 735.0))
    at = 86_400.0 * carried_days
    around = motion(np.array([at - 10.0, at, at + 10.0]))
    found = file_of(
        scenario,
        {
            "epoch.tdb": (J2000_TDB + timedelta(days=last + 730.5)).isoformat(),
            "sun.body_position_km": around[1].tolist(),
            "sun.body_velocity_km_s": ((around[2] - around[0]) / 20.0).tolist(),
        },
    )
    scene = Scene.of(found)
    warnings = list(known.known_orbit(scene))
    assert bool(warnings) == told
    assert all("2037" in w.given and "2035" in w.given for w in warnings)


@pytest.mark.parametrize(("fraction", "told"), [(0.0, 0), (0.001, 0), (0.09, 0), (0.3, 2)])
def test_only_a_large_initial_sigma_is_warned_about(fraction, told, mission):
    """Nor does anything of the packaged scenario."""
    warnings = mission_of(f"uncertainty.initial_sigma_fraction={fraction}").warnings
    assert [w.entry for w in warnings] == told * ["uncertainty.initial_sigma_fraction"]
    assert mission.warnings == ()


WHOLE = ("risk.allocation=exact", "risk.scope=flight")
INSIDE = "{radius_m=250, normal=[1, 0, 0], departure_deg=[160, 160], arrival_deg=[0, 0]}"
DARK = (
    "observation.incidence_max_deg=170.0",
    *(f"observation.local_solar_time_{key}" for key in ("min_h=14.0", "max_h=19.0")),
    *("schedule.recharge_s=0.0", "schedule.heating_s=0.0"),
)


@pytest.mark.parametrize(
    ("overrides", "entry", "words"),
    [
        (["grid.step_max_s=1.0"], "grid.step_max_s", "at most 3000"),
        (["sun.body_position_km=[1.0, 0.0, 0.0]"], "sun.body_position_km", "elements of Bennu"),
        (["body.reference_radius_m=1140.0"], "body.reference_radius_m", "at most 1138 m"),
        # kilometres in the place of metres, and km^3/s^2 converted the wrong way round
        ([f"{BEGIN}=[0.0702, -1.0963, 0.4064]"], BEGIN, "centre: 1.17 m); must be at least 290 m"),
        (["body.gm_m3_s2=4.89e9"], "body.gm_m3_s2", "the planner's steps are 240 s"),
        # local solar time alone makes the window
        (DARK, "observation.incidence_max_deg", "must keep the site in the light"),
        ((*WHOLE, "risk.p_chance=0.999999"), "risk.p_chance", "at least 1e-05"),
        ([f"boundary.home={INSIDE}"], "boundary.home.radius_m", "got 250 (from the centre"),
        # the value as it was given
        ([f"{BEGIN}=[1128712.5,0,0]"], BEGIN, "got [1128712.5, 0, 0] (from"),
        ([f"{PLACE}=[1128712.5,3,-2.25]"], PLACE, "got [1128712.5, 3, -2.25]"),
        ([f"{WINDOW}=[1128712.5,1128999.5]"], WINDOW, "got [1128712.5, 1128999.5] s"),
        (["body.gm_m3_s2=1128712.5"], "body.gm_m3_s2", "got 1128712.5 m^3/s^2"),
        (["safety.radius_min_m=500000"], "safety.radius_min_m", "got 500000 m"),
        # the one that is out of proportion
        (["safety.radius_min_m=5000"], "safety.radius_min_m", "must be"),
        (["body.reference_radius_m=29000"], "body.reference_radius_m", "must be"),
    ],
)
def test_it_is_refused_by_name(overrides, entry, words):
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        mission_of(*overrides)
    assert caught.value.entry == entry
    reliability.count(reliability.BAD_INPUTS)


def test_a_body_that_may_reach_sun_is_refused(scenario):
    sun = scenario.sun.model_copy(update={"body_position_km": (1.0, 0.0, 0.0)})
    with pytest.raises(InputError, match=r"0\.5 times the way to the Sun") as caught:
        Mission.from_scenario(scenario.model_copy(update={"sun": sun}))
    assert caught.value.entry == "sun.body_velocity_km_s"


FLIGHT = {
    "at_s": 17_000.0,
    "position_m": [-122.6, 419.9, -556.2],
    "velocity_m_s": [0.007, 0.079, 0.066],
    "flown_m_s": [[0.0, 0.0, 0.0]] * 2,
}


def test_a_low_state_in_flight_is_named(scenario):
    """About a body whose boundary states are far enough out; outside it all the same."""
    low = FLIGHT | {"position_m": [295.0, 0.0, 0.0], "velocity_m_s": [0.0, 0.1, 0.0]}
    heavy = scenario.replace({"body.gm_m3_s2": 600.0, "in_flight": low})
    expected = r"^in_flight.position_m: got \[295, 0, 0\] \(.*: 295 m\); must be at least 32"
    with pytest.raises(InputError, match=expected):
        check_plannable(Scene.of(heavy))
    check_plannable(Scene.of(heavy.replace({"in_flight.position_m": [800.0, 0.0, 0.0]})))


@pytest.mark.parametrize(
    ("key", "value"), [("velocity_m_s", [0.0, 60.0, 0.0]), ("position_m", [0.0, 9e5, 0.0])]
)
def test_a_delivered_state_in_thousandths_is_refused(key, value, scenario, mission):
    """It is checked where all else is known, as of a plan made again."""
    Mission.from_scenario(scenario.replace({"in_flight": FLIGHT}), known=mission)
    wrong = scenario.replace({"in_flight": FLIGHT | {key: value}})
    error = refusal(Mission.from_scenario, wrong, known=mission)
    assert error.entry == f"in_flight.{key}"


@pytest.mark.parametrize("given", [(0.976, 0.73), (-1.2, -3.0), (0.1, 6.2)])
def test_radians_are_told_before_what_follows_from_them(given):
    """At such a place the flight may have no window, or none between its burns."""
    north, east = given
    error = refusal(mission_of, f"site.latitude_deg={north}", f"site.longitude_deg={east}")
    first, *others = str(error).splitlines()
    assert (error.entry, "degrees?" in first) == ("site.latitude_deg", True)
    assert others
    error = refusal(
        mission_of, f"site.latitude_deg={north}", f"site.longitude_deg={east}", "risk.p_chance=2"
    )
    assert error.entry == "risk.p_chance"


def test_largest_probability_of_whole_flights_is_accepted():
    assert mission_of(*WHOLE, f"risk.p_chance={PROBABILITY_MAX}").scenario.risk.scope == "flight"
    mission_of("risk.allocation=exact", "risk.p_chance=0.999999999")


ROWS = (*PLANNER_INTERVALS, *INTERVALS, *STATE_INTERVALS)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.quantity)
def test_the_rows_are_about_entries_of_a_scenario(row):
    """And what is refused is beyond what is warned about."""
    for entry in row.entries.split():
        table: Any = Scenario
        for key in entry.split("."):
            assert key in table.model_fields, entry
            kind = table.model_fields[key].annotation
            table = next((k for k in (kind, *get_args(kind)) if hasattr(k, "model_fields")), None)
    if row.warn and row.refuse:
        assert row.refuse[0] < row.warn[0] or row.warn[0] == -np.inf
        assert row.warn[0] < row.warn[1] < row.refuse[1]


@pytest.mark.parametrize(
    ("override", "hint"),
    [
        ("uncertainty.execution_error=8.0", "; a share, not per cent?"),
        ("risk.p_chance=70", "; a share, not per cent?"),
        ("risk.p_chance=1.5", None),
        ("observation.site_distance_max_m=0.74", "; metres, not kilometres?"),
        ("observation.site_distance_min_m=800", None),
        ("observation.emission_max_deg=0.3", "; degrees?"),
        ("observation.emission_max_deg=0.785", "below the maximum 0.785; degrees?"),
        ("observation.emission_max_deg=15.0", None),
        ("observation.local_solar_time_max_h=960", "; hours, not minutes?"),
        ("safety.radius_min_m=0.5", "; metres, not kilometres?"),
        ("safety.radius_min_m=200", None),
        ("body.reference_radius_m=0.29", "; the radius in metres?"),
        ("body.gm_m3_s2=4.89e-9", "; m^3/s^2, not km^3/s^2?"),
        (f"{BEGIN}=[0.07,-1.1,0.4]", "; metres, not kilometres?"),
        ("boundary.initial_velocity_m_s=[-4.7,-16.7,27.8]", "; m/s, not mm/s?"),
    ],
)
def test_refused_value_of_another_unit_gets_hint(override, hint):
    error = refusal(mission_of, override)
    said = error.allowed.splitlines()[0]
    assert said.endswith(hint) if hint else "?" not in said
