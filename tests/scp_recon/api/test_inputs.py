"""A refused window names the entries that explain it."""

import pytest

from scp_recon.api.designing import find_pass
from scp_recon.api.inputs import PlanRequest, resolve
from scp_recon.errors import InputError
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from tests.scp_recon.scenario.test_resolution import PLACE, ROCK, STATE, rock

WINDOW = {"window_s": [13_200.0, 16_500.0]}
AWAY = {entry: [-part for part in state] for entry, state in STATE.items()}


def refusal(scenario: Scenario | str, *overrides: str) -> str:
    request = PlanRequest(scenario, overrides=overrides)
    with pytest.raises(InputError) as caught:
        resolve(request)
    return str(caught.value)


@pytest.mark.parametrize(
    ("tables", "line"),
    [
        (
            {"site": PLACE | {"longitude_deg": -42.0}},
            "tried, and accepted: site.longitude_deg = 42 (counted to the west?)",
        ),
        ({"sun": AWAY}, "tried, and accepted: sun.body_position_km = [151091819.0"),
        (
            {"body": ROCK | {"rotation_period_h": 4.3 / 24.0}},
            "tried, and accepted: body.rotation_period_h = 4.3 (in days?)",
        ),
    ],
)
def test_other_readings_that_light_the_window_are_named(tables, line):
    said = refusal(rock(**tables, observation=WINDOW))
    assert said.startswith("observation.window_s: got ")
    assert line in said
    right = PlanRequest(rock(observation=WINDOW))
    assert resolve(right).mission.schedule.window_s == (13_200.0, 16_500.0)


@pytest.mark.parametrize(
    ("override", "right"),
    [
        ("body.pole_ra_deg=1.4935", "85.5712"),
        ("body.prime_meridian_deg=2.44", "139.802"),
        ("observation.incidence_max_deg=1.047", "59.9887"),
    ],
)
def test_one_angle_in_radians_begins_the_refusal(override, right):
    entry, given = override.split("=")
    first, *others = refusal("recon_b", override).splitlines()
    assert first == f"{entry}: got {given} deg; tried, and accepted: {right}; degrees?"
    assert others[0].startswith("observation")
    accepted = PlanRequest("recon_b", overrides=(f"{entry}={right}",))
    assert resolve(accepted).mission.schedule.window_s


def test_design_names_one_angle_in_radians():
    with pytest.raises(InputError) as caught:
        find_pass(load_scenario("recon_b", ["observation.incidence_max_deg=1.047"]))
    said = "observation.incidence_max_deg: got 1.047 deg; tried, and accepted: 59.9887; degrees?\n"
    assert str(caught.value).startswith(f"{said}design: got ")


def test_declination_in_radians_is_asked_about():
    request = PlanRequest("recon_b", overrides=("body.pole_dec_deg=-1.0535",))
    (warning,) = resolve(request).mission.warnings
    assert warning.entry == "body.pole_dec_deg"
    assert warning.expected.endswith("; degrees?")


def test_wrong_spin_of_known_body_is_named():
    overrides = "observation.window_s=[13200, 16500]", "body.prime_meridian_rate_deg_day=1600.0"
    said = refusal("recon_b", *overrides)
    assert said.startswith("observation.window_s: got ")
    assert "_deg_day: got 1600; Bennu has 2011" in said
