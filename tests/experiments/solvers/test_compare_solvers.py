"""The comparison of solvers: rows, tables and claims that follow from them."""

import hashlib

import pandas as pd
import pytest

from experiments.solvers.cases import (
    ELASTIC,
    REFERENCE,
    TUNED,
    Cell,
    Method,
    drawn,
    exact_design,
)
from experiments.solvers.cells import FAILED, burns_violation_m, checked_probability, named
from experiments.solvers.compare_solvers import MISS_M, claims, shares, tables_of
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import plan
from scp_recon.scenario.load import load_scenario

pytestmark = pytest.mark.slow


def row_of(scenario: str, method: Method, dv: float, status: str = "converged", **about) -> dict:
    cell = Cell(about.pop("group", "scenarios"), scenario, (), method, "p3")
    figures = {"total_dv_m_s": dv, "merit_m_s": dv, "heavy_merit_m_s": dv, "cpu_s": 1.0}
    return named(cell) | {"status": status, "detail": "", "problem": "P2"} | figures | about


def test_claims_hold_where_rows_say_so():
    rows = [
        row_of("a", REFERENCE, 0.14),
        row_of("a", TUNED, 0.140001),
        row_of("b", REFERENCE, 5.0, "infeasible"),
        row_of("b", TUNED, 0.1, FAILED),
        row_of("b", ELASTIC, 5.0001, "infeasible"),
    ]
    found = claims(pd.DataFrame(rows))
    assert [claim["holds"] for claim in found] == 3 * [True]
    rows[1]["total_dv_m_s"] = 0.15
    assert claims(pd.DataFrame(rows))[0]["holds"] is False


def test_shares_count_distances_from_the_least():
    rows = [
        *(row_of("a", REFERENCE, 0.1), row_of("a", TUNED, 0.1005)),
        *(row_of("b", REFERENCE, 0.2), row_of("b", TUNED, 0.1)),
        *(row_of("c", REFERENCE, 0.3, "infeasible"), row_of("c", TUNED, 0.3, FAILED)),
    ]
    ours, theirs = ([*row.values()][:-1] for row in shares(pd.DataFrame(rows)))
    assert ours == [REFERENCE.name, 3, 2, 2, 1, 1, 1]
    assert theirs == [TUNED.name, 3, 2, 2, 1, 2, 2]


def test_exact_plans_count_only_if_they_hold():
    good = {"group": "exact", "asked": 0.9, "reached": 0.9, "violation_m": 0.0}
    qoco = Method(solver="QOCO")
    rows = [
        row_of("node 00", REFERENCE, 0.2, **good),
        row_of("node 00", qoco, 0.1, **good | {"reached": 0.88}),
        row_of("flight 01", REFERENCE, 0.2, **good),
        row_of("flight 01", qoco, 0.1, **good),
    ]
    tables = tables_of(pd.DataFrame(rows))
    assert [row["solved"] for row in tables["nodes"]] == [1, 0]
    assert [row["within_0_1_of_the_least"] for row in tables["flights"]] == [0, 1]
    cheapest, holding = claims(pd.DataFrame(rows))[-2:]
    assert cheapest["holds"] is False
    assert "flight 01 (+100.00 %)" in cheapest["measured"]
    assert holding["holds"]


def test_drawn_scenarios_stay_as_they_are():
    """Later work compares plans of scenarios by their numbers."""
    name, changes = drawn(42)
    assert (name, changes["risk.p_chance"]) == ("node 42", 0.941)
    assert changes["boundary.initial_position_m"] == [68.766281, -1070.514, 378.632735]
    every = hashlib.sha256(repr([drawn(seed) for seed in range(200)]).encode()).hexdigest()
    assert every.startswith("65ae75d1a36e5b07")
    assert {cell.scenario for cell in exact_design(range(3))} == {"node 00", "flight 01", "node 02"}


@pytest.mark.parametrize("scope", ["node", "flight"])
def test_check_finds_the_required_probability(scope):
    exact = {"risk.allocation": "exact", "risk.p_chance": 0.9, "risk.scope": scope}
    mission = Mission.from_scenario(load_scenario().replace(exact))
    burns = plan(mission, initial_guess.cold(mission)).burns_m_s
    probability, error = checked_probability(mission, burns)
    assert probability == pytest.approx(0.9, abs=2e-3)
    assert error < 2e-3
    assert burns_violation_m(mission, burns) < MISS_M
    assert burns_violation_m(mission, 1.02 * burns) > 1.0
