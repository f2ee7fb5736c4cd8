"""Compare SCP's forms, algorithms and conic solvers with IPOPT.

Every method plans the default scenario, a pass from a home orbit and the rest of a flight; a few plan
variations of the default scenario, start from random guesses, and plan random scenarios with uniform
and with exact risk. Two cells are solved at a time, each in one process within a limit of processor
time. OUT/comparison.csv has a row for each cell, the other tables sum them up. A run that
was stopped continues with the first missing row.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import pairwise
from time import process_time
from typing import TypeAlias

import numpy as np
import pandas as pd

from experiments.harness import CONVERGED, Record, Session, Study, Tables, plan_figures, wide
from experiments.solvers.cases import (
    ELASTIC,
    EXACT,
    NLP_SOLVERS,
    REFERENCE,
    TUNED,
    UNO,
    Cell,
    Method,
    exact_design,
    full_design,
)
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import choose_facets
from formulations.problem.flyby import Iterate
from formulations.program.condensed import compile_condensed
from formulations.rows.uniform import ChanceRows
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.jobs.job import TIMED_OUT, Failure, Job, Key
from scp_recon.jobs.processes import Limits, Processes
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan, Provenance, Stage, StageSpec
from scp_recon.planning.planner import Planner, make_plan, other_starts
from scp_recon.planning.solver import screened
from scp_recon.planning.stages import Pipeline
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.algorithms import SCvx
from scp_recon.scp.status import Status

FAILED = "failed"
"""Status of a cell that was ended or failed."""
LIMIT_S, EXACT_LIMIT_S = 30.0, 300.0
CORES = 2
ASLEEP = 20.0
"""Times its limit that a cell's process may take by the clock, on a machine with other work."""
EXCESSES = (1e-4, 0.01, 0.1)
"""Relative differences of total delta-v from the least; of the first two methods found the same."""

Frame: TypeAlias = pd.DataFrame


# --- a cell ---------------------------------------------------------------------------------------


def named(cell: Cell) -> Record:
    """Columns of a row that say which cell it is."""
    about = {key: value for key, value in vars(cell).items() if key not in ("overrides", "base")}
    return {"key": cell.key, **about, "method": cell.method.name, **asdict(cell.method)}


def solve(cell: Cell) -> Record:
    """Solve a cell in this process: a row, SI.

    Columns besides those of `named`: status, a `Status` by name; problem, "P2" or, if it was not
    reached, "P3"; at_once, whether the first try solved it; total delta-v; heavy_merit_m_s, with
    SCvx's exact penalty and second weight, of the burns as flown; iterations_p3 and iterations_p2;
    cpu_s of the processor, imports apart.
    """
    mission = Mission.from_scenario(load_scenario(cell.base, cell.overrides))
    solver = cell.method.solver
    # Before the time is taken: what is imported late, and what an earlier cell compiled.
    importlib.import_module("formulations.program.lifted")
    importlib.import_module("scp_recon.planning.ipopt" if solver in NLP_SOLVERS else solver.lower())
    compile_condensed.cache_clear()
    begin = process_time()
    done = planned(mission, cell)
    seconds = process_time() - begin
    lin, merit, speed = done.final.result.lin, done.final.merit, mission.units.speed_m_s
    if not lin.is_dynamically_feasible:
        # A nonlinear program may end with gaps between its arcs, which no flight has.
        mean = mission.dynamics.rollout(mission.problem.initial_state, lin.iterate.burns)
        lin = mission.dynamics.linearise(mission.problem, Iterate(lin.iterate.burns, mean))
    return {
        **named(cell),
        **plan_figures(done),
        "cpu_s": seconds,
        "at_once": not any(stage.spec.start for _, stage in pairwise(done.stages)),
        "detail": "",
        "problem": done.final.problem,
        "total_dv_m_s": lin.iterate.total_dv * speed,
        "heavy_merit_m_s": merit(lin, SCvx().weight_max) * speed,
    }


