"""Make Plotly's marks for all pages: colours, numbers, panels, curves, maps, surfaces.

Colours are those of Okabe and Ito 2008, which readers with any colour vision can distinguish, on
light and on dark ground. Figures are plain dictionaries, as Plotly's script takes them, with as
many digits as are seen.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from formulations.arrays import Array, Indices
from scp_recon.display import COLOURS
from scp_recon.reports.surfaces import Solid

Trace = dict[str, Any]
Chart = dict[str, Any]
"""A key that is an identifier, title and note, and the data and layout of Plotly's figure."""

PLANS = COLOURS
"""Colours of overlaid plans, and of the curves in one chart."""
DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot")
"""Line styles that tell curves apart in print without colour."""
FLIGHTS = ("#8fa9bb", "#c9a791", "#8cb8a9", "#bfa9b6", "#c2b28d", "#9db9c6")
"""Colours of the sampled flights of each plan: the greyed colour of the plan."""
GREY = "#888888"
"""Colour of limits and whiskers, visible on light and on dark ground; no plan has this colour."""
BURN, SITE, SUN, VIEW, KEEP_IN, KEEP_OUT = (
    *("#CC79A7", "#E69F00", "#B58900", "#56B4E9"),
    *("#009E73", "#D55E00"),
)
BODY = "#b9b09e"
NIGHT_TO_DAY = [[0.0, "#23262e"], [0.499, "#3b3f4a"], [0.501, "#7c7466"], [1.0, "#f2e8d5"]]
"""Colours of the body by the cosine of the incidence, -1 to 1; the step is the terminator."""
MODES = {"delta-V": "#CC79A7", "sun-pointing": "#E69F00", "observation": "#0072B2"}

PLACES = ((1.0, "right"), (0.0, "left"), (0.5, "center"))
"""Positions across a panel (0 left, 1 right) for the names of limits, with text alignment."""
TIME = "time since the first burn (s)"
PANEL_PX, FOOT_PX, HEAD_PX, GAP_PX = 160, 56, 58, 42
"""Heights of a panel, of the margins below and above all panels, and of the gap between two."""
LEGEND = {"orientation": "h", "x": 0, "xanchor": "left", "yanchor": "bottom"}
"""Entries in a row, above the uppermost panel."""
LOGARITHMIC = {"type": "log", "exponentformat": "power", "nticks": 5}


ABOUT = {
    "flight": ("The flight, as it stands amid the observation window", ""),
    "observation": (
        "Constraints of the observation, in the window",
        "Line: planned mean. Bands: where 68.3 % and 95.4 % of the flights are. Dashed: limits.",
    ),
    "probability": (
        "Probability achieved over time",
        "Of sampled flights, with 95 % intervals. Shaded: observation window.",
    ),
    "ranges": (
        "Range to the surface and to the centre",
        "To the surface along the line to the centre. Bands: 1 and 3 sigma (99.7 %) of the sampled "
        "flights. Shaded: observation window.",
    ),
    "lighting": (
        "Incidence and local solar time at the site",
        "Certain: both follow from the body's rotation alone. Shaded: observation window.",
    ),
    "ground": (
        "Ground track and field of view",
        "Planned mean, body-fixed. Outlines: field of view at five times of the window, the camera "
        "pointed to the site. Ring: the time that the 3-D view shows.",
    ),
    "resolution": (
        "Resolution at the site, in the window",
        "Ground that a pixel sees at the site; along the slope it is stretched by the emission angle. "
        "Bands: 68.3 % and 95.4 % of the flights.",
    ),
    "timeline": (
        "Attitude modes under the burns",
        "Triangles: burns. Lines below them: where each may be moved, the others kept.",
    ),
    "budget": (
        "Delta-v of every burn",
        "Bars: planned. Whiskers: what 99 % of the executions stay below.",
    ),
    "knowledge": (
        "Dispersion and knowledge over time",
        "By the normal law: roots of the summed variances of the components. Corrections act from "
        "their burns on, measurements from their cut-offs on. Shaded: observation window.",
    ),
    "commanded": (
        "Delta-v with corrections",
        "Of the sampled flights, as their policy commands the burns.",
    ),
    "craft": (
        "Battery and pointing in the simulation",
        "One flight of the spacecraft's simulation. Shaded: observation window.",
    ),
    "convergence": ("Convergence", "Magnitudes. Hover names stage and iteration."),
}
"""Title of each chart of a plan, and the note below it."""


def labelled(plan: str, curve: str, alone: bool) -> str:
    """Name of a curve in the legend: after the plan's name, where several plans are overlaid."""
    return curve if alone else f"{plan}: {curve}"


