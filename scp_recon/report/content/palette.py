"""Colours: Okabe and Ito 2008, told apart with any colour vision, on light and on dark ground."""

from __future__ import annotations

PLANS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Of plans laid over each other; of curves in one chart, too."""
DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot")
"""Beside the colours, for print without colour."""
FLIGHTS = ("#8fa9bb", "#c9a791", "#8cb8a9", "#bfa9b6", "#c2b28d", "#9db9c6")
"""Of the sampled flights of each plan: its colour, greyed."""
GREY = "#888888"
"""Of limits and whiskers: seen on light and on dark ground, and no plan's."""
BURN, SITE, SUN, VIEW, KEEP_IN, KEEP_OUT = (
    *("#CC79A7", "#E69F00", "#F0E442", "#56B4E9"),
    *("#009E73", "#D55E00"),
)
NIGHT_TO_DAY = [[0.0, "#23262e"], [0.499, "#3b3f4a"], [0.501, "#7c7466"], [1.0, "#f2e8d5"]]
"""Of the body's surface by the cosine of the incidence, -1 to 1: the terminator is a step."""
MODES = {"delta-V": "#CC79A7", "sun-pointing": "#E69F00", "observation": "#0072B2"}


def faint(colour: str, share: float) -> str:
    """The colour with an opacity."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{share:g})"
