"""The table of observation times as the paper prints it.

By itself: `python -m paper_figs.paper.observation_table`.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint

if __name__ == "__main__":
    exit_on_sigint()

import sys
from collections.abc import Sequence

from paper_figs.drawing import command
from paper_figs.inputs import Runs

HEADER = (
    "method",
    "window (s)",
    "without uncertainty (s)",
    "mean (s)",
    "worst 1 sigma (s)",
    "paper: mean (s)",
    "paper: worst 1 sigma (s)",
)


def table(runs: Runs) -> str:
    """Markdown, the paper's columns with the paper's values beside ours."""
    lines = [HEADER, ("---", *["---:"] * (len(HEADER) - 1)), *map(_line, runs.table)]
    body = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"# Observation times\n\n{body}\n\n{caption(runs)}\n"


def _line(row: dict[str, str]) -> Sequence[str]:
    printed = (_rounded(row["paper_mean_s"]), _rounded(row["paper_worst_1_sigma_s"]))
    if not row["mean_s"]:
        return (row["label"], row["status"], "", "", "", *printed)
    return (
        row["label"],
        _rounded(row["window_s"]),
        _rounded(row["without_uncertainty_s"]),
        _with_interval(row, "mean_s"),
        _with_interval(row, "worst_1_sigma_s"),
        *printed,
    )


def _with_interval(row: dict[str, str], name: str) -> str:
    low, high = row[f"{name}_low"], row[f"{name}_high"]
    value = _rounded(row[name])
    return f"{value} ({_rounded(low)} to {_rounded(high)})" if low and high else value


def _rounded(number: str) -> str:
    return f"{float(number):.0f}"


def caption(runs: Runs) -> str:
    """What the table shows."""
    samples = sorted({row["samples"] for row in runs.table if row["samples"]})
    return (
        f"Observation times of {', '.join(samples)} flights a row with their 95 % confidence "
        "intervals, the paper's printed values on the right. Worst 1 sigma is reached by all but "
        "15.9 % of the flights."
    )


if __name__ == "__main__":
    sys.exit(command(table, __doc__))
