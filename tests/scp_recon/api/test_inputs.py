"""A refused window names the entries that explain it."""

import pytest

from scp_recon.api.inputs import PlanRequest, load, resolve
from scp_recon.errors import InputError
from scp_recon.scenario.schema import Scenario
from tests.scp_recon.scenario.test_resolution import PLACE, ROCK, STATE, rock

WINDOW = {"window_s": [13_200.0, 16_500.0]}
AWAY = {entry: [-part for part in state] for entry, state in STATE.items()}


def refusal(scenario: Scenario | str, *overrides: str) -> str:
    request = PlanRequest(scenario, overrides=overrides)
    with pytest.raises(InputError) as caught:
        resolve(load(request), request)
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
    assert resolve(load(right), right).mission.schedule.window_s == (13_200.0, 16_500.0)


def test_a_known_bodys_wrong_spin_is_named_beside_its_window():
    overrides = "observation.window_s=[13200, 16500]", "body.prime_meridian_rate_deg_day=1600.0"
    said = refusal("recon_b", *overrides)
    assert said.startswith("observation.window_s: got ")
    assert "body.prime_meridian_rate_deg_day: got 1600; Bennu has 2011" in said
