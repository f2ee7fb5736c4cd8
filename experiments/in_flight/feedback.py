"""Measure the value of feedback over the probability and the measurement's error.

The default scenario is planned for whole flights with exact risk and certified by flights: open
loop, with feedback, and with feedback and a limit on the final dispersion. They are compared with
the best scaled targeting gain: the burns of an open-loop plan, and at the corrected burn a share of
the gain that would return the flight to its planned position at some time. The study searches
share, time and the plan's probability. Flights of the same closed loop certify the result.
OUT/feedback.csv has a row for each, flown 40,000 times; OUT/feedback_errors.csv has plans that are
not certified, over the measurement's error, each from its neighbour's. `python -m paper_figs
feedback` draws both. OUT/feedback_programs.csv has sizes of programs and times of plans. After
Ctrl-C the study continues with the missing rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from time import process_time
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq, minimize_scalar
from scipy.special import ndtr, ndtri

from experiments.frontier import SEED, record
from experiments.harness import Claim, Findings, Record, Session, Study, fly_plan
from experiments.plans import FLIGHT
from experiments.solvers.variations import noted
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.flyby import Iterate
from formulations.program.subproblem import MeritFunction
from formulations.rows.exact_flight import FlightRows
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.api.verbs import plan
from scp_recon.certification.certify import certify
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.summary import MOST
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan, Stage
from scp_recon.planning.planner import FINE_WITH_GAINS, LINES, Planner
from scp_recon.planning.stages import RESOLUTION
from scp_recon.results.policy import transition
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status

PROBABILITIES = (0.7, 0.9, 0.95, 0.99, 0.997, 0.999)
TO_THE_END = (0.9, 0.99)
FLIGHTS = 40_000
ERRORS = (None, 1e6, 100.0, 10.0, 3.0, 1.0, 0.3, 0.1)
ERRORS_AT = (("flight", 0.9), ("flight", 0.99), ("node", 0.99))
"""Scopes of the risk, and probabilities."""
POSITION_M, VELOCITY_M_S = 10.0, 5e-4
"""1 sigma of the measurement along each axis, and what `ERRORS` multiply; without one, open loop."""
LEAD_S = 3600.0

OPEN, CORRECTED, LATE = "open loop", "feedback", "feedback, lead 1 h"
TARGETED, TARGETED_LATE = "targeting gain", "targeting gain, lead 1 h"
ENDING = "feedback, limited at the end"
AGAINST = {TARGETED: CORRECTED, TARGETED_LATE: LATE}
"""Each gain to beat, and the plan that has to."""
TARGETING = tuple((kind, p) for kind in (TARGETED, TARGETED_LATE) for p in (0.99, 0.997, 0.999))
LESS, FURTHER = 3.0, (1.03, 1.1, 1.2)
"""Times that the final dispersion is to be smaller than open loop, and how far limits that are tried
lie below that: the planner's local optima differ from one to the next."""
LIMIT = "boundary.final_sigma_position_m"
PROGRAMS = (
    *((risk, p) for risk in ("uniform", "node") for p in (0.7, 0.9, 0.99)),
    *(("flight", p) for p in (0.7, 0.9, 0.99, 0.997, 0.999)),
)
"""Risk and probability of plans with feedback that are timed."""
TIMES = 2
TIMES_AT_MOST = (
    ("nodes and facets", ("uniform", "node"), 10.0),
    ("whole flights", ("flight",), 20.0),
)
"""Seconds of a plan over those of the default one."""
AT_MOST_M_S = {0.99: 0.116, 0.997: 0.119, 0.999: 0.1205}
"""What plans without a lead are to cost."""


def measured(scale: float = 1.0, lead_s: float = 0.0) -> dict[str, Any]:
    """Changes to the scenario: feedback, by a measurement of so many times the usual error."""
    return {
        "policy.kind": "feedback",
        "navigation.lead_s": lead_s,
        "navigation.sigma_position_m": scale * POSITION_M,
        "navigation.sigma_velocity_m_s": scale * VELOCITY_M_S,
    }


KINDS: Mapping[str, dict[str, Any]] = {
    OPEN: {},
    CORRECTED: measured(),
    LATE: measured(lead_s=LEAD_S),
    TARGETED: measured(),
    TARGETED_LATE: measured(lead_s=LEAD_S),
    ENDING: measured(),
}
"""Changes to the scenario."""


