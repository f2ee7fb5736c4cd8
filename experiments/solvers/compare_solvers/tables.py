"""Make the comparison's tables from its rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace

import numpy as np

from experiments.harness import records
from experiments.solvers.compare_solvers.cases import EXACT
from experiments.solvers.compare_solvers.cell import Row
from experiments.solvers.compare_solvers.claims import (
    AGREE,
    SOLVERS,
    agreements,
    best_of,
    excess,
    holds,
    of_group,
    verdicts,
)
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.results.table import Column, Table, Value

SCENARIOS_NOTE = """\
Where a case is not solved the number is the merit with the second weight, of the burns flown: what a
method with hard constraints leaves when it gives up may miss the final state by hundreds of metres."""

GUESSES_NOTE = """\
What does not converge from a guess begins again elsewhere, by every method; seconds are those of all
tries. Shares are of all guesses."""

EXACT_NOTE = """\
Each scenario is the default one with other errors, boundary states, limits and probability, drawn from
its number. *Reached* is the check's, with its standard error; *s* are of the processor, for references
without the plan that they start from. A reference's delta-v is printed where the check finds that it
holds."""


PROFILED = {
    "scenarios": "P2 of every scenario",
    "random": "P3 and P2 of random scenarios, uniform risk",
    "guesses": "P3 and P2 from random guesses",
}
"""Groups of problems that many methods solve."""
EXCESSES = (AGREE, 0.01, 0.1)
"""Relative differences of total delta-v from the least."""
FACTORS = (1, 2, 5, 10, 20, 50, 100)
"""Of the least processor time, in a profile."""

PROFILE_NOTE = f"""\
The share of problems that a method solves within so many times the processor time of the quickest
(Dolan and More 2002), set-up included, of those that any method solves; *ever* is its share of success.
A method that ends dearer than the best by more than {AGREE:g} has not solved the problem."""


def csv_of(rows: Sequence[Row]) -> Table:
    """All rows, a column per attribute, burns with spaces between."""
    found = []
    for row in rows:
        burns = " ".join(f"{x:.9g}" for x in row.burns_m_s)
        found.append({"key": row.key, "method": row.method} | asdict(row) | {"burns_m_s": burns})
    return records(found)


def report(rows: Sequence[Row]) -> list[str | Table]:
    """A table per group."""
    return [
        _matrix("Every method", of_group(rows, "matrix"), "methods"),
        _scenarios(of_group(rows, "scenarios")),
        *(profiles(of_group(rows, group)) for group in PROFILED),
        shares(of_group(rows, "random"), "Random scenarios", "random", lambda row: row.solved),
        _guesses(of_group(rows, "guesses")),
        _optima(of_group(rows, "guesses")),
        _exact(rows),
    ]


def shown(row: Row) -> str:
    """A row's status as the tables print it."""
    words = row.detail if row.detail else row.status.replace("_", " ")
    if row.problem == "P3":
        words += " (P3)"
    return words + (", from the ballistic arc" if row.from_arc else "")


def _figure(value: float, form: str) -> str:
    return format(value, form) if np.isfinite(value) else "-"


def _matrix(title: str, rows: Sequence[Row], key: str) -> Table:
    """A line for each problem, start and method; of repeats the first, with the median of the times."""
    columns = (
        "problem", "start", "method", "status", "delta-v m/s", "merit m/s", "worst violation m",
        "P3 + P2 iterations", "repeats", "processor s", "wall s", "of it set-up s", "of it solver s",
        "peak MiB", "observes s",
    )  # fmt: skip
    runs: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        runs.setdefault((row.scenario, row.start, row.method), []).append(row)
    lines = []
    for (problem, start, method), own in runs.items():
        row = own[0]
        times = np.array([(r.cpu_s, r.total_s, r.setup_s, r.solver_s) for r in own])
        lines.append(
            (
                *(problem, start, method, shown(row)),
                _figure(row.total_dv_m_s, ".6f"),
                _figure(row.merit_m_s, ".6f"),
                _figure(row.violation_m, ".1e"),
                f"{row.iterations_p3} + {row.iterations_p2}",
                len(own),
                *(_figure(seconds, ".2f") for seconds in np.median(times, axis=0).tolist()),
                _figure(row.peak_mib, ".0f"),
                _figure(row.observed_s, ".0f"),
            )
        )
    return Table.of(title, columns, lines, key=key)


