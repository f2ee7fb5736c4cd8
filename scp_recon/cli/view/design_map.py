"""A map of delta-v over departure and arrival, as a design tried it."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from scp_recon.pass_design.design import Tried
from scp_recon.pass_design.near import Found

COLOURS_TOLD = 6


def draw(tried: Sequence[Tried], found: Found) -> bytes:
    """PNG: plans without uncertainty as squares, those with it as dots, what was found as a star."""
    figure = Figure(figsize=(7.0, 5.6), layout="constrained", dpi=130)
    axes = figure.subplots()
    kept = [one for one in tried if one.found.converged and one.step != "certain"]
    costs = np.array([one.found.dv_m_s for one in kept])
    places = np.rad2deg([one.found.at.phases for one in kept]) % 360.0
    mapped = np.array([one.step == "map" for one in kept])
    colours = LogNorm(costs.min(), max(costs.max(), 1.01 * costs.min()))
    squares = axes.scatter(
        places[mapped, 0], places[mapped, 1], c=costs[mapped], marker="s", s=420, norm=colours
    )
    axes.scatter(
        places[~mapped, 0],
        places[~mapped, 1],
        c=costs[~mapped],
        s=14,
        edgecolors="white",
        norm=colours,
    )
    if found.converged:
        label = f"found: {found.dv_m_s:.6f} m/s"
        place = np.rad2deg(found.at.phases) % 360.0
        axes.plot(*place, "*", color="red", markeredgecolor="white", markersize=14, label=label)
        figure.legend(loc="outside upper center", frameon=False)
    bar = figure.colorbar(squares, label="total delta-v, m/s; squares: without uncertainty")
    bar.minorticks_off()
    between = np.geomspace(costs.min(), costs.max(), COLOURS_TOLD)
    bar.set_ticks(between.tolist(), labels=[f"{cost:.2g}" for cost in between])
    axes.set(xlabel="phase of departure, deg", ylabel="phase of arrival, deg")
    edges, ticks = (-25.0, 380.0), np.arange(0.0, 361.0, 60.0)
    axes.set(xlim=edges, ylim=edges, xticks=ticks, yticks=ticks)
    picture = BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()
