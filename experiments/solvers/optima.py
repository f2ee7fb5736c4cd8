"""Compare the default plan with the best that many starts and choices of facets find.

The drawn scenarios of `compare_solvers` are planned as `solve` plans them. The reference of each is the
least that any of these finds: P3 from the straight line and from five random flights; with uniform
risk, facets settled along each P3 and along its plan with exact risk at nodes, where the default has
a rough one; SCvx and PTR from there, with exact risk SCvx* too. References are measured first, and
stay in OUT/reference.jsonl. The default was made while seeds below 600 were looked at; from 700 on they
are fresh. OUT/optima.csv has a row for each scenario, OUT/summary.csv one for each kind and set of
seeds. After Ctrl-C the study continues with the missing rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cache
from time import process_time

import pandas as pd

from experiments.harness import Findings, Record, Session, Study
from experiments.solvers.cases import NUMBER, drawn
from formulations.linearisation.linearisation import Linearisation
from formulations.rows.exact import NodeRows
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan, Stage, StageSpec, is_converged
from scp_recon.planning.planner import Planner
from scp_recon.planning.settling import Settling
from scp_recon.planning.stages import Pipeline, same_optimum
from scp_recon.planning.starts import random_flight
from scp_recon.scenario.load import load_scenario

STARTS = 6
"""Of the reference, the straight line included."""
FINE = 1e-3
"""Resolution of its plans with exact risk, along whose paths facets are settled."""
UNIFORM = {"risk.allocation": "uniform", "risk.scope": "node"}
SETS = (
    ("uniform", "tuned", range(NUMBER)),
    ("exact", "tuned", range(NUMBER)),
    ("uniform", "fresh", range(700, 800)),
)
"""Kinds of risk and seeds: those of every other comparison, and fresh ones."""
NEAR, FAR = 1e-3, 1e-2
"""Relative differences from the reference that are counted."""


def posed(kind: str, seed: int) -> Mission:
    """A drawn scenario with uniform risk at nodes, or with exact risk as it is drawn."""
    changes = drawn(seed)[1] | (UNIFORM if kind == "uniform" else {})
    return Mission.from_scenario(load_scenario().replace(changes))


def measure(case: tuple[str, str, int]) -> Record:
    """A row: the plans of a scenario, and the least that the reference and they find."""
    return _joined(planned(case), reference(case))


def _joined(row: Record, least: Record) -> Record:
    costs = [row["total_dv_m_s"], row["simple_m_s"], least["least_m_s"]]
    found = [cost for cost in costs if cost == cost]
    return row | {"least_m_s": min(found, default=float("nan"))}


def planned(case: tuple[str, str, int]) -> Record:
    """Plan a scenario as `solve` does, and with facets chosen once or from one start."""
    kind, seeds, seed = case
    row: Record = {"kind": kind, "seeds": seeds, "seed": seed, "status": "no window"}
    nothing = ("total_dv_m_s", "processor_s", "simple_m_s", "simple_processor_s", "p3_m_s")
    try:
        mission = posed(kind, seed)
    except InputError:
        return row | dict.fromkeys(nothing, float("nan"))
    _warm()
    options = PlanOptions(certify=False) if kind == "exact" else PlanOptions()
    simple = (
        PlanOptions(certify=False, starts=1) if kind == "exact" else PlanOptions(facet_rounds=0)
    )
    found, seconds = _planned(mission, options)
    other, less = _planned(mission, simple)
    p3 = found.without_uncertainty
    return row | {
        "status": found.status.value.name,
        "total_dv_m_s": _cost(mission, found.final),
        "processor_s": seconds,
        "simple_m_s": _cost(mission, other.final),
        "simple_processor_s": less,
        "p3_m_s": p3.total_dv_m_s if p3 else float("nan"),
    }


def reference(case: tuple[str, str, int]) -> Record:
    """The least delta-v that the reference finds for a scenario, m/s; NaN if it finds no plan."""
    kind, seeds, seed = case
    costs: list[float] = []
    with suppress(InputError):  # no window
        costs = _reference(posed(kind, seed), kind)
    least = min(costs, default=float("nan"))
    return {"kind": kind, "seeds": seeds, "seed": seed, "least_m_s": least}


def _planned(mission: Mission, options: PlanOptions) -> tuple[Plan, float]:
    """A plan from the straight line, and the processor's seconds for it."""
    begin = process_time()
    found = plan_mission(mission, initial_guess.cold(mission), options)
    return found, process_time() - begin


