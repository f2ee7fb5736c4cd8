"""Make the paper's tables and figures, or those named: `python -m paper_figs [NAME ...]`.

Without names everything of the paper goes to a folder: figures as PNG and PDF, tables as Markdown and
CSV, with the figures of every study whose folder is found. They are made from the results of
`python -m experiments observation_table`. Named figures are PNG, and a single one may be a file of
any format.
"""

from __future__ import annotations

from scp_recon.cli.command import (
    Answer,
    exit_on_sigint,
    parse,
    run_command,
    show_line,
    show_written,
)

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.console import Console

from paper_figs import flight, observation, plans, polytopes, spacecraft, tables
from paper_figs.drawing import save, write
from paper_figs.inputs import (
    FLOWN_PLAN,
    PAPER,
    SIMULATED,
    TABLE,
    Runs,
    Source,
    read_flight,
    read_flights,
    read_runs,
    read_whole_flight,
    run_missing,
)
from scp_recon.errors import one_of
from scp_recon.files import unwritable, write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.results.solution import Solution
from scp_recon.scenario.load import load_scenario
from scp_recon.simulation.record import Record

PICTURES = (".png", ".pdf")

Made = Figure | str | Mapping[str, Figure]
"""A figure, a table in Markdown, or several figures by name."""


@dataclass(frozen=True)
class Item:
    """A figure or a table.

    Attributes:
        make: function of the result of `read` to the item; writes nothing.
        source: the folder of its input, and the command that writes it.
        read: function of that folder to the input; by default the source's tables.
        dpi: resolution of a raster, if not the style's.
    """

    make: Callable[[Any], Made]
    source: Source = PAPER
    read: Callable[[Path], Any] | None = None
    dpi: float | None = None

    def found(self, folder: Path) -> Any:
        """The input in a folder."""
        return (self.read or self.source.read)(folder)


def _study(make: Callable[[Any], Made], folder: str = "", line: str = "", **tables: str) -> Item:
    """A figure of a study's tables, each with a column that it must have."""
    name = folder or make.__name__
    files = {f"{table}.csv": column for table, column in tables.items()}
    return Item(make, Source(name, f"python -m experiments {line or name}", files))


FIGURES = {
    make.__name__: Item(make, read=read_runs)
    for make in (
        observation.observation_geometry,
        polytopes.cone_polytopes,
        polytopes.ball_polytopes,
        flight.trajectories,
        flight.control_history,
        observation.observation_histories,
        observation.observation_times,
        observation.terminal_normality,
    )
}
"""The paper's figures, in the paper's order."""

TABLES = {
    make.__name__: Item(make, read=read_runs)
    for make in (tables.parameters, tables.observation_table)
}

STUDIES = {
    item.make.__name__: item
    for item in (
        _study(plans.frontier, frontier="total_dv_m_s"),
        _study(plans.feedback, feedback="dv99_m_s", feedback_errors="program_m_s"),
        _study(plans.policies, policies="dv99_m_s"),
        _study(plans.map_sample, line="maps --sample", sample="site.latitude_deg"),
        _study(plans.accuracy, accuracy="error"),
        _study(
            spacecraft.battery_cones,
            battery_cones="half_angle_deg",
            battery_cones_samples="power_w",
        ),
        _study(
            spacecraft.model_fidelity,
            model_fidelity="terminal_m",
            model_fidelity_history="distance_m",
        ),
        _study(spacecraft.uncertainty_sources, uncertainty_sources="rms_m"),
        _study(
            spacecraft.uncertainty_quantiles,
            "uncertainty_sources",
            uncertainty_quantiles="observed",
            uncertainty_sources="rms_m",
        ),
        Item(spacecraft.attitude_and_actuators, SIMULATED, read_flight),
        Item(spacecraft.power_history, SIMULATED, read_flight),
        Item(spacecraft.flown_plan, FLOWN_PLAN, read_flights),
        _study(
            spacecraft.timing_rules,
            timing_rules="measured_s",
            timing_rules_slews="settled_0.25_deg_s",
        ),
    )
}
"""Figures of studies, drawn with the paper's if the study's folder exists."""


def _default_mission(_: Path) -> Mission:
    return Mission.from_scenario(load_scenario())


ALONE = {
    "flyby": Item(flight.flyby, read=read_whole_flight, dpi=140),
    "modes": Item(flight.modes, read=_default_mission, dpi=120),
    "solver_comparison": _study(
        plans.solver_comparison, "comparison", "compare_solvers", comparison="group"
    ),
}
"""Figures that are drawn only if they are named."""

EVERYTHING: dict[str, Item] = FIGURES | TABLES | STUDIES | ALONE


