"""Fly a pass of Kingfisher with the spacecraft: as planned, corrected by gains, and planned again.

OUT/flown_policies.csv has a row for each policy, flown_policies_flights.csv one for each flight.
A run that was stopped continues with the missing flights; the plan in OUT/kingfisher is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import chain, product
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.interpolate import CubicHermiteSpline

from experiments.harness import Record as Row
from experiments.harness import Session, Study, Tables
from experiments.in_flight.feedback import LEAD_S
from experiments.plans import measured
from experiments.spacecraft.flown_plan import SEEDS, row
from scp_recon.api.options import PlanOptions
from scp_recon.api.plan_verbs import simulate
from scp_recon.api.planning import plan_mission
from scp_recon.api.verbs import design
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.monte_carlo.limits import ALL, joint_margins, time_held
from scp_recon.monte_carlo.sampling import PolicyKind
from scp_recon.planning.initial_guess import from_burns
from scp_recon.results.read import read_solution
from scp_recon.results.solution import FILE_NAME, Solution, make_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.simulation.record import Record
from scp_recon.verification.causes import shortfalls

SITE = "kingfisher"
POLICIES: tuple[PolicyKind, ...] = ("open", "feedback", "replan")
FLOWN = ("whole", "window_s", "observed_s", "commanded_m_s", "terminal_miss_m")
"""Columns that a flight lacks which could not be flown."""


def planned(out: Path) -> Solution:
    """The plan of the pass, kept in a folder.

    The pass is designed with measurements at the burns, and planned again for a lead in which the
    spacecraft can turn.

    Raises:
        InputError: if no pass is found.
    """
    if (out / FILE_NAME).is_file():
        return read_solution(out)
    found = design(load_scenario(SITE).replace(measured() | {"risk.p_chance": 0.9})).plan
    if found is None:
        raise InputError("design", SITE, "must be found")
    mission = Mission.from_scenario(found.mission.scenario.replace(measured(lead_s=LEAD_S)))
    start, options = from_burns(mission, found.burns_m_s), PlanOptions(certify=False, starts=1)
    solution = make_solution(plan_mission(mission, start, options))
    out.mkdir(parents=True, exist_ok=True)
    solution.write(out)
    return solution


def fly_policy(solution: Solution, case: tuple[PolicyKind, int]) -> Row:
    """Simulate a flight of a plan by a policy: a row."""
    policy, seed = case
    begun = {"policy": policy, "seed": seed}
    try:
        record = simulate(solution, seed=seed, policy=policy)
    except InputError as error:  # as of a burn that the thruster cannot give in its time
        return begun | {"shortfalls": str(error)}
    commanded = [np.linalg.norm(burn.planned_m_s) for burn in record.summary.burns]
    more: Row = {
        "commanded_m_s": float(sum(commanded)),
        "shortfalls": "; ".join(shortfalls(record.summary, solution)),
    }
    return begun | row(record) | observed(record, solution.mission) | more


def observed(record: Record, mission: Mission) -> Row:
    """Time for which a flight observes, and whether it keeps every limit on its path."""
    times, states = record.arrays["t_s"], record.arrays["state"]
    first, last = mission.schedule.window_s
    samples_s = np.unique([first, last, *times[(times > first) & (times < last)]])
    path = CubicHermiteSpline(times, states[:, :3], states[:, 3:])
    seen = np.hstack([path(samples_s), path(samples_s, 1)])[:, None]
    margins = joint_margins(mission, samples_s, seen[..., :3]).values()
    radius = np.linalg.norm(states[:, :3], axis=1).min() - mission.scenario.safety.radius_min_m
    return {
        "observed_s": float(time_held(mission, samples_s, seen)[ALL].duration[0]),
        "window_s": last - first,
        "whole": bool(min(radius, *(float(margin.min()) for margin in margins)) >= 0.0),
    }


def by_policy(rows: Sequence[Row]) -> list[Row]:
    """A row for each policy."""
    found = []
    table = pd.DataFrame(rows, columns=[*dict.fromkeys((*chain(*rows), *FLOWN))])
    for policy, own in table.groupby("policy", sort=False):
        whole = int(own.whole.eq(True).sum())
        share = proportion(whole, len(own))
        found.append(
            {
                "policy": policy,
                "flights": len(own),
                "whole": whole,
                "whole_low": share.low,
                "whole_high": share.high,
                "window_s": own.window_s.max(),
                "observed_mean_s": own.observed_s.mean(),
                "commanded_mean_m_s": own.commanded_m_s.mean(),
                "miss_m": np.sqrt((own.terminal_miss_m.astype(float) ** 2).mean()),
                "as_required": int(own.shortfalls.eq("").sum()),
            }
        )
    return found


def run(session: Session) -> Tables:
    """Fly the plan by each policy, once for each seed."""
    solution = planned(session.out / SITE)
    cases = product(POLICIES, range(SEEDS))
    rows = session.rows("flights", partial(fly_policy, solution), cases)
    return {"flown_policies": by_policy(rows), "flown_policies_flights": rows}


STUDY = Study(__doc__, run)
