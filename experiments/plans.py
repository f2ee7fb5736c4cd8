"""Studies of single plans and passes that pages quote, and of passes over other bodies."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from experiments.harness import (
    Record,
    Session,
    Study,
    Tables,
    flight_figures,
    fly_plan,
    plan_figures,
    run_python,
)
from scp_recon.api.plan_verbs import fly, save
from scp_recon.api.verbs import design, plan
from scp_recon.mission.scene import TruthModel
from scp_recon.planning.plan import Plan
from scp_recon.results.solution import make_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status
from scp_recon.verification.reintegration import FIGURES, verify

FLIGHTS, SEED = 10_000, 20
TANGENT = {"polytopes.ball": "tangent", "polytopes.cone": 12}
EXACT = {"risk.allocation": "exact"}
FLIGHT = EXACT | {"risk.scope": "flight"}
PLAIN = {"risk.sampling": "plain"}

POSITION_M, VELOCITY_M_S = 10.0, 5e-4
"""1 sigma of the measurement along each axis."""


def measured(scale: float = 1.0, lead_s: float = 0.0) -> dict[str, Any]:
    """Changes to the scenario: feedback, by a measurement of so many times the usual error."""
    return {
        "policy.kind": "feedback",
        "navigation.lead_s": lead_s,
        "navigation.sigma_position_m": scale * POSITION_M,
        "navigation.sigma_velocity_m_s": scale * VELOCITY_M_S,
    }


PLANS: Mapping[str, dict[str, Any]] = {
    "default": {},
    **{f"certified {p:g}": FLIGHT | {"risk.p_chance": p} for p in (0.9, 0.95, 0.99)},
    "earlier burn": FLIGHT
    | {"risk.p_chance": 0.9, "burns.times_s": [0.0, 7000.0, 25000.0, 34842.0]},
    **{f"plain {p:g}": FLIGHT | PLAIN | {"risk.p_chance": p} for p in (0.9, 0.99)},
}
"""Changes to the scenario."""

ITERATION = re.compile(r"\d* ?P[23]\S* +\d")
PRINTED = {
    "solve": "scp_recon.solve --init cold",
    "starts": "scp_recon.solve --starts 8 --seed 0 --workers 2 -v",
    "replan": "scp_recon replan {solve} --at 17000 "
    "--state -126.629 442.342 -596.582 0.0062679 0.0763651 0.0599579",
    "infeasible": "scp_recon.solve --set risk.p_chance=0.98",
    "certified": "scp_recon.solve --set risk.allocation=exact --set risk.scope=flight "
    "--set risk.p_chance=0.9",
}
"""Commands after `python -m`; in braces the folder of an earlier one."""
ENDS = {status.value.exit_code for status in (Status.CONVERGED, Status.INFEASIBLE)}

HOME = {
    "boundary.home.radius_m": 1000.0,
    "boundary.home.normal": [1.0, 0.0, 0.0],
    "boundary.home.sense": "left_handed",
}
SIXTY = {"observation.emission_max_deg": 60.0}
DESIGNS: Mapping[str, tuple[str, dict[str, Any]]] = {
    "tangent": ("recon_b", HOME | TANGENT),
    "tangent, smaller initial errors": (
        "recon_b",
        HOME
        | TANGENT
        | {
            "uncertainty.initial_sigma_position_m": [10.0] * 3,
            "uncertainty.initial_sigma_velocity_m_s": [5e-4] * 3,
            "uncertainty.initial_frame": "j2000",
        },
    ),
    **{
        f"whole flights {p:g}": ("recon_b", HOME | FLIGHT | {"risk.p_chance": p})
        for p in (0.7, 0.9, 0.99)
    },
    **{name: (name, {}) for name in ("nightingale", "sandpiper", "kingfisher", "osprey")},
    **{f"{name}, 60 deg": (name, SIXTY) for name in ("kingfisher", "osprey")},
    **{
        f"{name}, feedback": (name, measured() | {"risk.p_chance": 0.9})
        for name in ("kingfisher", "osprey")
    },
}
"""Base and changes of a pass."""


def measure(name: str) -> Record:
    """Plan a case: a row."""
    begin = process_time()
    found = plan(load_scenario().replace(PLANS[name]))
    return {"plan": name} | record(found, process_time() - begin)


def measure_design(name: str) -> Record:
    """Design a pass: a row."""
    base, changes = DESIGNS[name]
    begin = process_time()
    found = design(load_scenario(base).replace(changes))
    seconds = process_time() - begin
    if found.plan is None:
        failed = {"status": "none found", "message": found.message, "processor_s": seconds}
        return {"design": name} | failed
    departure, arrival = (np.rad2deg(found.best.at.phases) % 360.0).tolist()
    times = np.array(found.plan.mission.scenario.burn_times_s)
    return {
        "design": name,
        **record(found.plan, seconds),
        "departure_deg": departure,
        "arrival_deg": arrival,
        "burns_s": "; ".join(f"{time:.0f}" for time in times - times[0]),
    }


def record(found: Plan, processor_s: float) -> Record:
    """A row of a plan: its figures, and the results of verification, flights and certification."""
    solution, looked = make_solution(found), found.certificate
    row = plan_figures(found) | {"processor_s": processor_s, "violation_m": solution.violation.max}
    if found.status is not Status.CONVERGED:
        return row
    checked = verify(found.mission, solution)
    row |= {"verified": checked.ok, **{name: getattr(checked, name) for name in FIGURES}}
    row |= flight_figures(fly_plan(found, FLIGHTS, SEED))
    if looked is not None:
        row |= {
            "drawn": sum(looked.strata.drawn) if looked.strata else looked.samples,
            "flown": looked.samples,
            "certified_low": looked.low,
            "certified_high": looked.high,
        }
    return row


def printed(out: Path, name: str) -> Record:
    """Run a command as a program: its times, and what it prints, a line each, its folder as "runs"."""
    command = PRINTED[name].format(**{other: out / other for other in PRINTED})
    words = ["-m", *shlex.split(command), "--out", str(out / name)]
    seconds, said = run_python(words, ENDS)
    return {"command": name, **seconds, "lines": said.replace(str(out), "runs").splitlines()}


def plans(session: Session) -> Tables:
    """Measure the plans and passes that the pages quote, one by one.

    Each case is the default scenario with some changes, planned from a cold start, verified and
    flown 10,000 times; with `--designs` a pass from a home orbit, designed and planned.
    OUT/plans.csv or designs.csv has a row for each case: status, cost, probability by flights,
    processor time. Commands whose output a page shows are run as programs as well. After Ctrl-C the
    study continues with the missing rows.
    """
    if session.options.designs:
        return {"designs": session.rows("designs", measure_design, DESIGNS)}
    rows = session.rows("plans", measure, PLANS)
    said = session.rows("commands", partial(printed, session.out), PRINTED)
    lines = [
        {"command": row["command"], "line": line}
        for row in said
        for line in row.pop("lines")
        if line.strip() and not ITERATION.match(line)
    ]
    return {"plans": rows, "commands": said, "printed": lines}


DESIGNED = {"action": "store_true", "help": "passes from a home orbit instead"}


# --- passes over other bodies ---------------------------------------------------------------------

BODIES: dict[str, TruthModel] = {
    "ryugu": "polyhedron",
    "itokawa": "polyhedron",
    "didymos": "planner",
    "apophis": "planner",
}
"""Scenarios, and the gravity that is flown."""


def measure_pass(out: Path, name: str) -> Record:
    """Design, certify and fly a pass: a row."""
    begin = process_time()
    plan = design(load_scenario(name)).plan
    assert plan is not None
    assert plan.certificate is not None
    save(plan, out / name)
    flown = fly(plan, FLIGHTS, truth=BODIES[name])
    flown.write(out / name)
    mission, mean = plan.mission, plan.final.result.lin.iterate.mean
    first, last = mission.schedule.window_s
    companion, nearest = mission.scene.companion, np.nan
    if companion is not None:
        off = mission.units.length_m * mean[:, :3] - companion.position(mission.times_s)
        nearest = float(np.linalg.norm(off, axis=1).min())
    return {
        "body": name.title(),
        "gravity": flown.planned_gravity,
        "total_dv_m_s": plan.total_dv_m_s,
        "certified_low": plan.certificate.low,
        "flown": flown.whole_flight.value,
        "flown_low": flown.whole_flight.low,
        "flown_high": flown.whole_flight.high,
        "window_s": last - first,
        "companion_m": nearest,
        "processor_s": process_time() - begin,
    }


def gallery(session: Session) -> Tables:
    """Design, certify and fly a pass over each packaged body.

    Each pass is flown 10,000 times, in the body's homogeneous ellipsoid where the plan has less.
    OUT/BODY has the plan and its flights, OUT/gallery.csv a row for each: delta-v, what
    certification and flights find, the window, and the mean's least distance from a companion, at
    nodes. After Ctrl-C the study continues with the missing rows.
    """
    rows = session.rows("passes", partial(measure_pass, session.out), BODIES)
    return {"gallery": rows}


STUDIES = {
    "plans": Study(plans.__doc__, plans, {"--designs": DESIGNED}),
    "gallery": Study(gallery.__doc__, gallery),
}
