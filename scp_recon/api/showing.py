"""Draw and tabulate results for their methods `plot` and `to_frame` (`scp_recon.display`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from scp_recon.api.designing import Design, trials_table, windows_table
from scp_recon.api.files import solution_of
from scp_recon.api.plan_verbs import charts
from scp_recon.display import Displayed, Tabulated
from scp_recon.errors import imported, one_of, option
from scp_recon.interop.export import Export
from scp_recon.interop.files import columns
from scp_recon.mission.schedule import Survey
from scp_recon.monte_carlo.summary import Summary
from scp_recon.planning.plan import Plan
from scp_recon.reports import tables
from scp_recon.results.comparison import Comparison
from scp_recon.results.solution import Solution

if TYPE_CHECKING:
    import pandas
    from plotly.graph_objects import Figure

OF_A_PLAN = {
    "burns": tables.burns_table,
    "constraints": tables.constraints_table,
    "corrections": tables.corrections_table,
    "stages": tables.stages_table,
    "iterations": tables.iterations_table,
}
"""Tables of a solution; `path` is made of its flight."""


def plot(result: Displayed, chart: str | None) -> Figure:
    """See `Displayed.plot`."""
    if isinstance(result, Summary):
        imported("plot", "report", "plotly")
        from scp_recon.reports.charts import held_chart, lowest_chart
        from scp_recon.reports.write import figures_of

        drawn = figures_of((held_chart(result), lowest_chart(result)))
    else:
        shown: Any = result.plans if isinstance(result, Comparison) else (result,)
        drawn = charts(*shown)
    return drawn[_chosen("chart", chart, [*drawn])]


def to_frame(result: Tabulated, table: str | None) -> pandas.DataFrame:
    """See `Tabulated.to_frame`."""
    pandas = imported("to_frame", "notebooks", "pandas")
    names = [*OF_A_PLAN, "path"] if isinstance(result, Plan | Solution) else ["figures"]
    return pandas.DataFrame(_rows(result, _chosen("table", table, names)))


def _chosen(argument: str, given: str | None, names: list[str]) -> str:
    """The name given, or the first."""
    return names[0] if given is None else one_of(option(argument), given, names)


def _rows(result: Tabulated, table: str) -> Any:
    """A result's table as pandas takes it."""
    if isinstance(result, Summary):
        return _flown(result)
    if isinstance(result, Survey):
        return windows_table(result).records()
    if isinstance(result, Design):
        return trials_table(result).records()
    if isinstance(result, Comparison):
        named = {f"{name} ({unit})" if unit else name: row for name, unit, row in result.rows}
        return {"plan": result.names, **named}
    assert isinstance(result, Plan | Solution)
    if table == "path":
        return columns(Export.of(solution_of(result)))
    return OF_A_PLAN[table](solution_of(result)).records()


def _flown(flights: Summary) -> list[dict[str, Any]]:
    """Rows of flights: each joint constraint's lowest probability, and how long it holds."""
    rows = []
    for name, lowest in flights.probability.items():
        row = {"constraint": name, "probability": lowest.value, "low": lowest.low}
        row |= {"high": lowest.high, "at_s": lowest.worst_t_s}
        if (held := flights.held_s.get(name)) is not None:
            row |= {"held_mean_s": held.mean.value, "throughout": held.throughout.value}
        rows.append(row)
    return rows
