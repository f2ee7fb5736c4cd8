"""Compute the paper's table of observation times.

Every row's burns are designed and flown many times; solution.json and montecarlo.json are written to
OUT/<row>/, the table to OUT/observation_table.csv, and the paper's statements and numbers, each tested
(docs/validation/statements.toml), to OUT/statements.csv and numbers.csv. After a stop the study
continues with the missing rows. With --as-flown FILE there is a row for the real flight, and the warm
rows start from it, as the paper's do; without it they start from the ballistic arc.
"""

from __future__ import annotations

import operator
import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from experiments.evidence import ROOT
from experiments.harness import Findings, Record, Session, Study, default_mission, option
from experiments.observation_rows import Row, about, flown_states, rows, run_row, variants
from scp_recon.jobs.job import Job

STATEMENTS = ROOT / "docs" / "validation" / "statements.toml"
SAMPLES = 10_000
ROW_FAILED = 4
TWO_RUNS = 2.0**0.5
"""The paper's figures come from as many samples as ours: its interval adds to ours."""
OUTCOMES = {True: "same", False: "opposite", None: "not comparable"}
TESTS: Mapping[str, Callable[[float, float], bool]] = {
    "at_least": operator.ge,
    "above": operator.gt,
    "at_most": operator.le,
    "below": operator.lt,
}
"""Names of thresholds."""
PAPER, SETTLED = "scp_cold", "settled"
"""Rows of the plan with facets chosen once, as in the paper, and of the plan with settled facets."""
OTHER_PLANS = ("scp_warm", "ipopt_cold", "cones_24", "facets_again", "spread_printed")
"""Rows with facets chosen once too; statements that compare these say nothing of settled facets."""
Rows = Sequence[Record]


def statements(entries: Rows) -> list[Record]:
    """Every statement whose rows have been computed: its columns, with text and outcome filled in.

    `settled` says the same of the plan whose facets are settled, where a statement is of the plan with
    the paper's facets.
    """
    given = tomllib.loads(STATEMENTS.read_text("utf-8"))["statement"]
    by_key = {row["row"]: SimpleNamespace(**row) for row in entries if "mean_s" in row}
    others = by_key | {PAPER: by_key[SETTLED]} if SETTLED in by_key else {}
    found = []
    for each in given:
        try:
            measured = each["measured"].format(**by_key)
            same = outcome(each, by_key)
        except (KeyError, NameError):  # of a row that was not computed
            continue
        if each.get("unless") not in by_key:
            words = {key: each[key] for key in ("paper", "statement", "criterion")}
            end = {"measured": measured, "outcome": OUTCOMES[same], "why": each.get("why", "")}
            settled = each["measured"].format(**others) if others else measured
            alone = not any(f"{key}." in f"{each}" for key in OTHER_PLANS)
            told = alone and settled != measured
            again = f"{settled}: {OUTCOMES[outcome(each, others)]}" if told else ""
            found.append({**words, **end, "settled": again})
    return found


def outcome(statement: Mapping[str, Any], by_key: Mapping[str, SimpleNamespace]) -> bool | None:
    """Whether a statement's quantity meets its threshold; None where that is not decided.

    Raises:
        NameError: if the quantity names a row that was not computed.
    """
    quantity = statement.get("quantity")
    if quantity is None:
        return None
    name, threshold = next((name, statement[name]) for name in TESTS if name in statement)
    functions = {"abs": abs, "max": max, "min": min}
    ends = [eval(quantity, {"__builtins__": functions}, dict(by_key))]
    row, _, column = quantity.partition(".")
    if row in by_key and hasattr(by_key[row], f"{column}_low"):
        ends = [getattr(by_key[row], f"{column}_{end}") for end in ("low", "high")]
    met = {TESTS[name](float(end), threshold) for end in ends if end != ""}
    return met.pop() if len(met) == 1 else None


def numbers(entries: Rows) -> list[Record]:
    """The paper's numbers beside ours, and whether each is reproduced."""
    given = tomllib.loads(STATEMENTS.read_text("utf-8"))["number"]
    by_key = {row["row"]: row for row in entries if "mean_s" in row}
    found = []
    for each in given:
        ours = [by_key[key] for key in each["rows"] if key in by_key]
        column, printed = each["column"], each["printed"]
        agree = [row["row"] for row in ours if agrees(row, column, printed)]
        every = bool(ours) and len(agree) == len(ours)
        some = f"by {', '.join(agree)} alone" if agree else "no"
        digits = 1 if column.endswith("_m") or column == "window_s" else 0
        found.append(
            {
                "number": each["number"],
                "printed": printed,
                "ours": ", ".join(f"{row['row']} {row[column]:.{digits}f}" for row in ours),
                "reproduced": "yes" if every else some,
                "why_not": "" if every else each.get("why", ""),
            }
        )
    return found


def agrees(row: Record, column: str, printed: float) -> bool:
    """Whether a number agrees to the printed digit, or within the interval of two such runs."""
    off = abs(row[column] - printed)
    end = row.get(f"{column}_high" if printed > row[column] else f"{column}_low", "")
    return bool(off < 0.5 or (end != "" and off <= TWO_RUNS * abs(end - row[column])))


def measure(out: Path, row: Row) -> Record:
    """A row of the table; a failure in one does not stop the others."""
    try:
        return run_row(row, out / row.key, SAMPLES)
    except Exception as error:  # a solver's, a file system's: the row says which
        return about(row, f"failed: {type(error).__name__}: {' '.join(str(error).split())[:200]}")


def run(session: Session) -> Findings:
    """Design and fly every row."""
    kernel = session.options.as_flown
    if kernel:
        flown_states(kernel, default_mission())  # before the work, not after it
    cases = [*rows(as_flown=kernel), *variants(default_mission().scenario)]
    store = session.store(samples=SAMPLES, kernel=str(kernel))
    jobs = [Job(row.key, row) for row in cases]
    entries = session.rows("rows", partial(measure, session.out), jobs, store)
    tables = {
        "observation_table": entries,
        "statements": statements(entries),
        "numbers": numbers(entries),
    }
    whole = all("mean_s" in row for row in entries)
    return Findings(tables, status=0 if whole else ROW_FAILED)


AS_FLOWN = option(
    "--as-flown",
    type=Path,
    metavar="FILE",
    help="SPK of the flight, for a row of its own and as the warm rows' start; needs the extra [spice]",
)
STUDY = Study(__doc__, run, [AS_FLOWN], folder="paper")