class Case(NamedTuple):
    """What to plan: a kind for a probability, with more changes to the scenario."""

    kind: str
    asked: float
    changes: Mapping[str, Any] = {}


TARGET = dict.fromkeys(("planned_for", "share", "target_s"), np.nan)
"""Of plans that no scaled targeting gain corrects."""


def measure(case: Case) -> Record:
    """Plan a case from a cold start and fly it: a row, which says so where that failed."""
    changes = FLIGHT | KINDS[case.kind] | dict(case.changes) | {"risk.p_chance": case.asked}
    scenario, begin, more = load_scenario().replace(changes), process_time(), TARGET
    try:
        if case.kind in AGAINST:
            found, more = by_targeting(Mission.from_scenario(scenario))
        else:
            found = plan(scenario, certify=True)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        return {"kind": case.kind, "asked": case.asked, "status": f"failed: {error}"}
    return row(case, found, FLIGHTS, process_time() - begin) | more


def row(case: Case, found: Plan, flights: int, processor_s: float) -> Record:
    """A row of a plan: costs, with intervals if measured by flights, and probabilities."""
    flown = fly_plan(found, flights, SEED)
    costs = record(case.kind, case.asked, found, flown, processor_s)
    if not np.isfinite(costs["total_dv_m_s"]):
        return costs
    lin, speed = found.final.result.lin, found.mission.units.speed_m_s
    dv99, low, high = flown.commanded_dv.quantile(MOST)
    if not lin.iterate.gains.any():
        dv99 = low = high = found.total_dv_m_s
    limits = [counts.min() / flown.samples for counts in flown.limits.values() if len(counts)]
    return costs | {
        "dv99_m_s": dv99,
        "dv99_low_m_s": low,
        "dv99_high_m_s": high,
        "program_m_s": lin.cost.value * speed,
        "burns_hold": float(min(limits, default=1.0)),
        "final_sigma_m": float(np.sqrt(np.trace(flown.terminal_covariance()[:3, :3]))),
    }


class Gain(NamedTuple):
    """A share of the gain that targets the planned position at a time, on an open-loop plan's burns.

    Attributes:
        cost: 99 % of the delta-v by the program's draws, nondimensional.
        planned_for: probability of the open-loop plan.
        share: of the gain.
        target_s: the time.
        lin: linearisation with the gain.
    """

    cost: float
    planned_for: float = np.nan
    share: float = np.nan
    target_s: float = np.nan
    lin: Linearisation | None = None


NO_GAIN = Gain(1e3)
"""Stands for none that reaches the probability."""
PLANNED = (0.85, 0.985)
"""Probabilities between which the open-loop plan's is searched."""
CLOSE, AGAIN = 0.01, 0.05
"""To which difference of quantiles, and how far about the last one for another aim."""
STRIDE = 8
"""Nodes between the first times that are tried; then all about the best."""


def by_targeting(mission: Mission) -> tuple[Plan, dict[str, float]]:
    """The cheapest scaled targeting gain, certified like a plan, and the results of its search.

    For each aim of the certification it searches the probability of the open-loop plan, and for each
    the time and the share of the gain that reach the aim by the normal law.
    """
    open_loop = mission.changed({"policy.kind": "open"})
    options, start = PlanOptions(certify=False, starts=1), initial_guess.cold(open_loop)
    made = list[tuple[Stage, Gain]]()

    def search(mission: Mission, _: Iterate | Plan, target: float) -> Plan:
        tried = dict[float, tuple[Gain, Plan]]()

        def cost(quantile: float) -> float:
            p = float(ndtr(quantile))
            planned = plan_mission(open_loop, start, options, target=p)
            converged = planned.status is Status.CONVERGED
            gain = cheapest(mission, planned, target) if converged else NO_GAIN
            tried[gain.cost] = gain._replace(planned_for=p), planned
            return gain.cost

        last = float(ndtri(made[-1][1].planned_for)) if made else 0.0
        bounds = (last - AGAIN, last + AGAIN) if made else tuple(ndtri(PLANNED))
        minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": CLOSE})
        gain, planned = tried[min(tried)]
        result, merit = (
            replace(planned.final.result, status=Status.INFEASIBLE),
            planned.final.merit,
        )
        if gain.lin is not None:
            result = replace(planned.final.result, lin=gain.lin)
            merit = MeritFunction(mission.problem, rows_at(gain.lin, target))
        spec = replace(planned.final.spec, role="final")
        stage = replace(planned.final, spec=spec, result=result, merit=merit)
        made.append((stage, gain))
        return replace(planned, mission=mission, final=stage, target=target)

    found = certify(mission, initial_guess.cold(mission), search)
    gain = next((gain for final, gain in made if final is found.final), NO_GAIN)
    return found, {name: getattr(gain, name) for name in TARGET}


