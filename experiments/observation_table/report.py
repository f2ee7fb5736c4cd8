"""The observation-time table as CSV and as Markdown."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence

from experiments.observation_table.claims import claims, differences, verdicts
from experiments.observation_table.rows import PRINTED_CLOSEST_M, PRINTED_WINDOW_S
from experiments.observation_table.runs import Failed, Measured
from scp_recon.monte_carlo.estimates import CONFIDENCE, Estimate

Cells = dict[str, str | float | int]


def record(entry: Measured | Failed) -> Cells:
    """A row of the CSV, SI; a failed one has no figures."""
    row = entry.row
    printed: Cells = {
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


def _ends(name: str, e: Estimate) -> Cells:
    """A value and its interval, whose ends may be missing."""
    return {
        name: e.value,
        f"{name}_low": e.low if e.low > -float("inf") else "",
        f"{name}_high": e.high if e.high < float("inf") else "",
    }


def to_csv(entries: Sequence[Measured | Failed]) -> str:
    """The table with everything in it, one line per row."""
    records = [record(entry) for entry in entries]
    columns = list(dict.fromkeys(name for r in records for name in r))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return text.getvalue()


def to_markdown(entries: Sequence[Measured | Failed]) -> str:
    """The table as the paper lays it out, what it does not have, and the comparison in words."""
    measured = [entry for entry in entries if isinstance(entry, Measured)]
    samples = ", ".join(sorted({str(m.summary.samples) for m in measured})) or "no"
    parts = [
        "# Observation times\n",
        f"{samples} flights a row with errors of the burns by component and the planner's dynamics; "
        f"in brackets the {100 * CONFIDENCE:.0f} % confidence interval. Observation time is the time "
        "in the window during which site distance, emission and phase are all within their limits, "
        'crossings bisected to 0.02 s and tallied in bins of 0.5 s. "Worst 1 sigma" is '
        "reached by all but 15.9 % of the flights.\n",
        _table(*_observation_times(entries)),
        "\n## What the paper's table does not have\n",
        "Closest approach: distance from the centre of mass, every 240 s at least, over the whole "
        "flight, which 0.3 % of the flights fall below; the paper prints one, "
        f"{PRINTED_CLOSEST_M} m. Joint probability: of the least probable joint constraint, and of "
        "all observation constraints at once, each at its least probable time.\n",
        _table(*_other_figures(entries)),
        "\n## Order\n",
        *(f"- {'Holds' if c.holds else 'Does not hold'}: {c.words}" for c in claims(entries)),
        "\n## Each row against the paper\n",
        *(f"- {sentence}" for sentence in differences(entries)),
        "\n## The paper's numbers\n",
        "Reproduced means: equal to the printed digit, or within the interval of the difference of "
        f"two runs of {samples} flights.\n",
        *(f"- {verdict}" for verdict in verdicts(entries)),
    ]
    return "\n".join(parts) + "\n"


def _observation_times(
    entries: Iterable[Measured | Failed],
) -> tuple[Sequence[str], list[Sequence[str]]]:
    header = (
        "row",
        "window (s)",
        "without uncertainty (s)",
        "mean (s)",
        "worst 1 sigma (s)",
        "paper: mean (s)",
        "paper: worst 1 sigma (s)",
    )
    lines: list[Sequence[str]] = []
    for entry in entries:
        row = entry.row
        printed = (f"{row.printed.mean_s:.0f}", f"{row.printed.worst_1_sigma_s:.0f}")
        if isinstance(entry, Failed):
            lines.append((row.label, f"failed: {entry.reason}", "", "", "", *printed))
            continue
        full = ", full window" if entry.full_at_1_sigma else ""
        lines.append(
            (
                row.label,
                f"{entry.window_s:.0f}",
                f"{entry.without_uncertainty_s:.0f}",
                shown(entry.mean, 0),
                shown(entry.worst_1_sigma, 0) + full,
                *printed,
            )
        )
    return header, lines


def _other_figures(
    entries: Iterable[Measured | Failed],
) -> tuple[Sequence[str], list[Sequence[str]]]:
    header = (
        "row",
        "closest at 0.3 % (m)",
        "total delta-v (m/s)",
        "lowest joint probability per node",
        "all at once",
        "mean on a uniform 232 s grid (s)",
        "design",
    )
    lines: list[Sequence[str]] = []
    for entry in entries:
        if isinstance(entry, Failed):
            lines.append((entry.row.label, "", "", "", "", "", "failed"))
            continue
        name, lowest = entry.lowest_joint
        lines.append(
            (
                entry.row.label,
                shown(entry.closest, 1),
                f"{entry.solution.total_dv_m_s:.5f}",
                f"{shown(lowest, 4)}, {name.replace('_', ' ')}",
                shown(entry.all_at_once, 4),
                f"{entry.summary.counted_on_uniform_grid.mean_s:.0f}",
                entry.status,
            )
        )
    return header, lines


def shown(e: Estimate, digits: int) -> str:
    """A value with its interval, if it has one."""
    if e.low == -float("inf") or e.high == float("inf"):
        return f"{e.value:.{digits}f}"
    return f"{e.value:.{digits}f} ({e.low:.{digits}f} to {e.high:.{digits}f})"


def _table(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    body = [header, ["---"] + ["---:"] * (len(header) - 1), *lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in body)
