"""Plan random scenarios of exact risk by methods that differ from the default in one thing.

The fifty scenarios of `compare_solvers --exact` are planned from the straight line by the forms that
take exact risk, by the other algorithms and by the other conic solvers, and the burns are judged by the
same check. Two plans are made at a time, each in a process of its own within `LIMIT_S` seconds of the
processor. OUT/exact_methods.csv has a row for each plan; nodes.csv and flights.csv count how many of
their scenarios each method solves, and how near the least delta-v of all methods. A plan counts that
has converged and holds by the check. After Ctrl-C the study continues with the missing rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from time import process_time

import numpy as np

from experiments.harness import Findings, Session, Study
from experiments.solvers.compare_solvers.cases import (
    NUMBER,
    ONE_FACTOR,
    REFERENCE,
    Cell,
    exact_design,
)
from experiments.solvers.compare_solvers.cell import Row, empty_row
from experiments.solvers.compare_solvers.claims import holds
from experiments.solvers.compare_solvers.exact.check import check
from experiments.solvers.compare_solvers.study import run_cells
from experiments.solvers.compare_solvers.tables import csv_of, shares
from formulations.registry import FULL
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.results.table import Table
from scp_recon.scenario.load import load_scenario

METHODS = tuple(method for method in ONE_FACTOR if method.formulation in FULL)
SCENARIOS = range(NUMBER)
LIMIT_S = 300.0


def solve(cell: Cell, flights: int) -> Row:
    """Plan a cell by its method, not certified, and check its burns independently."""
    del flights
    mission = Mission.from_scenario(load_scenario(cell.base, cell.overrides))
    method = (cell.method.formulation, cell.method.algorithm, cell.method.solver)
    begin = process_time()
    options = PlanOptions("P2", "scp", *method, certify=False)
    plan = plan_mission(mission, initial_guess.cold(mission), options)
    seconds = process_time() - begin
    checked = check(mission, plan.burns_m_s)
    return replace(
        empty_row(cell),
        problem="P2",
        status=plan.status.value.name,
        total_dv_m_s=checked.total_dv_m_s,
        violation_m=checked.violation_m,
        asked=mission.scenario.risk.p_chance,
        reached=checked.probability,
        reached_error=checked.error,
        cpu_s=seconds,
        total_s=plan.total_s,
        setup_s=plan.timing.setup,
        solver_s=plan.timing.conic_solver,
        burns_m_s=tuple(np.ravel(plan.burns_m_s).tolist()),
    )


def counted(rows: Sequence[Row], scope: str) -> Table:
    """How many scenarios of a scope, "node" or "flight", each method solves."""
    own = [row for row in rows if row.scenario.startswith(scope)]
    return shares(own, "", scope, lambda row: row.solved and holds(row))


def run(session: Session) -> Findings:
    """Plan every scenario by every method."""
    ours = [cell for cell in exact_design(SCENARIOS) if cell.method == REFERENCE]
    cells = [replace(cell, method=method) for cell in ours for method in METHODS]
    rows = []
    with session.steps("plans", len(cells)) as done:
        for row in run_cells(cells, session.store(), flights=0, limit_s=LIMIT_S, solve=solve):
            rows.append(row)
            done()
    files = {f"{scope}s.csv": counted(rows, scope) for scope in ("node", "flight")}
    return Findings([], {"exact_methods.csv": csv_of(rows), **files})


STUDY = Study("Exact risk by one method after another", __doc__, run)
