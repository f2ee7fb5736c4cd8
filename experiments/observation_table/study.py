"""Compute the paper's table of observation times.

Every row's burns are designed and flown many times; solution.json and montecarlo.json are written to
OUT/<row>/, the table to OUT/observation_table.csv and .md, and the paper's statements about P2 and its
plan, each tested, to OUT/statements.csv. A second run of the same version keeps existing results. With
--as-flown FILE there is a row for the real flight, and the warm rows start from it, as the paper's do;
without it they start from the ballistic arc.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter

import numpy as np

from experiments.harness import FRESH, Findings, Record, Session, Study, option, records
from experiments.observation_table.rows import (
    COLD,
    FRAME_CAVEAT,
    KERNEL,
    OSIRIS_REX,
    PRINTED_CLOSEST_M,
    PRINTED_WINDOW_S,
    WARM,
    Row,
    read_states,
    rows,
    variants,
)
from experiments.observation_table.runs import failed, not_flown, run_row
from experiments.observation_table.statements import (
    CLOSEST,
    COLUMNS,
    MEAN,
    ONE,
    SAME_BURNS_M_S,
    Rows,
    burns_apart,
    computed,
    of_role,
    shown,
    standing_for,
    statements,
    statements_table,
)
from scp_recon.cli.options import int_between
from scp_recon.files import write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import CONFIDENCE
from scp_recon.results.table import Column, Table, Value
from scp_recon.scenario.load import load_scenario

STAMP = "version.txt"
"""Beside the rows: version of the study that made them; those of another one are not taken up."""
SAMPLES, QUICK_SAMPLES = 10_000, 3_000
ROW_FAILED = 4

TWO_RUNS = np.sqrt(2.0)
"""The paper's figures come from as many samples as ours: its interval adds to ours."""


# --- the tables -----------------------------------------------------------------------------------


def observation_times(entries: Rows) -> Table:
    """The table in the paper's layout."""
    columns = (
        Column("row"),
        Column("window", "s", ".0f"),
        Column("without uncertainty", "s", ".0f"),
        *(Column(heading, "s", ".0f") for heading in (MEAN, ONE)),
        *(Column(f"paper: {heading}", "s", ".0f") for heading in (MEAN, ONE)),
    )
    lines = []
    for row in entries:
        ours: tuple[Value, ...] = (row["status"], None, None, None)
        if "mean_s" in row:
            full = ", full window" if row["full_window_at_worst_1_sigma"] else ""
            times = shown(row, "mean_s", 0), shown(row, "worst_1_sigma_s", 0) + full
            ours = (row["window_s"], row["without_uncertainty_s"], *times)
        lines.append((row["label"], *ours, row["paper_mean_s"], row["paper_worst_1_sigma_s"]))
    return Table.of("", columns, lines)


def other_figures(measured: Rows) -> Table:
    """Table of the figures that the paper's does not have."""
    columns = (
        "row",
        Column("closest at 0.3 %", "m"),
        Column("total delta-v", "m/s", ".5f"),
        "lowest joint probability per node",
        "all at once",
        Column("mean on a uniform 232 s grid", "s", ".0f"),
        "design",
    )
    lines = [
        (
            row["label"],
            shown(row, "closest_0_3_percent_m", 1),
            row["total_dv_m_s"],
            f"{shown(row, 'lowest_joint_probability', 4)}, "
            f"{row['lowest_joint_constraint'].replace('_', ' ')}",
            shown(row, "lowest_probability_all_at_once", 4),
            row["mean_on_uniform_grid_s"],
            row["status"],
        )
        for row in measured
    ]
    note = (
        "Closest approach: distance from the centre of mass, every 240 s at least, over the whole "
        "flight, which 0.3 % of the flights fall below; the paper prints one, "
        f"{PRINTED_CLOSEST_M} m. Joint probability: of the least probable joint constraint, and of "
        "all observation constraints at once, each at its least probable time."
    )
    return Table.of("What the paper's table does not have", columns, lines, note=note)


def differences(measured: Rows) -> Table:
    """Table of the differences of each row from the paper's."""
    columns = (
        Column("row"),
        Column("paper's row"),
        *(Column(f"{heading}, ours less printed", "s", "+.0f") for heading in (MEAN, ONE)),
        Column("remark"),
    )
    lines = [
        (
            row["label"],
            row["paper_row"],
            *(round(row[name]) - row[f"paper_{name}"] for name in ("mean_s", "worst_1_sigma_s")),
            row["remark"],
        )
        for row in measured
    ]
    return Table.of("Each row against the paper", columns, lines)


def other_choices(measured: Rows) -> Table:
    """Table of P3, the default plan and its variants."""
    columns = (
        "case",
        Column("total delta-v", "m/s", ".6f"),
        "lowest joint probability per node",
        Column("mean", "s", ".0f"),
        "design",
    )
    lines = [
        (
            row["label"],
            row["total_dv_m_s"],
            f"{row['lowest_joint_probability']:.3f}, "
            f"{row['lowest_joint_constraint'].replace('_', ' ')}",
            row["mean_s"],
            row["status"],
        )
        for row in measured
        if row["role"] == "variant" or row["row"] in ("p3", "scp_cold")
    ]
    return Table.of("Other readings and choices, SCP from the cold start", columns, lines)


