"""Exact methods: a row is a plan by its method, and counts only where the check finds that it holds."""

from dataclasses import replace

import pytest

from experiments.solvers.compare_solvers.cases import REFERENCE, exact_design
from experiments.solvers.compare_solvers.cell import Row, empty_row
from experiments.solvers.exact_methods import METHODS, counted, solve
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.scenario.load import load_scenario

CELL = next(cell for cell in exact_design(range(2, 3)) if cell.method == REFERENCE)
QOCO = next(method for method in METHODS if method.solver == "QOCO")


def row_of(scenario: str, dv: float, reached: float = 0.9, status: str = "converged") -> Row:
    row = replace(empty_row(replace(CELL, scenario=scenario)), status=status, problem="P2")
    return replace(row, total_dv_m_s=dv, asked=0.9, reached=reached, violation_m=0.0, cpu_s=1.0)


def test_methods_differ_from_the_default_in_one_thing():
    ours = (REFERENCE.formulation, REFERENCE.algorithm, REFERENCE.solver)
    for method in METHODS:
        theirs = (method.formulation, method.algorithm, method.solver)
        assert sum(a != b for a, b in zip(ours, theirs, strict=True)) == (method != REFERENCE)


def test_a_row_is_the_plan_of_its_method_and_holds_by_the_check():
    mission = Mission.from_scenario(load_scenario(CELL.base, CELL.overrides))
    options = PlanOptions(solver="QOCO", certify=False)
    plan = plan_mission(mission, initial_guess.cold(mission), options)
    row = solve(replace(CELL, method=QOCO), 0)
    assert row.burns_m_s == tuple(plan.burns_m_s.ravel())
    assert row.total_dv_m_s == pytest.approx(plan.total_dv_m_s, rel=1e-9)
    assert row.solved
    assert row.reached == pytest.approx(row.asked, abs=5e-3)
    (counts,) = counted([row], "node").records()
    assert (counts["method"], counts["scenarios"], counts["solved"]) == (QOCO.name, 1, 1)


def test_a_plan_counts_in_its_scope_if_it_converged_and_holds():
    rows = [
        row_of("node 00", 0.2),
        row_of("node 02", 0.1, reached=0.88),
        row_of("node 04", 0.1, status="max_iterations"),
        row_of("flight 01", 0.1),
    ]
    (node,), (flight,) = (counted(rows, scope).records() for scope in ("node", "flight"))
    assert [node[key] for key in ("scenarios", "solved_by_any", "solved")] == [3, 1, 1]
    assert [flight[key] for key in ("scenarios", "solved_by_any", "solved")] == [1, 1, 1]
