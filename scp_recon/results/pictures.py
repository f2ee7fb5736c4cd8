"""Write pictures with Matplotlib: formats, metadata, legends; needs the extra [report].

The charts of commands and the figures of `paper_figs` use this module.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import Any

from cycler import cycler
from matplotlib import rc_context
from matplotlib.figure import Figure

from scp_recon.display import COLOURS

WIDTH_IN = 7.0
"""Of a figure across the page."""

HOUR_S = 3600.0
STYLE = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.prop_cycle": cycler(color=COLOURS),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 9,
    "date.converter": "concise",
    "font.size": 9,
    "grid.color": "0.92",
    "hatch.linewidth": 0.6,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "pdf.fonttype": 42,
    "savefig.dpi": 200,
    "svg.hashsalt": "scp_recon",
}
"""Of all pictures; C0 to C5 are blue, vermilion, green, purple, orange and sky blue."""


@contextmanager
def page(height_in: float, width_in: float = WIDTH_IN) -> Iterator[Figure]:
    """Yield an empty figure in the common style, with room for its labels; draw within the context."""
    with rc_context(STYLE):
        yield Figure(figsize=(width_in, height_in), layout="constrained")


def plain(text: str) -> str:
    """A name escaped so that Matplotlib finds no formula in it."""
    return text.replace("$", r"\$")


def legend(figure: Figure, ncols: int, loc: str = "outside upper center", **look: Any) -> None:
    """Add one legend for all panels, each label once, beside the panels."""
    named = {
        label: handle
        for axes in figure.axes
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(list(named.values()), list(named), loc=loc, ncols=ncols, **look)


def endings() -> list[str]:
    """The file endings of picture formats, with their dots."""
    return [f".{name}" for name in Figure().canvas.get_supported_filetypes()]


def picture(
    figure: Figure, ending: str = ".png", *, plan_hash: str | None = None, dpi: float | None = None
) -> bytes:
    """A figure in the format of a file ending, with its dot; the same bytes every time.

    A plan's hash is kept in the metadata of PNG, PDF and SVG. Dots per inch are by default the
    figure's or the style's.
    """
    ending, plan = ending.lower(), f"plan {plan_hash}" if plan_hash else None
    metadata: dict[str, dict[str, str | None]] = {
        ".png": {"Description": plan} if plan else {},
        ".pdf": {"Keywords": plan, "CreationDate": None},
        ".svg": {"Description": plan, "Date": None},
    }
    rendered = BytesIO()
    with rc_context(STYLE):
        figure.savefig(rendered, format=ending[1:], metadata=metadata.get(ending), dpi=dpi)
    return rendered.getvalue()
