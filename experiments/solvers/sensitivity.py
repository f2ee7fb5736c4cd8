"""Vary the penalty weight, the first trust-region radius and the dynamics weight, one at a time.

The three problems of `compare_solvers` are planned from the straight line, in the condensed form by
Clarabel, each time with one of these at a multiple of its usual value. SCvx bounds a step by the radius
r, PTR charges ||s||^2 / (2 r). The dynamics weight charges the miss of the final state that many times
as much as a constraint. They belong to the loop, not to a scenario, and no value of them is refused.
OUT/sensitivity.csv has a row for each plan; the processor's seconds are the better of two runs.
OUT/by_value.csv has a row for each value, and a column for each problem: delta-v in m/s, or the status
without a plan, and P3's and P2's iterations. After Ctrl-C the study continues with the missing rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import product
from time import process_time
from typing import NamedTuple

from experiments.harness import Findings, Record, Session, Study, records
from experiments.solvers.cases import PROBLEMS
from formulations.program import model, subproblem
from scp_recon.jobs.job import Job
from scp_recon.mission.grid import Units
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import Planner
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.algorithms import ALGORITHMS, SCvx
from scp_recon.scp.status import Status


class Factor(NamedTuple):
    """What is varied: an attribute of `ExactPenalty`, its usual value in the planner's units; SI."""

    attribute: str
    usual: float
    unit: str
    scale: Callable[[Units], float]


DYNAMICS = "dynamics weight"
FACTORS = {
    "penalty weight": Factor("weight", SCvx.weight, "m/s per m", lambda units: 1 / units.time_s),
    "first radius": Factor(
        "initial_radius", SCvx.initial_radius, "m/s", lambda units: units.speed_m_s
    ),
    DYNAMICS: Factor("", subproblem.DYNAMICS_WEIGHT, "of a constraint", lambda _: 1.0),
}
"""By name; SCvx and PTR have the same. The dynamics weight is a constant of the program."""
MULTIPLES = (0.001, 0.01, 0.1, 1.0, 10.0, 100.0, 1000.0)
VARIED = ("scvx", "ptr")


@contextmanager
def dynamics_weight(weight: float) -> Iterator[None]:
    """Weigh the miss of the final state so much within the context, in the program and the merit."""
    usual = subproblem.DYNAMICS_WEIGHT
    try:
        for module in (subproblem, model):
            vars(module).update(DYNAMICS_WEIGHT=weight)
        yield
    finally:
        for module in (subproblem, model):
            vars(module).update(DYNAMICS_WEIGHT=usual)


def measure(case: tuple[str, str, str, float]) -> Record:
    """Plan a problem by an algorithm with a factor at a multiple, twice: a row."""
    problem, algorithm, name, multiple = case
    base, overrides = PROBLEMS[problem]
    mission = Mission.from_scenario(load_scenario(base, overrides))
    start, factor = initial_guess.cold(mission), FACTORS[name]
    value = multiple * factor.usual
    changed = {factor.attribute: value} if factor.attribute else {}
    times = []
    with dynamics_weight(value if name == DYNAMICS else subproblem.DYNAMICS_WEIGHT):
        for _ in range(2):
            planner = Planner(mission, algorithm=algorithm)
            planner.algorithm = ALGORITHMS[algorithm](**changed)
            begin = process_time()
            plan = planner.plan(start)
            times.append(process_time() - begin)
    stages = [stage.name[:2] for stage in plan.stages for _ in stage.result.records]
    return {
        "problem": problem,
        "algorithm": algorithm,
        "factor": name,
        "multiple": multiple,
        "value": value,
        "value_si": value * factor.scale(mission.units),
        "unit": factor.unit,
        "status": plan.status.value.name,
        "total_dv_m_s": plan.total_dv_m_s,
        "iterations_p3": stages.count("P3"),
        "iterations_p2": stages.count("P2"),
        "processor_s": min(times),
    }


def compared(rows: Sequence[Record]) -> list[Record]:
    """Rows with the relative difference of their delta-v from the least plan's of the problem."""
    plans = [row for row in rows if row["status"] == Status.CONVERGED.value.name]
    least = {
        name: min((r["total_dv_m_s"] for r in plans if r["problem"] == name), default=float("nan"))
        for name in {row["problem"] for row in rows}
    }
    return [row | {"off": row["total_dv_m_s"] / least[row["problem"]] - 1.0} for row in rows]


def by_value(rows: Sequence[Record]) -> list[Record]:
    """A row for each value of a factor, a column for each problem."""
    found: dict[tuple[object, ...], Record] = {}
    for row in rows:
        of = {key: row[key] for key in ("algorithm", "factor", "multiple", "value")}
        solved = row["status"] == Status.CONVERGED.value.name
        end = f"{row['total_dv_m_s']:.6f}" if solved else row["status"].replace("_", " ")
        cell = {row["problem"]: f"{end} ({row['iterations_p3']} + {row['iterations_p2']})"}
        found[tuple(of.values())] = found.get(tuple(of.values()), of) | cell
    return list(found.values())


def run(session: Session) -> Findings:
    """Plan every problem with every value."""
    cases = [(problem, *rest) for *rest, problem in product(VARIED, FACTORS, MULTIPLES, PROBLEMS)]
    jobs = [Job(", ".join(map(str, case)), case) for case in cases]
    rows = compared(session.rows("plans", measure, jobs, session.store()))
    return Findings({"sensitivity.csv": records(rows), "by_value.csv": records(by_value(rows))})


STUDY = Study(__doc__, run)
