"""Measure how much each trick speeds up the nonlinear program.

P2 of the default scenario is solved from SCP's P3 solution, with the facets chosen there: first with
the tricks that lead from the program as the paper prints it to the tuned one, each added to those
before; then with alternatives to one of them. The table goes to OUT/nlp_tricks.csv.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from time import process_time
from typing import TYPE_CHECKING

from experiments.harness import Findings, Record, Session, Study, records
from experiments.solvers.cells import p3_solution
from formulations.problem.facets import choose_facets
from scp_recon.jobs.job import Job
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.scenario.load import load_scenario

if TYPE_CHECKING:
    from formulations.nlp.solve import Variant

FOR_SPRAL = {"OMP_CANCELLATION": "TRUE", "OMP_PROC_BIND": "TRUE"}
"""Settings of OpenMP that SPRAL needs before it is loaded."""


def tricks() -> dict[str, Variant]:
    """Variants from printed to tuned, and alternatives, each named by its difference."""
    from formulations.nlp.covariance import Covariance, Factor, initial_deviation
    from formulations.nlp.shooting import MultipleShooting, SingleShooting
    from formulations.nlp.solve import (
        VARIANTS,
        Settings,
        Variant,
        paper_covariance,
        scaled_covariance,
    )
    from formulations.problem.flyby import FlybyProblem

    def unique(problem: FlybyProblem) -> Covariance:
        return Covariance(problem, unique=True)

    def factor(problem: FlybyProblem) -> Factor:
        return Factor(problem, unit=initial_deviation(problem))

    plain, adaptive = Settings(), Settings(barrier="adaptive")
    printed, tuned = VARIANTS["printed"], VARIANTS["tuned"]
    shooting = MultipleShooting(paper_covariance, arcs="called", whole=True)
    signed = Variant(shooting, plain, plain, screened=False)
    entries = replace(signed, transcription=replace(shooting, spread=unique))
    scaled = replace(signed, transcription=replace(shooting, spread=scaled_covariance))
    screened = replace(scaled, screened=True)
    short = MultipleShooting(scaled_covariance, arcs="called")
    cut = replace(screened, transcription=short)
    barrier = replace(cut, p3=adaptive, p2=adaptive)
    mapped = replace(barrier, transcription=replace(short, arcs="mapped"))
    by_factor = replace(tuned, transcription=MultipleShooting(factor, arcs="differentiated"))
    bfgs = replace(adaptive, hessian="limited-memory")
    spral = replace(adaptive, linear_solver="spral")
    single = SingleShooting()
    return {
        "as printed: 36 entries, angles as ratios": printed,
        "+ margins as signed distances": signed,
        "+ 21 unique entries": entries,
        "+ covariance in units of the initial one": scaled,
        "+ facets far from binding left out": screened,
        "+ covariance up to the last facet only": cut,
        "+ adaptive barrier": barrier,
        "+ one map over all arcs": mapped,
        "+ derivatives arc by arc = tuned": tuned,
        "tuned, but a factor instead of the covariance": by_factor,
        "tuned, but L-BFGS instead of exact Hessians": replace(tuned, p2=bfgs),
        "tuned, but SPRAL instead of MUMPS": replace(tuned, p2=spral),
        "single shooting, exact Hessians": Variant(single, adaptive, adaptive),
        "single shooting, L-BFGS = shooting": Variant(single, adaptive, bfgs),
    }


def measuring(mission: Mission, chosen: Mapping[str, Variant]) -> Callable[[str], Record]:
    """Make the function that solves P2 with a trick from the same P3 solution, and returns a row."""
    from scp_recon.planning.ipopt import IpoptStages, casadi_arcs

    start = p3_solution(mission, initial_guess.cold(mission))
    facets = choose_facets(mission.problem, mission.polytopes, start.iterate.mean, start.factor)
    arcs = casadi_arcs(mission.flow)

    def measure(name: str) -> Record:
        solver = IpoptStages(mission, arcs, chosen[name])
        begin = process_time()
        spec = solver.p2_stage(facets, start)
        stage = solver.solve(spec, start, mission.dynamics, lambda *_: None)
        run = stage.runs[-1]
        return {
            "trick": name,
            "status": f"{stage.result.status.value.name.replace('_', ' ')} ({run.status})",
            "delta-v m/s": f"{stage.result.lin.iterate.total_dv * mission.units.speed_m_s:.6f}",
            "unknowns": str(run.unknowns),
            "rows": str(run.rows),
            "iterations": str(max(len(run.iterations) - 1, 0)),
            "build wall s": f"{run.build_s:.2f}",
            "IPOPT wall s": f"{run.solve_s:.2f}",
            "of it evaluating wall s": f"{run.evaluate_s:.2f}",
            "processor s": f"{process_time() - begin:.2f}",
        }

    return measure


def run(session: Session) -> Findings:
    """Measure every trick."""
    os.environ.update(FOR_SPRAL)
    chosen = tricks()
    work = measuring(Mission.from_scenario(load_scenario()), chosen)
    jobs = [Job(name, name) for name in chosen]
    found = records(session.rows("tricks", work, jobs, session.store(), line=_line))
    return Findings({"nlp_tricks.csv": found})


def _line(row: Record) -> str:
    return ", ".join(f"{column} {value}" for column, value in row.items())


STUDY = Study(__doc__, run)
