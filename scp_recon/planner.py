"""The three-stage planner: P3, facets at its solution, P2; and more facet rounds on request."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Literal

import numpy as np

from formulations.facets import Facets, choose_facets, included_rows
from formulations.lifting import Linearisation
from formulations.problem import Iterate
from formulations.rows import P2Rows, P3Rows, Rows
from formulations.subproblem import Subproblem
from scp_recon.mission import Mission
from scp_recon.scp import Record, Result, Timing, TrustRegion, run
from scp_recon.status import Status

Observer = Callable[[str, Record], None]

CLEARANCE_M = 200.0
"""Facets farther than this from binding stay out of the convex program, and are checked after it."""


@dataclass(frozen=True)
class Stage:
    """A run of the SCP on one problem.

    Attributes:
        name: "P3", "P2", "P2.2" with the facets chosen a second time, ...
        result: how it ended and where.
        subproblem: of which it was; it knows the constraints' margins.
        facets: of P2, None for P3.
        tolerance: violation that counted as none.
    """

    name: str
    result: Result
    subproblem: Subproblem
    facets: Facets | None
    tolerance: float


@dataclass(frozen=True)
class Plan:
    """All stages; the last one in `stages` that `final` names holds the answer."""

    stages: tuple[Stage, ...]
    final: Stage
    timing: Timing
    total_s: float


def plan(
    mission: Mission,
    guess: Iterate,
    *,
    problem: Literal["P3", "P2"] = "P2",
    formulation: str = "condensed",
    facet_rounds: int = 0,
    observe: Observer | None = None,
) -> Plan:
    """Solve P3 from the guess, choose the facets at its solution, and solve P2 from there.

    Args:
        mission: what to plan.
        guess: initial iterate, which may have defects.
        problem: "P3" stops after the first stage.
        formulation: a key of `formulations.subproblem.FORMULATIONS`.
        facet_rounds: how often to choose the facets again at the solution and solve again. A round
            is kept only while it lowers the merit, so that facets cannot cycle.
        observe: called after each iteration with the stage's name and the record.
    """
    started = perf_counter()
    timing = Timing()
    stages: list[Stage] = []
    algorithm = TrustRegion()

    def solve(name: str, rows: Rows, start: Linearisation, facets: Facets | None) -> Stage:
        begin = perf_counter()
        subproblem = Subproblem(mission.problem, rows, formulation)
        timing.setup += perf_counter() - begin
        result = run(
            subproblem,
            mission.dynamics,
            start,
            algorithm,
            lambda record: observe(name, record) if observe else None,
        )
        timing.add(result.timing)
        stages.append(Stage(name, result, subproblem, facets, algorithm.feasible))
        return stages[-1]

    def solve_p2(name: str, start: Linearisation) -> Stage:
        lin = start
        facets = choose_facets(mission.problem, mission.polytopes, lin.iterate.mean, lin.factor)
        margin = facets.margin(lin.iterate.mean, lin.factor)
        included = included_rows(margin, CLEARANCE_M / mission.units.length_m)
        while True:
            rows = P2Rows(mission.problem, facets, included)
            stage = solve(name, rows, lin, facets)
            missed = rows.missed(stage.result.lin, algorithm.feasible)
            if stage.result.status is Status.INTERRUPTED or not missed.any():
                return stage
            included, lin = included | missed, stage.result.lin

    final = solve(
        "P3", P3Rows(mission.problem), mission.dynamics.linearise(mission.problem, guess), None
    )
    if problem == "P2" and final.result.status is not Status.INTERRUPTED:
        final = solve_p2("P2", final.result.lin)
        for round_ in range(2, facet_rounds + 2):
            if final.result.status is Status.INTERRUPTED:
                break
            again = solve_p2(f"P2.{round_}", final.result.lin)
            if not _better(again, final):
                break
            final = again
    return Plan(tuple(stages), final, timing, perf_counter() - started)


def _better(new: Stage, old: Stage) -> bool:
    """Whether a facet round is worth keeping: first feasible, then cheaper."""
    if new.result.status is not old.result.status:
        return new.result.status is Status.CONVERGED
    merits = [s.subproblem.merit(s.result.lin, TrustRegion().weight) for s in (new, old)]
    return bool(np.diff(merits)[0] > 0.0)