def _scenarios(rows: Sequence[Row]) -> Table:
    found = {(row.scenario, row.method): row for row in rows}
    methods = list(dict.fromkeys(row.method for row in rows))
    agreeing = {a.scenario: a for a in agreements(rows)}
    lines = []
    for scenario in dict.fromkeys(row.scenario for row in rows):
        cells = [_scenario_cell(found.get((scenario, method))) for method in methods]
        a = agreeing.get(scenario)
        tail = (_figure(a.difference, "+.1e"), a.verdict) if a else ("-", "-")
        lines.append((scenario, *cells, *tail))
    columns = ("scenario", *methods, "IPOPT over SCP less one", "verdict")
    title = "P2 from the same P3 solution and facets"
    return Table.of(title, columns, lines, key="scenarios", note=SCENARIOS_NOTE)


def _scenario_cell(row: Row | None) -> str:
    """Delta-v if solved, else status and merit with the second weight."""
    if row is None:
        return "-"
    if row.solved:
        return f"{row.total_dv_m_s:.6f} ({row.cpu_s:.2f} s)"
    return f"{shown(row)}, {_figure(row.heavy_merit_m_s, '.4f')} ({_figure(row.cpu_s, '.2f')} s)"


def _guesses(rows: Sequence[Row]) -> Table:
    columns = (
        "method", "guesses",
        "solved at the first try", Column("95 % interval", name="first_interval"),
        "solved", Column("95 % interval", name="solved_interval"),
        "at the best optimum", Column("95 % interval", name="best_interval"),
        "median processor s", "90th percentile", "best delta-v m/s",
    )  # fmt: skip
    best, lines = best_of(rows), list[tuple[Value, ...]]()
    for method, tries in _by(rows, "method").items():
        solved = [row for row in tries if row.solved]
        at_once = [row for row in solved if row.solved_at_once]
        at_best = [row for row in solved if row.total_dv_m_s <= best * (1.0 + AGREE)]
        shares = [proportion(len(count), len(tries)) for count in (at_once, solved, at_best)]
        percent = [
            (f"{100 * s.value:.0f} %", f"{100 * s.low:.0f} to {100 * s.high:.0f} %") for s in shares
        ]
        median, most = np.quantile([row.cpu_s for row in tries], (0.5, 0.9)).tolist()
        own = min((row.total_dv_m_s for row in solved), default=np.nan)
        lines.append(
            (
                method,
                len(tries),
                *(text for both in percent for text in both),
                _figure(median, ".2f"),
                _figure(most, ".2f"),
                _figure(own, ".6f"),
            )
        )
    return Table.of("Random guesses", columns, lines, key="guesses", note=GUESSES_NOTE)


def shares(rows: Sequence[Row], title: str, key: str, solves: Callable[[Row], bool]) -> Table:
    """How often each method solves a scenario, and how near the least of all methods."""
    rows = [row if solves(row) else replace(row, total_dv_m_s=np.inf) for row in rows]
    cases = _by(rows, "scenario")
    least = {name: min(row.total_dv_m_s for row in own) for name, own in cases.items()}
    lines = list[tuple[Value, ...]]()
    for method, tries in _by(rows, "method").items():
        solved = [row for row in tries if row.total_dv_m_s < np.inf]
        above = [row.total_dv_m_s / least[row.scenario] - 1.0 for row in solved]
        near = (sum(excess <= most for excess in above) for most in EXCESSES)
        seconds = float(np.median([row.cpu_s for row in solved])) if solved else np.nan
        any_solves = sum(least[row.scenario] < np.inf for row in tries)
        lines.append((method, len(tries), any_solves, len(solved), *near, _figure(seconds, ".2f")))
    columns = (
        "method", "scenarios", "solved by any", "solved",
        *(f"within {most:g} of the least" for most in EXCESSES),
        "median processor s of the solved",
    )  # fmt: skip
    return Table.of(title, columns, lines, key=key)


