"""The paper's table of observation times.

Every row's burns are designed and flown many times; solution.json and montecarlo.json are left in
OUT/<row>/, the table in OUT/observation_table.csv and .md. A second run takes up what is there.
With --as-flown FILE there is a row for the flight, and the warm rows start from it, as the paper's do;
without it they start from the ballistic arc.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter

import numpy as np

from experiments.harness import FRESH, Claim, Findings, Record, Session, Study, option, records
from experiments.observation_table.rows import (
    COLD,
    OSIRIS_REX,
    PRINTED_CLOSEST_M,
    PRINTED_WINDOW_S,
    WARM,
    Row,
    read_states,
    rows,
)
from experiments.observation_table.runs import Failed, Measured, run_row
from scp_recon.cli.options import int_between
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import CONFIDENCE, Estimate
from scp_recon.monte_carlo.observation_time import ALL
from scp_recon.monte_carlo.summary import ONE_SIGMA
from scp_recon.results.table import Column, Table, Value
from scp_recon.scenario.load import load_scenario

SAMPLES, QUICK_SAMPLES = 10_000, 3_000
ROW_FAILED = 4

TWO_RUNS = np.sqrt(2.0)
"""The paper's figures come from as many samples as ours: its interval adds to ours."""
SAME_BURNS_M_S = 1e-4
"""Largest difference of a component with which two designs count as one."""

Entries = Sequence[Measured | Failed]
MEAN, ONE, CLOSEST = "mean", "worst 1 sigma", "closest"
VALUES: dict[str, Callable[[Measured], Estimate]] = {
    MEAN: lambda m: m.mean,
    ONE: lambda m: m.worst_1_sigma,
    CLOSEST: lambda m: m.closest,
}


# --- the table ------------------------------------------------------------------------------------


def record(entry: Measured | Failed) -> Record:
    """A row of the CSV, SI; a failed one has no figures."""
    row = entry.row
    printed: Record = {
        "paper_row": row.printed.name,
        "paper_without_uncertainty_s": PRINTED_WINDOW_S,
        "paper_mean_s": row.printed.mean_s,
        "paper_worst_1_sigma_s": row.printed.worst_1_sigma_s,
    }
    if isinstance(entry, Failed):
        status = f"failed: {entry.reason}"
        return {"row": row.key, "label": row.label, "status": status, **printed}
    name, lowest = entry.lowest_joint
    counted = entry.summary.counted_on_uniform_grid
    return {
        "row": row.key,
        "label": row.label,
        "status": entry.status,
        "samples": entry.summary.samples,
        "window_s": entry.window_s,
        "without_uncertainty_s": entry.without_uncertainty_s,
        **_ends("mean_s", entry.mean),
        **_ends("worst_1_sigma_s", entry.worst_1_sigma),
        "full_window_at_worst_1_sigma": str(entry.full_at_1_sigma).lower(),
        **_ends("closest_0_3_percent_m", entry.closest),
        "total_dv_m_s": entry.solution.total_dv_m_s,
        **_ends("lowest_joint_probability", lowest),
        "lowest_joint_constraint": name,
        **_ends("lowest_probability_all_at_once", entry.all_at_once),
        "mean_on_uniform_grid_s": counted.mean_s,
        "worst_1_sigma_on_uniform_grid_s": counted.worst_1_sigma_s,
        **printed,
        "paper_closest_m": PRINTED_CLOSEST_M if row.role == "planned" else "",
    }


def _ends(name: str, e: Estimate) -> Record:
    """A value and its interval, whose ends may be missing."""
    return {
        name: e.value,
        f"{name}_low": e.low if e.low > -float("inf") else "",
        f"{name}_high": e.high if e.high < float("inf") else "",
    }


def shown(e: Estimate, digits: int) -> str:
    """A value with its interval, if it has one."""
    if e.low == -float("inf") or e.high == float("inf"):
        return f"{e.value:.{digits}f}"
    return f"{e.value:.{digits}f} ({e.low:.{digits}f} to {e.high:.{digits}f})"


