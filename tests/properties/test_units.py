"""A consistent scenario with one entry in another unit, or with two axes swapped, is never let pass.

Physics cannot tell everything. Left out are: the axes of boundary states and of a site near a diagonal;
the prime meridian, the pole and the spin of a body that is not packaged, in radians; limits of
probability, and small errors; and a `dv_max_m_s` in km/s, which leaves no plan.
"""

from datetime import timedelta
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from scp_recon.bodies.catalogue import GM_SUN_KM3_S2, OBLIQUITY
from scp_recon.errors import InputError
from scp_recon.mission.checks import check_scene, check_state
from scp_recon.mission.intervals import INTERVALS
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import Scene
from scp_recon.physics.frames import unit
from scp_recon.physics.geometry import Site
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from scp_recon.scenario.uncertainty import Uncertainty
from tests import reliability
from tests.scp_recon.support import file_of

RECON_B = load_scenario()
MISSION = Mission.from_scenario(RECON_B)
Entries = dict[str, Any]
LENGTHS = (
    *("body.reference_radius_m", "site.position_body_m", "safety.radius_min_m"),
    *("boundary.initial_position_m", "boundary.final_position_m"),
    *("observation.site_distance_min_m", "observation.site_distance_max_m"),
)
SPEEDS = ("boundary.initial_velocity_m_s", "boundary.final_velocity_m_s", "burns.dv_max_m_s")


def entry_of(scenario: Scenario, path: str) -> Any:
    found: Any = scenario
    for part in path.split("."):
        found = getattr(found, part)
    return found


def scaled(value: Any, factor: float) -> Any:
    return [factor * x for x in value] if isinstance(value, tuple) else factor * value


@st.composite
def consistent(draw: st.DrawFn) -> Scenario:
    """Reconnaissance B about another body: larger or smaller, denser, elsewhere on its orbit."""
    size, density = 10.0 ** draw(st.floats(-0.5, 1.5)), draw(st.floats(0.7, 3.0))
    changes: Entries = {path: scaled(entry_of(RECON_B, path), size) for path in LENGTHS}
    speed = size * np.sqrt(density)
    changes |= {path: scaled(entry_of(RECON_B, path), speed) for path in SPEEDS}
    sun = np.array(RECON_B.sun.body_position_km) * draw(st.floats(0.95, 1.05))
    return file_of(
        RECON_B,
        changes
        | {
            "body.gm_m3_s2": 1.001 * RECON_B.body.gm_m3_s2 * density * size**3,
            "body.j2": draw(st.floats(0.0, 0.04)),
            "sun.body_position_km": [*(sun[:2] + 1.0), sun[2]],
        },
        name="Mine",
    )


def is_told(scenario: Scenario, changes: Entries) -> bool:
    """Whether a file of these entries is refused, or warned about at any of them."""
    try:
        told = bool(Mission.from_scenario(file_of(scenario, changes)).warnings)
    except InputError:
        told = True
    reliability.count(reliability.BAD_INPUTS)
    return told


@given(consistent())
def test_consistent_scenario_raises_no_question(scenario):
    assert Mission.from_scenario(scenario).warnings == ()


KM, MM = 1e-3, 1e3
WRONG = [
    *((path, KM) for path in LENGTHS),
    *((path, KM) for path in SPEEDS[:2]),
    *((path, MM) for path in LENGTHS),
    *((path, MM) for path in SPEEDS),
    ("body.gm_m3_s2", 1e-9),
    ("sun.body_position_km", 1e3),
    ("sun.body_position_km", 1.0 / 149_597_870.7),
    ("sun.body_velocity_km_s", 1e3),
    ("sun.body_velocity_km_s", 1e-3),
    ("sun.solar_constant_w_m2", 1e-3),
    ("spacecraft.mass_kg", 1e-3),
    ("spacecraft.mass_kg", 1e3),
]


LIMITS = (
    *("observation.emission_min_deg", "observation.emission_max_deg", "observation.phase_min_deg"),
    *("observation.incidence_max_deg", "battery.delta_v_cone_deg"),
    "battery.observation_cone_deg",
)
BODY_ANGLES = ("body.pole_ra_deg", "body.pole_dec_deg", "body.prime_meridian_rate_deg_day")
Factors = dict[str, float]
"""Numbers that entries are multiplied by."""

