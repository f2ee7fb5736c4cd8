"""Measure the probability and the delta-v of sites that only feedback makes feasible.

Kingfisher and Osprey are designed as packaged, measured without a lead to 10 m and 0.5 mm/s, and
certified at 0.90 of whole flights, into OUT/SITE; a design that `scp-recon design` left there
counts. The phases and times of that pass are kept, and the plan of the largest probability is found,
as by `--objective probability`. From there burns and gains are planned again for every navigation and
lead, in `ROUNDS` with directions where flights then fail. Independent flights judge the last plan, as
in certification, and other flights its delta-v. OUT/sites.csv has a row for each, OUT/passes.csv one
for each design. After Ctrl-C the study continues with the missing rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from experiments.harness import Findings, Record, Session, Study
from experiments.in_flight.feedback import row
from formulations.arrays import Array
from formulations.rows.exact_flight import FLIGHT as WHOLE
from scp_recon.api.options import PlanOptions
from scp_recon.api.plan_verbs import save
from scp_recon.api.planning import plan_mission
from scp_recon.api.verbs import design
from scp_recon.certification.flights import fly_plan, run_test
from scp_recon.certification.targets import MOST
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import flights_of_test
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.method import ALGORITHM, FORMULATION, SOLVER
from scp_recon.planning.missions import make_plan
from scp_recon.planning.plan import Provenance, Stage
from scp_recon.planning.planner import Planner
from scp_recon.planning.stages import Pipeline
from scp_recon.replanning.flown import FlownPlan
from scp_recon.results.solution import FILE_NAME
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.algorithms import ALGORITHMS
from scp_recon.scp.status import Status

SITES = ("kingfisher", "osprey")
NAVIGATION = ((10.0, 5e-4), (1.0, 5e-5), (50.0, 2e-3))
"""1 sigma of the measurement along each axis, m and m/s."""
LEADS_H = (0.0, 1.0, 4.0)
ASKED, BURNS_HOLD = 0.9, 0.99
"""Required of a design; and of each limit on a corrected burn, where the probability is raised."""
ROUNDS, ITERATIONS = 3, 12
"""Rounds of planning for more than any flights can certify, and the iterations of each."""
RADIUS = 0.02
"""Trust radius with which a round begins: what it starts from is near."""
FLIGHTS = 10_000


class Measured(NamedTuple):
    """A site, and the navigation before its burns."""

    site: str
    position_m: float
    velocity_m_s: float
    lead_h: float

    def changes(self, p: float = BURNS_HOLD) -> dict[str, Any]:
        """To the scenario."""
        return {
            "policy.kind": "feedback",
            "navigation.lead_s": 3600.0 * self.lead_h,
            "navigation.sigma_position_m": self.position_m,
            "navigation.sigma_velocity_m_s": self.velocity_m_s,
            "risk.p_chance": p,
        }


CASES = [Measured(site, *nav, lead) for lead in LEADS_H for nav in NAVIGATION for site in SITES]


def raised(out: Path, site: str) -> Record:
    """The plan of the largest probability of a site's pass: burns and gains, nondimensional."""
    begin, folder, case = process_time(), out / site, Measured(site, *NAVIGATION[0], 0.0)
    if not (folder / FILE_NAME).is_file():
        found = design(load_scenario(site).replace(case.changes(ASKED)))
        assert found.plan is not None, found.message
        save(found.plan, folder)
    known = FlownPlan.of(folder)
    mission, burns_m_s = known.mission, known.burns_m_s
    options = PlanOptions(objective="probability", certify=False)
    likeliest = plan_mission(mission, from_burns(mission, burns_m_s), options)
    end = likeliest.final.result.lin.iterate
    return {
        "site": site,
        "burns_s": "; ".join(f"{time:.0f}" for time in mission.scenario.burn_times_s),
        "total_dv_m_s": float(np.linalg.norm(burns_m_s, axis=1).sum()),
        "burns": end.burns.tolist(),
        "gains": end.gains.tolist(),
        "processor_s": process_time() - begin,
    }


def law_of(target: float, stage: Stage) -> float:
    """The probability of a whole flight by the law, of a stage that aimed at a target."""
    return float(ndtr(ndtri(target) + stage.margins[WHOLE].margin.min()))


def measure(out: Path, ends: Mapping[str, Record], case: Measured) -> Record:
    """A row of the most probable plan found for a pass, judged by flights."""
    begin, known, end = process_time(), FlownPlan.of(out / case.site), ends[case.site]
    mission = Mission.from_scenario(known.mission.scenario.replace(case.changes()))
    feedback = mission.problem.feedback
    assert feedback is not None
    burns_m_s = mission.units.speed_m_s * np.array(end["burns"])
    gains = last_gains(np.array(end["gains"]), len(feedback.burns))
    iterate = replace(from_burns(mission, burns_m_s), gains=gains)
    planner = Planner(mission, target=MOST)
    planner.algorithm = ALGORITHMS[ALGORITHM](max_iterations=ITERATIONS, initial_radius=RADIUS)
    pipeline, (*_, spec) = Pipeline(mission, planner), planner.exact_stages()

    def likelier() -> Stage:
        at = iterate
        for _ in range(ROUNDS):
            stage = pipeline.solve(spec, mission.dynamics.linearise(spec.rows.problem, at))
            at = stage.result.lin.iterate
        # That it keeps less than it was planned for is no fault of it.
        return replace(stage, result=replace(stage.result, status=Status.CONVERGED))

    provenance = Provenance(FORMULATION, ALGORITHM, SOLVER, "design")
    found = make_plan(mission, pipeline, likelier, provenance)
    margins = found.final.margins.items()
    least = min(float(one.margin.min()) for name, one in margins if name != WHOLE)
    law = law_of(MOST, found.final)
    judged, _ = run_test(
        replace(found, target=law), partial(fly_plan, None), flights_of_test(law), 1, 1
    )
    assert judged.certificate is not None
    low, high = judged.certificate.low, judged.certificate.high
    return {
        **row(case.site, low, judged, FLIGHTS, process_time() - begin),
        **case._asdict(),
        "law": law,
        "certified_high": high,
        "corrected": len(feedback.burns),
        "least_margin": least,
    }


def last_gains(gains: Array, left: int) -> Array:
    """Gains of the last corrected burns, without gains on knowledge before the first of them."""
    parts, first = list[Array](), 0
    while first < len(gains):
        last = first + 18 * (len(parts) + 1)
        parts.append(gains[first:last].reshape(3, -1))
        first = last
    gone = len(parts) - left
    return np.concatenate([one[:, 6 * gone :].ravel() for one in parts[gone:]])


def run(session: Session) -> Findings:
    """Design both passes, and plan them again for everything that may be known in flight."""
    store = session.store()
    passes = session.rows("passes", partial(raised, session.out), SITES, store)
    ends = {one["site"]: one for one in passes}
    rows = session.rows("navigation", partial(measure, session.out, ends), CASES, store)
    rows.sort(key=lambda one: (one["site"], one["position_m"], one["lead_h"]))
    short = [{name: one[name] for name in one if name not in ("burns", "gains")} for one in passes]
    return Findings({"sites": rows, "passes": short})


STUDY = Study(__doc__, run, version=2)
