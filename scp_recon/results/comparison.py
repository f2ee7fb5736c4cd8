"""Compare plans by burns, delta-v, margins, probabilities, and the distance between paths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np

from formulations.arrays import Array
from scp_recon.display import Displayed, digits
from scp_recon.errors import unknown_name
from scp_recon.physics.flow import interpolate
from scp_recon.planning.plan import NOT_CHECKED
from scp_recon.results.solution import Solution
from scp_recon.results.table import SCALES, Cell, Column, Table
from scp_recon.results.verification import Verification
from scp_recon.scenario.schema import Scenario

DIFFERS = "differs from the first in"
"""Row of the sections in which a scenario differs from the first plan's: it limits comparison."""
MARGIN, MARGIN_ROUNDING = "margin ", {"m/s": 1e-6}
"""Names of margins begin so; below this size, `BINDING` for m and sigma, one is a solver's rounding."""
BINDING = 1e-4
"""Margin in the program below which a limit binds, m or sigma."""


Row = tuple[str, str, tuple[float | str | None, ...]]
"""A name, its unit, and every plan's figure, None where it has none."""


@dataclass(frozen=True, repr=False)
class Comparison(Displayed):
    """Figures of plans.

    Attributes:
        names: of the plans.
        rows: of figures, in the order of the table.
        plans: that are compared.
    """

    names: tuple[str, ...]
    rows: tuple[Row, ...]
    plans: tuple[Solution, ...]

    def __getitem__(self, name: str) -> tuple[float | str | None, ...]:
        """Every plan's figure of that name.

        Raises:
            KeyError: naming what there is.
        """
        known = {row: figures for row, _, figures in self.rows}
        if name not in known:
            raise KeyError(unknown_name(name, known))
        return known[name]

    @property
    def table(self) -> Table:
        """Rows with their units in brackets, speeds in mm/s; six digits, rounding counts as zero."""
        rows = (
            [Column(name, shown(unit)).label, *(_cell(name, unit, figure) for figure in row)]
            for name, unit, row in self.rows
        )
        columns = (Column("", name="figure"), *map(Column, self.names))
        return Table.of("Plans side by side", columns, rows, key="comparison")

    def __str__(self) -> str:
        """A table in plain text."""
        return str(self.table)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        """The table as HTML, for a notebook."""
        return self.table.html()


def compare(names: Sequence[str], solutions: Sequence[Solution]) -> Comparison:
    """Compare plans with each other, and their paths with the first one's."""
    rows: list[Row] = [
        ("scenario", "", tuple(s.scenario.name for s in solutions)),
        (DIFFERS, "", tuple(_differences(solutions[0].scenario, s.scenario) for s in solutions)),
        ("status", "", tuple(s.status for s in solutions)),
        ("verified", "", tuple(_verdict(s.verification) for s in solutions)),
        ("p_chance asked", "", tuple(s.scenario.risk.p_chance for s in solutions)),
        ("p_chance asked of", "", tuple(map(_scope, solutions))),
        ("total delta-v", "m/s", tuple(s.total_dv_m_s for s in solutions)),
    ]
    if any(s.policy for s in solutions):
        for name, figure in (("mean", "mean_m_s"), ("99 %", "dv99_m_s")):
            figures = (getattr(s.policy, figure) if s.policy else s.total_dv_m_s for s in solutions)
            rows.append((f"commanded delta-v, {name}", "m/s", tuple(figures)))
    if any(len(s.flown_m_s) for s in solutions):
        rows += _history(solutions)
    flights = (np.linalg.norm(_whole_flight(s), axis=1).tolist() for s in solutions)
    burns = enumerate(zip_longest(*flights), start=1)
    rows += [(f"burn {number}", "m/s", sizes) for number, sizes in burns]
    margins = [{c.name: c.worst_margin for c in s.constraints} for s in solutions]
    units = {c.name: c.unit for s in solutions for c in s.constraints}
    rows += [(f"{MARGIN}{n}", unit, tuple(m.get(n) for m in margins)) for n, unit in units.items()]
    checked = [s.verification.probabilities if s.verification else [] for s in solutions]
    chances = [{p.name: p.estimate for p in each} for each in checked]
    events = dict.fromkeys(name for each in chances for name in each)
    rows += [(f"P({n})", "", tuple(c.get(n) for c in chances)) for n in events]
    apart = tuple(largest_distance_m(solutions[0], other) for other in solutions)
    rows.append(("farthest from the first", "m", apart))
    return Comparison(tuple(names), tuple(rows), tuple(solutions))


