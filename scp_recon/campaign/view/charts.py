"""The charts of a campaign's page as Plotly's figures; each point knows its case."""

from __future__ import annotations

from typing import Any

import numpy as np

from scp_recon.campaign.study.axes import EPOCH, LATITUDE, LONGITUDE
from scp_recon.campaign.view.figures import axes_of, cheapest
from scp_recon.campaign.view.labels import COLOURS, COST, DELTA_V, GREYS, MEASURES, label, told
from scp_recon.campaign.view.outcome import ENDS, FEASIBLE, CampaignResults
from scp_recon.environment.surface import direction_of
from scp_recon.report.content.numbers import compact, significant
from scp_recon.report.content.palette import DASHES, PLANS
from scp_recon.report.content.shape import shape_of
from scp_recon.report.panels import Trace, chart
from scp_recon.report.view.solids import Solid
from scp_recon.report.view.traces import mesh

SYMBOLS = {FEASIBLE: "circle"} | dict(
    zip(ENDS[1:], ("x", "circle-open", "cross", "diamond"), strict=True)
)
CURVES_MAX = 60
"""In one chart."""
LIFTED = 1.012
"""Of sites off the surface, so that it does not hide them."""
POINTS_PX, HEIGHT_PX, VIEW_PX = 11, 430, 560


def charts_of(results: CampaignResults) -> list[dict[str, Any]]:
    """A chart of sites and the shape, or one of each measure along the axes."""
    if results.is_map:
        return [map_chart(results.by_site), shape_chart(results.by_site)]
    return [curve_chart(results, *measure) for measure in MEASURES] if results.varies else []


def map_chart(results: CampaignResults) -> dict[str, Any]:
    """Sites by longitude and latitude, in the colour of their delta-v."""
    data = [
        trace
        | {
            "type": "scatter",
            "x": significant(rows[LONGITUDE].to_numpy(dtype=float) % 360.0),
            "y": significant(rows[LATITUDE]),
        }
        for trace, rows in _by_end(results, POINTS_PX)
    ]
    layout = {
        "height": HEIGHT_PX,
        "margin": {"l": 55, "r": 10, "t": 36, "b": 50},
        "xaxis": {"title": {"text": "east longitude (deg)"}, "range": [0, 360], "dtick": 30},
        "yaxis": {"title": {"text": "latitude (deg)"}, "range": [-92, 92], "dtick": 30},
        "legend": {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom"},
    }
    return chart("map", "Sites by latitude and longitude", data, layout)


def shape_chart(results: CampaignResults) -> dict[str, Any]:
    """The sites on the body's shape, body-fixed."""
    shape = shape_of(results.base)
    body = mesh(Solid(shape.vertices_m, shape.facets), "body", "body", "#b9b09e", 1.0)
    body |= {
        "hoverinfo": "skip",
        "lighting": {"ambient": 0.75, "diffuse": 0.4, "specular": 0.0, "fresnel": 0.0},
    }
    data: list[Trace] = [body]
    for trace, rows in _by_end(results, 6):
        at = np.array([direction_of(*s) for s in zip(rows[LATITUDE], rows[LONGITUDE], strict=True)])
        places = (LIFTED * shape.radius(at)[:, None] * at).reshape(-1, 3)
        xyz = {axis: compact(places[:, n], 1) for n, axis in enumerate("xyz")}
        data.append(trace | {"type": "scatter3d"} | xyz)
    hidden = {"visible": False}
    layout = {
        "height": VIEW_PX,
        "margin": {"l": 0, "r": 0, "t": 30, "b": 0},
        "legend": {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom"},
        "scene": {
            "aspectmode": "data",
            "xaxis": hidden,
            "yaxis": hidden,
            "zaxis": hidden,
            "camera": {"eye": {"x": 1.1, "y": 0.6, "z": 0.6}},
        },
    }
    return chart("shape", f"Sites on the shape ({shape.told})", data, layout)


def curve_chart(results: CampaignResults, column: str, name: str) -> dict[str, Any]:
    """A measure of the feasible cases along an axis, a curve for each value of the others."""
    along, *others = axes_of(results)
    by = [entry for entry in others if entry is not None]
    table = results.table[np.array(results.ends) == FEASIBLE]
    groups = [((), table)] if not by else list(table.groupby(by))
    shown = f", {CURVES_MAX} of {len(groups)} curves" if len(groups) > CURVES_MAX else ""
    scattered = results.scatters(along)
    data: list[Trace] = []
    for number, (values, rows) in enumerate(groups[:CURVES_MAX]):
        called = ", ".join(f"{label(e)} {told(v)}" for e, v in zip(by, values, strict=True))
        rows = cheapest(rows, along)
        x = rows[along]
        data.append(
            {
                "type": "scatter",
                "mode": "markers" if scattered else "lines+markers",
                "name": called or name,
                "showlegend": bool(by),
                "x": x.tolist() if along == EPOCH else significant(x),
                "y": significant(rows[column]),
                "customdata": rows["case"].tolist(),
                "line": {
                    "color": PLANS[number % len(PLANS)],
                    "dash": DASHES[number // len(PLANS) % len(DASHES)],
                },
            }
        )
    layout = {
        "height": HEIGHT_PX,
        "margin": {"l": 65, "r": 10, "t": 20, "b": 50},
        "xaxis": {"title": {"text": label(along)}},
        "yaxis": {"title": {"text": name}},
    }
    return chart(column, f"{name} of the feasible cases{shown}", data, layout)


def _by_end(results: CampaignResults, size: int) -> list[tuple[Trace, Any]]:
    """Markers of the cases that ended alike, without their places, and their rows."""
    ends, found = np.array(results.ends), []
    for end in ENDS:
        rows = results.table[ends == end]
        if not len(rows):
            continue
        marker: dict[str, Any] = {"symbol": SYMBOLS[end], "size": size}
        if end == FEASIBLE:
            bar = {"title": {"text": DELTA_V, "side": "right"}}
            line = {"color": "#333333", "width": 0.5}
            marker |= {"color": significant(rows[COST]), "colorscale": COLOURS.capitalize()}
            marker |= {"showscale": True, "colorbar": bar, "line": line}
        else:
            marker |= {"color": GREYS[end], "size": size * 0.7}
        trace: Trace = {
            "mode": "markers",
            "name": f"{end}: {len(rows)}",
            "marker": marker,
            "customdata": rows["case"].tolist(),
            "text": [_hover(row) for row in rows.to_dict("records")],
            "hoverinfo": "text",
        }
        found.append((trace, rows))
    return found


def _hover(row: dict[str, Any]) -> str:
    name = row.get("site.name") or f"{row[LATITUDE]:g}, {row[LONGITUDE]:g} deg"
    if row[COST] == row[COST] and row[COST] is not None:
        return f"case {row['case']}, {name}: {row[COST]:.4f} m/s"
    binds = row.get("binds")
    return f"case {row['case']}, {name}: {row['status']} {binds if isinstance(binds, str) else ''}"
