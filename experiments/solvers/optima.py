"""Studies of the default plan: against many starts, and by the loop's weight and radius."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import product
from time import process_time

import numpy as np
import pandas as pd

from experiments.evidence import Evidence, path_of
from experiments.harness import CONVERGED, Record, Session, Study, Tables, plan_figures, wide
from experiments.solvers.cases import NUMBER, PROBLEMS, drawn
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import is_converged
from scp_recon.planning.planner import Planner
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.algorithms import ALGORITHMS, SCvx

# --- many starts ----------------------------------------------------------------------------------

UNIFORM = {"risk.allocation": "uniform", "risk.scope": "node"}
SETS = (
    ("uniform", "tuned", range(NUMBER)),
    ("exact", "tuned", range(NUMBER)),
    ("uniform", "fresh", range(700, 800)),
)
"""Kinds of risk and seeds: those of every other comparison, and fresh ones."""
NEAR = 1e-3
"""Relative difference from the reference that counts as none."""


def posed(kind: str, seed: int) -> Mission:
    """A drawn scenario with uniform risk at nodes, or with exact risk as it is drawn."""
    changes = drawn(seed)[1] | (UNIFORM if kind == "uniform" else {})
    return Mission.from_scenario(load_scenario().replace(changes))


@cache
def reference() -> dict[tuple[str, int], float]:
    """The least delta-v known of each scenario, by kind of risk and seed, m/s; NaN of no plan."""
    rows = pd.DataFrame(Evidence.read(path_of("optima")).tables["optima"])
    return rows.set_index(["kind", "seed"]).least_m_s.astype(float).to_dict()


def plan_drawn(case: tuple[str, str, int]) -> Record:
    """Plan a scenario as `solve` does, and with facets chosen once or from one start: a row."""
    kind, seeds, seed = case
    least = reference()[kind, seed]
    row: Record = {"kind": kind, "seeds": seeds, "seed": seed, "status": "no window"}
    row |= dict.fromkeys(
        ("total_dv_m_s", "processor_s", "simple_m_s", "simple_processor_s"), np.nan
    )
    try:
        mission = posed(kind, seed)
    except InputError:
        return row | {"p3_m_s": np.nan, "least_m_s": least}
    _warm()
    more, less = PlanOptions(), PlanOptions(facet_rounds=0)
    if kind == "exact":
        more, less = PlanOptions(certify=False), PlanOptions(certify=False, starts=1)
    for cost, seconds, options in (
        ("simple_m_s", "simple_processor_s", less),
        ("total_dv_m_s", "processor_s", more),
    ):
        begin = process_time()
        found = plan_mission(mission, initial_guess.cold(mission), options)
        row[seconds] = process_time() - begin
        if is_converged(found.final) and found.final.problem == "P2":
            row[cost] = found.total_dv_m_s
    p3 = found.without_uncertainty
    return row | {
        "status": found.status.value.name,
        "p3_m_s": p3.total_dv_m_s if p3 else np.nan,
        "least_m_s": pd.Series([row["total_dv_m_s"], row["simple_m_s"], least]).min(),
    }


@cache
def _warm() -> None:
    """Compile the programs that every scenario shares, once per process."""
    for kind in ("uniform", "exact"):
        mission = posed(kind, 0)
        Planner(mission).plan(initial_guess.cold(mission))


def summary(rows: Sequence[Record]) -> list[Record]:
    """Sum up scenarios that anything solves: how many the default solves, how near, in what time."""
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


def optima(session: Session) -> Tables:
    """Compare the default plan with the best that many starts and choices of facets find.

    The drawn scenarios of `compare_solvers` are planned as `solve` plans them. The reference of
    each is the least delta-v that is known, in the evidence: what any version has found, and what
    six starts found once (commit 10805cd7): P3 from the straight line and from five random flights;
    with uniform risk, facets settled along each P3 and along its plan with exact risk at nodes;
    SCvx and PTR from there, with exact risk SCvx* too. The default was made while seeds below 600
    were looked at; from 700 on they are fresh. OUT/optima.csv has a row for each scenario,
    OUT/summary.csv one for each kind and set of seeds. After Ctrl-C the study continues with the
    missing rows.
    """
    cases = [(kind, name, seed) for kind, name, seeds in SETS for seed in seeds]
    rows = session.rows("plans", plan_drawn, cases)
    return {"optima": rows, "summary": summary(rows)}


# --- weight and radius ----------------------------------------------------------------------------

FACTORS = {
    "penalty weight": ("weight", SCvx.weight),
    "first radius": ("initial_radius", SCvx.initial_radius),
}
"""By name an attribute of `ExactPenalty` and its usual value in the planner's units; SCvx and PTR have
the same."""
MULTIPLES = (0.001, 0.01, 0.1, 1.0, 10.0, 100.0, 1000.0)
VARIED = ("scvx", "ptr")


def plan_varied(case: tuple[str, str, str, float]) -> Record:
    """Plan a problem by an algorithm with a factor at a multiple of its usual value: a row."""
    problem, algorithm, name, multiple = case
    mission = Mission.from_scenario(load_scenario(*PROBLEMS[problem]))
    attribute, usual = FACTORS[name]
    planner, value = Planner(mission, algorithm=algorithm), multiple * usual
    planner.algorithm = ALGORITHMS[algorithm](**{attribute: value})
    found = planner.plan(initial_guess.cold(mission))
    return {
        "problem": problem,
        "algorithm": algorithm,
        "factor": name,
        "multiple": multiple,
        "value": value,
        **plan_figures(found),
    }


def by_value(rows: Sequence[Record]) -> list[Record]:
    """A row for each value of a factor, a column for each problem: delta-v, or the status."""
    found = pd.DataFrame(rows)
    cost = found.total_dv_m_s.map("{:.6f}".format)
    ends = cost.where(found.status == CONVERGED, found.status.str.replace("_", " "))
    counts = found.iterations_p3.astype(str) + " + " + found.iterations_p2.astype(str)
    index = ("algorithm", "factor", "multiple", "value")
    return wide(found.assign(cell=ends + " (" + counts + ")"), index, "problem", "cell")


def sensitivity(session: Session) -> Tables:
    """Vary the penalty weight and the first trust-region radius, one at a time.

    The three problems of `compare_solvers` are planned from the straight line, in the condensed
    form by Clarabel, each time with weight or radius at a multiple of its usual value. SCvx bounds
    a step by the radius r, PTR charges ||s||^2 / (2 r). Both factors belong to the loop, not to a
    scenario, and no value is refused. OUT/sensitivity.csv has a row for each plan. OUT/by_value.csv
    has a row for each value, and a column for each problem: delta-v in m/s, or the status without a
    plan, and P3's and P2's iterations. After Ctrl-C the study continues with the missing rows.
    """
    cases = [(problem, *rest) for *rest, problem in product(VARIED, FACTORS, MULTIPLES, PROBLEMS)]
    rows = session.rows("plans", plan_varied, cases)
    return {"sensitivity": rows, "by_value": by_value(rows)}


STUDIES = {
    "optima": Study(optima.__doc__, optima, version=3),
    "sensitivity": Study(sensitivity.__doc__, sensitivity),
}
