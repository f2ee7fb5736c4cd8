"""A map of delta-v over departure and arrival, as a design tried it."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from scp_recon.pass_design.design import Tried


def draw(tried: Sequence[Tried]) -> bytes:
    """PNG: plans without uncertainty as squares, those with it as dots, the best as a star."""
    figure = Figure(figsize=(7.0, 5.6), layout="constrained", dpi=130)
    axes = figure.subplots()
    kept = [one for one in tried if one.found.converged and one.step != "certain"]
    costs = np.array([one.found.dv_m_s for one in kept])
    places = np.rad2deg([one.found.at.phases for one in kept]) % 360.0
    mapped = np.array([one.step == "map" for one in kept])
    colours = Normalize(costs.min(), costs.max())
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
    if not mapped.all():
        last = kept[-1].step
        final = [k for k, one in enumerate(kept) if one.step == last]
        best = min(final, key=lambda k: costs[k])
        label = f"{costs[best]:.6f} m/s ({last})"
        axes.plot(*places[best], "*", color="red", markersize=14, label=label)
        axes.legend(loc="upper right")
    figure.colorbar(squares, label="total delta-v, m/s; squares: without uncertainty")
    axes.set(xlabel="phase of departure, deg", ylabel="phase of arrival, deg")
    axes.set(xlim=(-20.0, 380.0), ylim=(-20.0, 380.0))
    picture = BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()
