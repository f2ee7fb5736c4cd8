"""The server of the page with sliders: what it plans, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from http.client import HTTPConnection
from typing import Any

import numpy as np
import pytest

from scp_recon.api.exploring import BYTES_MAX, Explorer, Server, changed, sliders_of
from scp_recon.api.verbs import explore, plan, scenarios
from scp_recon.errors import InputError
from scp_recon.results.solution import make_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status

JSON = {"Content-Type": "application/json"}
FEEDBACK = {"policy.kind": "feedback"}
GATES = {
    "magnitude_fixed_m_s": 1e-4,
    "magnitude_proportional": 0.01,
    "pointing_fixed_m_s": 1e-4,
    "pointing_proportional_rad": 0.01,
}
SIGMAS = {
    "initial_sigma_position_m": [1.0, 2.0, 3.0],
    "initial_sigma_velocity_m_s": [1e-4, 2e-4, 3e-4],
    "initial_frame": "rtn",
}
OTHER_ERRORS = {
    "uncertainty": {"gates": GATES, **SIGMAS},
    "navigation": {"covariance": np.diag([1.0] * 3 + [1e-8] * 3).tolist()},
}


def ask(
    server: Server, method: str, path: str, body: str | None = None, **headers: str
) -> tuple[int, str]:
    connection = HTTPConnection("127.0.0.1", server.server_port, timeout=60)
    try:
        connection.request(method, path, body, {k.replace("_", "-"): v for k, v in headers.items()})
        answer = connection.getresponse()
        return answer.status, answer.read().decode()
    finally:
        connection.close()


def answered(server: Server, path: str, values: object) -> dict[str, Any]:
    status, text = ask(server, "POST", path, json.dumps(values), **JSON)
    assert status == 200
    found: dict[str, Any] = json.loads(text)
    return found


@pytest.mark.slow
def test_the_written_scenario_gives_the_shown_plan(server, tmp_path):
    values = {"risk.p_chance": 0.8, "burns.times_s.1": 7000.0}
    found = answered(server, "/plan", values)
    (tmp_path / "mine.toml").write_text(found["toml"], "utf-8")
    scenario = load_scenario(tmp_path / "mine.toml")
    assert (scenario.risk.p_chance, scenario.burns.times_s[1]) == (0.8, 7000.0)
    alone = make_solution(plan(scenario))
    assert found["drawn"]["file"] == f"{scenario.name}-{alone.plan_hash[:12]}"
    assert found["cost"] == f"{1e3 * alone.total_dv_m_s:.1f} mm/s"
    assert found["legal"]["burns.times_s.2"].startswith("legal, the others kept: 23137 to ")
    assert "not checked" in found["verdict"]
    assert "not checked" not in (judged := answered(server, "/verdict", values)["verdict"])
    assert "<strong>verified</strong>" in judged
    assert "next:" not in judged  # it is for commands; the page has controls
    assert {chart["key"] for chart in found["drawn"]["charts"]} >= {"observation", "timeline"}


@pytest.mark.slow
def test_a_plan_that_is_infeasible_says_so(server):
    made = server.explorer.plan({})
    infeasible = replace(made.solution, status="infeasible")
    shown = replace(made, solution=infeasible)
    found = Explorer(server.explorer.scenario, ({}, shown)).answer({})
    assert found["cost"].endswith("mm/s, infeasible")
    assert not found["converged"]
    assert Status.INFEASIBLE.value.message in found["verdict"]
    assert "init" not in found["verdict"]  # which is an option of commands


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"risk.p_chance": 2}, "must be a number from 0.51 to 0.999"),
        ({"risk.p_chance": "0.8"}, "must be a number"),
        ({"risk.p_chance": True}, "must be a number"),
        ({"name": "other"}, "must be one of risk.p_chance"),
        ({"policy.kind": "closed"}, "must be one of open, feedback"),
        ({"burns.times_s.1": 12000.0}, "this burn may be between"),
        ({"observation.emission_min_deg": 80.0}, "must be below the maximum"),
        ([0.8], "must be values by entry"),
    ],
)
def test_invalid_slider_values_get_a_reason(server, values, reason):
    for path in ("/plan", "/verdict"):
        found = answered(server, path, values)
        assert [*found] == ["refused"]
        assert reason in found["refused"]


@pytest.mark.parametrize(
    ("method", "path", "body", "headers", "status"),
    [
        ("GET", "/", None, {}, 200),
        ("GET", "/plan", None, {}, 405),
        ("GET", "/../pyproject.toml", None, {}, 404),
        ("PUT", "/plan", "{}", JSON, 501),
        ("POST", "/", "{}", JSON, 405),
        ("POST", "/plan", "{}", {}, 415),
        ("POST", "/plan", "{", JSON, 400),
        ("POST", "/plan", " " * BYTES_MAX + "{}", JSON, 400),
        ("POST", "/plan", "[" * 10_000, JSON, 400),
        ("POST", "/plan", "{}", JSON | {"Content-Length": "9" * 5000}, 400),
        ("POST", "/plan", '{"risk.p_chance": NaN}', JSON, 200),
        ("GET", "/", None, {"Host": "elsewhere.example"}, 403),
        ("POST", "/plan", "{}", JSON | {"Origin": "http://elsewhere.example"}, 403),
    ],
)
def test_it_answers_its_own_page_alone(server, method, path, body, headers, status):
    found, text = ask(server, method, path, body, **headers)
    assert found == status
    if "NaN" in (body or ""):
        assert "must be a number" in text


@pytest.mark.parametrize("scenario", [*scenarios().values()], ids=lambda one: one.name)
def test_sliders_hold_the_values_of_their_scenario(scenario):
    sliders = sliders_of(scenario)
    assert len({slider.key for slider in sliders}) == len(sliders) > 8
    for slider in sliders:
        assert slider.low <= slider.value <= slider.high
    given = {slider.key: slider.value for slider in sliders if slider.group != "Navigation"}
    assert changed(scenario, sliders, given) == scenario


def test_entries_of_many_numbers_are_multiplied_as_sigmas(scenario):
    other: Scenario = scenario.replace(OTHER_ERRORS)
    sliders = sliders_of(other)
    several = {slider.key for slider in sliders if slider.power}
    assert len(several) == 4
    assert "navigation.sigma_position_m" not in {slider.key for slider in sliders}
    found = changed(other, sliders, dict.fromkeys(several, 2.0))
    assert found.uncertainty.initial_sigma_position_m == (2.0, 4.0, 6.0)
    assert found.uncertainty.gates.pointing_proportional_rad == 0.02
    assert np.allclose(np.diag(found.navigation.covariance)[:3], 4.0, rtol=1e-12)


def test_feedback_without_measurements_takes_the_sliders_sigmas(scenario):
    sliders = sliders_of(scenario)
    found = changed(scenario, sliders, FEEDBACK | {"navigation.sigma_position_m": 5.0})
    assert found.policy.kind == "feedback"
    shown = {slider.key: slider.value for slider in sliders}
    assert found.navigation.sigma_position_m == 5.0
    assert found.navigation.sigma_velocity_m_s == shown["navigation.sigma_velocity_m_s"]


def test_a_port_that_is_taken_is_refused(server):
    with pytest.raises(InputError, match=f"got {server.server_port} .*; must be free"):
        explore(server.explorer.scenario, port=server.server_port, no_browser=True)
