"""Charts of panels one above the other with one time axis: what most of the report's charts are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from scp_recon.report.content import palette
from scp_recon.report.content.histories import Bound, History
from scp_recon.report.content.numbers import significant

Trace = dict[str, Any]

TIME = "time since the first burn (s)"
PANEL_PX, FOOT_PX, HEAD_PX = 160, 56, 58
GAP_PX = 42
"""Of panels, of what is below and above all of them, and between them; words stand there."""
SHADES = {1: 0.34, 2: 0.2, 3: 0.14}
"""Opacity of a band by its sigmas."""
WORDS = {1: "1 sigma of the flights", 2: "2 sigma", 3: "3 sigma"}


def chart(key: str, title: str, data: list[Trace], layout: dict[str, Any]) -> dict[str, Any]:
    """As the page takes it: a key that is an identifier, what it shows, and Plotly's figure."""
    return {"key": key, "title": title, "data": data, "layout": layout}


def stacked(titles: Sequence[str], x_title: str = TIME, panel_px: int = PANEL_PX) -> dict[str, Any]:
    """A layout of panels from the top down, with axes y, y2, ... that share x; each has its heading."""
    n = len(titles)
    inner = n * panel_px + (n - 1) * GAP_PX
    layout: dict[str, Any] = {
        "height": inner + FOOT_PX + HEAD_PX,
        "margin": {"l": 55, "r": 16, "t": HEAD_PX, "b": FOOT_PX},
        "hovermode": "x",
        "legend": {
            "orientation": "h",
            "x": 0,
            "xanchor": "left",
            "y": round(1.0 + 22.0 / inner, 6),
            "yanchor": "bottom",
        },
        "xaxis": {"title": {"text": x_title}, "anchor": axis_name("y", n - 1)},
        "shapes": [],
        "annotations": [],
    }
    for i, title in enumerate(titles):
        top = 1.0 - i * (panel_px + GAP_PX) / inner
        layout[_key("y", i)] = {
            "domain": [max(0.0, round(top - panel_px / inner, 6)), round(top, 6)],
            "anchor": "x",
        }
        layout["annotations"].append(
            {
                "text": f"<b>{title}</b>",
                "name": axis_name("y", i),
                "showarrow": False,
                "xref": "paper",
                "x": 0,
                "xanchor": "left",
                "yref": "paper",
                "y": round(top, 6),
                "yanchor": "bottom",
            }
        )
    return layout


def axis_name(letter: str, panel: int) -> str:
    """What traces call a panel's axis."""
    return letter if panel == 0 else f"{letter}{panel + 1}"


def _key(letter: str, panel: int) -> str:
    return f"{letter}axis" if panel == 0 else f"{letter}axis{panel + 1}"


def curve(
    x: Any, y: Any, name: str, number: int, panel: int = 0, *, legend: bool = True, **line: Any
) -> Trace:
    """A line in the colour and dash of a number."""
    style = {"color": palette.PLANS[number], "dash": palette.DASHES[number], "width": 2}
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "legendgroup": name,
        "showlegend": legend,
        "x": significant(x, 8),
        "y": significant(y),
        "yaxis": axis_name("y", panel),
        "line": style | line,
    }


def band(
    x: Any,
    edges: tuple[Any, Any],
    name: str,
    number: int,
    panel: int,
    shade: float,
    *,
    legend: bool,
) -> list[Trace]:
    """What lies between two curves."""
    shared = {
        "type": "scatter",
        "mode": "lines",
        "x": significant(x, 8),
        "yaxis": axis_name("y", panel),
        "legendgroup": name,
        "name": name,
        "hoverinfo": "skip",
        "line": {"width": 0},
    }
    colour = palette.faint(palette.PLANS[number], shade)
    low = shared | {"y": significant(edges[0]), "showlegend": False}
    high = shared | {"y": significant(edges[1]), "showlegend": legend}
    return [low, high | {"fill": "tonexty", "fillcolor": colour}]


def limit_line(layout: dict[str, Any], bound: Bound, panel: int) -> None:
    """Enter a dashed line across a panel, with its name, once."""
    axis = axis_name("y", panel)
    shapes = layout["shapes"]
    if any(s["yref"] == axis and s.get("y0") == bound.value for s in shapes):
        return
    shapes.append(
        {
            "type": "line",
            "xref": "paper",
            "x0": 0,
            "x1": 1,
            "yref": axis,
            "y0": bound.value,
            "y1": bound.value,
            "line": {"color": palette.GREY, "width": 2, "dash": "dash"},
        }
    )
    words = {"text": f"{bound.name} {bound.value:g}", "xref": "paper", "x": 1, "xanchor": "right"}
    place = {"yref": axis, "y": bound.value, "yanchor": _beside(bound), "showarrow": False}
    layout["annotations"].append(words | place | {"font": {"size": 11}})


def _beside(bound: Bound) -> str:
    """A greatest value is named below its line, a least one above: inside what is allowed."""
    return "top" if bound.name.endswith(("most", "to")) else "bottom"


def shade_window(layout: dict[str, Any], window_s: tuple[float, float], panels: int) -> None:
    """Mark the observation window behind all panels."""
    for panel in range(panels):
        layout["shapes"].append(
            {
                "type": "rect",
                "xref": "x",
                "x0": window_s[0],
                "x1": window_s[1],
                "yref": f"{axis_name('y', panel)} domain",
                "y0": 0,
                "y1": 1,
                "fillcolor": palette.faint(palette.PLANS[5], 0.16),
                "line": {"width": 0},
                "layer": "below",
            }
        )


def history_chart(
    key: str,
    title: str,
    named: Sequence[tuple[str, Sequence[History]]],
    window_s: tuple[float, float] | None = None,
) -> dict[str, Any]:
    """Panels of histories, those of several plans laid over each other.

    Args:
        key: of the chart.
        title: of it.
        named: plans by name, each with a history per panel.
        window_s: to be marked.
    """
    first = named[0][1]
    layout = stacked([history.title for history in first])
    alone, data = len(named) == 1, []
    if window_s is not None:
        shade_window(layout, window_s, len(first))
    for number, (name, histories) in enumerate(named):
        for panel, history in enumerate(histories):
            for sigmas in sorted(history.bands, reverse=True):
                said = WORDS[sigmas] if alone else f"{name}: {WORDS[sigmas]}"
                if not alone and sigmas != max(history.bands):
                    continue
                data += band(
                    history.times_s,
                    history.bands[sigmas],
                    said,
                    number,
                    panel,
                    SHADES[sigmas],
                    legend=panel == 0,
                )
            shown = "plan" if alone else name
            data.append(
                curve(history.times_s, history.planned, shown, number, panel, legend=panel == 0)
            )
            for bound in history.bounds:
                limit_line(layout, bound, panel)
    return chart(key, title, data, layout)