def planned(mission: Mission, cell: Cell) -> Plan:
    """Plan P3, facets and P2 by a cell's method, or P2 from SCP's solution of P3 and its facets."""
    of, from_p3 = cell.method, cell.start == "p3"
    start = initial_guess.cold(mission)  # of P3, too, where that is the start
    if cell.start == "random":
        start = initial_guess.random(mission, cell.seed)
    if of.solver not in NLP_SOLVERS and not from_p3:
        certify = False if cell.group == EXACT else None
        names = of.formulation, of.algorithm, of.solver
        options = PlanOptions("P2", "scp", *names, facet_rounds=0, certify=certify, starts=1)
        return plan_mission(mission, start, options)
    pipeline = Pipeline(mission, planner_of(mission, of))

    def work() -> Stage:
        if not from_p3:
            return pipeline.plan(start, "P2", other_starts(mission))
        p3 = p3_solution(mission)
        facets = choose_facets(mission.problem, mission.polytopes, p3.iterate.mean, p3.factor)
        rows = ChanceRows(mission.problem, facets, screened(facets, p3, mission.clearances[0]))
        return pipeline.solve(StageSpec("P2", rows), p3)

    provenance = Provenance(of.formulation, of.algorithm, of.solver, cell.start)
    return make_plan(pipeline, work, provenance)


def p3_solution(mission: Mission) -> Linearisation:
    """SCP's solution of P3 from the straight line, where no burn is held at zero."""
    stages = plan_mission(mission, initial_guess.cold(mission), PlanOptions(problem="P3")).stages
    return [one for one in stages if one.spec.role != "held"][-1].result.lin


def planner_of(mission: Mission, method: Method) -> Planner[Mission]:
    """The solver of stages by a method."""
    form, name, solver = method.formulation, method.algorithm, method.solver
    if solver not in NLP_SOLVERS:
        return Planner(mission, formulation=form, algorithm=name, solver=solver)
    from formulations.nlp.solve import VARIANTS, Settings
    from scp_recon.planning.ipopt import IpoptPlanner

    variant = VARIANTS[form]
    if solver == UNO:
        variant = replace(variant, p3=Settings(solver="uno"), p2=Settings(solver="uno"))
    return IpoptPlanner(mission, variant, elastic=name == "elastic")


def solved_cells(session: Session, cells: Sequence[Cell]) -> Frame:
    """A row for each cell, from the finished work if it has them.

    A cell that reaches its limit is not repeated.
    """

    def rows(label: str, some: Sequence[Cell], seconds: float) -> list[Record]:
        by_key: dict[Key, Cell] = {f"{cell.key}|{seconds:g} s": cell for cell in some}
        limits = Limits(seconds=ASLEEP * seconds, cpu_s=seconds)
        return session.rows(
            label,
            solve,
            [Job(*pair) for pair in by_key.items()],
            executor=Processes(CORES, limits),
            failed=lambda key, failure: ended(by_key[key], seconds, failure),
        )

    uniform = [cell for cell in cells if cell.group != EXACT]
    once = rows("uniform risk", [c for c in uniform if not c.repeat], LIMIT_S)
    late = {row["key"] for row in once if row["status"] == FAILED}
    again = [c for c in uniform if c.repeat and replace(c, repeat=0).key not in late]
    once += rows("uniform risk, repeated", again, LIMIT_S)
    exact = [cell for cell in cells if cell.group == EXACT]
    return pd.DataFrame(once + rows("exact risk", exact, EXACT_LIMIT_S))


def ended(cell: Cell, limit_s: float, failure: Failure) -> Record:
    """The row of a cell that reached its limit or failed."""
    late = failure.status == TIMED_OUT
    words = f"no end after {limit_s:g} s" if late else " ".join(failure.message.split())[:200]
    return {**named(cell), "status": FAILED, "detail": words, "cpu_s": limit_s if late else np.nan}


# --- tables ---------------------------------------------------------------------------------------


def costs(rows: Frame) -> pd.Series:
    """Total delta-v of the rows in which P2 converged; NaN of the others."""
    return rows.total_dv_m_s.where((rows.status == CONVERGED) & (rows.problem == "P2"))


def shown(row: pd.Series) -> str:
    """A row's status as the tables print it."""
    words = row.detail or row.status.replace("_", " ")
    return f"{words} (P3)" if row.problem == "P3" else str(words)


def figure(value: float, form: str) -> str:
    """A number, or a dash."""
    return format(value, form) if np.isfinite(value) else "-"


def methods(rows: Frame) -> list[Record]:
    """A row for each problem, start and method, with the medians of the repeats."""
    found = []
    for (problem, start, method), own in rows.groupby(["scenario", "start", "method"], sort=False):
        of = own.median(numeric_only=True)
        p3, p2 = (figure(of[f"iterations_{stage}"], ".0f") for stage in ("p3", "p2"))
        found.append(
            {
                "problem": problem,
                "start": start,
                "method": method,
                "status": shown(own.iloc[0]),
                "delta_v_m_s": figure(of.total_dv_m_s, ".6f"),
                "processor_s": figure(of.cpu_s, ".2f"),
                "p3_p2_iterations": f"{p3} + {p2}",
            }
        )
    return found


