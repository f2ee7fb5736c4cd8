"""Build the tables of a plan: burns, margins, verification, iterations.

Each table is built here once, for the terminal and for the report. Its values are those of the
files to the last digit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from scp_recon.display import digits
from scp_recon.mission.constraints import required_of_mean
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.limits import ALL
from scp_recon.physics.geometry import track
from scp_recon.planning.records import Starts
from scp_recon.results.comparison import BINDING
from scp_recon.results.facts import IterationRecord
from scp_recon.results.policy import sigmas
from scp_recon.results.solution import Solution
from scp_recon.results.table import Cell, Column, Table, columns
from scp_recon.results.verification import DriftSafety, MeanMargin, Verification
from scp_recon.scenario.time_scales import instant, shown_utc
from scp_recon.verification.reintegration import FIGURES, limits_of

ITERATION_COLUMNS = columns(
    "stage", "k", "merit (mm/s) .3f", "predicted (mm/s) .2e", "actual (mm/s) .2e", "step",
    "radius (mm/s) .3g", "violation (m) .1e", "defect (m) .1e", "solver (s) .3f",
)  # fmt: skip
NO_BURN = Cell("0", 0.0)
"""In place of each component of a burn that is not executed."""
STARTS_NAMED = 6
"""Starts of a local optimum that are listed by number."""


def burns_table(solution: Solution, legal_s: Sequence[tuple[float, float]] = ()) -> Table:
    """Times, components along J2000 and sizes of the burns, and their legal times where given."""
    scenario = solution.scenario
    axes = (f"{axis} (mm/s) +z.3f" for axis in "xyz")
    heads = columns("burn", "time (s)", "UTC", *axes, "size (mm/s) .3f")
    rows: list[list[object]] = [
        [
            str(number),
            burn.t_s,
            shown_utc(instant(scenario.epoch.tdb, burn.t_s)),
            *or_none(any(burn.dv_m_s), *burn.dv_m_s, float(np.linalg.norm(burn.dv_m_s))),
        ]
        for number, burn in enumerate(solution.burns, start=1 + scenario.burns_flown)
    ]
    for row, (early, late) in zip(rows, legal_s, strict=False):
        until = "" if early == late else f" to {late:.0f}"
        row.append(f"{early:.0f}{until}" if np.isfinite(late) else f"from {early:.0f}")
    return Table.of("Burns, J2000", heads + columns("legal (s)") * bool(legal_s), rows, key="burns")


def corrections_table(solution: Solution) -> Table:
    """Corrected burns and knowledge at their cut-offs; no rows if burns are fixed."""
    corrections = solution.policy.corrections if solution.policy is not None else []
    flown = solution.scenario.burns_flown
    fixed = {*range(flown + 1, flown + 1 + len(solution.burns))} - {c.burn for c in corrections}
    nominal = [solution.burns_m_s[one.burn] for one in solution.corrections]
    known = (
        f"{what} known {when} ({unit}) {form}"
        for when in ("before", "after")
        for what, unit, form in (("position", "m", ".2f"), ("velocity", "m/s", ".2e"))
    )
    heads = "burn", "cut-off (s)", "nominal (mm/s) .3f", "correction, 1 sigma (mm/s) .3f"
    return Table.of(
        "Corrected burns",
        columns(*heads, *known),
        (
            [
                str(c.burn),
                c.cut_off_s,
                float(np.linalg.norm(burn)),
                c.sigma_m_s,
                *sigmas(np.array(c.predicted_covariance)),
                *sigmas(np.array(c.estimate_covariance)),
            ]
            for c, burn in zip(corrections, nominal, strict=True)
        ),
        key="corrections",
        note="The cut-off is the time of the last data that a burn uses. Known before and after the "
        "measurement there: roots of the summed variances of the estimate's errors."
        + (f" Not corrected: burns {', '.join(map(str, sorted(fixed)))}." if fixed else ""),
    )


def burn_limits_table(v: Verification, required: float) -> Table:
    """Probabilities that corrected burns keep their limits, each for itself."""
    return Table.of(
        "Limits on corrected burns",
        columns("burn", "limit", "probability .4f", "at (s) .0f", "required g"),
        ([str(b.burn), b.name, b.probability, b.t_s, required] for b in v.burn_limits),
        key="burn_limits",
        note="As they are commanded, by the normal law of the corrections.",
    )


def or_none(fired: object, *figures: float) -> Sequence[object]:
    """Cells of a burn; dashes for a burn that is not executed."""
    return figures if fired else len(figures) * [NO_BURN]


def constraints_table(solution: Solution) -> Table:
    """Worst margins at the nodes, and violations without a margin, such as that of the final state."""
    by, violated = Column("violated by"), solution.violation.by_constraint
    amounts = {name: by.cell(amount.max, "bad") for name, amount in violated.items()}
    worst = "worst chance margin" if solution.problem == "P2" else "worst margin"
    rows = [
        [
            c.name,
            c.kind.replace("_", " "),
            c.worst_margin,
            c.unit,
            c.worst_t_s,
            c.facets or None,
            amounts.pop(c.name, None),
        ]
        for c in solution.constraints
    ]
    rows += [
        [name, "", None, violated[name].unit, None, None, cell] for name, cell in amounts.items()
    ]
    rows += [
        [d.row, "drift", d.closest_m - d.radius_m, "m", d.closest_t_s, None, None]
        for d in _planned_drifts(solution.verification)
    ]
    return Table.of(
        "Margins at the nodes",
        [*columns("constraint", "kind", f"{worst} +.4f", "unit", "at (s) .0f", "facets"), by],
        rows,
        key="constraints",
        note="A margin of 0 or more is satisfied. Of a drift it is that of the distance which 99.7 % "
        "of its flights keep.",
    )


def limits_table(mission: Mission, solution: Solution, v: Verification) -> Table:
    """Each limit in a row: the mean's values, and the lowest probability with its interval.

    The limits of a joint constraint, such as a least and a largest distance, share a row. Values are in
    the limit's own unit, and count between the nodes too. The time is that of the lowest probability,
    or of the mean's worst value where the probability is 1 or there is none. A limit binds if the
    program's margin is zero, and is "off" by its largest violation. Violations without a limit, such as
    that of the final state, are rows of their own.
    """
    required = required_of_mean(mission.scenario, mission.limits)
    joint = {limit.name: limit.joint for limit in mission.limits}
    chance, marks = {p.name: p for p in v.probabilities}, _marks(mission, solution)
    named = [m.name for m in v.mean_margins]
    rows: list[list[object]] = []
    for name in dict.fromkeys(joint.get(one, one) for one in (*named, *chance, *marks)):
        of = [m for m in v.mean_margins if joint.get(m.name, m.name) == name]
        known = [(m, *required[m.name]) for m in of if m.name in required]
        p, worst = chance.get(name), min(of, key=lambda m: m.worst_margin, default=None)
        weakest = p if worst is None or (p is not None and p.estimate < 1.0) else worst
        rows.append(
            [
                name,
                " ".join(_span((sense, value, m.unit) for m, sense, value in known)),
                _span((sense, _reached(m, sense, value), m.unit) for m, sense, value in known)[0],
                *((None, "") if p is None else (p.estimate, f"{p.low:.4f} to {p.high:.4f}")),
                None if weakest is None else weakest.worst_t_s,
                _joined(marks, [one for one in marks if joint.get(one, one) == name], name),
            ]
        )
    rows += _least_burn(mission, solution)
    rows += [
        [
            d.row,
            f">= {digits(d.radius_m, 4)} m",
            f">= {digits(d.closest_m, 4)} m",
            d.value,
            f"{d.low:.4f} to {d.high:.4f}",
            d.closest_t_s,
            Cell("short", style="bad") if d.is_refuted else Cell("binds" if d.binds else ""),
        ]
        for d in _planned_drifts(v)
    ]
    interval = f"{100 * v.confidence:.0f} % interval"
    return Table.of(
        "Limits",
        [*columns("limit", "allowed", "planned", "chance .4f", interval, "at (s) .0f"), Column("")],
        rows,
        key="limits",
        note=f"planned: of the mean; chance: lowest of {v.samples} flights, required "
        f"{mission.scenario.risk.p_chance:g}; {mission.scene.gravity_in_words()}{own_windows(mission)}"
        + "".join(
            f"; of drifts: the distance that 99.7 % of flights keep for {d.drift_s / 3600.0:.3g} h, "
            f"and the chance to keep the radius, required {d.required:g}"
            for d in _planned_drifts(v)[:1]
        ),
    )


def _least_burn(mission: Mission, solution: Solution) -> list[list[object]]:
    """The row of the smallest executed burn, if it is as small as a burn may be."""
    least = mission.scenario.burns.dv_min_m_s
    all_sizes = {burn.t_s: float(np.linalg.norm(burn.dv_m_s)) for burn in solution.burns}
    sizes = {time: size for time, size in all_sizes.items() if size > 0.0}
    at = min(sizes, key=lambda time: sizes[time], default=None)
    if at is None or least == 0.0 or abs(sizes[at] / least - 1.0) > BINDING:
        return []
    allowed, planned = (f">= {digits(1e3 * size, 4)}" for size in (least, sizes[at]))
    return [["dv_min", f"{allowed} mm/s", planned, None, "", at, "binds"]]


def _planned_drifts(v: Verification | None) -> list[DriftSafety]:
    """Drifts for which the plan has a required probability."""
    return [] if v is None else [d for d in v.drifts if d.required is not None]


def _marks(mission: Mission, solution: Solution) -> dict[str, Cell]:
    """By constraint: whether it binds, or by how much it is violated."""
    found = {c.name: Cell("binds") for c in solution.constraints if abs(c.worst_margin) < BINDING}
    for name, amount in solution.violation.by_constraint.items():
        value, unit = _shown(*_in_own_unit(mission, solution, name))
        found[name] = Cell(f"off {digits(value, 3)} {unit}", amount.max, "bad")
    return found


def _in_own_unit(mission: Mission, solution: Solution, name: str) -> tuple[float, str]:
    """A violation and its unit; of angles in degrees, at the site or at the start of the burn."""
    amount = solution.violation.by_constraint[name]
    at = next((c.worst_t_s for c in solution.constraints if c.name == name), None)
    angles = {limit.name for limit in mission.limits if limit.unit == "rad"}
    if at is not None and name in angles and amount.unit == "m":
        site = track(mission.site, mission.rotation, np.array([at])).position[0]
        reach = solution.nodes.state[solution.nodes.t_s.index(at)][:3] - site
    elif at is not None and name == "dv_battery":
        reach = np.array(next(burn.dv_m_s for burn in solution.burns if burn.t_s == at))
    else:
        return amount.max, amount.unit
    return float(np.rad2deg(np.arcsin(min(amount.max / float(np.linalg.norm(reach)), 1.0)))), "deg"


def _joined(marks: Mapping[str, Cell], of: Sequence[str], name: str) -> Cell:
    """The marks of a row, after what a constraint's name adds; of violations the largest alone."""
    if violated := [one for one in of if marks[one].style]:
        of = [max(violated, key=lambda one: float(marks[one].value or 0.0))]
    text = ", ".join(f"{one.removeprefix(name)} {marks[one].text}".strip(" _") for one in of)
    return Cell(text, style=marks[of[0]].style if of else "")


