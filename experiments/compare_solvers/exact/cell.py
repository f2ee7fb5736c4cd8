"""One cell of the comparison on exact risk, solved and checked: a row of the table."""

from __future__ import annotations

from dataclasses import replace
from time import process_time

import numpy as np

from experiments.compare_solvers.cases import REFERENCE, Cell
from experiments.compare_solvers.exact.check import check
from experiments.compare_solvers.exact.search import search
from experiments.compare_solvers.row import Row, empty_row
from formulations.linearisation.linearisation import Linearisation
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import plan
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status

SEARCH_S = 60.0
"""Seconds of the processor that a reference may search, its start not counted."""


def solve_exact(cell: Cell, flights: int) -> Row:
    """Solve a cell in this process.

    Args:
        cell: what to solve.
        flights: of no use here: what a plan is worth is checked by the law that it was made for.
    """
    del flights
    mission = Mission.from_scenario(load_scenario(None, cell.overrides))
    found = _planned(mission, cell) if cell.method == REFERENCE else _searched(mission, cell)
    checked = check(mission, np.reshape(found.burns_m_s, (-1, 3)))
    return replace(
        found,
        problem="P2",
        total_dv_m_s=checked.total_dv_m_s,
        violation_m=checked.violation_m,
        asked=mission.scenario.risk.p_chance,
        reached=checked.probability,
        reached_error=checked.error,
    )


def _planned(mission: Mission, cell: Cell) -> Row:
    """By the planner, as `python -m scp_recon.solve --certify no` does it."""
    begin = process_time()
    done = plan(mission, initial_guess.cold(mission))
    names = [stage.name for stage in done.stages for _ in stage.result.records]
    return replace(
        empty_row(cell),
        status=done.status.value.name,
        iterations_p3=sum(name.startswith("P3") for name in names),
        iterations_p2=sum(name.startswith("P2") for name in names),
        from_arc=done.final.begun_again,
        cpu_s=process_time() - begin,
        burns_m_s=_components(done.burns_m_s),
    )


def _searched(mission: Mission, cell: Cell) -> Row:
    """By a reference."""
    starts = _starts(mission)
    begin = process_time()
    found = search(mission, starts, cell.method.solver, SEARCH_S)
    status = Status.CONVERGED if found.holds else Status.INFEASIBLE
    if found.out_of_time:
        status = Status.MAX_ITERATIONS
    return replace(
        empty_row(cell),
        status=status.value.name,
        detail=found.ended,
        iterations_p2=found.evaluations,
        cpu_s=process_time() - begin,
        burns_m_s=_components(found.burns * mission.units.speed_m_s),
    )


def _starts(mission: Mission) -> dict[str, Linearisation]:
    """SCP's solution of P3, where its P2 begins, and its plan with uniform risk, feasible or not."""
    guess = initial_guess.cold(mission)
    uniform = {"risk.allocation": "uniform", "risk.scope": "node"}
    even = Mission.from_scenario(mission.scenario.replace(uniform))
    found = plan(even, guess)
    p3 = next(stage for stage in found.stages if stage.name.startswith("P3"))
    return {"P3": p3.result.lin, "uniform": found.final.result.lin}


def _components(burns_m_s: np.ndarray) -> tuple[float, ...]:
    return tuple(burns_m_s.ravel().tolist())
