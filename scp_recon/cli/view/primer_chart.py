"""The primer's history of a plan as a picture."""

from __future__ import annotations

from io import BytesIO

import numpy as np
from matplotlib.figure import Figure

from scp_recon.solution.primer import Primer

HOUR_S = 3600.0


def draw(primer: Primer, burns_s: list[float]) -> bytes:
    """PNG: size and allowed part over time, legal times shaded, the burns that are there as lines.

    Args:
        primer: of a solution.
        burns_s: times of its burns.
    """
    figure = Figure(figsize=(7.0, 4.2), layout="constrained", dpi=130)
    axes = figure.subplots()
    hours, legal = np.array(primer.t_s) / HOUR_S, np.array(primer.legal)
    top = 1.05 * max(1.0, *np.linalg.norm(primer.vector, axis=1))
    axes.fill_between(
        hours, 0.0, top, where=legal.tolist(), color="0.88", label="another burn is legal"
    )
    for number, time in enumerate(burns_s):
        label = "burns of the plan" if number == 0 else None
        axes.axvline(time / HOUR_S, color="tab:red", lw=1.0, ls=":", label=label)
    axes.axhline(1.0, color="black", lw=0.8)
    sizes = np.linalg.norm(primer.vector, axis=1)
    axes.plot(hours, sizes, color="tab:blue", lw=1.0, ls="--", label="in any direction")
    axes.plot(
        hours, primer.allowed, color="tab:blue", label="in directions off the battery's cones"
    )
    axes.set(
        xlabel="time past the epoch, h", ylabel="delta-v saved per delta-v of a small burn more"
    )
    axes.set(ylim=(0.0, top))
    axes.margins(x=0.01)
    figure.legend(loc="outside upper center", ncols=2, fontsize="small", frameon=False)
    picture = BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()