def observation_times(entries: Entries) -> Table:
    """The table as the paper lays it out."""
    columns = (
        Column("row"),
        Column("window", "s", ".0f"),
        Column("without uncertainty", "s", ".0f"),
        *(Column(heading, "s", ".0f") for heading in (MEAN, ONE)),
        *(Column(f"paper: {heading}", "s", ".0f") for heading in (MEAN, ONE)),
    )
    lines: list[Sequence[Value]] = []
    for entry in entries:
        row = entry.row
        printed = (row.printed.mean_s, row.printed.worst_1_sigma_s)
        if isinstance(entry, Failed):
            lines.append((row.label, f"failed: {entry.reason}", None, None, None, *printed))
            continue
        full = ", full window" if entry.full_at_1_sigma else ""
        ours = (shown(entry.mean, 0), shown(entry.worst_1_sigma, 0) + full)
        lines.append((row.label, entry.window_s, entry.without_uncertainty_s, *ours, *printed))
    return Table.of("", columns, lines)


def other_figures(measured: Sequence[Measured]) -> Table:
    """What the paper's table does not have."""
    columns = (
        Column("row"),
        Column("closest at 0.3 %", "m"),
        Column("total delta-v", "m/s", ".5f"),
        "lowest joint probability per node",
        "all at once",
        Column("mean on a uniform 232 s grid", "s", ".0f"),
        "design",
    )
    lines = [
        (
            m.row.label,
            shown(m.closest, 1),
            m.solution.total_dv_m_s,
            f"{shown(m.lowest_joint[1], 4)}, {m.lowest_joint[0].replace('_', ' ')}",
            shown(m.all_at_once, 4),
            m.summary.counted_on_uniform_grid.mean_s,
            m.status,
        )
        for m in measured
    ]
    note = (
        "Closest approach: distance from the centre of mass, every 240 s at least, over the whole "
        "flight, which 0.3 % of the flights fall below; the paper prints one, "
        f"{PRINTED_CLOSEST_M} m. Joint probability: of the least probable joint constraint, and of "
        "all observation constraints at once, each at its least probable time."
    )
    return Table.of("What the paper's table does not have", columns, lines, note=note)


def differences(measured: Sequence[Measured]) -> Table:
    """Each row against the paper's that stands for it."""
    columns = (
        Column("row"),
        Column("paper's row"),
        *(Column(f"{heading}, ours less printed", "s", "+.0f") for heading in (MEAN, ONE)),
        Column("remark"),
    )
    lines = [
        (
            m.row.label,
            m.row.printed.name,
            round(m.mean.value) - m.row.printed.mean_s,
            round(m.worst_1_sigma.value) - m.row.printed.worst_1_sigma_s,
            m.solution.message if m.row.anew else "",
        )
        for m in measured
    ]
    return Table.of("Each row against the paper", columns, lines)


# --- the paper's numbers --------------------------------------------------------------------------


def numbers(measured: Sequence[Measured]) -> Table:
    """Of every number in the paper's table: whether it is reproduced, and if not why not."""
    by_key = {m.row.key: m for m in measured}
    lines = _certain_numbers(measured) if measured else []
    flights = [by_key[key] for key in ("as_flown", "ballistic", "p3") if key in by_key]
    reason = (
        "the forces, the errors and the firing times are those of the scenario, not the flight's"
        if "as_flown" in by_key
        else "neither surrogate is the flown trajectory, whose public kernel was not at hand"
    )
    warm, cold = ([m for m in measured if m.row.printed is printed] for printed in (WARM, COLD))
    for printed, chosen, why in (
        (OSIRIS_REX, flights, reason),
        (WARM, warm, _same_optimum(by_key)),
        (COLD, cold, _open_readings(cold)),
    ):
        lines.append(_number(printed.name, printed.mean_s, chosen, MEAN, why))
        lines.append(_number(printed.name, printed.worst_1_sigma_s, chosen, ONE, why))
    planned = [m for m in measured if m.row.role == "planned"]
    why = "the paper does not say of which start it is; of the OSIRIS-REx rows " + ", ".join(
        f"{m.row.key} has {m.closest.value:.1f} m" for m in flights
    )
    name = "the solution trajectory at 0.3 %"
    lines.append(_number(name, PRINTED_CLOSEST_M, planned, CLOSEST, why))
    samples = ", ".join(sorted({str(m.summary.samples) for m in measured})) or "no"
    note = (
        "Reproduced: equal to the printed digit, or within the interval of the difference of two runs "
        f"of {samples} flights."
    )
    columns = (
        "number",
        Column("printed", form="g"),
        "ours",
        "reproduced",
        "why not",
    )
    return Table.of("The paper's numbers", columns, lines, note=note)


