"""The comparison's tables and claims, from its rows."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import asdict

import numpy as np

from experiments.compare_solvers.claims import AGREE, Claim, agreements, best_of, claims, of_group
from experiments.compare_solvers.exact.claims import exact_claims, exact_table
from experiments.compare_solvers.row import Row
from scp_recon.monte_carlo.estimates import proportion

SCENARIOS_NOTE = """\
Where a case is not solved the number is the merit with the second weight, of the burns flown: what a
method with hard constraints leaves when it gives up may miss the final state by hundreds of metres."""

GUESSES_NOTE = """\
What does not converge from a guess begins again elsewhere, by every method; seconds are those of all
tries. Shares are of all guesses."""


PEER_NOTE = """\
Left by `experiments.openscvx_peer`; numbers after *ptr* are its weights of cost, virtual control and
virtual buffer and the step at which it stops. All start at the ballistic arc."""


EXACT_NOTE = """\
Each scenario is the default one with other errors, boundary states, limits and probability, drawn from
its number. *Reached* is the check's, with its standard error; *s* are of the processor, for references
without the plan that they start from. A reference's delta-v is printed where the check finds that it
holds."""


def every_claim(rows: Sequence[Row]) -> list[Claim]:
    """What the comparison is to show, of uniform risk and of exact risk."""
    return [*claims(rows), *exact_claims(rows)]


def to_csv(rows: Sequence[Row]) -> str:
    """All rows, a column per attribute, burns with spaces between."""
    text = io.StringIO()
    names = ["key", "method", *(name for name in Row.__dataclass_fields__ if name != "key")]
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        burns = " ".join(f"{x:.9g}" for x in row.burns_m_s)
        writer.writerow(asdict(row) | {"method": row.method, "burns_m_s": burns})
    return text.getvalue()


def to_markdown(rows: Sequence[Row]) -> str:
    """Claims, then a table per group."""
    parts = [
        "# Comparison of solvers",
        "",
        *(f"- {claim_line(claim)}" for claim in every_claim(rows)),
        "",
    ]
    for title, table, note in (
        ("Default scenario, every method", _matrix(of_group(rows, "matrix")), ""),
        ("P2 from the same P3 solution and facets", _scenarios(rows), SCENARIOS_NOTE),
        ("Random guesses", _guesses(rows), GUESSES_NOTE),
        ("Optima reached from random guesses", _optima(rows), ""),
        ("Exact risk against nonlinear programming", exact_table(rows), EXACT_NOTE),
        ("P3 by OpenSCvx, an outside peer", peer_table(rows), PEER_NOTE),
    ):
        parts += [f"## {title}", "", *table, "", *([note, ""] if note else [])]
    return "\n".join(parts)


def claim_line(claim: Claim) -> str:
    """A claim with its verdict."""
    verdict = {True: "holds", False: "DOES NOT HOLD", None: "not tested"}[claim.holds]
    return f"{verdict}: {claim.words}"


def _table(head: Sequence[str], body: Iterable[Sequence[str]]) -> list[str]:
    lines = [head, ["---"] * len(head), *body]
    return [f"| {' | '.join(line)} |" for line in lines]


def shown(row: Row) -> str:
    """A row's status as the tables print it."""
    words = row.detail if row.detail else row.status.replace("_", " ")
    if row.problem == "P3":
        words += " (P3)"
    return words + (", from the ballistic arc" if row.from_arc else "")


def _matrix(rows: Sequence[Row]) -> list[str]:
    head = (
        "start", "method", "status", "delta-v m/s", "merit m/s", "worst violation m",
        "P3 + P2 iterations", "total s", "processor s", "solver s", "peak MiB", "observes s",
    )  # fmt: skip
    return _table(
        head,
        (
            (
                row.start,
                row.method,
                shown(row),
                _figure(row.total_dv_m_s, ".6f"),
                _figure(row.merit_m_s, ".6f"),
                _figure(row.violation_m, ".1e"),
                f"{row.iterations_p3} + {row.iterations_p2}",
                _figure(row.total_s, ".2f"),
                _figure(row.cpu_s, ".2f"),
                _figure(row.solver_s, ".2f"),
                _figure(row.peak_mib, ".0f"),
                _figure(row.observed_s, ".0f"),
            )
            for row in rows
        ),
    )