def _span(bounds: Iterable[tuple[str, float, str]]) -> tuple[str, str]:
    """A range, such as "500 to 740" or ">= 20", and its unit, of senses, values and their units."""
    by = {sense: _shown(value, unit) for sense, value, unit in bounds}
    ends = [digits(by[sense][0], 4) for sense in ("min", "max") if sense in by]
    unit = next((unit for _, unit in by.values()), "")
    one = {"min": ">= ", "max": "<= "}[next(iter(by))] if len(by) == 1 else ""
    return one + " to ".join(ends), unit


def _reached(m: MeanMargin, sense: str, value: float) -> float:
    """The value of the mean that has a margin to a limit."""
    return value + (m.worst_margin if sense == "min" else -m.worst_margin)


def _shown(value: float, unit: str) -> tuple[float, str]:
    """A figure and its unit: speeds in mm/s, angles in deg."""
    factor, shown = {"m/s": (1e3, "mm/s"), "rad": (float(np.rad2deg(1.0)), "deg")}.get(
        unit, (1.0, unit)
    )
    return factor * value, shown


def reintegration_table(mission: Mission, v: Verification) -> Table:
    """Differences of a flight by another integrator; no limit where they are not judged."""
    limits = limits_of(mission)
    return Table.of(
        "Integrated again without the solver",
        columns("re-integrated", "off by .1e", "allowed .1e", "unit"),
        (
            [
                name,
                getattr(v, figure),
                limits[figure] if np.isfinite(limits[figure]) else None,
                unit or "1",
            ]
            for figure, (name, unit, _) in FIGURES.items()
            if getattr(v, figure) is not None
        ),
        key="reintegration",
    )


