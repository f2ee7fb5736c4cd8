"""Studies of plans: rows are what their cases describe, all rounds count, maps are summed up."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from experiments import costs, maps, plans
from experiments.costs import NOT_CERTIFIED, record
from experiments.harness import fly_plan
from scp_recon.api.verbs import plan
from scp_recon.planning.records import Certificate
from scp_recon.scenario.load import load_scenario
from tests.scenarios import COARSE

pytestmark = pytest.mark.slow


def test_measured_frontiers_are_monotone():
    """A plan for a higher probability costs no less, and exists only where lower ones have plans."""
    root = Path(costs.__file__).parents[1]
    file = json.loads((root / "docs" / "evidence" / "frontier.json").read_text())
    for row in pd.DataFrame(file["tables"]["costs"]).set_index("delta_v_m_s_for").to_numpy():
        solved = [cost for cost in row if not isinstance(cost, str)]
        assert solved == sorted(solved)
        assert [*row[: len(solved)]] == solved


@pytest.mark.parametrize("name", [*plans.PLANS, *plans.DESIGNS])
def test_every_case_is_a_scenario(name):
    base, changes = plans.DESIGNS.get(name, ("recon_b", plans.PLANS.get(name, {})))
    scenario = load_scenario(base).replace(changes)
    assert (scenario.boundary.home is not None) == (name in plans.DESIGNS)


def test_cases_are_summed_up():
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
    row = maps.summary(pd.DataFrame(cases))
    assert (row["cases"], row["feasible"]) == (7, 2)
    assert (row["dv_m_s_min"], row["dv_m_s_max"]) == (0.1, 0.2)
    assert row["why_not"] == "emission max (3); not verified (1); refused (1)"
    assert math.isnan(maps.summary(pd.DataFrame(cases[3:]))["dv_m_s_min"])
    assert maps.latitude({"site.latitude_deg": -5.0}) == "0 to 40 S"
    assert maps.latitude({"site.latitude_deg": 80.0}) == "above 70 N"


def test_flights_that_fall_short_certify_nothing():
    """Its delta-v is not the price of what was asked."""
    short = Certificate(20_000, 2_000, 0.7, 0.69, 0.71, 0.7, 1, 1, 0.975)
    plain = plan(load_scenario(None, (COARSE,)))
    found = replace(plain, certificate=short, target=0.7)
    flown = fly_plan(found, 100, 0)
    kept, missed = (record("certified, each node", p, found, flown, 1.0) for p in (0.69, 0.7))
    assert kept["total_dv_m_s"] == plain.total_dv_m_s
    assert (missed["status"], math.isnan(float(missed["total_dv_m_s"]))) == (NOT_CERTIFIED, True)


def test_sites_are_counted_by_how_reached():
    alone = {"open": True, "corrected": True, "dv99_m_s": 0.1, "whole_flight": 0.91}
    more = {"open": False, "corrected": True, "dv99_m_s": 0.3, "whole_flight": 0.88}
    row = maps.counted(pd.DataFrame([alone, more, {"open": False, "corrected": False}]))
    assert (row["sites"], row["open"], row["more"]) == (3, 1, 1)
    assert row["open_dv99_m_s_max"] == 0.1
    assert row["more_dv99_m_s_min"] == 0.3
    assert row["more_whole_flight_min"] == 0.88