def _certain_numbers(measured: Sequence[Measured]) -> list[Sequence[Value]]:
    """The window, and the observation times without uncertainty."""
    window, certain = measured[0].window_s, {m.row.key: m.without_uncertainty_s for m in measured}
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


def _number(
    name: str, printed: float, chosen: Sequence[Measured], what: str, why: str
) -> Sequence[Value]:
    """A line of `numbers`."""
    unit = "m" if what == CLOSEST else "s"
    values = {m.row.key: VALUES[what](m) for m in chosen}
    agree = [key for key, e in values.items() if _agrees(e, printed)]
    ours = ", ".join(f"{key} {e.value:.{unit == 'm':d}f}" for key, e in values.items())
    every = bool(chosen) and len(agree) == len(chosen)
    some = f"by {', '.join(agree)} alone" if agree else "no"
    reason = "" if every else why if chosen else "no row was computed for it"
    return f"{name}, {what}, {unit}", printed, ours, "yes" if every else some, reason


def _agrees(e: Estimate, printed: float) -> bool:
    """Equal within what two such runs may differ by, or to the printed digit."""
    if abs(e.value - printed) < 0.5:
        return True
    side = e.high - e.value if printed > e.value else e.value - e.low
    return bool(np.isfinite(side) and abs(e.value - printed) <= TWO_RUNS * side)


def _same_optimum(by_key: dict[str, Measured]) -> str:
    """How far apart the two starts end."""
    pairs = [(f"{solver}_warm", f"{solver}_cold") for solver in ("scp", "ipopt")]
    apart = [
        (warm, np.abs(by_key[warm].solution.burns_m_s - by_key[cold].solution.burns_m_s).max())
        for warm, cold in pairs
        if warm in by_key and cold in by_key
    ]
    if not apart:
        return "no pair of starts was computed to compare"
    words = ", ".join(f"{1e3 * d:.3f} mm/s ({k.removesuffix('_warm')})" for k, d in apart)
    same = max(d for _, d in apart) < SAME_BURNS_M_S
    so = (
        "both find the same design, and the warm row is as good as the cold one; in the paper they end "
        "apart"
        if same
        else "they end at different designs, as in the paper"
    )
    return f"the burns of the two starts differ by at most {words} a component: {so}"


def _open_readings(rows: Sequence[Measured]) -> str:
    """What the paper leaves open, and what of it was measured not to be the cause."""
    shifts = [m.summary.counted_on_uniform_grid.mean_s - m.mean.value for m in rows]
    gaps = [COLD.mean_s - m.mean.value for m in rows]
    moved, gap = (
        " and ".join(dict.fromkeys(f"{s:+.0f} s" for s in values)) for values in (shifts, gaps)
    )
    return (
        f"counting nodes of the paper's uniform grid would move our mean by {moved} of the "
        f"{gap} between them; not printed, and therefore ours, are how the polytopes are turned, the "
        "site's position, the gravity field and the spacecraft's reflectivity"
    )


# --- what it is to show ---------------------------------------------------------------------------


def claims(entries: Entries) -> list[Claim]:
    """Planned rows above the OSIRIS-REx rows, and a full window at worst 1 sigma from a cold start."""
    measured = [e for e in entries if isinstance(e, Measured)]
    planned = [m for m in measured if m.row.role == "planned"]
    reference = [m for m in measured if m.row.role == "reference"]
    found = [_order(what, planned, reference) for what in (MEAN, ONE) if planned and reference]
    for m in planned:
        if m.row.printed is COLD:
            share = m.summary.held_s[ALL].throughout.estimate.value
            threshold = f"{100 * (1.0 - ONE_SIGMA):.1f} % of flights observe throughout"
            words = f"{m.row.label}: full window at worst 1 sigma"
            found.append(Claim(words, threshold, f"{100 * share:.1f} %", m.full_at_1_sigma))
    return found