some_lengths = st.builds(
    lambda factor, paths: dict.fromkeys(paths, factor),
    st.sampled_from([KM, MM]),
    st.sets(st.sampled_from(LENGTHS), min_size=1, max_size=len(LENGTHS) - 1),
)
in_radians = st.sets(st.sampled_from(LIMITS), min_size=1).map(
    lambda paths: dict.fromkeys(paths, np.deg2rad(1.0))
)
wholly_in_km: Factors = dict.fromkeys((*LENGTHS, *SPEEDS), KM) | {"body.gm_m3_s2": KM**3}
"""Gravity and speeds too: a smaller body of the same density, which nobody flies to."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "wrong",
    [
        st.sampled_from(WRONG).map(lambda pair: dict([pair])),
        some_lengths,
        in_radians,
        st.just(wholly_in_km),
    ],
    ids=["one entry", "some lengths", "limits in radians", "all in kilometres"],
)
@given(consistent(), st.data())
def test_entries_in_another_unit_are_told(wrong, scenario, data):
    factors = data.draw(wrong)
    changes = {path: scaled(entry_of(scenario, path), factor) for path, factor in factors.items()}
    assert is_told(scenario, changes)


@pytest.mark.slow
@given(st.sets(st.sampled_from(BODY_ANGLES), min_size=1))
def test_pole_or_spin_in_radians_is_told(paths):
    assert is_told(RECON_B, {path: np.deg2rad(entry_of(RECON_B, path)) for path in paths})
    body = RECON_B.body
    changes = {"body.pole_ra_deg": body.pole_dec_deg, "body.pole_dec_deg": body.pole_ra_deg}
    assert is_told(RECON_B, changes)


SHAPELESS = file_of(RECON_B, {}, name="Mine")
"""On a shape the scenario holds the normal to that before."""
SWAPS = {"xy": (1, 0, 2), "xz": (2, 1, 0), "yz": (0, 2, 1), "xyz": (1, 2, 0), "zyx": (2, 0, 1)}


@pytest.mark.parametrize("swap", SWAPS)
@pytest.mark.parametrize("path", ["sun.body_position_km", "sun.body_velocity_km_s"])
def test_swapped_axes_of_the_sun_are_told(path, swap):
    value = entry_of(RECON_B, path)
    assert is_told(RECON_B, {path: [value[i] for i in SWAPS[swap]]})


@given(st.floats(0.0, 2.0 * np.pi), st.floats(0.0, 16.6), st.booleans())
def test_sun_in_ecliptic_axes_alone_is_told(node, inclination_deg, wrong):
    """An orbit about any node, less inclined if the axes are wrong."""
    inclination_deg *= 0.4 if wrong else 1.0
    tilt = Rotation.from_euler("zx", [node, np.deg2rad(inclination_deg)])
    state = tilt.inv().apply([[1.5e8, 1e6, 0.0], [-2.0, 29.0, 0.0]])
    if not wrong:
        state = Rotation.from_euler("x", OBLIQUITY).apply(state)
    changes = {
        "sun.body_position_km": state[0].tolist(),
        "sun.body_velocity_km_s": state[1].tolist(),
    }
    found = file_of(RECON_B, changes, name="Mine")
    (row,) = (row for row in INTERVALS if "equator" in row.quantity)
    told = list(row.check(Scene.of(found)))
    assert [bool("ecliptic" in warning.expected) for warning in told] == wrong * [True]


@given(
    st.floats(1.01e-4, 0.0998), st.sampled_from([KM, MM]), st.sampled_from([(1, 0), (0, 1), (1, 1)])
)
def test_a_spread_in_another_unit_is_told(share, factor, which):
    """Position, velocity or both, whatever share of distance and speed is said without a word."""
    distance, speed = (np.linalg.norm(MISSION.initial_state[part]) for part in HALVES)
    speed = max(speed, np.sqrt(RECON_B.body.gm_m3_s2 / distance))
    sigma = np.array([share * distance, share * speed])
    assert not spread_is_told(*sigma)
    assert spread_is_told(*(sigma * [factor**power for power in which]))


def spread_is_told(position_m: float, velocity_m_s: float) -> bool:
    """Whether sigmas of every component are refused, or warned about."""
    given = Uncertainty(
        initial_sigma_position_m=(position_m,) * 3,
        initial_sigma_velocity_m_s=(velocity_m_s,) * 3,
        initial_frame="j2000",
        execution_error=0.02,
    )
    scenario = RECON_B.model_copy(update={"uncertainty": given})
    try:
        return bool(check_state(Scene(scenario, MISSION.rotation, MISSION.site)))
    except InputError:
        return True


HALVES = slice(0, 3), slice(3, 6)


@given(st.floats(-1.0, 1.0))
def test_known_body_may_be_anywhere_on_orbit(days):
    """Carried on by SciPy's integrator about a Sun alone, a hundred days either way, with the epoch."""
    sun = RECON_B.sun
    later = RECON_B.epoch.tdb + timedelta(days=100.0 * days)
    start = [*sun.body_position_km, *sun.body_velocity_km_s]

    def rate(_: float, y: np.ndarray) -> list[float]:
        return [*y[3:], *(-GM_SUN_KM3_S2 * y[:3] / np.linalg.norm(y[:3]) ** 3)]

    flown = solve_ivp(rate, (0.0, 100.0 * 86_400.0 * days), start, rtol=1e-9, atol=1e-3).y[:, -1]
    given = {
        "epoch.tdb": later.isoformat(),
        "sun.body_position_km": flown[:3].tolist(),
        "sun.body_velocity_km_s": flown[3:].tolist(),
    }
    found = file_of(RECON_B, given)
    assert check_scene(Scene.of(found)) == ()


@given(
    st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
    st.sampled_from(list(SWAPS.values())),
)
def test_swapped_site_axes_are_told_by_slope(direction, swap):
    normal, position = unit(direction), 250.0 * unit(direction)
    site = Site(position[list(swap)], normal)
    moved = np.rad2deg(np.arccos(np.clip(site.position_body @ position / 250.0**2, -1.0, 1.0)))
    try:
        found = check_scene(Scene(SHAPELESS, MISSION.rotation, site))
        told = any(warning.entry == "site.normal_body" for warning in found)
    except InputError as error:
        assert moved > 89.9
        told = error.entry == "site.normal_body"
    assert told == (moved > 30.0) or abs(moved - 30.0) < 1e-6