def own_windows(mission: Mission) -> str:
    """How far the window's edges move with spin and site, after a semicolon; empty where they stay."""
    if (sigmas := mission.edges.sigmas_s) is None:
        return ""
    return (
        f"; the window's edges move by {sigmas[0]:.0f} and {sigmas[1]:.0f} s (1 sigma), and flights "
        "count the observation's limits in their own window"
    )


def drifts_table(v: Verification) -> Table:
    """Drifts after a missed or cut burn: how near they come, and how many are safe."""
    spell = v.drifts[0].drift_s / 3600.0 if v.drifts else 0.0
    radius = v.drifts[0].radius_m if v.drifts else 0.0
    return Table.of(
        "Drift after a missed burn",
        columns(
            "what happens",
            "closest 99.7 % (m) .0f",
            "at (s) .0f",
            "safe .4f",
            "low .4f",
            "high .4f",
            "impact .4f",
            "required g",
        ),
        (
            [d.event, d.closest_m, d.closest_t_s, d.value, d.low, d.high, d.impact, d.required]
            for d in v.drifts
        ),
        key="drifts",
        note=f"Nonlinear flights, {100 * v.confidence:.0f} % intervals; free for {spell:.3g} h from "
        f"the burn on. Safe: never within {radius:g} m of the centre. Impact: within the body's "
        "reference radius.",
    )