@cache
def _warm() -> None:
    """Compile the programs that every scenario shares, once per process."""
    for kind in ("uniform", "exact"):
        mission = posed(kind, 0)
        Planner(mission).plan(initial_guess.cold(mission))


def _cost(mission: Mission, stage: Stage) -> float:
    """Delta-v of a converged run of P2, m/s; NaN of any other."""
    solved = is_converged(stage) and stage.problem == "P2"
    return (
        float(stage.result.lin.iterate.total_dv * mission.units.speed_m_s)
        if solved
        else float("nan")
    )


def _reference(mission: Mission, kind: str) -> list[float]:
    """Delta-v of every plan that the reference finds, m/s."""
    guesses = [initial_guess.cold(mission)]
    guesses += [random_flight(mission, 0, number) for number in range(1, STARTS)]
    names = ("scvx", "ptr", "scvx-star") if kind == "exact" else ("scvx", "ptr")
    planners = {name: Planner(mission, algorithm=name) for name in names}
    runs = Pipeline(mission, planners["scvx"])
    costs, optima = [], list[Stage]()
    for guess in guesses:
        start = runs.start(guess)
        p3 = runs.run(planners["scvx"].p3_stages(start), start)
        if not is_converged(p3) or any(same_optimum(p3, other) for other in optima):
            continue
        optima.append(p3)
        for planner in planners.values():
            by = Pipeline(mission, planner)
            if kind == "exact":
                costs.append(_cost(mission, by.exact(p3.result.lin)))
                continue
            for settled in _settled(mission, runs, p3.result.lin):
                assert settled.facets is not None
                lin = settled.result.lin
                costs.append(_cost(mission, by.run([planner.p2_stage(settled.facets, lin)], lin)))
    return [cost for cost in costs if cost == cost]


def _settled(mission: Mission, runs: Pipeline, p3: Linearisation) -> Iterator[Stage]:
    """Rough plans with facets settled along P3, and along its plan with exact risk."""
    settling = Settling(mission, runs.solve)
    rows = NodeRows(mission.problem.open_loop, mission.risk.p_chance, FINE)
    exact = runs.solve(StageSpec("P2", rows, "node"), p3)
    yield from map(settling.along, (p3, exact.result.lin))


def summary(rows: Sequence[Record]) -> list[Record]:
    """Of the scenarios that anything solves: how many the default solves, how near, in what time."""
    found = pd.DataFrame(rows)
    found["over"] = found.total_dv_m_s / found.least_m_s - 1.0
    found["simple_over"] = found.simple_m_s / found.least_m_s - 1.0
    found["times"] = found.processor_s / found.simple_processor_s
    result = []
    for (kind, seeds), own in found[found.least_m_s.notna()].groupby(["kind", "seeds"], sort=False):
        result.append(
            {
                "kind": kind,
                "seeds": seeds,
                "solved_by_any": len(own),
                "solved": int(own.over.notna().sum()),
                "near": int((own.over < NEAR).sum()),
                "far": int((own.over > FAR).sum()),
                "worst": 100.0 * own.over.max(),
                "simple_solved": int(own.simple_over.notna().sum()),
                "simple_near": int((own.simple_over < NEAR).sum()),
                "simple_median": 100.0 * own.simple_over.median(),
                "simple_worst": 100.0 * own.simple_over.max(),
                "times_median": own.times.median(),
                "times_worst": own.times.max(),
            }
        )
    return result


def run(session: Session) -> Findings:
    """Plan every scenario, and tabulate."""
    cases = [(kind, name, seed) for kind, name, seeds in SETS for seed in seeds]
    least = session.rows("reference", reference, cases, session.store("reference.jsonl"))
    plans = session.rows("plans", planned, cases, session.store())
    rows = [_joined(*pair) for pair in zip(plans, least, strict=True)]
    return Findings({"optima": rows, "summary": summary(rows)})


STUDY = Study(__doc__, run, version=3)
