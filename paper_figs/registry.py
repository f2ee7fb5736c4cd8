"""Register all figures and tables: how to read their input, and how to draw them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from paper_figs import concepts, flyby, frames
from paper_figs.inputs import COMMAND, Source, read_runs
from paper_figs.paper import (
    ball_polytopes,
    cone_polytopes,
    control_history,
    observation_geometry,
    observation_histories,
    observation_times,
    tables,
    terminal_normality,
    trajectories,
)
from paper_figs.studies import (
    accuracy,
    attitude_and_actuators,
    battery_cones,
    feedback,
    flown_plan,
    frontier,
    map_sample,
    model_fidelity,
    policies,
    power_history,
    solver_comparison,
    timing_rules,
    uncertainty_quantiles,
    uncertainty_sources,
)

PAPER = Source("paper", COMMAND)
"""Where the paper's own figures come from."""

Made = Figure | str | Mapping[str, Figure]
"""A figure, a table in Markdown, or several figures by name."""


@dataclass(frozen=True)
class Item:
    """A figure or a table.

    Attributes:
        make: function of the result of `read` to the item; writes nothing.
        caption: function of the same to a caption; an item without one is made only if named.
        source: the folder of its input, and the command that writes it.
        read: function of that folder to the input.
        dpi: resolution of a raster, if not the style's.
    """

    make: Callable[[Any], Made]
    caption: Callable[[Any], str] | None = None
    source: Source = PAPER
    read: Callable[[Path], Any] = read_runs
    dpi: float | None = None


def _study(module: Any) -> Item:
    """A figure of a study: a module with `draw`, `caption`, `SOURCE` and perhaps its own `read`."""
    source = module.SOURCE
    read = source.rows if len(source.tables) == 1 else source.read
    return Item(module.draw, module.caption, source, getattr(module, "read", read))


def _without_input(draw: Callable[[], Figure]) -> Item:
    """A drawing for a page."""
    return Item(lambda _: draw(), read=lambda _: None, dpi=120)


FIGURES: dict[str, Item] = {
    module.__name__.rpartition(".")[2]: Item(module.draw, module.caption)
    for module in (
        observation_geometry,
        cone_polytopes,
        ball_polytopes,
        trajectories,
        control_history,
        observation_histories,
        observation_times,
        terminal_normality,
    )
}
"""Of the paper, in its order."""

TABLES = {
    "parameters": Item(tables.parameters),
    "observation_table": Item(tables.observation_table),
}

STUDIES: dict[str, Item] = {
    module.__name__.rpartition(".")[2]: _study(module)
    for module in (
        frontier,
        feedback,
        policies,
        map_sample,
        accuracy,
        battery_cones,
        model_fidelity,
        uncertainty_sources,
        uncertainty_quantiles,
        attitude_and_actuators,
        power_history,
        flown_plan,
        timing_rules,
    )
}
"""Drawn with the paper's where their folders are found."""

ALONE = {
    "flyby": Item(flyby.draw, read=flyby.read, dpi=140),
    "frames": _without_input(frames.draw),
    **{
        one.__name__: _without_input(one)
        for one in (
            concepts.planner,
            concepts.modes,
            concepts.polytopes,
            concepts.lifting,
            concepts.directions,
            concepts.closed_loop,
        )
    },
    "solver_comparison": Item(
        solver_comparison.draw, source=solver_comparison.SOURCE, read=solver_comparison.SOURCE.rows
    ),
}
"""Drawn only where they are named."""

EVERYTHING = FIGURES | TABLES | STUDIES | ALONE
