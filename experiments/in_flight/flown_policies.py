"""Fly plans by three policies with the spacecraft: as planned, corrected by gains, and planned again.

OUT/flown_policies.csv has a row for each plan and policy, flown_policies_flights.csv one for each
flight. Flights that were flown before are kept.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.interpolate import CubicHermiteSpline

from experiments.harness import Findings, Session, Study, option
from experiments.harness import Record as Row
from experiments.in_flight.feedback import LEAD_S, measured
from experiments.spacecraft.flown_plan import SEEDS, row
from scp_recon.api.options import PlanOptions
from scp_recon.api.plan_verbs import simulate
from scp_recon.api.planning import plan_mission
from scp_recon.api.verbs import design, plan
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.monte_carlo.observation_time import ALL, joint_margins, time_held
from scp_recon.monte_carlo.sampling import PolicyKind
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.plan import Plan
from scp_recon.results.read import read_solution
from scp_recon.results.solution import FILE_NAME, Solution, make_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.simulation.record import Record, inputs_digest
from scp_recon.simulation.vehicle import load_vehicle
from scp_recon.verification.causes import shortfalls

PLANS: Mapping[str, tuple[str, dict[str, Any], tuple[PolicyKind, ...]]] = {
    "default": ("recon_b", measured(lead_s=LEAD_S) | {"policy.kind": "open"}, ("open", "replan")),
    "default, with gains": ("recon_b", measured(lead_s=LEAD_S), ("feedback",)),
    "kingfisher, designed": ("kingfisher", measured() | {"risk.p_chance": 0.9}, ()),
    "kingfisher": ("kingfisher", measured(lead_s=LEAD_S), ("open", "feedback", "replan")),
}
"""Base, changes and policies of each plan that is flown by policies."""
FLOWN = ("whole", "window_s", "observed_s", "commanded_m_s", "terminal_miss_m")
"""Columns that a flight lacks which could not be flown."""
SUBJECTS = ("default", "kingfisher")
"""How the names of plans begin that are flown together."""


def plan_of(out: Path, name: str) -> Solution:
    """The plan of a name, kept in a folder of that name.

    A pass is designed with measurements at the burns, and planned again for a lead in which the
    spacecraft can turn.

    Raises:
        InputError: if there is none.
    """
    folder = out / name
    if (folder / FILE_NAME).is_file():
        return read_solution(folder)
    base, changes, flown = PLANS[name]
    scenario = load_scenario(base).replace(changes)
    if scenario.boundary.home is None:
        found: Plan | None = plan(scenario)
    elif not flown:
        found = design(scenario).plan
    else:
        pass_ = plan_of(out, f"{name}, designed")
        mission = Mission.from_scenario(pass_.scenario.replace(changes))
        start, options = from_burns(mission, pass_.burns_m_s), PlanOptions(certify=False, starts=1)
        found = plan_mission(mission, start, options)
    if found is None:
        raise InputError("plan", name, "must be found")
    solution = make_solution(found)
    folder.mkdir(parents=True, exist_ok=True)
    solution.write(folder)
    return solution


def fly_policy(plans: Mapping[str, Solution], case: tuple[str, PolicyKind, int]) -> Row:
    """Simulate a flight of a plan by a policy: a row."""
    name, policy, seed = case
    solution, begun = plans[name], {"plan": name, "policy": policy, "seed": seed}
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
    """A row for each plan and policy."""
    found = []
    table = pd.DataFrame(rows, columns=[*dict.fromkeys((*chain(*rows), *FLOWN))])
    for (name, policy), own in table.groupby(["plan", "policy"], sort=False):
        whole = int(own.whole.eq(True).sum())
        share = proportion(whole, len(own))
        found.append(
            {
                "plan": name,
                "policy": policy,
                "flights": len(own),
                "whole": whole,
                "whole_low": share.low,
                "whole_high": share.high,
                "window_s": own.window_s.max(),
                "observed_mean_s": own.observed_s.mean(),
                "observed_least_s": own.observed_s.min(),
                "commanded_mean_m_s": own.commanded_m_s.mean(),
                "commanded_most_m_s": own.commanded_m_s.max(),
                "miss_m": np.sqrt((own.terminal_miss_m.astype(float) ** 2).mean()),
                "as_required": int(own.shortfalls.eq("").sum()),
            }
        )
    return found


def run(session: Session) -> Findings:
    """Fly each plan by its policies, once for each seed; seed by seed."""
    names = [name for name in PLANS if name.startswith(session.options.subject)]
    plans = {name: plan_of(session.out, name) for name in names}
    digests = [inputs_digest(one, load_vehicle()) for one in plans.values()]
    store = session.store("flown_policies.jsonl", inputs=digests)
    cases = [
        (name, policy, seed) for seed in range(SEEDS) for name in names for policy in PLANS[name][2]
    ]
    rows = session.rows("flights", partial(fly_policy, plans), cases, store)
    return Findings({"flown_policies": by_policy(rows), "flown_policies_flights": rows})


SUBJECT = option(
    "subject", choices=SUBJECTS, metavar="SUBJECT", help=f"one of {', '.join(SUBJECTS)}"
)
STUDY = Study(__doc__, run, [SUBJECT])
