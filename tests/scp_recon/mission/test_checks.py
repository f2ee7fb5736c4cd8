"""Missions that are hardly what was meant: refused, or warned about in so many words."""

from __future__ import annotations

import json
import tomllib
from importlib.resources import files
from pathlib import Path

import pytest

from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from tests import reliability
from tests.scp_recon.support import mission_of

ELSEWHERE = "site.position_body_m=[-91.0, 81.0, 181.0]"
LATER = 'epoch.tdb="2020-03-21T20:33:17"'
REFUSED = [
    ([ELSEWHERE], "site.normal_body", "49.4 deg away"),
    ([ELSEWHERE, "site.normal_body=[0.4, -0.5, -0.7]"], "site.normal_body", "out of the body"),
    ([LATER], "sun.body_position_km", "must be given for the new epoch"),
    ([LATER, "sun.body_position_km=[1e8, 1e8, 0]"], "sun.body_velocity_km_s", "new epoch"),
    (["sun.body_position_km=[1.51e11, -4.9e9, -3.4e9]"], "sun.body_position_km", "0.1 to 50 au"),
    (["sun.body_velocity_km_s=[-4300, 26811, 15168]"], "sun.body_velocity_km_s", "km/s"),
    (["safety.radius_min_m=0.5"], "safety.radius_min_m", "reference radius, 290 m"),
    (["site.position_body_m=[0.0914, 0.0817, 0.1811]"], "site.position_body_m", "29 to 1450 m"),
    (["body.reference_radius_m=0.29"], "body.gm_m3_s2", "kg/m^3"),
    (
        ["observation.site_distance_min_m=0.5", "observation.site_distance_max_m=0.74"],
        "observation.site_distance_max_m",
        "outside the safety radius",
    ),
    (
        ["observation.window_s=[20000, 24000]", "burns.times_s=[0, 8000, 30000, 34842]"],
        "observation.window_s",
        "incidence reaches 136.0 deg",
    ),
]


@pytest.mark.parametrize(("overrides", "entry", "words"), REFUSED)
def test_what_physics_rules_out_is_refused(overrides: list[str], entry: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        mission_of(*overrides)
    assert caught.value.entry == entry
    assert words in str(caught.value)
    reliability.count(reliability.BAD_INPUTS)


WARNED = [
    (
        ["site.normal_body=[0.1, 0.8, 0.3]"],
        "site.normal_body",
        "deg off the direction from the centre",
    ),
    (["body.name=Other"], "body.gm_m3_s2", "that of Bennu"),
    (["body.name=Other"], "sun.body_position_km", "that of Bennu"),
    (["body.gm_m3_s2=0.5"], "body.gm_m3_s2", "73.3 kg/m^3"),
    (["body.gm_m3_s2=4.0"], "body.gm_m3_s2", "Bennu has 4.89"),
    (["boundary.initial_velocity_m_s=[0, 1e-5, 0]"], "boundary.initial_velocity_m_s", "escape"),
    (["boundary.final_position_m=[0, 1e5, 0]"], "boundary.final_position_m", "100 radii"),
    (["burns.dv_max_m_s=200.0"], "burns.dv_max_m_s", "200 m/s"),
    (["battery.delta_v_cone_deg=0.4067"], "battery.delta_v_cone_deg", "0.4067 deg"),
    (["observation.site_distance_min_m=0.5"], "observation.site_distance_min_m", "0.5 m"),
    (["spacecraft.mass_kg=0.178"], "spacecraft.srp_area_m2", "0.178 kg"),
    (["sun.solar_constant_w_m2=1.361"], "sun.solar_constant_w_m2", "1.361"),
    (["sun.body_velocity_km_s=[0, 0, 0]"], "sun.body_velocity_km_s", "eccentricity of 1.00"),
]


@pytest.mark.parametrize(("overrides", "entry", "words"), WARNED)
def test_what_is_unlikely_is_warned_about(overrides: list[str], entry: str, words: str) -> None:
    warnings = mission_of(*overrides).warnings
    assert [w for w in warnings if w.entry == entry and words in w.given + w.expected]
    assert all(str(w).isprintable() and str(w).startswith(w.entry) for w in warnings)
    reliability.count(reliability.BAD_INPUTS)


def test_the_default_raises_no_question(mission: Mission) -> None:
    assert mission.warnings == ()


def test_a_window_beyond_the_files_own_limit_is_told_with_the_worst_incidence() -> None:
    (warning,) = mission_of(
        "observation.window_s=[13140.0, 17200.0]", "burns.times_s=[0, 8000, 25000, 34842]"
    ).warnings
    assert warning.entry == "observation.window_s"
    assert "incidence reaches 68.6 deg at 17200 s" in warning.given
    assert warning.expected == "observation.incidence_max_deg is 60 deg"


def test_a_window_beyond_the_local_solar_time_is_told() -> None:
    warnings = mission_of(
        "observation.window_s=[13200.0, 16500.0]", "observation.local_solar_time_max_h=11.0"
    ).warnings
    assert "local solar time" in warnings[0].given
    assert "8 and 11 h" in warnings[0].expected


def test_the_computed_window_given_again_is_no_question(mission: Mission) -> None:
    first, last = mission.schedule.window_s
    assert mission_of(f"observation.window_s=[{first:.0f}, {last:.0f}]").warnings == ()


# --- how an entry was left as it was -------------------------------------------------------------


def test_a_copied_file_is_as_a_derived_one(tmp_path: Path) -> None:
    """Whoever copies the packaged file and edits the epoch inherits its Sun as well."""
    text = (files("scp_recon") / "data" / "recon_b.toml").read_text("utf-8")
    file = tmp_path / "mine.toml"
    file.write_text(text.replace("2020-01-21T20:33:17.184", "2020-02-21T20:33:17.184"), "utf-8")
    with pytest.raises(InputError, match="new epoch"):
        Mission.from_scenario(load_scenario(file))


def test_changes_of_ones_own_scenario_are_held_to_it() -> None:
    """Though nothing of it is a packaged scenario's."""
    data = tomllib.loads((files("scp_recon") / "data" / "recon_b.toml").read_text("utf-8"))
    data["site"]["normal_body"] = [0.4, 0.5, 0.7]
    data["epoch"]["tdb"] = "2020-01-21T20:33:17.184"
    own = Scenario.validated(json.loads(json.dumps(data)))
    with pytest.raises(InputError, match="a slope of its own"):
        own.replace({"site.position_body_m": [-91.0, 81.0, 181.0]})


def test_small_moves_keep_sun_and_normal(scenario: Scenario) -> None:
    moved = [x + 1.0 for x in scenario.site.position_body_m]
    near = {"site.position_body_m": moved, "epoch.tdb": "2020-01-21T20:34:00"}
    assert Mission.from_scenario(scenario.replace(near)).warnings == ()


def test_what_is_given_with_it_is_taken(scenario: Scenario) -> None:
    there = {"site.position_body_m": [150.0, 0.0, 150.0], "site.normal_body": [0.7, 0.0, 0.7]}
    assert scenario.replace(there).site.normal_body == (0.7, 0.0, 0.7)
