"""Time one method in a process of its own: `python -m benchmarks.methods NAME REPEATS`."""

from __future__ import annotations

import importlib
import json
import resource
import statistics
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from time import perf_counter, process_time

import numpy as np

from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import FlightConfig, run_block
from scp_recon.monte_carlo.sampling import BLOCK
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import Planner
from scp_recon.results.solution import make_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.verification.reintegration import verify

REPLANS = 100
LATE = {
    "scp": ("formulations.program.condensed", "formulations.program.lifted"),
    "ipopt": ("scp_recon.planning.ipopt",),
}
"""Modules that the methods import late, with CVXPY or CasADi."""


@dataclass(frozen=True)
class Timed:
    """One method's figures; seconds.

    Attributes:
        first: of the first run in the process, programs compiled and solvers set up in it, without
            imports.
        best: of the fastest of the later runs; of replans the median.
        cpu: processor time of the fastest run.
        split: its seconds by part.
        peak_mib: resident memory at the end, imports included.
        total_dv_m_s: of the plan.
        status: of the plan.
        verified: whether an independent integration and Monte Carlo confirm it.
        details: further figures of the method; "import" are the seconds that importing `LATE`
            modules took before, beyond what every method imports.
    """

    first: float
    best: float
    cpu: float
    split: dict[str, float] = field(default_factory=dict)
    peak_mib: float = 0.0
    total_dv_m_s: float = float("nan")
    status: str = ""
    verified: bool = False
    details: dict[str, float] = field(default_factory=dict)


def timed(run: Callable[[], object], repeats: int) -> Timed:
    """Time the first run and the fastest of `repeats` later ones."""
    walls, cpus = [], []
    for _ in range(repeats + 1):
        wall, cpu = perf_counter(), process_time()
        run()
        walls.append(perf_counter() - wall)
        cpus.append(process_time() - cpu)
    best = 1 + int(np.argmin(walls[1:])) if repeats else 0
    return Timed(walls[0], walls[best], cpus[best])


def imported(*names: str) -> float:
    """Import modules; returns the seconds that it took."""
    begin = perf_counter()
    for name in names:
        importlib.import_module(name)
    return perf_counter() - begin


def _described(figures: Timed, mission: Mission, plans: list[Plan], import_s: float) -> Timed:
    found = min(plans[1:] or plans, key=lambda plan: plan.total_s)
    solution = make_solution(found)
    parts = asdict(found.timing) | {"other": found.total_s - sum(vars(found.timing).values())}
    p2 = [
        r.solver_s for stage in found.stages if stage.problem == "P2" for r in stage.result.records
    ]
    solves = {"p2_subproblem": statistics.median(p2)} if p2 else {}
    return replace(
        figures,
        split=parts,
        total_dv_m_s=found.final.result.lin.iterate.total_dv * mission.units.speed_m_s,
        status=found.final.result.status.value.name,
        verified=verify(mission, solution).ok,
        details=solves
        | {
            "iterations": float(sum(len(s.result.records) for s in found.stages)),
            "import": import_s,
        },
    )


def scp(mission: Mission, formulation: str, repeats: int) -> Timed:
    """P3, facets and P2 from a cold start, each time by a new planner."""
    import_s = imported(*LATE["scp"])
    start, plans = initial_guess.cold(mission), list[Plan]()

    def run() -> None:
        plans.append(Planner(mission, formulation=formulation).plan(start))

    return _described(timed(run, repeats), mission, plans, import_s)


def ipopt(mission: Mission, variant: str, repeats: int) -> Timed:
    """The same stages by IPOPT."""
    import_s = imported(*LATE["ipopt"])
    from scp_recon.planning import ipopt as reference

    start, plans = initial_guess.cold(mission), list[Plan]()

    def run() -> None:
        plans.append(reference.plan(mission, start, variant=variant))

    return _described(timed(run, repeats), mission, plans, import_s)


def replan(mission: Mission, repeats: int) -> Timed:
    """P2 again from initial states drawn from their covariance, against planning them cold."""
    del repeats
    planner = Planner(mission)
    last, start = planner.plan(initial_guess.cold(mission)), initial_guess.cold(mission)
    rng, again, cold = np.random.default_rng(0), [], []
    converged = 0
    first = perf_counter()
    planner.replan(last, mission.initial_state)
    first = perf_counter() - first
    for _ in range(REPLANS):
        state = mission.initial_state + mission.initial_factor @ rng.standard_normal(6)
        begin = perf_counter()
        found = planner.replan(last, state)
        again.append(perf_counter() - begin)
        converged += found.final.result.status.value.exit_code == 0
        begin = perf_counter()
        Planner(mission.with_initial_state(state)).plan(start)
        cold.append(perf_counter() - begin)
    details = {"cold": statistics.median(cold), "converged": float(converged)}
    return Timed(first, statistics.median(again), float("nan"), details=details)


def montecarlo(mission: Mission, repeats: int) -> Timed:
    """A block of flights with crossing times."""
    found = Planner(mission).plan(initial_guess.cold(mission)).final.result.lin.iterate.burns
    config = FlightConfig(mission, found * mission.units.speed_m_s)
    figures = timed(lambda: run_block(config, (0, BLOCK)), 4 * repeats)
    return replace(figures, details={"flights_per_s": BLOCK / figures.best})


METHODS: dict[str, Callable[[Mission, int], Timed]] = {
    "scp condensed": lambda mission, n: scp(mission, "condensed", n),
    "scp frozen-stm": lambda mission, n: scp(mission, "frozen-stm", n),
    "scp frozen-covariance": lambda mission, n: scp(mission, "frozen-covariance", n),
    "scp lifted": lambda mission, n: scp(mission, "lifted", n),
    "ipopt tuned": lambda mission, n: ipopt(mission, "tuned", n),
    "ipopt shooting": lambda mission, n: ipopt(mission, "shooting", n),
    "ipopt printed": lambda mission, n: ipopt(mission, "printed", n),
    "replan": replan,
    "montecarlo": montecarlo,
}


def main() -> None:
    """Print a method's figures as JSON."""
    name, repeats = sys.argv[1:]
    figures = METHODS[name](Mission.from_scenario(load_scenario()), int(repeats))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(json.dumps(asdict(replace(figures, peak_mib=peak))))


if __name__ == "__main__":
    main()
