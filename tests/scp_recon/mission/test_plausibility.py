"""Entries that are each within their bounds and make no sense together."""

from __future__ import annotations

from pathlib import Path

import pytest

from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.mission.plausibility import check_plausible
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from tests import reliability
from tests.scp_recon.support import mission_of


@pytest.mark.parametrize(
    ("override", "entry", "words"),
    [
        ("grid.step_max_s=1.0", "grid.step_max_s", "at most 3000 nodes"),
        ("sun.body_position_km=[1.0, 0.0, 0.0]", "sun.body_position_km", "elements of Bennu"),
        ("body.reference_radius_m=1140.0", "boundary.final_position_m", "outside the body"),
        # kilometres in the place of metres, and km^3/s^2 converted the wrong way round
        (
            "boundary.initial_position_m=[0.0702, -1.0963, 0.4064]",
            "boundary.initial_position_m",
            "1.17131 m from the centre; must be outside",
        ),
        ("body.gm_m3_s2=4.89e9", "body.gm_m3_s2", "the planner's steps are 240 s"),
    ],
)
def test_it_is_refused_by_name(override: str, entry: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        mission_of(override)
    assert caught.value.entry == entry
    assert words in str(caught.value)
    reliability.count(reliability.BAD_INPUTS)


def test_a_body_that_could_reach_the_sun_is_refused(scenario: Scenario) -> None:
    sun = scenario.sun.model_copy(update={"body_position_km": (1.0, 0.0, 0.0)})
    with pytest.raises(InputError, match="half its 1 km") as caught:
        Mission.from_scenario(scenario.model_copy(update={"sun": sun}))
    assert caught.value.entry == "sun.body_velocity_km_s"


def test_a_state_in_flight_is_not_blamed_on_the_gravity(scenario: Scenario) -> None:
    """About a body whose boundary states are far enough out; outside it all the same."""
    flight = {
        "at_s": 17_000.0,
        "position_m": [295.0, 0.0, 0.0],
        "velocity_m_s": [0.0, 0.1, 0.0],
        "flown_m_s": [[0.0, 0.0, 0.0]] * 2,
    }
    heavy = scenario.replace({"body.gm_m3_s2": 600.0, "in_flight": flight})
    expected = r"^in_flight.position_m: got 295 m from the centre; must be above [0-9.]+ m, where"
    with pytest.raises(InputError, match=expected):
        check_plausible(heavy)
    check_plausible(heavy.replace({"in_flight.position_m": [800.0, 0.0, 0.0]}))


def test_a_home_orbit_inside_the_body_is_refused_by_its_radius(tmp_path: Path) -> None:
    home = tmp_path / "home.toml"
    home.write_text(
        'base = "recon_b"\n[boundary.home]\nradius_m = 250.0\nnormal = [1, 0, 0]\n'
        "departure_deg = [160, 160]\narrival_deg = [0, 0]\n",
        "utf-8",
    )
    with pytest.raises(InputError, match=r"^boundary\.home\.radius_m: got 250 m from the centre"):
        Mission.from_scenario(load_scenario(home))
