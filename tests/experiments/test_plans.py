"""Rows of plans and passes as the plans themselves have them, and campaigns summed up."""

from __future__ import annotations

import pytest

from experiments import maps, plans
from scp_recon.scenario.load import load_scenario
from tests.scp_recon.support import fly_few


def test_a_row_is_the_plan_that_its_case_describes(monkeypatch: pytest.MonkeyPatch) -> None:
    fly_few(monkeypatch)
    monkeypatch.setattr(plans, "FLIGHTS", 200)
    monkeypatch.setitem(plans.PLANS, "tangent", plans.TANGENT)
    found = {name: plans.measure(name) for name in ("default", "tangent")}
    assert [row["status"] for row in found.values()] == 2 * ["converged"]
    assert all(row["verified"] and row["node"] > 0.7 for row in found.values())
    costs = [row["total_dv_m_s"] for row in found.values()]
    assert costs == sorted(costs, reverse=True)


@pytest.mark.parametrize("name", [*plans.PLANS, *plans.DESIGNS])
def test_every_case_is_a_scenario(name: str) -> None:
    base, changes = plans.DESIGNS.get(name, ("recon_b", plans.PLANS.get(name, {})))
    scenario = load_scenario(base).replace(changes)
    assert (scenario.boundary.home is not None) == (name in plans.DESIGNS)


def test_cases_are_summed_up() -> None:
    def case(status: str, cost: float, **more: object) -> dict[str, object]:
        known = {"verdict": "verified", "binds": "emission_max", "probability": cost}
        return known | {"status": status, "total_dv_m_s": cost} | more

    cases = [
        case("converged", 0.2),
        case("converged", 0.1),
        case("converged", 0.05, verdict="P(emission)"),
        *3 * [case("infeasible", float("nan"))],
        case("refused", float("nan")),
    ]
    row = maps.summary(cases)
    assert (row["cases"], row["feasible"]) == (7, 2)
    assert (row["dv_m_s_min"], row["dv_m_s_max"]) == (0.1, 0.2)
    assert row["why_not"] == "emission max (3); not verified (1); refused (1)"
    assert maps.summary(cases[3:])["dv_m_s_min"] is None
    assert maps.latitude({"site.latitude_deg": -5.0}) == "0 to 40 S"
    assert maps.latitude({"site.latitude_deg": 80.0}) == "above 70 N"
