"""Trace how near to the optimum of P2 each method is after how many of the processor's seconds.

P2 of the comparison's three problems is solved from one solution of P3, on the facets that its plan
needs. Each method is run again and again, each time one iteration longer, in a process of its own;
its seconds include building the program, not imports. The burns at its end are flown. What counts is
their merit, with SCvx's first weight and all facets: its error is relative to the least of all methods.
OUT/accuracy.csv has a row for each run, reached.csv when each method comes and stays near.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from time import process_time

import numpy as np

from experiments.harness import Findings, Record, Session, Study, records
from experiments.solvers.cases import (
    NLP_SOLVERS,
    PROBLEMS,
    REFERENCE,
    SHOOTING,
    TUNED,
    Method,
)
from experiments.solvers.cells import merit_of, stage_solver
from formulations.problem.flyby import Iterate
from formulations.rows.uniform import ChanceRows
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.jobs.job import Job
from scp_recon.jobs.processes import Limits, Processes
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import StageSpec
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status

for form in ("condensed", "lifted"):
    # With CVXPY, which the copy of this process that solves need not import again.
    importlib.import_module(f"formulations.program.{form}")

METHODS = (
    REFERENCE,
    Method("condensed", "ptr", "CLARABEL"),
    Method("condensed", "scvx-star", "CLARABEL"),
    Method("lifted", "scvx", "CLARABEL"),
    Method("frozen-stm", "scvx", "CLARABEL"),
    TUNED,
    SHOOTING,
)
"""All solve P2 as it is but frozen-stm; the program as printed takes too long to be run so often."""
NEAR = {"within_1e2_s": 1e-2, "within_1e4_s": 1e-4, "within_1e6_s": 1e-6}
"""Relative errors of the merit, by column."""
ENOUGH = 1_000
"""More iterations than a method takes."""


@dataclass(frozen=True)
class Begun:
    """P2 of a problem as every method gets it: the start, a solution of P3, and its rows."""

    mission: Mission
    start: Iterate
    rows: ChanceRows


def begin(name: str) -> Begun:
    """P2 of a problem by its name, with the facets that the default plan's program has."""
    base, overrides = PROBLEMS[name]
    mission = Mission.from_scenario(load_scenario(base, overrides))
    plan = plan_mission(mission, initial_guess.cold(mission), PlanOptions())
    free = [stage for stage in plan.stages if stage.spec.role != "held"]
    p3 = [stage for stage in free if stage.name.startswith("P3")][-1]
    rows = free[-1].merit.rows
    assert isinstance(rows, ChanceRows)
    return Begun(mission, p3.result.lin.iterate, rows)


def run_to(begun: Mapping[str, Begun], case: tuple[str, Method, int]) -> Record:
    """Solve P2 of a problem by a method that stops after some iterations: a row."""
    name, method, most = case
    mission, rows = begun[name].mission, begun[name].rows
    if method.solver in NLP_SOLVERS:
        importlib.import_module("scp_recon.planning.ipopt")
    start = mission.dynamics.linearise(mission.problem, begun[name].start)
    since = process_time()
    stage = stage_solver(mission, method, most).solve(
        StageSpec("P2", rows), start, mission.dynamics, lambda *_: None
    )
    seconds = process_time() - since
    return {
        "problem": name,
        "method": method.name,
        "iterations": len(stage.result.records),
        "ended": stage.result.status is not Status.MAX_ITERATIONS,
        "processor_s": seconds,
        "merit_m_s": merit_of(mission, stage.result.lin.iterate.burns, rows),
    }


def judged(rows: Sequence[Record]) -> list[Record]:
    """Rows, runs of a method from the shortest on, with the errors of their merits.

    The error is relative to the least merit of the problem's ends. No run counts more seconds than a
    longer one: other work on the machine only lengthens them.
    """
    least: dict[str, float] = {}
    seconds: dict[tuple[str, str], float] = {}
    found = []
    for row in reversed(rows):
        name, method = row["problem"], row["method"]
        if row["ended"]:
            least[name] = min(row["merit_m_s"], least.get(name, np.inf))
        seconds[name, method] = min(row["processor_s"], seconds.get((name, method), np.inf))
        found.append(row | {"processor_s": seconds[name, method]})
    return [
        row | {"error": abs(row["merit_m_s"] / least[row["problem"]] - 1.0)}
        for row in reversed(found)
    ]


def reached(rows: Sequence[Record]) -> list[Record]:
    """When each method comes near and stays: a row a problem and method; NaN where it does not."""
    found = []
    for problem, method in dict.fromkeys((row["problem"], row["method"]) for row in rows):
        own = [row for row in rows if (row["problem"], row["method"]) == (problem, method)]
        errors = np.array([row["error"] for row in own])
        last = np.maximum.accumulate(errors[::-1])[::-1]  # the largest from here on
        row: Record = {"problem": problem, "method": method, "iterations": own[-1]["iterations"]}
        for column, near in NEAR.items():
            stays = np.flatnonzero(last <= near)
            row[column] = own[stays[0]]["processor_s"] if len(stays) else np.nan
        found.append(row | {"end_s": own[-1]["processor_s"], "end_error": own[-1]["error"]})
    return found


def run(session: Session) -> Findings:
    """Run every method to its end, and again to every iteration before."""
    begun = {name: begin(name) for name in PROBLEMS}
    work, store = partial(run_to, begun), session.store()

    def rows(label: str, cases: Sequence[tuple[str, Method, int]]) -> list[Record]:
        jobs = [Job(f"{name}|{one.name}|{most}", (name, one, most)) for name, one, most in cases]
        return session.rows(label, work, jobs, store, executor=Processes(1, Limits(apart=True)))

    pairs = [(name, method) for name in PROBLEMS for method in METHODS]
    ends = rows("ends", [(*pair, ENOUGH) for pair in pairs])
    lengths = {pair: range(1, end["iterations"]) for pair, end in zip(pairs, ends, strict=True)}
    before = rows("iterations", [(*pair, most) for pair in pairs for most in lengths[pair]])
    order = [(name, method.name) for name, method in pairs]
    by_length = sorted([*before, *ends], key=lambda row: row["iterations"])
    found = judged(sorted(by_length, key=lambda row: order.index((row["problem"], row["method"]))))
    return Findings({"accuracy.csv": records(found), "reached.csv": records(reached(found))})


STUDY = Study(__doc__, run)
