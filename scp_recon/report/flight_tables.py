"""Tables of what was flown of a plan: many flights, and the spacecraft's simulation."""

from __future__ import annotations

import numpy as np

from scp_recon.report.content.subject import Subject
from scp_recon.report.table import Row, Table, cell, table


def flights_table(subject: Subject) -> Table:
    """How long flights observe, where they were flown."""
    found = subject.summary
    rows: list[Row] = []
    for name, held in found.held_s.items() if found else ():
        figures = (held.mean, held.worst_1_sigma, held.worst_2_sigma, held.throughout)
        rows.append(
            [name, *(cell(f.value, ".4f" if f is held.throughout else ".1f") for f in figures)]
        )
    note = "" if found is None else (
        f"{found.samples} flights, seed {found.seed}, truth: {found.truth}, {found.errors} errors, "
        "as in montecarlo.json."
    )  # fmt: skip
    heading = ("constraint", "mean (s)", "worst 1 sigma (s)", "worst 2 sigma (s)", "throughout (1)")
    return table("flights", "Observation times", heading, rows, note)


def simulation_tables(subject: Subject) -> list[Table]:
    """Of the spacecraft's simulation, where there is one."""
    if subject.record is None:
        return []
    s = subject.record.summary
    burns: list[Row] = []
    for number, burn in enumerate(s.burns, start=1):
        sizes = [float(np.linalg.norm(dv)) for dv in (burn.planned_m_s, burn.executed_m_s)]
        angles = (burn.pointing_deg, burn.executed_pointing_deg)
        shown = [*(cell(x, ".6f") for x in sizes), *(cell(a, ".3f") for a in angles)]
        burns.append([str(number), cell(burn.t_s, ".0f"), *shown])
    miss = s.terminal_miss
    figures: list[Row] = [
        ["least state of charge", cell(100.0 * s.least_charge, ".1f"), "%"],
        ["floor of it", cell(100.0 * s.floor_charge, ".1f"), "%"],
        ["camera off the site, 99.7 %", cell(s.window_pointing_deg.site.q997, ".3f"), "deg"],
        ["final position off the mean", cell(miss.position_m, ".1f"), "m"],
        ["final velocity off the mean", cell(miss.velocity_m_s, ".4f"), "m/s"],
        [
            "largest distance in the planned spread",
            cell(s.largest_sigma_distance, ".2f"),
            "sigma",
        ],
        ["momentum dumps", s.dumps, ""],
    ]
    heading = (
        "burn",
        "at (s)",
        "planned (m/s)",
        "executed (m/s)",
        "off at start (deg)",
        "off (deg)",
    )
    vehicle = f"{s.vehicle}, seed {s.seed}"
    return [
        table("simulated_burns", f"Burns in the simulation ({vehicle})", heading, burns),
        table("simulated", f"In the simulation ({vehicle})", ("figure", "value", "unit"), figures),
    ]
