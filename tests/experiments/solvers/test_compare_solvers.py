"""The comparison of solvers: tables that follow from rows, and scenarios that stay as they are."""

import hashlib

import pandas as pd

from experiments.solvers.cases import ELASTIC, REFERENCE, TUNED, Cell, Method, drawn, exact_design
from experiments.solvers.compare_solvers import FAILED, by_scenario, named, shares


def row_of(scenario: str, method: Method, dv: float, status: str = "converged") -> dict:
    cell = Cell("scenarios", scenario, (), method, "p3")
    figures = {"total_dv_m_s": dv, "heavy_merit_m_s": dv, "cpu_s": 1.0}
    return named(cell) | {"status": status, "detail": "", "problem": "P2"} | figures


def test_ipopt_is_compared_by_cost_or_merit():
    rows = [
        *(row_of("a", REFERENCE, 0.14), row_of("a", TUNED, 0.15), row_of("a", ELASTIC, 0.14)),
        *(row_of("b", REFERENCE, 5.0, "infeasible"), row_of("b", TUNED, 0.1, FAILED)),
        row_of("b", ELASTIC, 5.05, "infeasible"),
    ]
    one, other = by_scenario(pd.DataFrame(rows))
    assert one["condensed_scvx_clarabel"] == "0.140000 (1.00 s)"
    assert one["ipopt_over_scp_less_one"] == "+7.1e-02"
    assert other["tuned_elastic_ipopt"] == "infeasible, 5.0500 (1.00 s)"
    assert other["ipopt_over_scp_less_one"] == "+1.0e-02"


def test_shares_count_distances_from_the_least():
    rows = [
        *(row_of("a", REFERENCE, 0.1), row_of("a", TUNED, 0.1005)),
        *(row_of("b", REFERENCE, 0.2), row_of("b", TUNED, 0.1)),
        *(row_of("c", REFERENCE, 0.3, "infeasible"), row_of("c", TUNED, 0.3, FAILED)),
    ]
    ours, theirs = ([*row.values()][:-1] for row in shares(pd.DataFrame(rows)))
    assert ours == [REFERENCE.name, 3, 2, 2, 1, 1, 1]
    assert theirs == [TUNED.name, 3, 2, 2, 1, 2, 2]


def test_drawn_scenarios_stay_as_they_are():
    """Later work compares plans of scenarios by their numbers."""
    name, changes = drawn(42)
    assert (name, changes["risk.p_chance"]) == ("node 42", 0.941)
    assert changes["boundary.initial_position_m"] == [68.766281, -1070.514, 378.632735]
    every = hashlib.sha256(repr([drawn(seed) for seed in range(200)]).encode()).hexdigest()
    assert every.startswith("65ae75d1a36e5b07")
    assert {cell.scenario for cell in exact_design(range(3))} == {"node 00", "flight 01", "node 02"}
