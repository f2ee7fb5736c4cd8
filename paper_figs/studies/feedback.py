"""Draw the value of feedback over the probability and over the measurement's error."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from scipy.special import ndtri

from formulations.arrays import Array
from paper_figs.drawing import legend, page
from paper_figs.inputs import Row, Source

SOURCE = Source(
    "feedback",
    "python -m experiments feedback",
    {"feedback.csv": "dv99_m_s", "feedback_errors.csv": "program_m_s"},
)
OPEN = "open loop"
MARKS = {
    OPEN: ("s-", "tab:red"),
    "feedback": ("o-", "tab:blue"),
    "feedback, lead 1 h": ("o:", "tab:cyan"),
    "targeting gain": ("^--", "tab:orange"),
    "targeting gain, lead 1 h": ("v:", "tab:brown"),
    "feedback, limited at the end": ("D-", "tab:green"),
}
LOOKS = ("o-", "o--")
ROOM_MM_S = 1.0
"""Below and above all but the open loop, beside whose cost the others' differences would vanish."""
TICKS = (0.7, 0.9, 0.95, 0.99, 0.997, 0.999)
FEW_TICKS = (0.7, 0.9, 0.99, 0.999)
POSITION_M = 10.0
"""Error of the measurement that others are multiples of."""


def draw(tables: list[list[Row]]) -> Figure:
    """Delta-v's 99 % and the final dispersion by probability; the program's delta-v by error."""
    rows, errors = tables
    with page(4.4) as figure:
        panels = figure.subplot_mosaic([["dv", "end"], ["dv", "errors"]], width_ratios=(1.4, 1.0))
        for kind, (mark, colour) in MARKS.items():
            p, cost = curve(rows, kind, "asked", "dv99_m_s")
            panels["dv"].plot(ndtri(p), 1e3 * cost, mark, color=colour, ms=4, label=kind)
            p, sigma = curve(rows, kind, "asked", "final_sigma_m")
            panels["end"].plot(ndtri(p), sigma, mark, color=colour, ms=3)
        errors = [row for row in errors if row["scope"] == "flight"]
        for asked, look in zip(dict.fromkeys(row["asked"] for row in errors), LOOKS, strict=False):
            own = [row for row in errors if row["asked"] == asked]
            scale, cost = curve(own, "feedback", "scale", "program_m_s")
            label = f"program, for {asked}"
            panels["errors"].semilogx(
                POSITION_M * scale, 1e3 * cost, look, color="k", ms=3, label=label
            )
        for name, ticks in (("dv", TICKS), ("end", FEW_TICKS)):
            panels[name].set_xticks(ndtri(ticks), [f"{p:g}" for p in ticks])
            panels[name].set_xlabel("required probability of whole flights (-)")
        panels["dv"].set_ylabel("99 % quantile of delta-v (mm/s)")
        costs = [float(row["dv99_m_s"]) for row in rows if row["kind"] != OPEN and row["dv99_m_s"]]
        if costs:  # which a run that was stopped need not have
            panels["dv"].set_ylim(1e3 * min(costs) - ROOM_MM_S, 1e3 * max(costs) + ROOM_MM_S)
        panels["end"].set_ylabel("final dispersion (m)")
        panels["errors"].set(xlabel="error of the measured position (m)", ylabel="delta-v (mm/s)")
        legend(figure, 3)
    return figure


def curve(rows: list[Row], kind: str, x: str, y: str) -> tuple[Array, Array]:
    """Two columns of the rows of a kind that have figures, the cheapest of several, by the first."""
    own = [row for row in rows if row["kind"] == kind and row.get(y)]
    found = {
        float(row[x]): float(row[y]) for row in sorted(own, key=lambda row: -float(row["dv99_m_s"]))
    }
    return np.array(sorted(found)), np.array([found[at] for at in sorted(found)])


def caption(tables: list[list[Row]]) -> str:
    """Describe the figure and its finding."""
    cost = {
        (row["kind"], float(row["asked"])): float(row["dv99_m_s"] or "nan") for row in tables[0]
    }
    open_loop, corrected, targeted = (
        1e3 * cost.get((kind, 0.99), float("nan")) for kind in (OPEN, "feedback", "targeting gain")
    )
    return (
        "Left: 99 % of the commanded delta-v of plans of whole flights that flights have certified, "
        "against the required probability; the open loop's is what is planned, and leaves the panel. "
        "Above: 1 sigma of the final position, root of the summed variances. Below: 99 % of the "
        "delta-v by the program, not certified, over the error of the measured position; that of the "
        "velocity changes alike. "
        f"For 0.99 feedback costs {corrected:.1f} mm/s, the best scaled targeting gain "
        f"{targeted:.1f} mm/s and the open loop {open_loop:.1f} mm/s."
    )
