"""Time a method in this process, and print JSON: `python -m benchmarks.methods WHAT WORD ...`.

WHAT is `planned` (by a method, repeats), `replanned`, `flown` (repeats) or `growth` (with a quantity,
by a method).
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

from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import FlightConfig, run_block
from scp_recon.monte_carlo.sampling import BLOCK
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import Planner
from scp_recon.results.solution import make_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status
from scp_recon.verification.reintegration import verify

Row = dict[str, Any]
Method = Callable[[Mission, Iterate], Plan]

REPLANS = 100
LATE = {
    "scp": ("formulations.program.condensed", "formulations.program.lifted"),
    "ipopt": ("scp_recon.planning.ipopt",),
}
"""Modules that the methods import late, with CVXPY or CasADi."""
REPEATS, AGAIN_S = 5, 5.0
"""Plans of a size at most, and the seconds after which no further one is made."""
LEFT_OUT = {("nodes", "scp lifted"): (2400,), ("burns", "scp lifted"): (12,)}
"""Sizes of which a plan takes minutes: 134 s with 2400 nodes; with 12 burns none after nine minutes."""


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
    config = FlightConfig(mission, Planner(mission).plan(initial_guess.cold(mission)).burns_m_s)
    return {"flights": BLOCK, **timed(lambda: run_block(config, (0, BLOCK)), 4 * repeats)}


def burn_times(count: int) -> list[str]:
    """Times of a number of burns, none near the observation window, without attitude modes between."""
    early = np.linspace(0.0, 11_000.0, -(-count // 2))
    late = np.linspace(19_000.0, 34_842.0, count // 2) if count > 2 else [34_842.0]
    times = [round(float(time), 1) for time in (*early, *late)]
    modes = [f"schedule.{name}_s=1.0" for name in ("attitude", "heating", "recharge")]
    return [f"burns.times_s={times}", *modes]


QUANTITIES: dict[str, tuple[tuple[int, ...], Callable[[int], list[str]]]] = {
    "nodes": ((75, 150, 300, 600, 1200, 2400), lambda n: [f"grid.step_max_s={34_842 / n}"]),
    "facets of each polytope": (
        (4, 8, 16, 32, 64, 128),
        lambda n: [f"polytopes.ball={n}", f"polytopes.cone={n}"],
    ),
    "burns": ((2, 4, 6, 8, 12), burn_times),
}
"""Sizes of each quantity, and the changes to a scenario that give them."""


def growth(quantity: str, method: str) -> Row:
    """Processor seconds of a method's plans by size, the fastest of a few.

    Exponents are of power laws through the sizes that converged (others took as long as there were
    starts and facets left to try): of seconds, of the last two, of seconds over iterations; None for
    fewer than two. Where delta-v differs, methods did not find the same plan.
    """
    plan, _ = way(method)
    all_sizes, overrides = QUANTITIES[quantity]
    sizes = [size for size in all_sizes if size not in LEFT_OUT.get((quantity, method), ())]
    found, seconds = zip(*(fastest(overrides(size), plan) for size in sizes), strict=True)
    counts = [sum(len(stage.result.records) for stage in one.stages) for one in found]
    converged = np.array([one.status is Status.CONVERGED for one in found])
    x, y, n = (np.array(column, float)[converged] for column in (sizes, seconds, counts))
    words = [
        f"{s:.2f} ({n}{'' if ok else ', ' + one.status.value.name.replace('_', ' ')})"
        for s, n, ok, one in zip(seconds, counts, converged, found, strict=True)
    ]
    return {
        "growth with": quantity,
        "method": method,
        "sizes": ", ".join(map(str, sizes)),
        "seconds": ", ".join(words),
        "total_dv_m_s": ", ".join(f"{one.total_dv_m_s:.6f}" for one in found),
        "exponent": exponent(x, y),
        "last": exponent(x[-2:], y[-2:]),
        "an_iteration": exponent(x, y / n),
    }


def exponent(sizes: Array, values: Array) -> float | None:
    """Exponent of the power law through values by size, each of shape (n,); None for fewer than two."""
    if len(sizes) < 2:
        return None
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])


def fastest(overrides: list[str], plan: Method) -> tuple[Plan, float]:
    """The plan of a changed default scenario, and the least processor seconds of a few plans."""
    mission = Mission.from_scenario(load_scenario(None, overrides))
    start, seconds = initial_guess.cold(mission), list[float]()
    while len(seconds) < REPEATS and sum(seconds) < AGAIN_S:
        begin = process_time()
        found = plan(mission, start)
        seconds.append(process_time() - begin)
    return found, min(seconds)


def main() -> None:
    """Print a row as JSON."""
    what, *words = sys.argv[1:]
    work: dict[str, Callable[..., Row]] = {
        f.__name__: f for f in (planned, replanned, flown, growth)
    }
    print(json.dumps(work[what](*(int(word) if word.isdigit() else word for word in words))))


if __name__ == "__main__":
    main()