def lost_contacts_table(v: Verification) -> Table:
    """What each lost contact does; no rows if the scenario does not ask."""
    return Table.of(
        "Lost contacts",
        columns(
            "contact (s)",
            "ends (s)",
            "for burn",
            "fewest keep",
            "probability .4f",
            "low .4f",
            "high .4f",
        ),
        (
            [one.begin_s, one.end_s, str(one.burn), p.name, p.estimate, p.low, p.high]
            for one in v.lost_contacts or ()
            for p in (one.worst,)
        ),
        key="lost_contacts",
        note="By flights in which this contact alone is lost: its burn is commanded from the estimate "
        "at the cut-off before, carried on, or as planned if there is none.",
    )


def starts_table(starts: Starts) -> Table:
    """The distinct local optima of several starts."""
    return Table.of(
        "Local optima",
        columns(f"local optima, seed {starts.seed}", "delta-v (mm/s) .3f", "starts", "which"),
        (
            [
                f"{optimum.problem} {optimum.status}",
                optimum.total_dv_m_s,
                len(optimum.starts),
                ", ".join(map(str, optimum.starts[:STARTS_NAMED]))
                + (", ..." if len(optimum.starts) > STARTS_NAMED else ""),
            ]
            for optimum in starts.optima
        ),
        note=str(starts),
    )


def called(constraint: str) -> str:
    """A constraint's name in a table of flights."""
    return "all at once" if constraint == ALL else constraint


def stages_table(solution: Solution) -> Table:
    """Status, iterations and delta-v of each stage of planning."""
    return Table.of(
        "Stages",
        columns("stage", "status", "iterations", "total delta-v (mm/s) .3f", "meaning"),
        ([s.name, s.status, s.iterations, s.total_dv_m_s, s.meaning] for s in solution.stages),
        key="stages",
    )


def iteration_row(r: IterationRecord) -> list[object]:
    """A row of `ITERATION_COLUMNS`."""
    step = "accepted" if r.accepted else "rejected"
    sizes = r.trust_radius, r.max_violation, r.max_defect, r.solver_s
    return [r.stage, r.k, r.merit, r.predicted, r.actual, step, *sizes]


def iterations_table(solution: Solution) -> Table:
    """Every iteration of every stage."""
    return Table.of(
        "Iterations",
        ITERATION_COLUMNS,
        map(iteration_row, solution.iterations),
        key="iterations",
        note="Merit: total delta-v plus penalties. Violation and defect: velocities count as metres "
        "per unit of time.",
    )