# --- the paper's numbers --------------------------------------------------------------------------


def numbers(measured: Rows) -> Table:
    """Table of the paper's numbers: whether each is reproduced, or why not."""
    by_key = {row["row"]: row for row in measured}
    lines = _certain_numbers(measured) if measured else []
    flights = [by_key[key] for key in ("as_flown", "ballistic", "p3") if key in by_key]
    reason = (
        "the forces, the errors and the firing times are those of the scenario, not the flight's"
        if "as_flown" in by_key
        else f"neither surrogate is the flown trajectory, whose kernel {KERNEL} was not at hand"
    )
    reason = "; ".join([reason, *(f"{r['row']}: {r['remark']}" for r in flights if _chosen(r))])
    warm, cold = (standing_for(printed, measured) for printed in (WARM, COLD))
    for printed, chosen, why in (
        (OSIRIS_REX, flights, reason),
        (WARM, warm, _same_optimum(by_key)),
        (COLD, cold, _open_readings(cold)),
    ):
        lines.append(_number(printed.name, printed.mean_s, chosen, MEAN, why))
        lines.append(_number(printed.name, printed.worst_1_sigma_s, chosen, ONE, why))
    planned = [row for row in measured if row["role"] == "planned"]
    why = "the paper does not say of which start it is; of the OSIRIS-REx rows " + ", ".join(
        f"{row['row']} has {row[COLUMNS[CLOSEST]]:.1f} m" for row in flights
    )
    name = "the solution trajectory at 0.3 %"
    lines.append(_number(name, PRINTED_CLOSEST_M, planned, CLOSEST, why))
    note = (
        "Reproduced: equal to the printed digit, or within the interval of the difference of two runs "
        f"of {_samples(measured)} flights."
    )
    columns = ("number", Column("printed", form="g"), "ours", "reproduced", "why not")
    return Table.of("The paper's numbers", columns, lines, note=note)


def _samples(measured: Rows) -> str:
    return ", ".join(sorted({str(row["samples"]) for row in measured})) or "no"


def _certain_numbers(measured: Rows) -> list[Sequence[Value]]:
    """The window, and the observation times without uncertainty."""
    window = measured[0]["window_s"]
    certain = {row["row"]: row["without_uncertainty_s"] for row in measured}
    short = [f"{k} {v:.0f} s" for k, v in certain.items() if abs(v - PRINTED_WINDOW_S) > 1.0]
    same = abs(window - PRINTED_WINDOW_S) < 1.0
    return [
        ("window, s", PRINTED_WINDOW_S, f"{window:.1f}", "yes" if same else "no", ""),
        (
            "observation time without uncertainty in every row, s",
            PRINTED_WINDOW_S,
            f"shorter: {', '.join(short)}" if short else "within 1 s in every row",
            "no" if short else "yes",
            "",
        ),
    ]


def _number(name: str, printed: float, chosen: Rows, what: str, why: str) -> Sequence[Value]:
    """A line of `numbers`."""
    unit = "m" if what == CLOSEST else "s"
    agree = [r["row"] for r in chosen if _agrees(r, COLUMNS[what], printed) and not _chosen(r)]
    fitted = [r["row"] for r in chosen if _agrees(r, COLUMNS[what], printed) and _chosen(r)]
    ours = ", ".join(f"{row['row']} {row[COLUMNS[what]]:.{unit == 'm':d}f}" for row in chosen)
    every = bool(chosen) and len(agree) == len(chosen)
    some = f"by {', '.join(agree)} alone" if agree else "no"
    some += f"; {', '.join(fitted)} agrees, as it was chosen to" if fitted else ""
    reason = "" if every else why if chosen else "no row was computed for it"
    return f"{name}, {what}, {unit}", printed, ours, "yes" if every else some, reason


def _chosen(row: Record) -> bool:
    """Whether a reading was chosen for this row to agree with the printed one."""
    return row["remark"] == FRAME_CAVEAT


def _agrees(row: Record, name: str, printed: float) -> bool:
    """Whether a number agrees to the printed digit, or within the interval of two such runs."""
    off = abs(row[name] - printed)
    end = row[f"{name}_high" if printed > row[name] else f"{name}_low"]
    return bool(off < 0.5 or (end != "" and off <= TWO_RUNS * abs(end - row[name])))


def _same_optimum(by_key: dict[str, Record]) -> str:
    """Sentence on the difference between the designs of the two starts."""
    apart = {}
    for solver in ("scp", "ipopt"):
        warm, cold = (by_key.get(f"{solver}_{start}") for start in ("warm", "cold"))
        if warm and cold:
            apart[solver] = burns_apart(warm, cold)
    if not apart:
        return "no pair of starts was computed to compare"
    words = ", ".join(f"{1e3 * d:.3f} mm/s ({solver})" for solver, d in apart.items())
    same = max(apart.values()) < SAME_BURNS_M_S
    so = (
        "both find the same design, and the warm row is as good as the cold one; in the paper they end "
        "apart"
        if same
        else "they end at different designs, as in the paper"
    )
    return f"the burns of the two starts differ by at most {words} a component: {so}"


