"""Draw the paper's figures, or those named: `python -m paper_figs [NAME ...]`.

Without names all of the paper's go to a folder as PNG and PDF, with the figures of every study whose
folder is found. They are drawn from the results of `python -m experiments observation_table`. Named
figures are PNG, and a single one may be a file of any format.
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

from paper_figs import campaigns, flight, observation, plans, polytopes, spacecraft
from paper_figs.drawing import save
from paper_figs.inputs import (
    FLOWN_PLAN,
    PAPER,
    SIMULATED,
    Source,
    read_flight,
    read_flights,
    read_runs,
    read_whole_flight,
    run_missing,
)
from scp_recon.errors import one_of
from scp_recon.files import unwritable
from scp_recon.mission.mission import Mission
from scp_recon.scenario.load import load_scenario

PICTURES = (".png", ".pdf")


@dataclass(frozen=True)
class Item:
    """A figure.

    Attributes:
        draw: function of the result of `read` to the figure, or to several by name.
        source: the folder of its input, and the command that writes it.
        read: function of that folder to the input; by default the source's tables.
        dpi: resolution of a raster, if not the style's.
    """

    draw: Callable[[Any], Figure | Mapping[str, Figure]]
    source: Source = PAPER
    read: Callable[[Path], Any] | None = None
    dpi: float | None = None

    def found(self, folder: Path) -> Any:
        """The input in a folder."""
        return (self.read or self.source.read)(folder)


def _study(
    draw: Callable[..., Figure | Mapping[str, Figure]],
    folder: str = "",
    line: str = "",
    **tables: str,
) -> Item:
    """A figure of a study's tables, each with a column that it must have."""
    name = folder or draw.__name__
    files = {f"{table}.csv": column for table, column in tables.items()}
    return Item(draw, Source(name, f"python -m experiments {line or name}", files))


FIGURES = {
    draw.__name__: Item(draw, read=read_runs)
    for draw in (
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

STUDIES = {
    item.draw.__name__: item
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
    "maps": Item(
        campaigns.campaigns, Source("maps", "python -m experiments maps"), campaigns.read_campaigns
    ),
    "solver_comparison": _study(
        plans.solver_comparison, "comparison", "compare_solvers", methods="method", random="solved"
    ),
}
"""Figures that are drawn only if they are named."""

EVERYTHING: dict[str, Item] = FIGURES | STUDIES | ALONE


def plan_hash_of(source: Any) -> str | None:
    """Hash of the plan of which a figure is drawn; None if it is not one known plan."""
    one = source[0] if isinstance(source, list) else source
    found: str | None = getattr(one, "plan_hash", None)
    return found


def draw(
    items: Mapping[str, Item], folders: Mapping[str, Path], out: Path, endings: Sequence[str]
) -> Iterator[Path]:
    """Draw figures from their folders into a folder, or one into a file; yields each path.

    Raises:
        InputError: if a folder is unusable, or the name of a file is no picture's.
        OSError: if the folder cannot be written.
    """
    alone = len(items) == 1 and out.suffix != "" and not out.is_dir()
    if not alone:
        out.mkdir(parents=True, exist_ok=True)
    inputs: dict[tuple[object, Path], Any] = {}  # the paper's figures share theirs
    for name, item in items.items():
        key = item.read or name, folders[name]
        inputs = inputs if key in inputs else {key: item.found(folders[name])}
        made = item.draw(inputs[key])
        for own, figure in ({name: made} if isinstance(made, Figure) else made).items():
            for path in [out] if alone else [out / f"{own}{ending}" for ending in endings]:
                yield save(figure, path, item.dpi, plan_hash_of(inputs[key]))


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(
        prog="python -m paper_figs",
        description=__doc__,
        epilog=f"Names: {', '.join(EVERYTHING)}.",
    )
    p.add_argument("names", nargs="*", metavar="NAME", help="a figure (default: the paper's)")
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
    return run_command(lambda console: _draw(options, console), options)


def _draw(options: argparse.Namespace, console: Console) -> Answer:
    names = [one_of("NAME", name, EVERYTHING) for name in options.names]
    items = {name: EVERYTHING[name] for name in names} or FIGURES | STUDIES
    paper, single = Path("runs") / PAPER.folder, len(names) == 1
    if options.all:
        sources = [item.source for item in items.values() if item.source is not PAPER]
        runs = options.runs or paper
        run_missing(runs, options.studies, sources, lambda line: show_line(console, line))
    folders = {}
    for name, item in items.items():
        home = paper if item.source is PAPER else options.studies / item.source.folder
        folders[name] = options.runs if options.runs and (single or home == paper) else home
    wanting = {
        name: STUDIES[name].source.command
        for name in ({} if names else STUDIES)
        if not folders[name].is_dir()
    }
    files: list[str] = []
    try:
        endings = PICTURES[:1] if names else PICTURES
        chosen = {name: item for name, item in items.items() if name not in wanting}
        for path in draw(chosen, folders, options.out, endings):
            show_written(console, path)
            files.append(str(path))
    except OSError as error:
        raise unwritable(options.out, "--out", error) from None
    for name, line in wanting.items():
        show_line(console, f"not drawn: {name}, for want of `{line}`")
    return Answer(0, {"files": files, "not_drawn": wanting})


if __name__ == "__main__":
    sys.exit(main())
