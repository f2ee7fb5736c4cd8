"""Write pictures with Matplotlib: formats, metadata, legends; needs the extra [report].

The charts of commands and the figures of `paper_figs` use this module.
"""

from __future__ import annotations

from io import BytesIO
from typing import Any

from matplotlib.figure import Figure

WIDTH_IN = 7.0
"""Of a figure across the page."""

HOUR_S = 3600.0


def sheet(height_in: float, width_in: float = WIDTH_IN, dpi: float = 130) -> Figure:
    """An empty figure whose layout makes room for its labels."""
    return Figure(figsize=(width_in, height_in), layout="constrained", dpi=dpi)


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
    figure.savefig(rendered, format=ending[1:], metadata=metadata.get(ending), dpi=dpi)
    return rendered.getvalue()
