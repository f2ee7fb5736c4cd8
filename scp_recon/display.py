"""Give results their displays: text in a notebook, charts by Plotly, frames by pandas.

The modules that draw are on a much higher floor than the results. The package's face, which alone
knows both, says where they are (`shown_by`); they are imported when a result is displayed.
"""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas
    from plotly.graph_objects import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito's colours, which eyes of all kinds tell apart: of pages and pictures alike."""


COUNTED = {"nominal": "", "expected": " (mean commanded)", "dv99": " (99 % of commanded delta-v)"}
"""What a delta-v with corrected burns is, by `policy.cost`."""


def mm_s(speed_m_s: float, digits: int = 3, counted: str = "nominal") -> str:
    """A speed in m/s as words in mm/s; with corrected burns also what `counted` makes of it."""
    return f"{1e3 * speed_m_s:.{digits}f} mm/s{COUNTED[counted]}"


def digits(value: float, number: int = 6) -> str:
    """A figure in so many significant digits; a larger one to the unit, without an exponent."""
    return f"{value:.0f}" if abs(value) >= 10.0**number - 0.5 else f"{value:.{number}g}"


def exact(value: float) -> str:
    """A number as it was given: the fewest digits that are it, with an exponent from 1e16 on alone."""
    return repr(float(value)).removesuffix(".0")


_showing: list[Callable[[], Any]] = []


def shown_by(module: Callable[[], Any]) -> None:
    """Let `plot` and `to_frame` of a module display the results; the package calls this once.

    Args:
        module: imports and returns it.
    """
    _showing[:] = [module]


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
        frame: pandas.DataFrame = _showing[0]().to_frame(self, table)
        return frame


class Displayed(Tabulated):
    """A result with tables and charts."""

    def plot(self, chart: str | None = None) -> Figure:
        """Draw a chart, which a notebook shows as it is; needs the extra [report].

        Args:
            chart: of plans, and of their comparison, one of `scp_recon.charts`: "flight" in 3-D,
                "observation", "probability", "ranges", "lighting", "ground", "resolution", "timeline",
                "budget", "convergence"; with feedback "knowledge", "commanded" too. Of
                flights "held", the time for which limits hold, or "probability" (default: the first).

        Returns:
            A figure of Plotly, with units on its axes.

        Raises:
            InputError: naming the charts that there are, or the missing extra.
        """
        figure: Figure = _showing[0]().plot(self, chart)
        return figure
