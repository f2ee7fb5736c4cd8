"""What figures and pages of a campaign call what they show, and its colours and marks."""

from __future__ import annotations

from typing import Any

from scp_recon.campaign.view.outcome import INFEASIBLE, NO_ANSWER, NO_MISSION, NOT_VERIFIED
from scp_recon.report.content.palette import PLANS

DELTA_V, PROBABILITY = "total delta-v (m/s)", "lowest probability (-)"
COST, CHANCE = "total_dv_m_s", "probability"
MEASURES = ((COST, DELTA_V), (CHANCE, PROBABILITY))
"""Columns that are drawn, and what they are called. The probability is the lowest of the joint
constraints over the nodes, of 10,000 flights of the nonlinear dynamics."""
COLOURS = "viridis"
"""Colormap, here and in Plotly, that is told apart with any colour vision and holds no grey."""
UNITS = {
    "deg": "deg",
    "m": "m",
    "km": "km",
    "s": "s",
    "m_s": "m/s",
    "h": "h",
    "kg": "kg",
    "m2": "m^2",
    "w_m2": "W/m^2",
}
NAMED = {"tdb": "epoch (TDB)", "name": "site"}
MARKS = {INFEASIBLE: "x", NO_MISSION: ".", NOT_VERIFIED: "+", NO_ANSWER: "*"}
"""Of cases without a verified plan, in Matplotlib."""
GREYS = {INFEASIBLE: "#8b9098", NO_MISSION: "#bcc1c8", NOT_VERIFIED: PLANS[1], NO_ANSWER: PLANS[3]}
"""Their colours, of sites and of the surface about them."""


def told(value: Any) -> str:
    """A value of an entry in a legend; of an epoch its date and minute."""
    return value[:16] if isinstance(value, str) else f"{value:.3g}"


def label(entry: str) -> str:
    """An entry with its unit in brackets, without its section: `radius min (m)`."""
    key = entry.rpartition(".")[2]
    for ending in sorted(UNITS, key=len, reverse=True):
        if key.endswith(f"_{ending}"):
            return f"{key.removesuffix(f'_{ending}').replace('_', ' ')} ({UNITS[ending]})"
    if key in NAMED:
        return NAMED[key]
    return f"{key.replace('_', ' ')} (-)"
