"""Measure what it costs to survive a missed burn, and what can be done after one.

The default scenario with several kinds of risk, and the passes of packaged scenarios at the times and
boundary states of their designs (`passes.toml`), are planned without drifts, for any one burn missed,
and for any one cut short: a day at 0.997, by the law and the drifts' flights, and certified where
burns are corrected. OUT/costs.csv has a row for each, with the delta-v as `policy.cost` counts it;
where there is no plan, the burns whose drifts fail, and what the infeasibility diagnosis offers.
OUT/afterwards.csv has a row for each burn of the plan that survives its miss (with gains of the one
without drifts): the pass, and the way home. A plan with gains takes minutes.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Set
from itertools import product
from pathlib import Path
from time import process_time
from typing import Any, Literal

import numpy as np

from experiments.harness import Record, Session, Study, Tables
from experiments.plans import FLIGHT, TANGENT
from scp_recon.advice.infeasibility import diagnose
from scp_recon.api.inputs import PlanRequest
from scp_recon.api.options import PlanOptions
from scp_recon.api.verbs import plan, replan
from scp_recon.jobs.job import Failure, Job, Key
from scp_recon.jobs.processes import Limits, Processes
from scp_recon.mission.constraints import planned_misses
from scp_recon.planning.plan import Plan
from scp_recon.results.solution import make_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status
from scp_recon.verification.reintegration import verify

GAINS = {
    "policy.kind": "feedback",
    "navigation.lead_s": 0.0,
    "navigation.sigma_position_m": 5.0,
    "navigation.sigma_velocity_m_s": 5e-4,
}
DEFAULT: Mapping[str, dict[str, Any]] = {
    "0.70, tangent facets": TANGENT,
    "0.90 of whole flights": FLIGHT | {"risk.p_chance": 0.9},
    "0.99 of whole flights": FLIGHT | {"risk.p_chance": 0.99},
    "0.99 with feedback": FLIGHT | GAINS | {"risk.p_chance": 0.99},
}
"""Changes to the default scenario."""
MEASURED = GAINS | {"navigation.sigma_position_m": 10.0, "risk.p_chance": 0.9}
CORRECTED = {"kingfisher": MEASURED, "osprey": MEASURED}
"""Changes to passes that need feedback."""
DRIFTS: Mapping[str, dict[str, Any]] = {
    "without": {},
    "missed": {"safety.missed_burns": 1},
    "cut short": {"safety.cut_short": True},
}
FED = {"0.99 with feedback", *CORRECTED}
"""Cases whose plans flights certify: with gains the law finds a probability too high by 0.07 sigma."""
LIMIT_S = 600.0
"""Processor time that a case may take."""
RADIUS, NEARER_M = "safety.drift_radius_m", 400.0
MORE = (0.2, 0.7), (0.5, 1.0), (0.3, 1.5)
"""Times of two burns that are added for the way home after the last one, past it, over the flight's
duration: the first pair that has a plan."""


PASSES: dict[str, dict[str, Any]] = tomllib.loads(
    Path(__file__).with_name("passes.toml").read_text("utf-8")
)
"""Entries of the passes that designs found over packaged scenarios' sites."""
CASES = [*DEFAULT, *PASSES]


def fixed(case: str) -> dict[str, Any]:
    """A pass by itself: no home orbit is left to design from."""
    return PASSES[case] | {"boundary.home": None, "design": None}


def scenario_of(case: str, drifts: str) -> Scenario:
    """The scenario of a case."""
    if case in DEFAULT:
        return load_scenario().replace(DEFAULT[case] | DRIFTS[drifts])
    return load_scenario(case).replace(fixed(case) | CORRECTED.get(case, {}) | DRIFTS[drifts])


def options_of(case: str) -> dict[str, Any]:
    """Options of planning."""
    return {"starts": 1, "certify": case in FED}


def measure(at: tuple[str, str]) -> Record:
    """Plan a case: a row."""
    case, drifts = at
    scenario, begin = scenario_of(case, drifts), process_time()
    found = plan(scenario, **options_of(case))
    seconds = process_time() - begin
    row = {
        "case": case,
        "drifts": drifts,
        "status": found.status.value.name,
        "processor_s": seconds,
    }
    if found.status is not Status.CONVERGED:
        names = [one.name for one in found.mission.problem.drifts]
        blind = {name for name, _ in found.mission.drift_losses}
        short = {n for n in names if found.final.margins[n].margin.min() < -found.final.tolerance}
        return row | {
            "in_the_way": in_words(scenario, blind | short) or "other limits",
            "what_would_do": what_would_do(found, case, scenario) or "nothing found",
        }
    checked = verify(found.mission, make_solution(found))
    later = [one for one in checked.drifts if one.burn > 1]
    nearest = min(later, key=lambda one: (one.value, one.closest_m))
    return row | {
        "cost_m_s": found.cost_m_s,
        "verified": checked.ok,
        "worst": nearest.event,
        "safe": nearest.value,
        "closest_m": nearest.closest_m,
        "impact": max(one.impact for one in later),
    }


