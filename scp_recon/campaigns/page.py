"""Write a campaign's page, campaign.html, which works without a network, and give its charts.

The page has maps or curves, and a table in which each case opens. An unfinished campaign is shown
with the cases that have ended. A button above each chart saves it as a PNG file.
"""

from __future__ import annotations

from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scp_recon.bodies.surface import direction_of
from scp_recon.campaigns.axes import EPOCH, LATITUDE, LONGITUDE, solution_name
from scp_recon.campaigns.outcome import (
    CHANCE,
    COLOURS,
    COST,
    ENDS,
    FEASIBLE,
    GREYS,
    SHORTFALLS,
    CampaignResults,
    in_words,
    label,
    remarks,
)
from scp_recon.campaigns.run import OWN
from scp_recon.files import PAGE as MADE
from scp_recon.files import check_own, write_atomically, writing
from scp_recon.reports.marks import (
    BODY,
    DASHES,
    PLANS,
    Trace,
    chart,
    compact,
    map_axes,
    mesh,
    significant,
)
from scp_recon.reports.page import made_by, render_offline
from scp_recon.reports.surfaces import shape_of
from scp_recon.reports.write import check_extra, figures_of
from scp_recon.results.table import Column

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

PAGE = "campaign.html"
EXTRA = ("jinja2", "pandas", "plotly")
ROWS_MAX = 5_000
"""Cases in the page's table."""
SYMBOLS = {FEASIBLE: "circle"} | dict(
    zip(ENDS[1:], ("x", "circle-open", "cross", "diamond"), strict=True)
)
CURVES_MAX = 60
"""Most curves in one chart."""
LIFTED = 1.012
"""Scale that lifts sites off the surface, so that it does not hide them."""
POINTS_PX, HEIGHT_PX, VIEW_PX = 11, 430, 560
ABOVE = {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom"}
"""Where the legend of sites is."""
BAR_PX, LINE_PX = 38, 30
"""Heights of Plotly's buttons at the top, which nothing may be below, and of a legend's line."""


def has_extras() -> bool:
    """Whether the extra for the page is installed."""
    return all(find_spec(name) is not None for name in EXTRA)


def write_page(results: CampaignResults) -> Path:
    """Write the page of a campaign into the campaign's folder, and return the file.

    Raises:
        InputError: if the extra [report] is missing, or the folder cannot be written.
    """
    check_extra()
    check_own(results.folder / PAGE, "DIR", MADE)
    with writing(results.folder, "DIR"):
        return write_atomically(results.folder / PAGE, render(results, datetime.now(UTC)))


def figures(results: CampaignResults) -> dict[str, Figure]:
    """The page's charts by name, as figures of Plotly; none if no axis has numbers."""
    return figures_of(charts_of(results))


def render(results: CampaignResults, made: datetime) -> str:
    """The page as one self-contained HTML file."""
    charts = charts_of(results)
    names = [label(entry) for entry in shown(results)]
    done = len(results.table)
    return render_offline(
        "campaign.html",
        ("campaign.js",),
        charts,
        "scp_recon.campaigns",
        title=f"{results.campaign.do}, {results.base.name}: {', '.join(names) or 'one case'}",
        feasible=results.feasible,
        verdict=results.verdict,
        lines=remarks(results),
        identity=made_by(made),
        charts=charts,
        heading=["end", *names, *(name for _, name in results.measures), "limit broken most"],
        left_out=f"The first {ROWS_MAX:,} of {done:,}; results.parquet has all."
        * (done > ROWS_MAX),
        rows=[line_of(results, place) for place in order(results)[:ROWS_MAX]],
    )


def shown(results: CampaignResults) -> list[str]:
    """Entries shown in the table: all that change, except epochs that follow from a site."""
    return [e for e in results.entries if not (results.is_map and e == EPOCH)]


def order(results: CampaignResults) -> list[int]:
    """Order of the rows: feasible ones by cost, then the others by case."""
    costs = results.table[COST].to_numpy(dtype=float)
    good = np.array(results.ends) == FEASIBLE
    found: list[int] = np.lexsort((np.where(good, costs, 0.0), ~good)).tolist()
    return found


def line_of(results: CampaignResults, place: int) -> dict[str, Any]:
    """A row as the page holds it: cells, and the details shown when it is opened."""
    (row,) = results.table.iloc[[place]].dropna(axis="columns").to_dict("records")
    number = int(row["case"])
    columns = [*shown(results), *(column for column, _ in results.measures), "binds"]
    solution = Path(solution_name(number))
    report = solution.with_name("report.html")
    said = (row.get(column) for column in ("message", *SHORTFALLS, "warnings"))
    own = [c for c in OWN[results.campaign.do] if c not in SHORTFALLS and c in row]
    return {
        "number": number,
        "end": results.ends[place],
        "cells": [Column(name).cell(row.get(name)) for name in columns],
        "message": " ".join(filter(None, said)),
        "found": "; ".join(f"{name} {Column(name).cell(row[name]).text}" for name in own),
        "report": report.as_posix() if (results.folder / report).is_file() else None,
        "solution": solution.parent.as_posix() if (results.folder / solution).is_file() else None,
        "changes": "; ".join(f"{entry} = {row.get(entry)}" for entry in (*results.entries, "seed")),
    }


def charts_of(results: CampaignResults) -> list[dict[str, Any]]:
    """Maps of each measure and the sites on the shape, or each measure along the axes."""
    if results.is_map:
        sites = results.by_site
        return [*(map_chart(sites, *measure) for measure in sites.measures), shape_chart(sites)]
    return (
        [curve_chart(results, *measure) for measure in results.measures] if results.varies else []
    )


def map_chart(results: CampaignResults, column: str, name: str) -> dict[str, Any]:
    """Sites by longitude and latitude, in the colour of a measure."""
    data = [
        trace
        | {
            "type": "scatter",
            "x": significant(rows[LONGITUDE].to_numpy(dtype=float) % 360.0),
            "y": significant(rows[LATITUDE]),
        }
        for trace, rows in _by_end(results, POINTS_PX, column, name)
    ]
    axes = map_axes((0, 360), margin_deg=2)
    axes["yaxis"]["title"] = {"text": "latitude (deg)"}
    margin = {"l": 55, "r": 10, "t": BAR_PX + LINE_PX, "b": 50}
    layout = {"height": HEIGHT_PX, "margin": margin, **axes, "legend": ABOVE}
    title = f"{name.capitalize()} by latitude and longitude"
    return chart(f"map_{column}", data, layout, title)


def shape_chart(results: CampaignResults) -> dict[str, Any]:
    """The sites on the body's shape, body-fixed."""
    shape = shape_of(results.base)
    body = mesh(shape, "body", "body", BODY, 1.0) | {
        "hoverinfo": "skip",
        "lighting": {"ambient": 0.75, "diffuse": 0.4, "specular": 0.0, "fresnel": 0.0},
    }
    data: list[Trace] = [body]
    for trace, rows in _by_end(results, 6, *results.measures[0]):
        at = np.array([direction_of(*s) for s in zip(rows[LATITUDE], rows[LONGITUDE], strict=True)])
        places = (LIFTED * shape.radius(at)[:, None] * at).reshape(-1, 3)
        data.append(
            trace | {"type": "scatter3d"} | dict(zip("xyz", compact(places.T, 1), strict=True))
        )
    hidden = {f"{axis}axis": {"visible": False} for axis in "xyz"}
    camera = {"eye": {"x": 1.1, "y": 0.6, "z": 0.6}}
    layout = {
        "height": VIEW_PX,
        "margin": {"l": 0, "r": 0, "t": BAR_PX + LINE_PX, "b": 0},
        "legend": ABOVE,
        "scene": {"aspectmode": "data", **hidden, "camera": camera},
    }
    return chart("shape", data, layout, f"Sites on the shape ({shape.description})")


def curve_chart(results: CampaignResults, column: str, name: str) -> dict[str, Any]:
    """Curves of a measure of the feasible cases along an axis, one for each value of the others."""
    along, *by = results.axes
    table = results.ending(FEASIBLE)
    groups = [((), table)] if not by else list(table.groupby(by))
    shown = f", {CURVES_MAX} of {len(groups)} curves" if len(groups) > CURVES_MAX else ""
    scattered = results.scatters(along)
    data: list[Trace] = []
    for number, (values, rows) in enumerate(groups[:CURVES_MAX]):
        called = ", ".join(f"{label(e)} {in_words(v)}" for e, v in zip(by, values, strict=True))
        rows = rows.sort_values(COST).drop_duplicates(along).sort_values(along)
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
        "margin": {"l": 65, "r": 10, "t": BAR_PX, "b": 50},
        "xaxis": {"title": {"text": label(along)}},
        "yaxis": {"title": {"text": name}},
    }
    return chart(column, data, layout, f"{name} of the feasible cases{shown}")


def _by_end(results: CampaignResults, size: int, column: str, name: str) -> list[tuple[Trace, Any]]:
    """Markers without places and rows of the cases of each end; feasible ones coloured by a column."""
    found = []
    for end in results.counts():
        rows = results.ending(end)
        marker: dict[str, Any] = {"symbol": SYMBOLS[end], "size": size}
        if end == FEASIBLE:
            bar = {"title": {"text": name, "side": "right"}}
            line = {"color": "#333333", "width": 0.5}
            marker |= {"color": significant(rows[column]), "colorscale": COLOURS}
            if column == CHANCE:  # Plotly would take 0.4 to 1.4 where all are 0.9
                marker |= {"cmin": float(rows[column].min()), "cmax": 1.0}
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
