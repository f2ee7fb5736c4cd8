"""Compare the sizes and the times of P2 in its lifted and its condensed form.

P2 of the default scenario is solved in both forms from the same start with the same facets: with
uniform risk, near facets or all, and with exact risk of nodes and of whole flights. OUT/lifted.csv
has a row for each: the largest cone program that Clarabel got, iterations, delta-v, and the
processor's time. After Ctrl-C the study continues with the missing rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import process_time
from typing import Any

import numpy as np

from experiments.frontier import EXACT
from experiments.harness import Findings, Record, Session, Study, records
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import choose_facets
from formulations.program import solvers
from formulations.program.certificate import ConeProgram
from formulations.rows.uniform import ChanceRows
from scp_recon.jobs.job import Job
from scp_recon.mission.mission import CLEARANCE_M, Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Stage, StageSpec
from scp_recon.planning.planner import Planner, screened
from scp_recon.planning.stages import Pipeline
from scp_recon.scenario.load import load_scenario

FORMS = ("condensed", "lifted")
AT_NODES = EXACT | {"risk.p_chance": 0.9}
CASES: dict[str, tuple[dict[str, Any], float]] = {
    "uniform": ({}, CLEARANCE_M),
    "uniform, all facets": ({}, np.inf),
    "exact, nodes": (AT_NODES, 0.0),
    "exact, flight": (AT_NODES | {"risk.scope": "flight"}, 0.0),
}
"""Changes to the scenario, and up to which margin facets take part, m."""


@contextmanager
def noted() -> Iterator[list[ConeProgram]]:
    """Record the cone programs that Clarabel gets within the context."""
    programs: list[ConeProgram] = []

    class Noting(solvers.Clarabel):
        """Clarabel with a record of its programs."""

        def solve(self, program: ConeProgram) -> solvers.Answer:
            programs.append(program)
            return super().solve(program)

    usual = solvers.SOLVERS["CLARABEL"]
    solvers.SOLVERS["CLARABEL"] = Noting
    try:
        yield programs
    finally:
        solvers.SOLVERS["CLARABEL"] = usual


def measure(case: tuple[str, str]) -> Record:
    """Solve a case in a form, twice, after everything that its start needs: a row."""
    name, form = case
    changes, clearance_m = CASES[name]
    mission = Mission.from_scenario(load_scenario().replace(changes))
    planner = Planner(mission, formulation=form)
    run = Pipeline(mission, planner)
    p3 = Pipeline(mission, Planner(mission)).plan(initial_guess.cold(mission), "P3")
    lin = p3.result.lin
    if name == "exact, flight":  # which begins at the plan of nodes
        first = Planner(mission).exact_stages()[0]
        lin = Pipeline(mission, Planner(mission)).solve(first, lin).result.lin
    solve = solving(mission, planner, run, lin, clearance_m)
    with noted() as programs:
        times = []
        for _ in range(2):
            begin = process_time()
            stage = solve()
            times.append(process_time() - begin)
    largest = max(programs, key=lambda program: program.matrix.nnz)
    rows_, variables = largest.matrix.shape
    return {
        "risk": name,
        "form": form,
        "variables": variables,
        "rows": rows_,
        "nonzeros": largest.matrix.nnz,
        "iterations": len(stage.result.records),
        "total_dv_m_s": stage.result.lin.iterate.total_dv * mission.units.speed_m_s,
        "processor_s": min(times),
    }


def solving(
    mission: Mission,
    planner: Planner[Mission],
    run: Pipeline,
    lin: Linearisation,
    clearance_m: float,
) -> Callable[[], Stage]:
    """P2 from a start, with the facets there or exact risk."""
    if mission.scenario.risk.allocation == "exact":
        return lambda: run.solve(planner.exact_stages()[-1], lin)
    facets = choose_facets(mission.problem, mission.polytopes, lin.iterate.mean, lin.factor)
    clearance = clearance_m / mission.units.length_m
    chosen = ChanceRows(mission.problem, facets, screened(facets, lin, clearance))
    return lambda: run.solve(StageSpec("P2", chosen), lin)


def run(session: Session) -> Findings:
    """Measure every case in both forms."""
    cases = [(name, form) for name in CASES for form in FORMS]
    jobs = [Job(", ".join(case), case) for case in cases]
    rows = session.rows("cases", measure, jobs, session.store())
    return Findings({"lifted.csv": records(rows)})


STUDY = Study(__doc__, run)
