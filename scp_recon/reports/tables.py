"""Build the tables of a plan: burns, margins, verification, iterations, flights, simulation.

Each table is built here once, for the terminal and for the report. Its values are those of the
files to the last digit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from scp_recon.mission.constraints import Bound, bounds_on_mean
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.observation_time import ALL
from scp_recon.planning.plan import Starts
from scp_recon.results.facts import Burn, IterationRecord, MeanMargin, Verification
from scp_recon.results.policy import sigmas
from scp_recon.results.solution import Solution
from scp_recon.results.table import SCALES, Cell, Column, Table
from scp_recon.scenario.time_scales import instant, shown_utc
from scp_recon.verification.reintegration import FIGURES, limits_of

if TYPE_CHECKING:
    from scp_recon.monte_carlo.summary import Commanded, Interval, Summary
    from scp_recon.simulation.record import FlightSummary

AT = Column("at", "s", ".0f")
ITERATION_COLUMNS = (
    "stage",
    "k",
    Column("merit", "m/s", ".6f"),
    Column("predicted", "m/s", ".2e"),
    Column("actual", "m/s", ".2e"),
    "step",
    Column("radius", "m/s", ".1e"),
    Column("violation", "m", ".1e"),
    Column("defect", "m", ".1e"),
    Column("solver", "s", ".3f"),
)
BINDING = 1e-4
"""Margin in the program below which a limit binds, m or m/s."""
NO_BURN = Cell("0", 0.0)
"""In place of each component of a burn that is not executed."""
STARTS_NAMED = 6
"""Starts of a local optimum that are listed by number."""


def dv_column(heading: str, form: str = ".3f") -> Column:
    """A column of delta-v: values in m/s, texts in mm/s."""
    return Column(heading, "m/s", form, shown_unit="mm/s")


def burns_table(solution: Solution, legal_s: Sequence[tuple[float, float]] = ()) -> Table:
    """Times, components along J2000 and sizes of the burns, and their legal times where given."""
    scenario = solution.scenario
    table = Table.of(
        "Burns, J2000",
        (
            "burn",
            Column("time", "s"),
            "UTC",
            *(dv_column(axis, "+z.3f") for axis in "xyz"),
            dv_column("size"),
        ),
        (
            [
                str(number),
                burn.t_s,
                shown_utc(instant(scenario.epoch.tdb, burn.t_s)),
                *_components(burn),
            ]
            for number, burn in enumerate(solution.burns, start=1 + scenario.burns_flown)
        ),
        key="burns",
    )
    if not legal_s:
        return table
    spans = (
        f"{early:.0f}"
        if early == late
        else (f"{early:.0f} to {late:.0f}" if np.isfinite(late) else f"from {early:.0f}")
        for early, late in legal_s
    )
    return table.with_column(Column("legal", "s"), spans)


def corrections_table(solution: Solution) -> Table:
    """Corrected burns and knowledge at their cut-offs; no rows if burns are fixed."""
    corrections = solution.policy.corrections if solution.policy is not None else []
    flown = solution.scenario.burns_flown
    fixed = {*range(flown + 1, flown + 1 + len(solution.burns))} - {c.burn for c in corrections}
    nominal = [solution.burns_m_s[one.burn] for one in solution.corrections]
    return Table.of(
        "Corrected burns",
        (
            "burn",
            Column("cut-off", "s"),
            dv_column("nominal"),
            dv_column("correction, 1 sigma"),
            *(
                Column(f"{what} known {when}", unit, form)
                for when in ("before", "after")
                for what, unit, form in (("position", "m", ".2f"), ("velocity", "m/s", ".2e"))
            ),
        ),
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
        ("burn", "limit", Column("probability", form=".4f"), AT, Column("required", form="g")),
        ([str(b.burn), b.name, b.probability, b.t_s, required] for b in v.burn_limits),
        key="burn_limits",
        note="As they are commanded, by the normal law of the corrections.",
    )


def _components(burn: Burn) -> Sequence[object]:
    """Its three and its size."""
    return or_none(any(burn.dv_m_s), *burn.dv_m_s, float(np.linalg.norm(burn.dv_m_s)))


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
    return Table.of(
        "Margins at the nodes",
        ("constraint", "kind", Column(worst, form="+.4f"), "unit", AT, "facets", by),
        rows,
        key="constraints",
        note="A margin of 0 or more is satisfied.",
    )


def mean_margins_table(mission: Mission, v: Verification) -> Table:
    """Worst margins of the original constraints on the mean, each beside its limit."""
    limits = bounds_on_mean(mission.scenario, mission.limits)
    rows = [
        [m.name, str(limits.get(m.name, "")), *_shown_margin(m), m.worst_t_s]
        for m in v.mean_margins
    ]
    return Table.of(
        "Margins of the mean, between the nodes too",
        (
            "original constraint on the mean",
            "required",
            Column("worst margin", form="+.4f"),
            "unit",
            AT,
        ),
        rows,
        key="mean_margins",
    )


def limits_table(mission: Mission, solution: Solution, v: Verification) -> Table:
    """Each limit in a row: the mean's values, and the lowest probability with its interval.

    The limits of a joint constraint, such as a least and a largest distance, share a row. Values are in
    the limit's own unit, and count between the nodes too. The time is that of the lowest probability,
    or of the mean's worst value where the probability is 1 or there is none. A limit binds if the
    program's margin is zero. Violations without a limit, such as that of the final state, are rows of
    their own.
    """
    bounds = bounds_on_mean(mission.scenario, mission.limits)
    joint = {limit.name: limit.joint for limit in mission.limits}
    chance, marks = {p.name: p for p in v.probabilities}, _marks(solution)
    named = [m.name for m in v.mean_margins]
    rows: list[list[object]] = []
    for name in dict.fromkeys(joint.get(one, one) for one in (*named, *chance, *marks)):
        of = [m for m in v.mean_margins if joint.get(m.name, m.name) == name]
        known = [(bounds[m.name], _shown_margin(m)[0]) for m in of if m.name in bounds]
        p, worst = chance.get(name), min(of, key=lambda m: m.worst_margin, default=None)
        weakest = p if worst is None or (p is not None and p.estimate < 1.0) else worst
        rows.append(
            [
                name,
                " ".join(_span(bound for bound, _ in known)),
                _span(bound._replace(value=bound.reached(m)) for bound, m in known)[0],
                *((None, "") if p is None else (p.estimate, f"{p.low:.4f} to {p.high:.4f}")),
                None if weakest is None else weakest.worst_t_s,
                _joined(marks, [one for one in marks if joint.get(one, one) == name], name),
            ]
        )
    return Table.of(
        "Limits",
        (
            "limit",
            "allowed",
            "planned",
            Column("chance", form=".4f"),
            f"{100 * v.confidence:.0f} % interval",
            AT,
            "",
        ),
        rows,
        note=f"planned: of the mean; chance: lowest of {v.samples} flights, required "
        f"{mission.scenario.risk.p_chance:g}; {mission.true_gravity('planner')}",
    )


def _marks(solution: Solution) -> dict[str, Cell]:
    """By constraint: whether it binds, or by how much it is violated."""
    found = {c.name: Cell("binds") for c in solution.constraints if abs(c.worst_margin) < BINDING}
    for name, amount in solution.violation.by_constraint.items():
        value, unit = _shown(amount.max, amount.unit)
        found[name] = Cell(f"off by {value:.3g} {unit}", amount.max, "bad")
    return found


def _joined(marks: Mapping[str, Cell], of: Sequence[str], name: str) -> Cell:
    """The marks of a row of limits, each after what its constraint's name adds to that of the row."""
    text = ", ".join(f"{one.removeprefix(name)} {marks[one].text}".strip(" _") for one in of)
    return Cell(text, style=max((marks[one].style for one in of), default=""))