def by_scenario(rows: Frame) -> list[Record]:
    """P2 from the same P3 solution and facets: a row for each scenario, a column for each method.

    A cell has delta-v if solved, else status and merit with the second weight, of the burns flown. The
    last column is IPOPT's delta-v over SCP's, less one: where there is no plan, that of the merits.
    """
    cost = costs(rows)
    words = [
        f"{row.total_dv_m_s:.6f} ({row.cpu_s:.2f} s)"
        if ok
        else f"{shown(row)}, {figure(row.heavy_merit_m_s, '.4f')} ({figure(row.cpu_s, '.2f')} s)"
        for (_, row), ok in zip(rows.iterrows(), cost.notna(), strict=True)
    ]
    columns = rows.method.str.replace("[/-]", "_", regex=True).str.lower()
    found = wide(rows.assign(words=words, column=columns), ["scenario"], "column", "words")
    table = rows.assign(cost=cost).set_index(["scenario", "method"])
    for row in found:
        ours = table.loc[row["scenario"], REFERENCE.name]
        solved = ours.cost > 0.0
        method, column = (TUNED, "cost") if solved else (ELASTIC, "heavy_merit_m_s")
        theirs = table.loc[row["scenario"], method.name]
        same = solved or ours.status == theirs.status == Status.INFEASIBLE.value.name
        off = theirs[column] / ours[column] - 1.0 if same else np.nan
        row["ipopt_over_scp_less_one"] = figure(off, "+.1e")
    return found


def shares(rows: Frame) -> list[Record]:
    """How often each method solves a scenario, and how near the least of all methods."""
    cost = costs(rows)
    least = cost.groupby(rows.scenario).transform("min")
    found = []
    for method, own in rows.groupby("method", sort=False):
        excess = cost[own.index] / least[own.index] - 1.0
        near = {f"within_{most:g}_of_the_least".replace(".", "_"): most for most in EXCESSES}
        median_s = own.cpu_s[excess.notna()].median()
        found.append(
            {
                "method": method,
                "scenarios": len(own),
                "solved_by_any": int(least[own.index].notna().sum()),
                "solved": int(excess.notna().sum()),
                **{column: int((excess <= most).sum()) for column, most in near.items()},
                "median_processor_s_of_the_solved": figure(median_s, ".2f"),
            }
        )
    return found


def guesses(rows: Frame) -> list[Record]:
    """How often each method solves from a random guess; what does not converge begins elsewhere."""
    found = []
    for method, tries in rows.assign(solved=costs(rows).notna()).groupby("method", sort=False):
        first = tries.solved & tries.at_once.eq(True)  # missing where a cell failed
        share = proportion(int(first.sum()), len(tries))
        found.append(
            {
                "method": method,
                "guesses": len(tries),
                "solved_at_the_first_try": f"{100 * share.value:.0f} %",
                "first_interval": f"{100 * share.low:.0f} to {100 * share.high:.0f} %",
                "solved": f"{100 * tries.solved.mean():.0f} %",
                "median_processor_s": figure(tries.cpu_s.median(), ".2f"),
            }
        )
    return found


def tables_of(rows: Frame) -> Tables:
    """The tables that sum up the rows, by name."""
    makers = {
        "methods": ("matrix", methods),
        "scenarios": ("scenarios", by_scenario),
        "random": ("random", shares),
        "guesses": ("guesses", guesses),
    }
    found = {name: make(rows[rows.group == of]) for name, (of, make) in makers.items()}
    exact = rows[rows.group == EXACT]
    for scope in ("node", "flight"):
        found[f"{scope}s"] = shares(exact[exact.scenario.str.startswith(scope)])
    columns = ["scenario", "method", "status", "total_dv_m_s", "cpu_s"]
    return {**found, "exact": exact[columns]}


def run(session: Session) -> Tables:
    """Solve the missing cells, those of exact risk last."""
    rows = solved_cells(session, (*full_design(), *exact_design()))
    return {**tables_of(rows), "comparison": rows}


STUDIES = {"compare_solvers": Study(__doc__, run, folder="comparison")}
