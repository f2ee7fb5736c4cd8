"""Measure the value of feedback over the probability and the measurement's error.

The default scenario is planned for whole flights with exact risk and certified by flights: open
loop, with feedback, and with feedback by a measurement an hour before the burn. OUT/feedback.csv has a
row for each, flown 40,000 times; OUT/feedback_errors.csv has plans that are not certified, over the
measurement's error, each from its neighbour's. `python -m paper_figs feedback` draws both. After
Ctrl-C the study continues with the missing rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from time import process_time
from typing import Any

import numpy as np

from experiments.frontier import SEED, record
from experiments.harness import Record, Session, Study, Tables, fly_plan
from experiments.plans import FLIGHT, measured
from scp_recon.api.verbs import plan
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.summary import MOST
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import Planner
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status

PROBABILITIES = (0.7, 0.9, 0.95, 0.99, 0.997, 0.999)
FLIGHTS = 40_000
ERRORS = (None, 1e6, 100.0, 10.0, 3.0, 1.0, 0.3, 0.1)
ERRORS_AT = (("flight", 0.9), ("flight", 0.99), ("node", 0.99))
"""Scopes of the risk, and probabilities."""
LEAD_S = 3600.0
OPEN, CORRECTED, LATE = "open loop", "feedback", "feedback, lead 1 h"


KINDS: Mapping[str, dict[str, Any]] = {
    OPEN: {},
    CORRECTED: measured(),
    LATE: measured(lead_s=LEAD_S),
}
"""Changes to the scenario."""


def measure(case: tuple[str, float]) -> Record:
    """Plan a kind for a probability from a cold start and fly it: a row."""
    (kind, asked), begin = case, process_time()
    changes = FLIGHT | KINDS[kind] | {"risk.p_chance": asked}
    found = plan(load_scenario().replace(changes), certify=True)
    return row(kind, asked, found, FLIGHTS, process_time() - begin)


def row(kind: str, asked: float, found: Plan, flights: int, processor_s: float) -> Record:
    """A row of a plan: its costs, as planned and as flown, and probabilities."""
    flown = fly_plan(found, flights, SEED)
    costs = record(kind, asked, found, flown, processor_s)
    if not np.isfinite(costs["total_dv_m_s"]):
        return costs
    lin, speed = found.final.result.lin, found.mission.units.speed_m_s
    dv99, corrected = flown.tallies["commanded_dv_m_s"], lin.iterate.gains.any()
    return costs | {
        "dv99_m_s": dv99.quantile(MOST)[0] if corrected else found.total_dv_m_s,
        "program_m_s": lin.cost.value * speed,
        "final_sigma_m": float(np.sqrt(np.trace(flown.terminal_covariance()[:3, :3]))),
    }


def over_errors(at: tuple[str, float, Sequence[float | None]]) -> Record:
    """Rows of plans that are not certified, by better and better measurements.

    Each begins at the plan before it, the first at the straight line.
    """
    scope, asked, scales = at
    rows, last = list[Record](), None
    for scale in scales:
        kind = OPEN if scale is None else CORRECTED
        changes = FLIGHT | {"risk.scope": scope, "risk.p_chance": asked}
        changes |= {} if scale is None else measured(scale)
        mission = Mission.from_scenario(load_scenario().replace(changes))
        begin = process_time()
        found = Planner(mission).plan(last or initial_guess.cold(mission))
        one = row(kind, asked, found, FLIGHTS, process_time() - begin)
        rows.append({"scope": scope, "scale": scale} | one)
        if found.status is Status.CONVERGED:
            last = found
    return {"rows": rows}


def run(session: Session) -> Tables:
    """Plan and fly everything."""
    cases = [(kind, p) for kind in KINDS for p in PROBABILITIES]
    rows = session.rows("plans", measure, cases)
    chains = session.rows("errors", over_errors, [(*at, ERRORS) for at in ERRORS_AT])
    errors = [one for chain in chains for one in chain["rows"]]
    return {"feedback": rows, "feedback_errors": errors}


STUDY = Study(__doc__, run)