def faint(colour: str, share: float) -> str:
    """The colour with an opacity."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{share:g})"


def compact(values: npt.ArrayLike, digits: int) -> Any:
    """Nested lists rounded to digits after the point; null where there is no number."""
    rounded = np.round(np.asarray(values, dtype=float), digits) + 0.0
    if digits <= 0:
        rounded = np.trunc(rounded)
    found, known = rounded.astype(object), np.isfinite(rounded)
    found[~known] = None
    return found.tolist()


def significant(values: npt.ArrayLike, digits: int = 6) -> list[float | None]:
    """A list rounded to significant digits; null where there is no number."""
    array = np.asarray(values, dtype=float)
    return [float(f"{x:.{digits}g}") if np.isfinite(x) else None for x in array.tolist()]


def packed(numbers: Indices) -> dict[str, str]:
    """Whole numbers from 0 to 2^32 - 1 as Plotly's typed array: half as long as their digits."""
    kind = "u2" if numbers.max(initial=0) < 2**16 else "u4"
    return {"dtype": kind, "bdata": base64.b64encode(numbers.astype(f"<{kind}").tobytes()).decode()}


def script(value: object) -> str:
    """JSON that may stand in a page's script: no tag can end it."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def chart(key: str, data: list[Trace], layout: dict[str, Any], title: str = "") -> Chart:
    """A chart as pages take it; title and note are those of `ABOUT` by default."""
    said, note = ABOUT.get(key, ("", ""))
    return {"key": key, "title": title or said, "note": note, "data": data, "layout": layout}


class Panels:
    """A chart of panels one above the other, numbered from the top, that share the x axis.

    The layout is Plotly's, with axes y, y2, ...
    """

    def __init__(
        self, titles: Sequence[str], x_title: str = TIME, panel_px: int = PANEL_PX
    ) -> None:
        """Begin a chart with a panel of that height for each title."""
        n = len(titles)
        inner = n * panel_px + (n - 1) * GAP_PX
        top = round(1.0 + 22.0 / inner, 6)
        self.data: list[Trace] = []
        self.layout: dict[str, Any] = {
            "height": inner + FOOT_PX + HEAD_PX,
            "margin": {"l": 55, "r": 16, "t": HEAD_PX, "b": FOOT_PX},
            "hovermode": "x",
            "legend": LEGEND | {"y": top},
            "xaxis": {"title": {"text": x_title}, "anchor": _axis(n - 1)},
            "shapes": [],
            "annotations": [],
        }
        self._panels = range(n)
        for i, title in enumerate(titles):
            top = round(1.0 - i * (panel_px + GAP_PX) / inner, 6)
            low = max(0.0, round(1.0 - (i * (panel_px + GAP_PX) + panel_px) / inner, 6))
            self.layout[_axis(i, "yaxis")] = {"domain": [low, top], "anchor": "x"}
            where = {"xref": "paper", "x": 0, "xanchor": "left", "yref": "paper", "y": top}
            self._write(f"<b>{title}</b>", where | {"name": _axis(i), "yanchor": "bottom"})

    def chart(self, key: str, title: str = "") -> Chart:
        """The chart as pages take it."""
        return chart(key, self.data, self.layout, title)

    def y_axis(self, panel: int, **entries: Any) -> None:
        """Set entries of a panel's axis."""
        self.layout[_axis(panel, "yaxis")] |= entries

    def curve(
        self, x: Any, y: Any, name: str, number: int, panel: int = 0, *, legend: bool = True,
        line: dict[str, Any] | None = None, **more: Any,
    ) -> None:  # fmt: skip
        """A line in the colour and dash of a number, but for what `line` has; broken at NaN.

        Lines of the same name are shown and hidden as one; `more` are entries of the trace.
        """
        style = {"color": PLANS[number], "dash": DASHES[number], "width": 2} | (line or {})
        trace = {
            "type": "scatter",
            "mode": "lines",
            "name": name,
            "legendgroup": name,
            "showlegend": legend,
            "x": significant(x, 8),
            "y": significant(y),
            "yaxis": _axis(panel),
            "line": style,
        }
        self.data.append(trace | more)

    def band(
        self, x: Any, edges: tuple[Any, Any], name: str, number: int, panel: int, shade: float,
        *, legend: bool,
    ) -> None:  # fmt: skip
        """Fill between two curves, in the colour of a number with an opacity."""
        filled: Trace = {"fill": "tonexty", "fillcolor": faint(PLANS[number], shade)}
        for y, more in zip(edges, (Trace(), filled), strict=True):
            named = legend and bool(more)
            self.curve(x, y, name, number, panel, legend=named, hoverinfo="skip", **more)
            self.data[-1]["line"] = {"width": 0}

    def limit(self, name: str, value: float, panel: int) -> None:
        """Draw a dashed line across a panel with its name, once; the name is on the allowed side.

        The names of a panel stand at different places across it, however close their lines are.
        """
        axis = _axis(panel)
        if any(s["yref"] == axis and s.get("y0") == value for s in self.layout["shapes"]):
            return
        line = {"color": GREY, "width": 2, "dash": "dash"}
        where = {"xref": "paper", "x0": 0, "x1": 1, "yref": axis, "y0": value, "y1": value}
        self.layout["shapes"].append({"type": "line", **where, "line": line})
        side = "top" if name.endswith(("most", "to")) else "bottom"
        named = sum(a.get("yref") == axis for a in self.layout["annotations"])
        across, anchor = PLACES[named % len(PLACES)]
        place = {"xref": "paper", "x": across, "xanchor": anchor, "yref": axis, "y": value}
        self._write(f"{name} {value:g}", place | {"yanchor": side, "font": {"size": 11}})

    def window(self, window_s: tuple[float, float]) -> None:
        """Mark the observation window behind all panels."""
        style = {"fillcolor": faint(PLANS[5], 0.16), "line": {"width": 0}, "layer": "below"}
        for panel in self._panels:
            across = {"xref": "x", "x0": window_s[0], "x1": window_s[1]}
            up = {"yref": f"{_axis(panel)} domain", "y0": 0, "y1": 1}
            self.layout["shapes"].append({"type": "rect", **across, **up, **style})

    def _write(self, text: str, where: dict[str, Any]) -> None:
        self.layout["annotations"].append({"text": text, "showarrow": False, **where})


