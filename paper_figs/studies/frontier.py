"""Draw delta-v against the required probability."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from scipy.special import ndtri

from paper_figs.drawing import legend, page
from paper_figs.inputs import Row, Source, numbers

SOURCE = Source("frontier", "python -m experiments frontier", {"frontier.csv": "total_dv_m_s"})
MARKS = {
    "uniform, paper polytopes": ("s-", "tab:red"),
    "uniform, tangent spheres": ("^-", "tab:orange"),
    "exact, each node": ("o-", "tab:blue"),
    "exact, whole flights": ("D-", "tab:green"),
    "certified, each node": ("o:", "tab:blue"),
    "certified, whole flights": ("D:", "tab:green"),
}
TICKS = (0.55, 0.7, 0.8, 0.9, 0.95, 0.99, 0.999)
FEW_TICKS = (0.55, 0.8, 0.95, 0.99, 0.999)


def draw(rows: list[Row]) -> Figure:
    """Delta-v, what certifying adds to it and the time observed, on the normal quantile scale."""
    with page(4.2) as figure:
        panels = figure.subplot_mosaic(
            [["dv", "more"], ["dv", "observed"]], width_ratios=(1.6, 1.0)
        )
        for kind, (mark, colour) in MARKS.items():
            chosen = [row for row in rows if row["kind"] == kind]
            required = ndtri(numbers(chosen, "asked"))
            dv, more, observed = (
                numbers(chosen, key)
                for key in ("total_dv_m_s", "certifying_dv_m_s", "observed_mean_s")
            )
            panels["dv"].plot(required, dv, mark, color=colour, ms=4, label=kind)
            panels["observed"].plot(required, observed, mark, color=colour, ms=3)
            if np.isfinite(more).any():
                panels["more"].plot(required, 100.0 * more / (dv - more), mark, color=colour, ms=3)
        for name, ticks in (("dv", TICKS), ("more", FEW_TICKS), ("observed", FEW_TICKS)):
            panels[name].set_xticks(ndtri(ticks), [f"{p:g}" for p in ticks])
        panels["dv"].set(xlabel="required probability (-)", ylabel="delta-v (m/s)")
        panels["more"].set(ylabel="certifying adds (%)")
        panels["observed"].set(xlabel="required probability (-)", ylabel="mean time observed (s)")
        legend(figure, 3)
    return figure


def caption(rows: list[Row]) -> str:
    """Describe the figure and its finding."""
    cost = {(row["kind"], float(row["asked"])): float(row["total_dv_m_s"]) for row in rows}
    kinds = ("uniform, paper polytopes", "exact, whole flights")
    paper, whole = (cost.get((kind, 0.9), float("nan")) for kind in kinds)
    return (
        "Delta-v of the default scenario against the required probability: uniform risk on polytopes, "
        "exact risk, and exact risk certified by flights; what certifying adds to the delta-v of "
        "targeting it itself; and the mean time observed. Missing points have no plan. "
        f"For 0.9 the paper's bookkeeping pays {paper:.4f} m/s at each node, exact risk {whole:.4f} "
        "m/s for whole flights."
    )
