"""Compare three policies: burns as planned, corrected by gains, and planned again before each burn.

The default scenario is planned for whole flights with exact risk, from a cold start and not certified:
open loop, which is also the plan that is replanned, and with feedback. Each plan is flown by its
policy, over the required probability and over the error of the measurement at each cut-off.
OUT/policies.csv has a row for each, with 95 % intervals; `python -m paper_figs policies` draws them.
After Ctrl-C the study continues with the missing rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from time import process_time
from typing import NamedTuple

from experiments.frontier import SEED
from experiments.harness import Record, Session, Study, Tables
from experiments.plans import FLIGHT, measured
from scp_recon.api.plan_verbs import fly
from scp_recon.api.verbs import plan
from scp_recon.monte_carlo.sampling import PolicyKind
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status

PROBABILITIES = (0.7, 0.9, 0.99)
ERRORS, ERRORS_AT = (0.1, 10.0), 0.99
"""Times the usual error of the measurement, and the probability at which it varies."""
FLIGHTS: Mapping[PolicyKind, int] = {"open": 10_000, "feedback": 10_000, "replan": 370}
"""Of a plan. The 99 % quantile of delta-v has an interval from 368 flights on."""


class Case(NamedTuple):
    """A policy, the required probability, and the measurement's error."""

    policy: PolicyKind
    asked: float
    scale: float = 1.0


CASES = [Case(kind, p) for p in PROBABILITIES for kind in FLIGHTS]
CASES += [Case(kind, ERRORS_AT, scale) for scale in ERRORS for kind in ("feedback", "replan")]


def measure(case: Case) -> Record:
    """Plan a case and fly it: a row."""
    changes = FLIGHT | measured(case.scale) | {"risk.p_chance": case.asked}
    if case.policy != "feedback":
        changes |= {"policy.kind": "open"}
    found = plan(load_scenario().replace(changes), certify=False)
    row = {**case._asdict(), "status": found.status.value.name}
    if found.status is not Status.CONVERGED:
        return row
    flights, begin = FLIGHTS[case.policy], process_time()
    flown = fly(found, flights, SEED, policy=case.policy)
    seconds = process_time() - begin
    whole, dv = flown.whole_flight, flown.commanded
    row |= {
        "whole_flight": whole.value,
        "whole_flight_low": whole.low,
        "whole_flight_high": whole.high,
        "mean_dv_m_s": dv.mean_dv_m_s.value if dv else found.total_dv_m_s,
        "dv99_m_s": dv.dv99_m_s.value if dv else found.total_dv_m_s,
        "final_sigma_m": flown.terminal.sigma_position_m.value,
    }
    failed = sum(burn.failed or 0 for burn in dv.burns) if dv else 0
    return row | {"flights": flights, "failed_replans": failed, "flying_s": seconds}


def run(session: Session) -> Tables:
    """Measure every case."""
    return {"policies": session.rows("cases", measure, CASES)}


STUDY = Study(__doc__, run)
