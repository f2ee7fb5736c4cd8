"""Draw measured durations against those of the schedule's rules."""

from __future__ import annotations

from matplotlib.figure import Figure

from paper_figs.drawing import legend, page
from paper_figs.inputs import Source, Tables, numbers

STEADY = "settled_0.25_deg_s"
"""Column of the slews' table whose largest entry the first rule is about."""

SOURCE = Source(
    "timing_rules",
    "python -m experiments timing_rules",
    {"timing_rules.csv": "measured_s", "timing_rules_slews.csv": STEADY},
)


def draw(found: Tables) -> Figure:
    """Measured durations against those of the schedule."""
    rules, half_turns = found
    with page(2.4) as figure:
        axes = figure.subplots()
        rows = range(len(rules))
        measured, allowed = (
            numbers(rules, column) / 60.0 for column in ("measured_s", "allowed_s")
        )
        slews = numbers(half_turns, STEADY) / 60.0
        axes.barh(rows, allowed, height=0.6, color="0.88", label="schedule")
        axes.plot(slews, [0.0] * len(slews), "|", ms=9, color="k", label="each half turn")
        for holds, colour in (("true", "k"), ("false", "tab:red")):
            chosen = [k for k in rows if rules[k]["holds"] == holds]
            label = "measured, holds" if holds == "true" else "measured, too long"
            axes.plot(measured[chosen], chosen, "o", color=colour, label=label)
        axes.set_yticks(rows, [f"{rule['name']}:\n{rule['how']}" for rule in rules])
        axes.set(xlabel="duration (min)", xlim=(0.0, None))
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")
        legend(figure, 4)
    return figure


def caption(found: Tables) -> str:
    """Describe the figure."""
    listed = [
        f"{rule['name']} ({rule['how']}) {float(rule['measured_s']) / 60.0:.1f} of "
        f"{float(rule['allowed_s']) / 60.0:.0f} min, "
        + ("holds" if rule["holds"] == "true" else "does not hold")
        for rule in found[0]
    ]
    return (
        "Durations of the schedule (bars) and as simulated with all errors (dots; strokes: each half "
        f"turn to steady state, an error that stays below 0.25 deg): {'; '.join(listed)}."
    )