def peer_table(rows: Sequence[Row]) -> list[str]:
    """P3 by OpenSCvx and by the planner."""
    return _matrix(of_group(rows, "peer"))


def _figure(value: float, form: str) -> str:
    return format(value, form) if np.isfinite(value) else "-"


def _scenarios(rows: Sequence[Row]) -> list[str]:
    found = {(row.scenario, row.method): row for row in of_group(rows, "scenarios")}
    methods = list(dict.fromkeys(row.method for row in of_group(rows, "scenarios")))
    verdicts = {a.scenario: a for a in agreements(rows)}
    head = ("scenario", *methods, "IPOPT over SCP less one", "verdict")
    body = []
    for scenario in dict.fromkeys(row.scenario for row in of_group(rows, "scenarios")):
        cells = [_scenario_cell(found.get((scenario, method))) for method in methods]
        a = verdicts.get(scenario)
        tail = (_figure(a.difference, "+.1e"), a.verdict) if a else ("-", "-")
        body.append((scenario, *cells, *tail))
    return _table(head, body)


def _scenario_cell(row: Row | None) -> str:
    """Delta-v where solved; the status and the merit of the second weight where not."""
    if row is None:
        return "-"
    if row.solved:
        return f"{row.total_dv_m_s:.6f} ({row.cpu_s:.2f} s)"
    return f"{shown(row)}, {_figure(row.heavy_merit_m_s, '.4f')} ({_figure(row.cpu_s, '.2f')} s)"


def _guesses(rows: Sequence[Row]) -> list[str]:
    head = (
        "method", "guesses", "solved at the first try", "95 % interval", "solved", "95 % interval",
        "at the best optimum", "95 % interval", "median processor s", "90th percentile",
        "best delta-v m/s",
    )  # fmt: skip
    best = best_of(of_group(rows, "guesses"))
    body = []
    for method, tries in _by_method(of_group(rows, "guesses")).items():
        solved = [row for row in tries if row.solved]
        at_once = [row for row in solved if row.solved_at_once]
        at_best = [row for row in solved if row.total_dv_m_s <= best * (1.0 + AGREE)]
        seconds = [row.cpu_s for row in tries]
        counts = (at_once, solved, at_best)
        shares = [proportion(len(count), len(tries)) for count in counts]
        cells = [
            (f"{100 * s.value:.0f} %", f"{100 * s.low:.0f} to {100 * s.high:.0f} %") for s in shares
        ]
        own = min((row.total_dv_m_s for row in solved), default=np.nan)
        body.append(
            (
                method,
                str(len(tries)),
                *(text for cell in cells for text in cell),
                _figure(float(np.median(seconds)), ".2f"),
                _figure(float(np.quantile(seconds, 0.9)), ".2f"),
                _figure(own, ".6f"),
            )
        )
    return _table(head, body)


def _by_method(rows: Iterable[Row]) -> dict[str, list[Row]]:
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row.method, []).append(row)
    return found


def _optima(rows: Sequence[Row]) -> list[str]:
    """How often each method ended where: total delta-v to four digits, by status."""
    guesses = _by_method(of_group(rows, "guesses"))
    ends = {
        method: [
            f"{row.status.replace('_', ' ')} {_figure(row.total_dv_m_s, '.4f')}" for row in tries
        ]
        for method, tries in guesses.items()
    }
    every = sorted({end for found in ends.values() for end in found})
    body = [(end, *(str(found.count(end) or "") for found in ends.values())) for end in every]
    return _table(("ends at (m/s)", *ends), body)
