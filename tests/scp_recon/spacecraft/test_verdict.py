"""A simulated flight ends with a verdict: what was kept beside what was asked."""

from __future__ import annotations

from typing import Any

import pytest

from scp_recon.solution.file import Solution
from scp_recon.spacecraft.vehicle import load_vehicle
from scp_recon.spacecraft.verdict import check_vehicle, shortfalls
from tests.scp_recon.spacecraft.made_up import entries, summary

KEPT = entries()


def leg(**changes: object) -> dict[str, Any]:
    return {"legs": [KEPT["legs"][0] | changes]}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, []),
        ({"least_charge": 0.3}, []),
        ({"least_charge": 0.0}, ["least state of charge 0.000, asked 0.30"]),
        ({"energy_wh": KEPT["energy_wh"] | {"short": 2.5}}, ["2.5 Wh short, asked 0"]),
        (
            leg(ok=False, duration_s=800.0),
            ["delta-V mode from 100 s 800 s long, asked 900 s"],
        ),
        (
            leg(settled_s=None, settled_in_time=False),
            ["delta-V mode from 100 s steady never, asked 650 s"],
        ),
    ],
)
def test_what_is_not_kept_stands_beside_what_was_asked(
    changes: dict[str, Any], said: list[str], short_solution: Solution
) -> None:
    assert shortfalls(summary(**changes), short_solution) == said


def test_a_plan_that_did_not_converge_is_named(short_solution: Solution) -> None:
    stalled = short_solution.model_copy(update={"status": "stalled"})
    assert shortfalls(summary(), stalled) == ["the plan is stalled, asked converged"]


def test_a_vehicle_that_is_not_the_plans_spacecraft_is_warned_about(
    short_solution: Solution,
) -> None:
    """A tonne is planned for, and the packaged vehicle flown."""
    vehicle, scenario = load_vehicle(None), short_solution.scenario
    assert list(check_vehicle(vehicle, scenario)) == []
    (warning,) = check_vehicle(vehicle, scenario.replace({"spacecraft.mass_kg": 1000.0}))
    assert warning.entry == "spacecraft.mass_kg"
    assert "DARE, the vehicle that is flown, has 178 kg" in warning.expected