def _open_readings(rows: Rows) -> str:
    """Sentence on choices that the paper leaves open, one of which was measured not to be the cause."""
    shifts = [row["mean_on_uniform_grid_s"] - row["mean_s"] for row in rows]
    gaps = [COLD.mean_s - row["mean_s"] for row in rows]
    moved, gap = (
        " and ".join(dict.fromkeys(f"{s:+.0f} s" for s in values)) for values in (shifts, gaps)
    )
    return (
        f"counting nodes of the paper's uniform grid would move our mean by {moved} of the "
        f"{gap} between them; not printed, and therefore ours, are how the polytopes are turned, the "
        "site's position, the gravity field and the spacecraft's reflectivity"
    )


# --- the study ------------------------------------------------------------------------------------


def measure(
    mission: Mission,
    table_rows: Sequence[Row],
    out: Path,
    *,
    samples: int,
    check: bool = False,
    fresh: bool = False,
    tell: Callable[[str], None] = lambda _: None,
) -> list[Record]:
    """Compute all rows in turn; a failure in one does not stop the others."""
    entries = []
    for row in table_rows:
        started, folder = perf_counter(), out / row.key
        try:
            anew = fresh or row.began_elsewhere(folder)
            found, reused = run_row(row, mission, folder, samples=samples, check=check, fresh=anew)
            took = "taken up" if reused else f"{perf_counter() - started:.1f} s"
            said = (
                f"{found['total_dv_m_s']:.5f} m/s, observes {shown(found, 'mean_s', 0)} s, worst 1 "
                f"sigma {found['worst_1_sigma_s']:.0f} s; {found['status']}; {took}"
            )
        except Exception as error:  # a solver's, a file system's: the row says which
            found = failed(row, f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")
            said = found["status"]
        entries.append(found)
        tell(f"{row.key:12} {said}")
    return entries


def report(entries: Rows) -> list[str | Table]:
    """The report: the table in the paper's layout, further figures, and the comparison."""
    measured = computed(entries)
    samples = _samples(measured)
    table = of_role(measured, "reference", "planned")
    return [
        f"{samples} flights a row with errors of the burns by component and the planner's dynamics; "
        f"in brackets the {100 * CONFIDENCE:.0f} % confidence interval. Observation time is the time "
        "in the window during which site distance, emission and phase are all within their limits, "
        'crossings bisected to 0.02 s and tallied in bins of 0.5 s. "Worst 1 sigma" is '
        "reached by all but 15.9 % of the flights.",
        observation_times(of_role(entries, "reference", "planned")),
        other_figures(table),
        differences(table),
        numbers(table),
        other_choices(measured),
    ]


def run(session: Session) -> Findings:
    """Design and fly every row."""
    options, out = session.options, session.out
    mission, kernel = Mission.from_scenario(load_scenario()), options.as_flown
    if kernel:
        read_states(mission, kernel)  # before the work, not after it
    out.mkdir(parents=True, exist_ok=True)
    flown = (kernel, out / "as_flown" / "states.csv") if kernel else None
    others = () if options.quick else variants(mission.scenario)
    made_by, stamp = str(session.evidence.version), out / STAMP
    same = stamp.exists() and stamp.read_text("utf-8") == made_by
    write_atomically(stamp, made_by)
    entries = measure(
        mission,
        (*rows(ipopt=not options.skip_ipopt, as_flown=flown), *others),
        out,
        samples=options.samples or (QUICK_SAMPLES if options.quick else SAMPLES),
        check=not options.quick,
        fresh=options.fresh or not same,
        tell=session.say,
    )
    status = 0 if len(computed(entries)) == len(entries) else ROW_FAILED
    entries += [] if kernel else [not_flown()]
    found = statements(entries)
    files = {"observation_table.csv": records(entries), "statements.csv": statements_table(found)}
    return Findings(report(entries), files, [each.claim for each in found], status)


STUDY = Study(
    "Observation times",
    __doc__,
    run,
    (
        option(
            "--samples",
            type=int_between(20, 10**9, "20 to 1e9"),
            metavar="N",
            help=f"flights a row (default: {SAMPLES}, with --quick {QUICK_SAMPLES})",
        ),
        option(
            "--quick",
            action="store_true",
            help="fewer flights, plans are not verified again, no other readings and choices",
        ),
        option(
            "--as-flown",
            type=Path,
            metavar="FILE",
            help="SPK of the flight, for a row of its own and as the warm rows' start; needs the "
            "extra [spice]",
        ),
        option("--skip-ipopt", action="store_true", help="no rows planned by IPOPT"),
        FRESH,
    ),
    folder="paper",
)
