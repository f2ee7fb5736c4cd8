"""Time a method in this process, and print JSON: `python -m benchmarks.methods WHAT WORD ...`.

WHAT is `planned` (by a method, repeats), `replanned` or `flown` (repeats).
"""

from __future__ import annotations

import importlib
import json
import resource
import statistics
import sys
from collections.abc import Callable
from dataclasses import asdict
from time import perf_counter, process_time
from typing import Any

import numpy as np

from formulations.problem.flyby import Iterate
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import run_block
from scp_recon.monte_carlo.sampling import BLOCK, Flyer
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import Planner
from scp_recon.results.solution import make_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.verification.reintegration import verify

Row = dict[str, Any]
Method = Callable[[Mission, Iterate], Plan]

REPLANS = 100
LATE = {
    "scp": ("formulations.program.condensed", "formulations.program.lifted"),
    "ipopt": ("scp_recon.planning.ipopt",),
}
"""Modules that the methods import late, with CVXPY or CasADi."""


def timed(run: Callable[[], object], repeats: int) -> Row:
    """Seconds of the first run, and of the fastest of `repeats` later ones with its processor time."""
    runs = []
    for _ in range(repeats + 1):
        wall, processor = perf_counter(), process_time()
        run()
        runs.append((perf_counter() - wall, process_time() - processor))
    later_s, processor_s = min(runs[1:] or runs)
    return {"first_s": runs[0][0], "later_s": later_s, "processor_s": processor_s}


def way(method: str) -> tuple[Method, float]:
    """How a method plans, by a new planner each time, and the seconds that its late imports took."""
    kind, form = method.split(maxsplit=1)
    begin = perf_counter()
    for name in LATE[kind]:
        importlib.import_module(name)
    import_s = perf_counter() - begin
    if kind == "scp":
        return lambda mission, start: Planner(mission, formulation=form).plan(start), import_s
    from scp_recon.planning import ipopt

    return lambda mission, start: ipopt.plan(mission, start, variant=form), import_s


def planned(method: str, repeats: int) -> Row:
    """P3, facets and P2 from a cold start; the parts are those of the fastest plan.

    The first plan compiles and sets up; imports are over before it.
    """
    mission, plans = Mission.from_scenario(load_scenario()), list[Plan]()
    plan, import_s = way(method)
    start = initial_guess.cold(mission)
    seconds = timed(lambda: plans.append(plan(mission, start)), repeats)
    found = min(plans[1:] or plans, key=lambda plan: plan.total_s)
    parts = asdict(found.timing) | {"other": found.total_s - sum(vars(found.timing).values())}
    records = [r for stage in found.stages if stage.problem == "P2" for r in stage.result.records]
    verified = verify(mission, make_solution(found)).ok
    peak_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "method": method,
        "total_dv_m_s": found.total_dv_m_s,
        "status": f"{found.status.value.name}, {'' if verified else 'not '}verified",
        "import_s": import_s,
        **seconds,
        **{f"{part}_s": max(taken, 0.0) for part, taken in parts.items()},
        "peak_mib": peak_kib / 1024.0,
        "subproblem_s": statistics.median(r.solver_s for r in records) if records else np.nan,
    }


def replanned() -> Row:
    """P2 again from initial states drawn from their covariance, against planning them cold."""
    mission = Mission.from_scenario(load_scenario())
    planner, start = Planner(mission), initial_guess.cold(mission)
    last = planner.plan(start)
    planner.replan(last, mission.initial_state)
    rng, again, cold, converged = np.random.default_rng(0), [], [], 0
    for _ in range(REPLANS):
        state = mission.initial_state + mission.initial_factor @ rng.standard_normal(6)
        begin = perf_counter()
        found = planner.replan(last, state)
        again.append(perf_counter() - begin)
        converged += found.final.result.status.value.exit_code == 0
        begin = perf_counter()
        Planner(mission.with_initial_state(state)).plan(start)
        cold.append(perf_counter() - begin)
    medians = {"later_s": statistics.median(again), "cold_s": statistics.median(cold)}
    return {"replans": REPLANS, "converged": converged, **medians}


def flown(repeats: int) -> Row:
    """A block of flights with crossing times."""
    mission = Mission.from_scenario(load_scenario())
    config = Flyer(mission, Planner(mission).plan(initial_guess.cold(mission)).burns_m_s)
    return {"flights": BLOCK, **timed(lambda: run_block(config, (0, BLOCK)), 4 * repeats)}


def main() -> None:
    """Print a row as JSON."""
    what, *words = sys.argv[1:]
    work: dict[str, Callable[..., Row]] = {f.__name__: f for f in (planned, replanned, flown)}
    print(json.dumps(work[what](*(int(word) if word.isdigit() else word for word in words))))


if __name__ == "__main__":
    main()