def cheapest(mission: Mission, planned: Plan, target: float) -> Gain:
    """The cheapest gain on an open-loop plan's burns with the required probability of whole flights."""
    problem = mission.problem
    assert problem.feedback is not None
    burn, size = int(problem.feedback.burns[0]), problem.feedback.size
    iterate = initial_guess.from_burns(mission, planned.burns_m_s)
    lin = mission.dynamics.linearise(problem, replace(iterate, gains=np.zeros(size)))
    first, last = int(problem.burn_nodes[burn]), problem.n_nodes
    rows = rows_at(targeted(lin, int(mission.window_nodes[-1]))(0.5), target)
    found = dict[int, Gain]()

    def at(end: int) -> float:
        if end not in found and first < end < last:
            gain = scaled(targeted(lin, end), rows)
            found[end] = gain._replace(target_s=float(mission.times_s[end]))
        return found[end].cost if end in found else np.inf

    near = min(range(first + STRIDE, last, STRIDE), key=at)
    best = found[min(range(near - STRIDE + 1, near + STRIDE), key=at)]
    if best.lin is None:
        return best
    # The law is looked at where flights of the best one fail.
    end = int(np.searchsorted(mission.times_s, best.target_s))
    return scaled(targeted(lin, end), rows_at(best.lin, target))._replace(target_s=best.target_s)


def rows_at(lin: Linearisation, target: float) -> FlightRows:
    """The row of whole flights, its directions aimed at an iterate."""
    rows = FlightRows(lin.problem, target, LINES, FINE_WITH_GAINS)
    rows.aim(lin)
    return rows


def targeted(lin: Linearisation, end: int) -> Callable[[float], Linearisation]:
    """Linearisations with shares of the gain on the estimate that targets a node's position."""
    feedback, innovation = lin.problem.feedback, lin.spread.innovations[0]
    assert feedback is not None
    node, stm = int(lin.problem.burn_nodes[feedback.burns[0]]), lin.arcs.stm
    ahead = transition(stm, node, end)[:3]
    gain = -np.linalg.solve(ahead[:, 3:], ahead) @ transition(stm, int(feedback.cut_offs[0]), node)
    whole = (gain @ innovation.gain).ravel()
    return lambda share: replace(lin, iterate=replace(lin.iterate, gains=share * whole))


def scaled(at: Callable[[float], Linearisation], rows: FlightRows) -> Gain:
    """The least share with which whole flights have the probability that the row requires."""

    def surplus(share: float) -> float:
        return rows.at(at(share)).value - rows.required

    for low, high in pairwise(np.linspace(0.0, 1.0, 6).tolist()):
        if surplus(high) >= 0.0:
            share = brentq(surplus, low, high, xtol=1e-4) if surplus(low) < 0.0 else low
            lin = at(share)
            return Gain(lin.cost.value, share=share, lin=lin)
    return NO_GAIN


def limited(rows: Sequence[Record]) -> list[Case]:
    """Feedback with limits on the final dispersion, from that of the open-loop plans among rows."""
    return [
        Case(ENDING, one["asked"], {LIMIT: one["final_sigma_m"] / (LESS * more)})
        for one in rows
        if one["kind"] == OPEN and one["asked"] in TO_THE_END and "final_sigma_m" in one
        for more in FURTHER
    ]


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
        one = row(Case(kind, asked), found, FLIGHTS, process_time() - begin)
        rows.append({"scope": scope, "scale": scale} | one)
        if found.status is Status.CONVERGED:
            last = found
    return {"rows": rows}


