"""A campaign's page: one HTML file with its map or curves, and a table from which each case opens."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from scp_recon.campaign.engine.columns import OWN
from scp_recon.campaign.rows.case import solution_path
from scp_recon.campaign.study.axes import EPOCH
from scp_recon.campaign.view.charts import charts_of
from scp_recon.campaign.view.labels import COST, MEASURES, label
from scp_recon.campaign.view.outcome import FEASIBLE, SHORTFALLS, CampaignResults
from scp_recon.campaign.view.remarks import remarks
from scp_recon.campaign.view.repeat import command_lines
from scp_recon.report.offline import render_offline
from scp_recon.report.page import version_of_planner
from scp_recon.report.table import Cell, cell

ROWS_MAX = 5_000
"""Cases in the page's table."""


@dataclass(frozen=True)
class Line:
    """A case in the table.

    Attributes:
        number: of the case.
        end: how it ended.
        cells: entries, measures and the limit that stopped it.
        message: what it said.
        found: what its flights, simulation, certificate or design came to, by column.
        report: of its plan, relative to the campaign's folder, if there is one.
        solution: its folder there, if it was kept.
        commands: that make it again.
    """

    number: int
    end: str
    cells: tuple[Cell, ...]
    message: str
    found: str
    report: str | None
    solution: str | None
    commands: str


def render(results: CampaignResults, made: datetime) -> str:
    """One HTML file that needs nothing else."""
    charts = charts_of(results)
    names = [label(entry) for entry in shown(results)]
    done = len(results.table)
    return render_offline(
        "campaign.html",
        "campaign.js",
        charts,
        "scp_recon.campaign",
        title=f"{results.campaign.do}, {results.base.name}: {', '.join(names) or 'one case'}",
        feasible=results.feasible,
        verdict=results.verdict,
        lines=remarks(results),
        identity=f"scp_recon {version_of_planner()} | made {made:%Y-%m-%d %H:%M:%S} UTC",
        charts=charts,
        heading=["end", *names, *(name for _, name in MEASURES), "limit broken most"],
        left_out=f"The first {ROWS_MAX:,} of {done:,}; results.parquet has all."
        * (done > ROWS_MAX),
        rows=[line_of(results, place) for place in order(results)[:ROWS_MAX]],
    )


def shown(results: CampaignResults) -> list[str]:
    """Entries of the table: all that change, but epochs that follow from a site."""
    return [e for e in results.entries if not (results.is_map and e == EPOCH)]


def order(results: CampaignResults) -> list[int]:
    """Places of the rows: feasible ones first, the cheapest first; the others by case."""
    costs = results.table[COST].to_numpy(dtype=float)
    good = np.array(results.ends) == FEASIBLE
    found: list[int] = np.lexsort((np.where(good, costs, 0.0), ~good)).tolist()
    return found


def line_of(results: CampaignResults, place: int) -> Line:
    """A row of the results as one of the table."""
    row = {key: _plain(value) for key, value in results.table.iloc[place].to_dict().items()}
    number = int(row["case"])
    changes = {entry: row[entry] for entry in results.entries}
    cells = [cell(row[entry]) for entry in shown(results)]
    cells += [cell(row.get(column)) for column, _ in MEASURES] + [cell(row.get("binds"))]
    folder = solution_path(Path(), number).parent
    kept = (results.folder / solution_path(Path(), number)).is_file()
    report = folder / "report.html"
    return Line(
        number=number,
        end=results.ends[place],
        cells=tuple(cells),
        message=" ".join(
            filter(None, (row.get(column) for column in ("message", *SHORTFALLS, "warnings")))
        ),
        found="; ".join(
            f"{column} {cell(row[column]).text}"
            for column in OWN[results.campaign.do]
            if column not in SHORTFALLS and row.get(column) is not None
        ),
        report=report.as_posix() if (results.folder / report).is_file() else None,
        solution=folder.as_posix() if kept else None,
        commands="\n".join(
            command_lines(results.campaign, changes, int(row["seed"]), results.base.risk.allocation)
        ),
    )


def _plain(value: Any) -> Any:
    """Python's own number or text; None of what is missing."""
    value = value.item() if hasattr(value, "item") else value
    return None if value is None or value != value else value
