"""Give results their displays: text in a notebook, charts by Plotly, frames by pandas.

The modules that draw are on a much higher floor than the results. Only their names are here: they
are imported when a result is displayed.
"""

from __future__ import annotations

from html import escape
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas
    from plotly.graph_objects import Figure


class Tabulated:
    """A result with tables."""

    def _repr_html_(self) -> str:
        """Its text as HTML, for a notebook."""
        # Some notebooks write other text than code in letters of all widths.
        return f'<pre style="font-family: monospace">{escape(str(self))}</pre>'

    def to_frame(self, table: str | None = None) -> pandas.DataFrame:
        """Tabulate it; needs pandas, of the extra [notebooks].

        Args:
            table: of a plan or a solution "burns", "constraints", "corrections", "stages",
                "iterations", or "path", that of `scp_recon.export`; other results have one table
                (default: the first).

        Returns:
            A row for each burn, constraint, window or plan made; names of columns end with the unit.

        Raises:
            InputError: naming the tables that there are, or the missing extra.
        """
        return _showing().to_frame(self, table)


class Displayed(Tabulated):
    """A result with tables and charts."""

    def plot(self, chart: str | None = None) -> Figure:
        """Draw a chart, which a notebook shows as it is; needs the extra [report].

        Args:
            chart: of plans, and of their comparison, one of `scp_recon.charts`: "flight" in 3-D,
                "observation", "probability", "ranges", "lighting", "ground", "resolution", "timeline",
                "budget", "convergence"; with feedback "knowledge", "ellipses", "commanded" too. Of
                flights "held", the time for which limits hold, or "probability" (default: the first).

        Returns:
            A figure of Plotly, with units on its axes.

        Raises:
            InputError: naming the charts that there are, or the missing extra.
        """
        return _showing().plot(self, chart)


def _showing() -> Any:
    return import_module("scp_recon.api.showing")