def _span(bounds: Iterable[Bound]) -> tuple[str, str]:
    """A range, such as "500 to 740" or ">= 20", and its unit; speeds in mm/s."""
    by = {bound.sense: _shown(bound.value, bound.unit) for bound in bounds}
    ends = [f"{by[sense][0]:.4g}" for sense in ("min", "max") if sense in by]
    unit = next((unit for _, unit in by.values()), "")
    one = {"min": ">= ", "max": "<= "}[next(iter(by))] if len(by) == 1 else ""
    return one + " to ".join(ends), unit


def _shown(value: float, unit: str) -> tuple[float, str]:
    """A figure and its unit, speeds in mm/s."""
    shown = "mm/s" if unit == "m/s" else unit
    return value * SCALES.get((unit, shown), 1.0), shown


def _shown_margin(m: MeanMargin) -> tuple[float, str]:
    """A margin and its unit, angles in deg."""
    in_deg = float(np.rad2deg(1.0)) * m.worst_margin
    return (in_deg, "deg") if m.unit == "rad" else (m.worst_margin, m.unit)


def reintegration_table(mission: Mission, v: Verification) -> Table:
    """Differences of a flight by another integrator; no limit where they are not judged."""
    limits = limits_of(mission)
    return Table.of(
        "Integrated again without the solver",
        ("re-integrated", Column("off by", form=".1e"), Column("allowed", form=".1e"), "unit"),
        (
            [
                name,
                getattr(v, figure),
                limits[figure] if np.isfinite(limits[figure]) else None,
                unit or "1",
            ]
            for figure, (name, unit) in FIGURES.items()
            if getattr(v, figure) is not None
        ),
        key="reintegration",
    )