def _differences(first: Scenario, other: Scenario) -> str | None:
    """Sections of a scenario, besides its name, that differ from the first one's."""
    names = [
        n for n in Scenario.model_fields if n != "name" and getattr(first, n) != getattr(other, n)
    ]
    return ", ".join(names) or None


def _scope(solution: Solution) -> str | None:
    """What a probability is required of; None without uncertainty."""
    if solution.problem == "P3":
        return None
    return "whole flights" if solution.scenario.risk.scope == "flight" else "every node"


def _verdict(verification: Verification | None) -> str:
    if verification is None:
        return NOT_CHECKED
    return "yes" if verification.ok else f"no: {verification.failed_in_words}"


def _whole_flight(solution: Solution) -> Array:
    """Burns flown and burns planned, m/s, shape (m, 3)."""
    return np.vstack([solution.flown_m_s, solution.burns_m_s])


def _history(solutions: Sequence[Solution]) -> list[Row]:
    """Rows for plans made in flight: parent, burns flown before, miss of the final state."""
    whole = [float(np.linalg.norm(_whole_flight(s), axis=1).sum()) for s in solutions]
    missed = [s.verification.missed if s.verification else None for s in solutions]
    return [
        ("parent", "", tuple(s.parent.name if s.parent else None for s in solutions)),
        ("begins at", "s", tuple(s.scenario.start_s for s in solutions)),
        ("burns flown before", "", tuple(str(len(s.flown_m_s)) for s in solutions)),
        ("with those flown", "m/s", tuple(whole)),
        ("final state missed by", "m", tuple(m.position_m if m else None for m in missed)),
    ]


def shown(unit: str) -> str:
    """Unit of a table's texts by that of the rows."""
    return dict(SCALES.keys()).get(unit, unit)


def _cell(name: str, unit: str, figure: float | str | None) -> Cell | str | None:
    """A figure to six digits; a margin within a solver's tolerance of its limit is zero."""
    if not isinstance(figure, float):
        return figure
    rounding = MARGIN_ROUNDING.get(unit, BINDING) if name.startswith(MARGIN) else 1e-9
    value = figure * SCALES.get((unit, shown(unit)), 1.0)
    return Cell(digits(value, 6) if abs(figure) >= rounding else "0", value)


def largest_distance_m(one: Solution, other: Solution) -> float | None:
    """Largest distance of two mean paths at their nodes, m; None if they share no time.

    Paths are compared in J2000 at the same time past the epoch; between nodes they are cubics.
    """
    times = np.union1d(one.nodes.t_s, other.nodes.t_s)
    first, last = (np.array([s.nodes.t_s[end] for s in (one, other)]) for end in (0, -1))
    times = times[(times >= first.max()) & (times <= last.min())]
    if not len(times):
        return None
    paths = [path_of(solution)(times) for solution in (one, other)]
    return float(np.linalg.norm(paths[0] - paths[1], axis=1).max())


def path_of(solution: Solution) -> Callable[[Array], Array]:
    """Mean positions of a plan at times within it, J2000, m: times (n,) to (n, 3).

    Between nodes it is a cubic through their states, at a burn through the state before it.
    """
    nodes, states = np.array(solution.nodes.t_s), np.array(solution.nodes.state)
    arriving = states[1:].copy()  # before the burn where one falls on the node
    for burn, dv in zip(solution.burns, solution.burns_m_s, strict=True):
        if (at := int(np.argmin(np.abs(nodes - burn.t_s)))) > 0:
            arriving[at - 1, 3:] -= dv

    def positions(times: Array) -> Array:
        k = np.clip(np.searchsorted(nodes, times, side="right") - 1, 0, len(nodes) - 2)
        h = (nodes[k + 1] - nodes[k])[:, None]
        start, end = states[k], arriving[k]
        position, _ = interpolate(
            (start[:, :3], start[:, 3:]),
            (end[:, :3], end[:, 3:]),
            h,
            (times - nodes[k])[:, None] / h,
        )
        return position

    return positions
