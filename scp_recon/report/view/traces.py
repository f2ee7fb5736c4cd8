"""Plotly's traces of lines and surfaces in the 3-D view."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from scp_recon.report.content.numbers import compact, packed
from scp_recon.report.view.solids import Solid

Array = npt.NDArray[np.float64]
Trace = dict[str, Any]


def lines(points: Array, name: str, group: str, colour: str, **line: Any) -> Trace:
    """Through points (n, 3) in m, broken where there is NaN; `group` is shown and hidden as one."""
    x, y, z = compact(points.T, 1)
    return {
        "type": "scatter3d",
        "mode": "lines",
        "name": name,
        "x": x,
        "y": y,
        "z": z,
        "line": {"color": colour, "width": 3, **line},
        "hoverinfo": "name",
        "meta": {"group": group},
    }


def mesh(solid: Solid, name: str, group: str, colour: str, opacity: float) -> Trace:
    """A surface."""
    x, y, z = compact(solid.vertices_m.T, 1)
    i, j, k = map(packed, np.ascontiguousarray(solid.facets.T))
    return {
        "type": "mesh3d",
        "name": name,
        "x": x,
        "y": y,
        "z": z,
        "i": i,
        "j": j,
        "k": k,
        "color": colour,
        "opacity": opacity,
        "hoverinfo": "name",
        "lighting": {"ambient": 0.75, "diffuse": 0.35, "specular": 0.0},
        "meta": {"group": group},
    }


def moved(trace: Trace, moves: str, **more: Any) -> Trace:
    """With what the page has to know to move it."""
    trace["meta"] |= {"moves": moves, **more}
    return trace
