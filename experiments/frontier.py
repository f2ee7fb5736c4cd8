"""Measure delta-v against the required probability.

The default scenario is planned for probabilities from 0.55 to 0.999: with the paper's risk split
(uniform risk on its polytopes, facets chosen once and settled, and on tangent spheres with 12-facet
cones), with exact risk per node and for whole flights, and certified by flights. Every plan is flown
10,000 times. OUT/frontier.csv has a row for each: its cost, the probability reached, the expected
observation time, the processor time of all rounds, and the extra delta-v and time of certifying.
`python -m paper_figs frontier` draws them. After Ctrl-C the study continues with the missing rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from time import process_time
from typing import Any

import pandas as pd

from experiments.harness import (
    CONVERGED,
    Record,
    Session,
    Study,
    Tables,
    flight_figures,
    fly_plan,
    wide,
)
from scp_recon.api.verbs import plan
from scp_recon.monte_carlo.flights import FlightTally
from scp_recon.planning.plan import Plan
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status

PROBABILITIES = (0.55, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999)
FLIGHTS, SEED = 10_000, 20

TANGENT = {"polytopes.ball": "tangent", "polytopes.cone": 12}
EXACT = {"risk.allocation": "exact"}
ONCE: dict[str, Any] = {"facet_rounds": 0}
KINDS: Mapping[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "uniform, paper polytopes": ({}, ONCE),
    "uniform, facets settled": ({}, {}),
    "uniform, tangent spheres": (TANGENT, {}),
    "exact, each node": (EXACT, {"certify": False}),
    "exact, whole flights": (EXACT | {"risk.scope": "flight"}, {"certify": False}),
    "certified, each node": (EXACT, {"certify": True}),
    "certified, whole flights": (EXACT | {"risk.scope": "flight"}, {"certify": True}),
}
"""Changes to the scenario, and options of planning; paper polytopes with facets chosen once."""
NOT_CERTIFIED = "not certified"
"""Status of a converged plan whose flights do not reach the required probability."""


def measure(case: tuple[str, float]) -> Record:
    """Plan one kind for one probability from a cold start, and fly it: a row."""
    kind, p = case
    changes, options = KINDS[kind]
    scenario = load_scenario().replace({**changes, "risk.p_chance": p})
    begin = process_time()
    found = plan(scenario, starts=1, **options)
    took = process_time() - begin
    return record(kind, p, found, fly_plan(found, FLIGHTS, SEED), took)


def record(kind: str, p: float, found: Plan, flown: FlightTally, processor_s: float) -> Record:
    """A row of a plan's cost and the probability its flights reach; the time is of all its rounds."""
    reached, converged = found.certificate, found.status is Status.CONVERGED
    missed = converged and reached is not None and not reached.certifies(p)
    figures = {
        "total_dv_m_s": float("nan") if missed else found.total_dv_m_s,
        "certified_low": reached.low if reached else float("nan"),
        **flight_figures(flown),
    }
    return {
        "kind": kind,
        "asked": p,
        "status": NOT_CERTIFIED if missed else found.status.value.name,
        "target": found.target or float("nan"),
        **(figures if converged else dict.fromkeys(figures, float("nan"))),
        "rounds": reached.rounds if reached else 1,
        "processor_s": processor_s,
    }


def with_costs(rows: Sequence[Record]) -> list[Record]:
    """Rows with what certifying adds to the plan for the probability itself; NaN if either failed."""
    found = {(row["kind"], row["asked"]): row for row in rows}
    result = []
    for row in rows:
        kind = row["kind"].replace("certified", "exact")
        if kind != row["kind"]:
            alone = found[kind, row["asked"]]
            more = row["total_dv_m_s"] - alone["total_dv_m_s"]
            percent = 100.0 * more / alone["total_dv_m_s"]
            row |= {"certifying_dv_m_s": more, "certifying_percent": percent}
            row |= {"by_itself_s": alone["processor_s"]}
        result.append(row)
    return result


def costs(rows: Sequence[Record]) -> list[Record]:
    """Delta-v, or the status without a plan: a row for each kind, a column for each probability."""
    frame = pd.DataFrame(rows)
    cells = frame.total_dv_m_s.astype(object).where(frame.status == CONVERGED, frame.status)
    columns = frame.asked.map("{:g}".format).str.replace(".", "_")
    named = frame.assign(delta_v_m_s_for=frame.kind, cell=cells, column=columns)
    return wide(named, ["delta_v_m_s_for"], "column", "cell")


def run(session: Session) -> Tables:
    """Plan and fly every kind for every probability."""
    cases = product(KINDS, PROBABILITIES)
    rows = with_costs(session.rows("plans", measure, cases))
    return {"frontier": rows, "costs": costs(rows)}


STUDY = Study(__doc__, run)