def _axis(panel: int, letter: str = "y") -> str:
    return letter if panel == 0 else f"{letter}{panel + 1}"


def points(x: Any, y: Any, name: str, **marker: Any) -> Trace:
    """Markers on a chart."""
    return {"type": "scatter", "mode": "markers", "name": name, "x": x, "y": y, "marker": marker}


def whiskers(up: npt.ArrayLike, down: npt.ArrayLike, **style: Any) -> dict[str, Any]:
    """Error bars of different lengths above and below, shape (n,) each."""
    lengths = {"array": significant(up), "arrayminus": significant(down)}
    return {"type": "data", "symmetric": False, **lengths, **style}


def lines(points_m: Array, name: str, group: str, colour: str, **line: Any) -> Trace:
    """Through points (n, 3) in space, broken where there is NaN; `group` is shown and hidden as one."""
    xyz = dict(zip("xyz", compact(points_m.T, 1), strict=True))
    style = {"color": colour, "width": 3, **line}
    about = {"hoverinfo": "name", "meta": {"group": group}}
    return {"type": "scatter3d", "mode": "lines", "name": name, **xyz, "line": style, **about}


def spots(points_m: Array, name: str, group: str, **marker: Any) -> Trace:
    """Markers at points (n, 3) in space."""
    trace = lines(points_m, name, group, "")
    del trace["line"]
    return trace | {"mode": "markers", "marker": marker}


def mesh(solid: Solid, name: str, group: str, colour: str, opacity: float) -> Trace:
    """A surface in space."""
    xyz = dict(zip("xyz", compact(solid.vertices_m.T, 1), strict=True))
    corners = dict(zip("ijk", map(packed, np.ascontiguousarray(solid.facets.T)), strict=True))
    return {
        "type": "mesh3d",
        "name": name,
        **xyz,
        **corners,
        "color": colour,
        "opacity": opacity,
        "lighting": {"ambient": 0.75, "diffuse": 0.35, "specular": 0.0},
        "hoverinfo": "name",
        "meta": {"group": group},
    }


def moved(trace: Trace, moves: str, **more: Any) -> Trace:
    """A trace with the data by which the page's script moves it."""
    trace["meta"] |= {"moves": moves, **more}
    return trace


def map_axes(longitudes: tuple[float, float], margin_deg: float = 0.0) -> dict[str, Any]:
    """A layout's axes of longitude and latitude, with a line each 30 degrees."""
    return {
        "xaxis": {"title": {"text": "east longitude (deg)"}, "range": [*longitudes], "dtick": 30},
        "yaxis": {"range": [-90 - margin_deg, 90 + margin_deg], "dtick": 30},
    }
