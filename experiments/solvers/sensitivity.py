"""Vary the penalty weight and the first trust-region radius, one at a time.

The three problems of `compare_solvers` are planned from the straight line, in the condensed form by
Clarabel, each time with weight or radius at a multiple of its usual value. SCvx bounds a step by the
radius r, PTR charges ||s||^2 / (2 r). Both factors belong to the loop, not to a scenario, and no value
is refused. OUT/sensitivity.csv has a row for each plan. OUT/by_value.csv has a row for each value, and
a column for each problem: delta-v in m/s, or the status without a plan, and P3's and P2's iterations.
After Ctrl-C the study continues with the missing rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import pandas as pd

from experiments.harness import CONVERGED, Record, Session, Study, Tables, plan_figures, wide
from experiments.solvers.cases import PROBLEMS
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import Planner
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.algorithms import ALGORITHMS, SCvx

FACTORS = {
    "penalty weight": ("weight", SCvx.weight),
    "first radius": ("initial_radius", SCvx.initial_radius),
}
"""By name an attribute of `ExactPenalty` and its usual value in the planner's units; SCvx and PTR have
the same."""
MULTIPLES = (0.001, 0.01, 0.1, 1.0, 10.0, 100.0, 1000.0)
VARIED = ("scvx", "ptr")


def measure(case: tuple[str, str, str, float]) -> Record:
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


def run(session: Session) -> Tables:
    """Plan every problem with every value."""
    cases = [(problem, *rest) for *rest, problem in product(VARIED, FACTORS, MULTIPLES, PROBLEMS)]
    rows = session.rows("plans", measure, cases)
    return {"sensitivity": rows, "by_value": by_value(rows)}


STUDY = Study(__doc__, run)