def profiles(rows: Sequence[Row]) -> Table:
    """Performance profiles of the processor time, of the methods that were given every problem."""
    problems = {(row.scenario, row.seed) for row in rows if row.solved}
    best = {p: best_of(r for r in rows if (r.scenario, r.seed) == p) for p in problems}
    ended = [
        r for r in rows if r.solved and r.total_dv_m_s <= (1 + AGREE) * best[r.scenario, r.seed]
    ]
    least = {p: min(r.cpu_s for r in ended if (r.scenario, r.seed) == p) for p in problems}
    lines = list[tuple[Value, ...]]()
    for method, own in _by(rows, "method").items():
        ratios = [r.cpu_s / least[r.scenario, r.seed] for r in own if r in ended]
        if problems and {(row.scenario, row.seed) for row in own} >= problems:
            within = [sum(ratio <= factor for ratio in ratios) for factor in (*FACTORS, np.inf)]
            lines.append((method, len(problems), *(count / len(problems) for count in within)))
    shares = (*(f"within {factor}" for factor in FACTORS), "ever")
    columns: list[Column | str] = ["method", "problems"]
    columns += [Column(heading, form=".2f") for heading in shares]
    group = next((row.group for row in rows), "")
    title = f"Performance profiles, {PROFILED.get(group, group)}"
    return Table.of(title, columns, lines, f"profiles_{group}", PROFILE_NOTE)


def _by(rows: Iterable[Row], what: str) -> dict[str, list[Row]]:
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(getattr(row, what), []).append(row)
    return found


def _optima(rows: Sequence[Row]) -> Table:
    """Number of runs of each method by status and optimum, total delta-v to four digits."""
    ends = {
        method: [
            f"{row.status.replace('_', ' ')} {_figure(row.total_dv_m_s, '.4f')}" for row in tries
        ]
        for method, tries in _by(rows, "method").items()
    }
    every = sorted({end for found in ends.values() for end in found})
    lines = [(end, *(found.count(end) or None for found in ends.values())) for end in every]
    columns = ("ends at (m/s)", *ends)
    return Table.of("Optima reached from random guesses", columns, lines, key="optima")


def _exact(rows: Sequence[Row]) -> Table:
    """A line for each scenario of exact risk."""
    group = of_group(rows, EXACT)
    columns = (
        "scenario", "asked", "planner: m/s", "reached", "s",
        *(f"{solver}: m/s (s)" for solver in SOLVERS),
        "planner over best", "verdict",
    )  # fmt: skip
    lines = []
    for verdict in verdicts(rows):
        own = {r.solver: r for r in group if r.scenario == verdict.scenario}
        ours = verdict.ours
        theirs = [own.get(solver) for solver in SOLVERS]
        known = verdict.best is not None and verdict.excess < np.inf
        lines.append(
            (
                verdict.scenario,
                *(("-",) * 4 if ours is None else _ours(ours)),
                *map(_theirs, theirs),
                excess(verdict) if known else "-",
                verdict.words,
            )
        )
    title = "Exact risk against nonlinear programming"
    return Table.of(title, columns, lines, key="exact", note=EXACT_NOTE)


def _ours(row: Row) -> tuple[str, str, str, str]:
    if not np.isfinite(row.reached):
        return "-", row.detail, "-", f"{row.cpu_s:.1f}"
    cost = f"{row.total_dv_m_s:.6f}" if row.solved else row.status.replace("_", " ")
    return (
        f"{row.asked:g}",
        cost,
        f"{row.reached:.4f} +- {row.reached_error:.4f}",
        f"{row.cpu_s:.1f}",
    )


def _theirs(row: Row | None) -> str:
    """Delta-v if the check holds, however the search ended."""
    if row is None:
        return "-"
    if not np.isfinite(row.reached):
        return row.detail
    late = "; out of time" if row.status == "max_iterations" else ""
    cost = f"{row.total_dv_m_s:.6f}" if holds(row) else "nothing that holds"
    return f"{cost} ({row.cpu_s:.1f}{late})"
