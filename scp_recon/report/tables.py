"""The report's tables: what the solution file says, with its numbers to the last digit in the cells."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scp_recon.mission.constraints import limits_in_words
from scp_recon.physics.time_scales import instant, shown_utc
from scp_recon.report.content.budget import SHARE, Budget
from scp_recon.report.content.subject import Subject
from scp_recon.report.flight_tables import flights_table, simulation_tables
from scp_recon.report.table import Cell, Row, Table, cell, table
from scp_recon.solution.comparison import compare, shown
from scp_recon.verification.reintegration import FIGURES, limits_of


def tables_of(subject: Subject, budget: Budget) -> list[Table]:
    """All tables of a plan that have anything in them."""
    found = [
        _burns(subject),
        _budget(budget),
        _probabilities(subject),
        _constraints(subject),
        _mean_margins(subject),
        _reintegration(subject),
        _stages(subject),
        _iterations(subject),
        flights_table(subject),
        *simulation_tables(subject),
    ]
    return [each for each in found if each.rows]


def _burns(subject: Subject) -> Table:
    solution = subject.solution
    start = solution.scenario.epoch.tdb
    rows: list[Row] = []
    for number, burn in enumerate(solution.burns, start=1 + solution.scenario.burns_flown):
        components = [cell(component, "+.6f") for component in burn.dv_m_s]
        size = float(np.linalg.norm(burn.dv_m_s))
        when = shown_utc(instant(start, burn.t_s))
        rows.append([str(number), burn.t_s, when, *components, cell(size, ".6f")])
    total: Row = ["total", "", "", "", "", "", cell(solution.total_dv_m_s, ".6f")]
    heading = ("burn", "time (s)", "UTC", "x (m/s)", "y (m/s)", "z (m/s)", "size (m/s)")
    return table("burns", "Burns, J2000", heading, [*rows, total])


def _budget(budget: Budget) -> Table:
    each = zip(budget.planned_m_s, budget.mean_m_s, budget.high_m_s, strict=True)
    rows: list[Row] = [
        [str(number), *(cell(float(figure), ".6f") for figure in figures)]
        for number, figures in enumerate(each, start=budget.first)
    ]
    total = (float(budget.planned_m_s.sum()), budget.total_mean_m_s, budget.total_high_m_s)
    rows.append(["whole flight", *(cell(figure, ".6f") for figure in total)])
    low, high = budget.interval_m_s
    percent = f"{100.0 * SHARE:g} %"
    return table(
        "budget",
        "Delta-v budget",
        ("burn", "planned (m/s)", "executed, mean (m/s)", f"executed, {percent} stay below (m/s)"),
        rows,
        f"95 % interval of the flights' {percent}: {low:.6f} to {high:.6f} m/s. Of the planned burns "
        "with their execution errors; no burns to correct them.",
    )


def _probabilities(subject: Subject) -> Table:
    found = subject.solution.verification
    asked = subject.solution.scenario.risk.p_chance
    return table(
        "probabilities",
        "Lowest probabilities, by the verification's flights",
        ("joint constraint", "achieved", "low", "high", "at (s)", "asked"),
        [
            [
                p.name,
                cell(p.estimate, ".4f"),
                cell(p.low, ".4f"),
                cell(p.high, ".4f"),
                cell(p.worst_t_s, ".0f"),
                cell(asked, "g"),
            ]
            for p in (found.probabilities if found else ())
        ],
        f"{found.samples} flights, {100 * found.confidence:.0f} % intervals." if found else "",
    )


def _constraints(subject: Subject) -> Table:
    solution = subject.solution
    violated = solution.violation.by_constraint
    listed = {c.name for c in solution.constraints}
    rows: list[Row] = [
        [
            c.name,
            c.kind.replace("_", " "),
            cell(c.worst_margin, "+.4f"),
            c.unit,
            cell(c.worst_t_s, ".0f"),
            c.facets or None,
            violated[c.name].max if c.name in violated else None,
        ]
        for c in solution.constraints
    ]
    rows += [
        [name, "", None, amount.unit, None, None, amount.max]
        for name, amount in violated.items()
        if name not in listed
    ]
    words = "chance margin" if solution.problem == "P2" else "margin"
    return table(
        "constraints",
        "Margins at the nodes",
        ("constraint", "kind", f"worst {words}", "unit", "at (s)", "facets", "violated by"),
        rows,
        "A margin of 0 or more is satisfied.",
    )


def _mean_margins(subject: Subject) -> Table:
    found, asked = subject.solution.verification, limits_in_words(subject.mission.scenario)
    rows: list[Row] = []
    for margin in found.mean_margins if found else ():
        scale, unit = (np.rad2deg(1.0), "deg") if margin.unit == "rad" else (1.0, margin.unit)
        shown = Cell(f"{scale * margin.worst_margin:+.4f}", margin.worst_margin)
        limit = asked.get(margin.name, "")
        rows.append([margin.name, limit, shown, unit, cell(margin.worst_t_s, ".0f")])
    return table(
        "mean_margins",
        "Margins of the mean, between the nodes too",
        ("original constraint", "asked", "worst margin", "unit", "at (s)"),
        rows,
    )


def _reintegration(subject: Subject) -> Table:
    """Figures beside what is allowed; no limit where one is not judged."""
    v, limits = subject.solution.verification, limits_of(subject.mission)
    rows: list[Row] = [
        [
            name,
            cell(getattr(v, figure), ".1e"),
            cell(limits[figure], ".1e") if np.isfinite(limits[figure]) else "",
            unit or "1",
        ]
        for figure, (name, unit) in (FIGURES.items() if v else ())
    ]
    return table(
        "reintegration",
        "Integrated again without the solver",
        ("what", "off by", "allowed", "unit"),
        rows,
    )


def _stages(subject: Subject) -> Table:
    return table(
        "stages",
        "Stages",
        ("stage", "status", "iterations", "total delta-v (m/s)"),
        [
            [s.name, s.status, s.iterations, cell(s.total_dv_m_s, ".6f")]
            for s in subject.solution.stages
        ],
    )


def _iterations(subject: Subject) -> Table:
    heading = (
        *("stage", "k", "merit (m/s)", "predicted (m/s)", "actual (m/s)", "step"),
        *("radius (m/s)", "violation (m)", "defect (m)", "solver (s)"),
    )
    return table(
        "iterations",
        "Iterations",
        heading,
        [
            [
                r.stage,
                r.k,
                cell(r.merit, ".6f"),
                cell(r.predicted, ".2e"),
                cell(r.actual, ".2e"),
                "accepted" if r.accepted else "rejected",
                cell(r.trust_radius, ".1e"),
                cell(r.max_violation, ".1e"),
                cell(r.max_defect, ".1e"),
                cell(r.solver_s, ".3f"),
            ]
            for r in subject.solution.iterations
        ],
        "Merit: total delta-v plus penalties. Violation and defect: velocities count as metres per "
        "unit of time.",
    )


def _compared(figure: float | str | None) -> Cell:
    """As the terminal shows it, rounding as zero."""
    return Cell(shown(figure), figure) if isinstance(figure, float) else cell(figure)


def comparison_table(subjects: Sequence[Subject]) -> Table:
    """Plans side by side."""
    found = compare([s.name for s in subjects], [s.solution for s in subjects])
    rows: list[Row] = [
        [f"{name} ({unit})" if unit else name, *map(_compared, figures)]
        for name, unit, figures in found.rows
    ]
    return table("comparison", "Plans side by side", ("", *found.names), rows)