def probabilities_table(mission: Mission, v: Verification) -> Table:
    """Lowest probabilities of the joint constraints, with their intervals."""
    required = mission.scenario.risk.p_chance
    return Table.of(
        "Lowest probabilities, by the verification's flights",
        (
            "joint constraint",
            *(Column(name, form=".4f") for name in ("lowest probability", "low", "high")),
            AT,
            Column("required", form="g"),
        ),
        ([p.name, p.estimate, p.low, p.high, p.worst_t_s, required] for p in v.probabilities),
        key="probabilities",
        note=f"Monte Carlo, {v.samples} flights, {100 * v.confidence:.0f} % intervals. Planned and "
        f"flown with {mission.true_gravity('planner')}.",
    )


def drifts_table(v: Verification) -> Table:
    """Drifts after a missed or cut burn: how near they come, and how many are safe."""
    spell = v.drifts[0].drift_s / 3600.0 if v.drifts else 0.0
    radius = v.drifts[0].radius_m if v.drifts else 0.0
    return Table.of(
        "Drift after a missed burn",
        (
            "what happens",
            Column("closest 99.7 %", "m", ".0f"),
            AT,
            *(Column(name, form=".4f") for name in ("safe", "low", "high", "impact")),
            Column("required", form="g"),
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
        (
            Column("contact", "s"),
            Column("ends", "s"),
            "for burn",
            "fewest keep",
            *(Column(name, form=".4f") for name in ("probability", "low", "high")),
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
        (
            f"local optima, seed {starts.seed}",
            dv_column("delta-v"),
            "starts",
            "which",
        ),
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


def observation_times_table(summary: Summary) -> Table:
    """Time observed by flights, s, and the probability that a limit holds throughout."""
    return Table.of(
        "Observation times",
        ("time held", *(Column(name, "s") for name in ("mean", "worst 1 sigma", "worst 2 sigma")),
         Column("throughout", "1")),
        (
            [
                called(name),
                *(
                    interval_cell(x, 1, "\n")
                    for x in (held.mean, held.worst_1_sigma, held.worst_2_sigma)
                ),
                interval_cell(held.throughout, 4, "\n"),
            ]
            for name, held in summary.held_s.items()
        ),
        key="flights",
        note=f"{summary.samples} flights, seed {summary.seed}, {summary.errors} errors, planned with "
        f"{summary.planned_gravity}, flown with "
        f"{summary.flown_gravity}, as in montecarlo.json.",
    )  # fmt: skip


def flown_probabilities_table(summary: Summary, required: float | None) -> Table:
    """Lowest probabilities of the joint constraints and of whole flights, with their intervals."""
    rows: list[list[object]] = [
        [
            called(name),
            interval_cell(lowest, 4),
            lowest.worst_t_s,
            None if name == ALL else required,
            _counted(summary, narrowed=summary.is_narrowed(name)),
        ]
        for name, lowest in summary.probability.items()
    ]
    whole, counted = interval_cell(summary.whole_flight, 4), _counted(summary, narrowed=False)
    rows.append(["all limits, whole flight", whole, None, None, counted])
    columns = ("joint constraint", "lowest probability", AT, Column("required", form="g"), "of")
    note = (
        "Rows of draws are of further flights, mostly of draws near a limit; within the intervals they "
        "differ from rows of flights."
    )
    return Table.of("Lowest probabilities", columns, rows, note=note if summary.strata else "")


def _counted(summary: Summary, *, narrowed: bool) -> str:
    """The flights that a probability is of."""
    own = summary.strata
    if own is None or not narrowed:
        return f"{summary.samples} flights"
    return f"{own.draws} draws, {own.flights} flown"


def corrected_burns_table(commanded: Commanded, required: float | None) -> Table:
    """How often each corrected burn keeps each limit on burns, with intervals; and failed replans."""
    again = any(burn.failed is not None for burn in commanded.burns)
    return Table.of(
        "Burns planned again, as commanded" if again else "Corrected burns as commanded",
        (
            "burn",
            Column("cut-off", "s", "g"),
            "limit",
            "probability that it holds",
            Column("required", form="g"),
            *(["failed replans"] if again else []),
        ),
        (
            [
                *(str(burn.burn), burn.cut_off_s, name, interval_cell(kept, 4), required),
                *([str(burn.failed)] if again else []),
            ]
            for burn in commanded.burns
            for name, kept in burn.limits.items()
        ),
        key="corrected_burns",
    )


def called(constraint: str) -> str:
    """A constraint's name in a table of flights."""
    return "all at once" if constraint == ALL else constraint


def interval_cell(interval: Interval, digits: int, gap: str = " ") -> Cell:
    """A value, with its interval if it has both ends."""
    text = f"{interval.estimate.value:.{digits}f}"
    if interval.low is not None and interval.high is not None:
        text += f"{gap}({interval.low:.{digits}f} to {interval.high:.{digits}f})"
    return Cell(text, interval.value)


def simulated_burns_table(summary: FlightSummary) -> Table:
    """Burns as planned and as the spacecraft's simulation executed them."""
    return Table.of(
        f"Burns in the simulation ({summary.vehicle}, seed {summary.seed})",
        (
            "burn",
            AT,
            *map(dv_column, ("planned", "executed")),
            *(Column(name, "deg", ".3f") for name in ("off at start", "off")),
        ),
        (
            [
                str(number),
                burn.t_s,
                *or_none(
                    any(burn.planned_m_s),
                    *(float(np.linalg.norm(dv)) for dv in (burn.planned_m_s, burn.executed_m_s)),
                    burn.pointing_deg,
                    burn.executed_pointing_deg,
                ),
            ]
            for number, burn in enumerate(summary.burns, start=1)
        ),
        key="simulated_burns",
    )


def legs_table(summary: FlightSummary) -> Table:
    """Attitude modes as flown, with their failed requirements."""
    rows = []
    for leg in summary.legs:
        faults = ("" if leg.ok else " too short") + (
            "" if leg.settled_in_time else " not steady in time"
        )
        settled = "never" if leg.settled_s is None else leg.settled_s
        rows.append([leg.mode + faults, leg.start_s, leg.duration_s, leg.required_s, settled])
    times = ("from", "for", "at least", "steady after")
    return Table.of("Attitude modes", ("mode", *(Column(name, "s", ".0f") for name in times)), rows)


def simulated_table(summary: FlightSummary) -> Table:
    """Charge, pointing and final state in the spacecraft's simulation."""
    miss = summary.terminal_miss
    rows = (
        ("least state of charge", 100.0 * summary.least_charge, ".1f", "%"),
        ("floor of it", 100.0 * summary.floor_charge, ".1f", "%"),
        ("camera off the site, 99.7 %", summary.window_pointing_deg.site.q997, ".3f", "deg"),
        ("final position off the mean", miss.position_m, ".1f", "m"),
        ("final velocity off the mean", miss.velocity_m_s, ".4f", "m/s"),
        ("largest distance in the planned spread", summary.largest_sigma_distance, ".2f", "sigma"),
        ("momentum dumps", summary.dumps, "d", ""),
    )
    return Table.of(
        f"In the simulation ({summary.vehicle}, seed {summary.seed})",
        ("figure", "value", "unit"),
        ([name, Cell(format(value, form), value), unit] for name, value, form, unit in rows),
        key="simulated",
    )


def stages_table(solution: Solution) -> Table:
    """Status, iterations and delta-v of each stage of planning."""
    return Table.of(
        "Stages",
        ("stage", "status", "iterations", dv_column("total delta-v"), "meaning"),
        ([s.name, s.status, s.iterations, s.total_dv_m_s, s.meaning] for s in solution.stages),
        key="stages",
    )


def iteration_row(r: IterationRecord) -> list[object]:
    """A row of `ITERATION_COLUMNS`."""
    return [
        r.stage,
        r.k,
        r.merit,
        r.predicted,
        r.actual,
        "accepted" if r.accepted else "rejected",
        r.trust_radius,
        r.max_violation,
        r.max_defect,
        r.solver_s,
    ]


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