def what_would_do(found: Plan, case: str, scenario: Scenario) -> str:
    """What the infeasibility diagnosis offers; a plan with gains takes longer than its trials may.

    Of these passes one smaller radius is tried, from the plan without drifts.
    """
    options = options_of(case)
    if case in CORRECTED:
        start = plan(scenario_of(case, "without"), **options)
        again = plan(scenario.replace({RADIUS: NEARER_M}), start, **options)
        return f"{RADIUS} {NEARER_M}" if again.status is Status.CONVERGED else ""
    offers = diagnose(found, PlanRequest(scenario, "cold", PlanOptions(**options))).remedies
    return "; ".join(
        ", ".join(f"{entry} {value}" for entry, value in one.changes.items()) for one in offers
    )


def in_words(scenario: Scenario, names: Set[str]) -> str:
    """Drifts by their names: what happens before them, the shares of each burn together."""
    misses = [miss for miss in planned_misses(scenario) if miss.name in names]
    said = [miss.event for miss in misses if not miss.share]
    for burn in dict.fromkeys(miss.burn for miss in misses if miss.share):
        shares = [f"{100.0 * miss.share:g}" for miss in misses if miss.share and miss.burn == burn]
        said.append(f"burn {burn} stops at {', '.join(shares)} %")
    return "; ".join(said)


def afterwards(case: str) -> Record:
    """The rows of the pass and the way home after each missed burn but the first.

    They are those of the plan that survives its misses; with gains, or where there is none, of the one
    without drifts.
    """
    drifts = "without" if case in CORRECTED else "missed"
    found = plan(scenario_of(case, drifts), **options_of(case))
    if found.status is not Status.CONVERGED:
        found = plan(scenario_of(case, "without"), **options_of(case))
    times = found.mission.scenario.burns.times_s
    return {"rows": [after(case, found, number) for number in range(2, 1 + len(times))]}


def after(case: str, found: Plan, number: int) -> Record:
    """What can be done after one burn of a plan is missed, from the mean state there: a row."""
    mission, times = found.mission, found.mission.scenario.burns.times_s
    at, state = times[number - 1], found.states[mission.burn_nodes[number - 1]].copy()
    state[3:] -= found.burns_m_s[number - 1]

    def left(goal: Literal["observe", "return"], *overrides: str) -> Plan:
        nothing = {number: np.zeros(3)}
        how: dict[str, Any] = {"measured_burns": nothing, "overrides": overrides, "certify": False}
        return replan(found, at, state, goal=goal, **how)

    row: Record = {"case": case, "missed": number, "at_s": at, "pass": "over by then"}
    if mission.schedule.window_s[1] > at:
        again = left("observe")
        row |= {"pass": again.status.value.name, "pass_dv_m_s": cost(again)}
    added = [[*times, *(times[-1] * (1.0 + share) for share in shares)] for shares in MORE]
    tries = [f"burns.times_s={one}" for one in added] if number == len(times) else []
    home = left("return", *tries[:1])
    for other in tries[1:]:
        home = home if home.status is Status.CONVERGED else left("return", other)
    first_s, last_s = (home.mission.scenario.burn_times_s[k] for k in (0, -1))
    way = {"home": home.status.value.name, "home_dv_m_s": cost(home)}
    return row | way | {"home_first_s": first_s, "home_last_s": last_s}


def cost(found: Plan) -> float:
    """Delta-v of a plan, m/s; NaN if it is none."""
    return found.cost_m_s if found.status is Status.CONVERGED else float("nan")


def run(session: Session) -> Tables:
    """Plan every case with and without drifts, and from each missed burn on."""
    alone = Processes(2, Limits(seconds=20.0 * LIMIT_S, cpu_s=LIMIT_S))
    how: dict[str, Any] = {"executor": alone, "failed": ended}
    plans = [Job("; ".join(of), of) for of in product(CASES, DRIFTS)]
    costs = session.rows("plans", measure, plans, **how)
    without = {row["case"]: row.get("cost_m_s") for row in costs if row["drifts"] == "without"}
    for row in costs:
        least, own = without[row["case"]], row.get("cost_m_s")
        row["more_percent"] = 100.0 * (own / least - 1.0) if own and least else float("nan")
    each = [Job(case, case) for case in CASES]
    later = session.rows("afterwards", afterwards, each, **how)
    every = [row for found in later for row in found.get("rows", [])]
    return {"costs": costs, "afterwards": every}


def ended(key: Key, failure: Failure) -> Record:
    """The row of a case that did not end in time."""
    if failure.error is not None:
        raise failure.error
    case, _, drifts = str(key).partition("; ")
    return {"case": case, "drifts": drifts, "status": f"not within {LIMIT_S:.0f} s"}


STUDIES = {"missed_burns": Study(__doc__, run, version=2)}
