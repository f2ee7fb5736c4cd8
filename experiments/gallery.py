"""Design, certify and fly a pass over each packaged body.

Each pass is flown 10,000 times, in the body's homogeneous ellipsoid where the plan has less. OUT/BODY
has the plan and its flights, OUT/gallery.csv a row for each: delta-v, what certification and flights
find, the window, and the mean's least distance from a companion, at nodes. After Ctrl-C the study
continues with the missing rows.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from time import process_time

import numpy as np

from experiments.harness import Record, Session, Study, Tables
from scp_recon.api.plan_verbs import fly, save
from scp_recon.api.verbs import design
from scp_recon.mission.scene import TruthModel
from scp_recon.scenario.load import load_scenario

BODIES: dict[str, TruthModel] = {
    "ryugu": "polyhedron",
    "itokawa": "polyhedron",
    "didymos": "planner",
    "apophis": "planner",
}
"""Scenarios, and the gravity that is flown."""
FLIGHTS = 10_000


def measure(out: Path, name: str) -> Record:
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


def run(session: Session) -> Tables:
    """Measure every body."""
    rows = session.rows("passes", partial(measure, session.out), BODIES)
    return {"gallery": rows}


STUDY = Study(__doc__, run)