def _order(what: str, planned: Sequence[Measured], reference: Sequence[Measured]) -> Claim:
    least = min(planned, key=lambda m: VALUES[what](m).value)
    most = max(reference, key=lambda m: VALUES[what](m).value)
    low, high = VALUES[what](least), VALUES[what](most)
    # Every row flies the same draws, so that the values are surer of their order than the intervals.
    apart = "apart" if low.low > high.high else "overlapping"
    return Claim(
        f"{what} of every planned row above every OSIRIS-REx row",
        f"highest OSIRIS-REx row {most.row.key} with {high.value:.0f} s",
        f"lowest planned {least.row.key} with {low.value:.0f} s, intervals {apart}",
        bool(low.value > high.value),
    )


def measure(
    mission: Mission,
    table_rows: Sequence[Row],
    out: Path,
    *,
    samples: int,
    check: bool,
    fresh: bool,
    tell: Callable[[str], None],
) -> list[Measured | Failed]:
    """All rows, one after the other; what goes wrong in one does not keep the others from running."""
    entries: list[Measured | Failed] = []
    for row in table_rows:
        started, folder = perf_counter(), out / row.key
        try:
            anew = fresh or row.began_elsewhere(folder)
            entry: Measured | Failed = run_row(
                row, mission, folder, samples=samples, check=check, fresh=anew
            )
        except Exception as error:  # a solver's, a file system's: the row says which
            entry = Failed(row, f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")
        entries.append(entry)
        tell(_progress(entry, perf_counter() - started))
    return entries


def _progress(entry: Measured | Failed, seconds: float) -> str:
    if isinstance(entry, Failed):
        return f"{entry.row.key:12} failed: {entry.reason}"
    source = "taken up" if entry.reused else f"{seconds:.1f} s"
    return (
        f"{entry.row.key:12} {entry.solution.total_dv_m_s:.5f} m/s, observes "
        f"{shown(entry.mean, 0)} s, worst 1 sigma {entry.worst_1_sigma.value:.0f} s; "
        f"{entry.status}; {source}"
    )


def report(entries: Entries) -> list[str | Table]:
    """The table as the paper lays it out, what it does not have, and the comparison."""
    measured = [entry for entry in entries if isinstance(entry, Measured)]
    samples = ", ".join(sorted({str(m.summary.samples) for m in measured})) or "no"
    lost = [f"{e.row.label}: not computed ({e.reason})." for e in entries if isinstance(e, Failed)]
    return [
        f"{samples} flights a row with errors of the burns by component and the planner's dynamics; "
        f"in brackets the {100 * CONFIDENCE:.0f} % confidence interval. Observation time is the time "
        "in the window during which site distance, emission and phase are all within their limits, "
        'crossings bisected to 0.02 s and tallied in bins of 0.5 s. "Worst 1 sigma" is '
        "reached by all but 15.9 % of the flights.",
        observation_times(entries),
        *lost,
        other_figures(measured),
        differences(measured),
        numbers(measured),
    ]


def run(session: Session) -> Findings:
    """Design and fly every row."""
    options, out = session.options, session.out
    mission, kernel = Mission.from_scenario(load_scenario()), options.as_flown
    if kernel:
        read_states(mission, kernel)  # before the work, not after it
    out.mkdir(parents=True, exist_ok=True)
    flown = (kernel, out / "as_flown" / "states.csv") if kernel else None
    entries = measure(
        mission,
        rows(ipopt=not options.skip_ipopt, as_flown=flown),
        out,
        samples=options.samples or (QUICK_SAMPLES if options.quick else SAMPLES),
        check=not options.quick,
        fresh=options.fresh,
        tell=session.say,
    )
    status = ROW_FAILED if any(isinstance(entry, Failed) for entry in entries) else 0
    table = records([record(entry) for entry in entries])
    return Findings(report(entries), {"observation_table.csv": table}, claims(entries), status)


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
            help="fewer flights, and plans are not verified again",
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
