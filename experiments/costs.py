"""Studies of what probability costs: by kinds of risk, with feedback, by three policies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from time import process_time
from typing import Any, NamedTuple

import numpy as np
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
from experiments.plans import EXACT, FLIGHT, FLIGHTS, SEED, TANGENT, measured
from scp_recon.api.plan_verbs import fly
from scp_recon.api.verbs import plan
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import FlightTally
from scp_recon.monte_carlo.sampling import PolicyKind
from scp_recon.monte_carlo.summary import MOST
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import Planner
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status

# --- the frontier ---------------------------------------------------------------------------------

ASKED = (0.55, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999)
RISKS: Mapping[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "uniform, paper polytopes": ({}, {"facet_rounds": 0}),
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


def plan_kind(case: tuple[str, float]) -> Record:
    """Plan one kind for one probability from a cold start, and fly it: a row."""
    kind, p = case
    changes, options = RISKS[kind]
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


def frontier(session: Session) -> Tables:
    """Measure delta-v against the required probability.

    The default scenario is planned for probabilities from 0.55 to 0.999: with the paper's risk
    split (uniform risk on its polytopes, facets chosen once and settled, and on tangent spheres
    with 12-facet cones), with exact risk per node and for whole flights, and certified by flights.
    Every plan is flown 10,000 times. OUT/frontier.csv has a row for each: its cost, the probability
    reached, the expected observation time, the processor time of all rounds, and the extra delta-v
    and time of certifying. `python -m paper_figs frontier` draws them. After Ctrl-C the study
    continues with the missing rows.
    """
    cases = product(RISKS, ASKED)
    rows = with_costs(session.rows("plans", plan_kind, cases))
    return {"frontier": rows, "costs": costs(rows)}


# --- feedback -------------------------------------------------------------------------------------

ASKED_OF_FEEDBACK = (0.7, 0.9, 0.95, 0.99, 0.997, 0.999)
FEEDBACK_FLIGHTS = 40_000
ERRORS = (None, 1e6, 100.0, 10.0, 3.0, 1.0, 0.3, 0.1)
ERRORS_AT = (("flight", 0.9), ("flight", 0.99), ("node", 0.99))
"""Scopes of the risk, and probabilities."""
LEAD_S = 3600.0
OPEN, CORRECTED, LATE = "open loop", "feedback", "feedback, lead 1 h"
POLICIES: Mapping[str, dict[str, Any]] = {
    OPEN: {},
    CORRECTED: measured(),
    LATE: measured(lead_s=LEAD_S),
}
"""Changes to the scenario."""


def plan_policy(case: tuple[str, float]) -> Record:
    """Plan a kind for a probability from a cold start and fly it: a row."""
    (kind, asked), begin = case, process_time()
    changes = FLIGHT | POLICIES[kind] | {"risk.p_chance": asked}
    found = plan(load_scenario().replace(changes), certify=True)
    return corrected_row(kind, asked, found, process_time() - begin)


def corrected_row(kind: str, asked: float, found: Plan, processor_s: float) -> Record:
    """A row of a plan: its costs, as planned and as flown, and probabilities."""
    flown = fly_plan(found, FEEDBACK_FLIGHTS, SEED)
    row = record(kind, asked, found, flown, processor_s)
    if not np.isfinite(row["total_dv_m_s"]):
        return row
    lin, speed = found.final.result.lin, found.mission.units.speed_m_s
    dv99, corrected = flown.tallies["commanded_dv_m_s"], lin.iterate.gains.any()
    return row | {
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
        one = corrected_row(kind, asked, found, process_time() - begin)
        rows.append({"scope": scope, "scale": scale} | one)
        if found.status is Status.CONVERGED:
            last = found
    return {"rows": rows}


def feedback(session: Session) -> Tables:
    """Measure the value of feedback over the probability and the measurement's error.

    The default scenario is planned for whole flights with exact risk and certified by flights: open
    loop, with feedback, and with feedback by a measurement an hour before the burn.
    OUT/feedback.csv has a row for each, flown 40,000 times; OUT/feedback_errors.csv has plans that
    are not certified, over the measurement's error, each from its neighbour's. `python -m
    paper_figs feedback` draws both. After Ctrl-C the study continues with the missing rows.
    """
    cases = [(kind, p) for kind in POLICIES for p in ASKED_OF_FEEDBACK]
    rows = session.rows("plans", plan_policy, cases)
    chains = session.rows("errors", over_errors, [(*at, ERRORS) for at in ERRORS_AT])
    errors = [one for chain in chains for one in chain["rows"]]
    return {"feedback": rows, "feedback_errors": errors}


# --- three policies -------------------------------------------------------------------------------

ASKED_OF_POLICIES = (0.7, 0.9, 0.99)
POLICY_ERRORS, POLICY_ERRORS_AT = (0.1, 10.0), 0.99
"""Times the usual error of the measurement, and the probability at which it varies."""
POLICY_FLIGHTS: Mapping[PolicyKind, int] = {"open": 10_000, "feedback": 10_000, "replan": 370}
"""Flights by each policy. The 99 % quantile of delta-v has an interval from 368 flights on."""


class Case(NamedTuple):
    """A policy, the required probability, and the measurement's error."""

    policy: PolicyKind
    asked: float
    scale: float = 1.0


CASES = [Case(kind, p) for p in ASKED_OF_POLICIES for kind in POLICY_FLIGHTS]
CASES += [
    Case(kind, POLICY_ERRORS_AT, scale)
    for scale in POLICY_ERRORS
    for kind in ("feedback", "replan")
]


def fly_policy(case: Case) -> Record:
    """Plan a case and fly it: a row."""
    changes = FLIGHT | measured(case.scale) | {"risk.p_chance": case.asked}
    if case.policy != "feedback":
        changes |= {"policy.kind": "open"}
    found = plan(load_scenario().replace(changes), certify=False)
    row = {**case._asdict(), "status": found.status.value.name}
    if found.status is not Status.CONVERGED:
        return row
    flights, begin = POLICY_FLIGHTS[case.policy], process_time()
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


def policies(session: Session) -> Tables:
    """Compare three policies: burns as planned, corrected by gains, planned again before each.

    The default scenario is planned for whole flights with exact risk, from a cold start and not
    certified: open loop, which is also the plan that is replanned, and with feedback. Each plan is
    flown by its policy, over the required probability and over the error of the measurement at each
    cut-off. OUT/policies.csv has a row for each, with 95 % intervals; `python -m paper_figs
    policies` draws them. After Ctrl-C the study continues with the missing rows.
    """
    return {"policies": session.rows("cases", fly_policy, CASES)}


STUDIES = {
    "frontier": Study(frontier.__doc__, frontier),
    "feedback": Study(feedback.__doc__, feedback),
    "policies": Study(policies.__doc__, policies),
}
