"""Compare the default plan with the best that many starts and choices of facets find.

The drawn scenarios of `compare_solvers` are planned as `solve` plans them. The reference of each is the
least delta-v that is known, in the evidence: what any version has found, and what six starts found once
(commit 10805cd7): P3 from the straight line and from five random flights; with uniform risk, facets
settled along each P3 and along its plan with exact risk at nodes; SCvx and PTR from there, with exact
risk SCvx* too. The default was made while seeds below 600 were looked at; from 700 on they are fresh.
OUT/optima.csv has a row for each scenario, OUT/summary.csv one for each kind and set of seeds. After
Ctrl-C the study continues with the missing rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from time import process_time

import numpy as np
import pandas as pd

from experiments.evidence import Evidence, path_of
from experiments.harness import Record, Session, Study, Tables
from experiments.solvers.cases import NUMBER, drawn
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import is_converged
from scp_recon.planning.planner import Planner
from scp_recon.scenario.load import load_scenario

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


def measure(case: tuple[str, str, int]) -> Record:
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


def run(session: Session) -> Tables:
    """Plan every scenario, and tabulate."""
    cases = [(kind, name, seed) for kind, name, seeds in SETS for seed in seeds]
    rows = session.rows("plans", measure, cases)
    return {"optima": rows, "summary": summary(rows)}


STUDY = Study(__doc__, run, version=3)