def plan_hash_of(source: object) -> str | None:
    """Hash of the plan of which a figure is drawn; None if it is not one known plan."""
    match source:
        case Runs(plan=flown):
            return flown.solution.plan_hash
        case (Solution() | Record()) as one:
            return one.plan_hash
        case [Record() as record, *_]:
            return record.plan_hash
    return None


def make_all(runs: Runs, source: Path, out: Path, studies: Path | None = None) -> Iterator[Path]:
    """Write everything of the paper into `out`, yielding each file as it is done.

    The table is copied from the folder `source`; `studies` contains the studies' folders.

    Raises:
        InputError: if a study's folder is unusable.
        OSError: if the folder cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    yield from _write(TABLES["parameters"], "parameters", runs, out)
    if runs.table is not None:
        yield from _write(TABLES["observation_table"], "observation_table", runs, out)
        yield write_atomically(out / TABLE, (source / TABLE).read_bytes())
    for name, item in FIGURES.items():
        yield from _write(item, name, runs, out)
    for name, item in STUDIES.items():
        if studies and (place := studies / item.source.folder).is_dir():
            yield from _write(item, name, item.found(place), out)


def _write(item: Item, name: str, found: Any, out: Path, *, png: bool = False) -> Iterator[Path]:
    """Write an item into a folder, or to `out` if that is a file's name."""
    made, alone = item.make(found), out.suffix != "" and not out.is_dir()
    if isinstance(made, str):
        yield write(out if alone else out / f"{name}.md", made)
        return
    figures: Mapping[str, Figure] = {name: made} if isinstance(made, Figure) else made
    endings = PICTURES[:1] if png else PICTURES
    for own, figure in figures.items():
        for path in [out] if alone else [out / f"{own}{ending}" for ending in endings]:
            yield save(figure, path, item.dpi, plan_hash_of(found))


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(
        prog="python -m paper_figs",
        description=__doc__,
        epilog=f"Names: {', '.join(EVERYTHING)}.",
    )
    p.add_argument(
        "names", nargs="*", metavar="NAME", help="a figure or table (default: the paper's)"
    )
    p.add_argument(
        "--runs",
        type=Path,
        metavar="DIR",
        help="what experiments observation_table wrote, or a plan of one's own (default: runs/paper); "
        "of a single study's figure, the study's folder",
    )
    p.add_argument(
        "--studies",
        type=Path,
        default=Path("runs"),
        metavar="DIR",
        help="folder of the studies' folders (default: runs)",
    )
    p.add_argument(
        "--out",
        type=Path,
        default=Path("runs") / "figures",
        metavar="DIR",
        help="folder for all of it (default: runs/figures), or for a single one a file, e.g. x.svg",
    )
    p.add_argument(
        "--all",
        action="store_true",
        help="run first whatever study has left nothing in its folder; hours, with all extras",
    )
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 if everything was written, 2 for missing input."""
    options = parse(parser(), arguments)
    return run_command(lambda console: _make(options, console), options)


def _make(options: argparse.Namespace, console: Console) -> Answer:
    names = [one_of("NAME", name, EVERYTHING) for name in options.names]
    items = {name: EVERYTHING[name] for name in names}
    runs = options.runs or Path("runs") / PAPER.folder
    if options.all:
        sources = [item.source for item in (items or STUDIES).values() if item.source is not PAPER]
        run_missing(runs, options.studies, sources, lambda line: show_line(console, line))
    files: list[str] = []
    written = (
        _make_named(items, options)
        if items
        else make_all(read_runs(runs), runs, options.out, options.studies)
    )
    try:
        for path in written:
            show_written(console, path)
            files.append(str(path))
    except OSError as error:
        raise unwritable(options.out, "--out", error) from None
    wanting = {
        name: item.source.command
        for name, item in ({} if items else STUDIES).items()
        if not (options.studies / item.source.folder).is_dir()
    }
    for name, line in wanting.items():
        show_line(console, f"not drawn: {name}, for want of `{line}`")
    return Answer(0, {"files": files, "not_drawn": wanting})


def _make_named(items: Mapping[str, Item], options: argparse.Namespace) -> Iterator[Path]:
    """Make the named items, each from its own input."""
    single, out = len(items) == 1, options.out
    if not (single and out.suffix):
        out.mkdir(parents=True, exist_ok=True)
    for name, item in items.items():
        of_paper = item.source is PAPER
        home = Path("runs") / PAPER.folder if of_paper else options.studies / item.source.folder
        place = options.runs if options.runs and (single or of_paper) else home
        yield from _write(item, name, item.found(place), out, png=True)


if __name__ == "__main__":
    sys.exit(main())