def timed(case: tuple[str, float]) -> Record:
    """Size of the largest cone program of a plan, and the processor's seconds of a later plan.

    The plan is made cold, without certification, in turn with the default one, which is open loop
    with uniform risk. The fastest of each counts, but for the first one in the process.
    """
    risk, p = case
    exact = {"risk.allocation": "exact", "risk.scope": risk}
    own = measured() | {"risk.p_chance": p} | ({} if risk == "uniform" else exact)
    seconds = dict[str, list[float]](default=[], own=[])
    with noted() as programs:
        for _ in range(1 + TIMES):
            for name, changes in (("default", {}), ("own", own)):
                mission = Mission.from_scenario(load_scenario().replace(changes))
                programs.clear()
                begin = process_time()
                found = Planner(mission, p3_resolution=RESOLUTION).plan(initial_guess.cold(mission))
                seconds[name].append(process_time() - begin)
    largest = max((program.matrix for program in programs), key=lambda matrix: matrix.nnz)
    fastest = {name: min(each[1:]) for name, each in seconds.items()}
    return {
        "risk": risk,
        "asked": p,
        "status": found.status.value.name,
        "gains": len(found.final.result.lin.iterate.gains),
        "variables": largest.shape[1],
        "rows": largest.shape[0],
        "nonzeros": largest.nnz,
        "processor_s": fastest["own"],
        "times_default": fastest["own"] / fastest["default"],
    }


def beside(rows: Sequence[Record]) -> list[Record]:
    """Rows with their extra cost over feedback, and the open loop's final dispersion over theirs."""
    found = {(one["kind"], one["asked"]): one for one in rows}

    def figure(kind: str, p: float, name: str) -> float:
        return float(found.get((kind, p), {}).get(name, np.nan))

    return [
        one
        | {"more_m_s": cost - figure(AGAINST.get(one["kind"], CORRECTED), one["asked"], "dv99_m_s")}
        | {"open_over_own": figure(OPEN, one["asked"], "final_sigma_m") / one["final_sigma_m"]}
        if np.isfinite(cost := one.get("dv99_m_s", np.nan))
        else one
        for one in rows
    ]


def claims(
    rows: Sequence[Record], errors: Sequence[Record], programs: Sequence[Record] = ()
) -> list[Claim]:
    """The claims of the study; a claim with a missing figure does not hold."""
    made = list[Claim]()

    def claim(words: str, measured: float, limit: float, *, least: bool = False) -> None:
        holds = measured >= limit if least else measured <= limit
        threshold = f"at {'least' if least else 'most'} {limit:g}"
        made.append(Claim(words, threshold, f"{measured:.6g}", bool(holds)))

    for one in rows:
        kind, p = one["kind"], one["asked"]
        if kind == CORRECTED and p in AT_MOST_M_S:
            cost = one.get("dv99_m_s", np.nan)
            claim(f"99 % of the delta-v for {p:g}, m/s", cost, AT_MOST_M_S[p])
        if kind in AGAINST:
            more = one.get("more_m_s", np.nan)
            claim(f"{kind} for {p:g} costs more than feedback, m/s", more, 0.0, least=True)
        if kind == ENDING:
            wider = one.get("open_over_own", np.nan)
            claim(f"for {p:g} the open loop ends wider, times", wider, LESS, least=True)
    for scope, p in dict.fromkeys((one["scope"], one["asked"]) for one in errors):
        own = [one for one in errors if (one["scope"], one["asked"]) == (scope, p)]
        costs, at = [one.get("program_m_s", np.nan) for one in own], f"scope {scope}, {p:g}:"
        useless = abs(costs[1] / costs[0] - 1.0)
        claim(f"{at} a useless measurement changes the cost by, relative", useless, 1e-6)
        worse = max(after / before - 1.0 for before, after in pairwise(costs))
        claim(f"{at} a better one costs more by, relative", worse, 1e-4)
    for words, risks, limit in TIMES_AT_MOST:
        times = [one["times_default"] for one in programs if one["risk"] in risks]
        if times:
            claim(f"{words}: a plan takes longer than the default, times", max(times), limit)
    return made


def run(session: Session) -> Findings:
    """Plan and fly everything; limits at the end follow from open-loop plans."""
    store = session.store(flights=FLIGHTS)
    cases = [Case(kind, p) for kind in (OPEN, CORRECTED, LATE) for p in PROBABILITIES]
    cases += [Case(kind, p) for kind, p in TARGETING]
    rows = session.rows("plans", measure, cases, store)
    rows += session.rows("limits at the end", measure, limited(rows), store)
    chains = session.rows("errors", over_errors, [(*at, ERRORS) for at in ERRORS_AT], store)
    errors = [one for chain in chains for one in chain["rows"]]
    programs = session.rows("programs", timed, PROGRAMS, store)
    rows = beside(rows)
    tables = {"feedback": rows, "feedback_errors": errors, "feedback_programs": programs}
    return Findings(tables, claims(rows, errors, programs))


STUDY = Study(__doc__, run)
