"""Draw the paper's figures, or those named: `python -m paper_figs [NAME ...]`.

Without names the paper's figures go to a folder as PNG and PDF, drawn from the results of
`python -m experiments observation_table`. Named figures are PNG, and a single one may be a file of
any format; those of studies are drawn from the study's folder.
"""

from __future__ import annotations

from scp_recon.cli.command import Answer, exit_on_sigint, parse, run_command, show_written

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure
from rich.console import Console

from paper_figs import flight, studies
from paper_figs.drawing import save
from paper_figs.inputs import Runs, read_runs, read_tables
from scp_recon.errors import one_of
from scp_recon.files import unwritable
from scp_recon.mission.mission import Mission
from scp_recon.results.read import read_solution
from scp_recon.scenario.load import load_scenario

PICTURES = (".png", ".pdf")


class Item(NamedTuple):
    """A figure.

    Attributes:
        draw: function of the result of `read` to the figure, or to several by name.
        read: function of a folder to the input.
        folder: usual name of the folder of its input, below runs.
        dpi: resolution of a raster, if not the style's.
    """

    draw: Callable[[Any], Figure | Mapping[str, Figure]]
    read: Callable[[Path], Any] = read_runs
    folder: str = "paper"
    dpi: float | None = None


FIGURES = {
    draw.__name__: Item(draw)
    for draw in (
        flight.ball_polytopes,
        flight.trajectories,
        flight.control_history,
        flight.observation_histories,
        flight.observation_times,
        flight.terminal_normality,
    )
}
"""The paper's figures, in the paper's order."""

TABLES = {
    "frontier": {"frontier": "total_dv_m_s"},
    "feedback": {"feedback": "dv99_m_s", "feedback_errors": "program_m_s"},
    "policies": {"policies": "dv99_m_s"},
    "missed_burns": {"costs": "more_percent"},
    "knowledge": {"parameters": "kept", "plans": "without"},
    "map_sample": {"sample": "site.latitude_deg"},
    "solver_comparison": {"methods": "method", "random": "solved"},
}
"""Tables of the studies that are drawn, each with a column that it must have."""
COMMANDS = {"map_sample": "maps --sample", "solver_comparison": "compare_solvers"}
"""Studies by their figures, where the names differ."""


def _study(name: str) -> Item:
    command = f"python -m experiments {COMMANDS.get(name, name)}"
    read = partial(read_tables, command=command, columns=TABLES[name])
    return Item(getattr(studies, name), read, name)


STUDIES = {name: _study(name) for name in TABLES}
EVERYTHING: dict[str, Item] = {
    **FIGURES,
    **STUDIES,
    "flyby": Item(flight.flyby, read_solution, "paper/scp_cold", 140),
    "modes": Item(flight.modes, lambda _: Mission.from_scenario(load_scenario()), dpi=120),
    "maps": Item(studies.campaigns, studies.read_campaigns, "maps"),
}


def draw(items: Mapping[str, Item], runs: Path | None, out: Path) -> Iterator[Path]:
    """Draw figures into a folder, or one into a file; yields each path.

    Args:
        items: the figures by name.
        runs: folder of their inputs; None for the usual one of each.
        out: folder, or the file of a single figure.

    Raises:
        InputError: if an input is unusable, or the name of a file is no picture's.
        OSError: if the folder cannot be written.
    """
    alone = len(items) == 1 and out.suffix != "" and not out.is_dir()
    endings = PICTURES if items == FIGURES else PICTURES[:1]
    if not alone:
        out.mkdir(parents=True, exist_ok=True)
    inputs: dict[tuple[object, Path], Any] = {}  # the paper's figures share theirs
    for name, item in items.items():
        folder = runs or Path("runs") / item.folder
        key = item.read, folder
        inputs = inputs if key in inputs else {key: item.read(folder)}
        given = inputs[key]
        made = item.draw(given)
        plan_hash = given.plan.solution.plan_hash if isinstance(given, Runs) else None
        for own, figure in ({name: made} if isinstance(made, Figure) else made).items():
            for path in [out] if alone else [out / f"{own}{ending}" for ending in endings]:
                yield save(figure, path, item.dpi, plan_hash)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    names = f"Names: {', '.join(EVERYTHING)}."
    p = argparse.ArgumentParser(prog="python -m paper_figs", description=__doc__, epilog=names)
    p.add_argument("names", nargs="*", metavar="NAME", help="a figure (default: the paper's)")
    said = "what the study wrote, of the paper's figures also a plan (default: the study's in runs)"
    p.add_argument("--runs", type=Path, metavar="DIR", help=said)
    said = "folder (default: runs/figures), or of a single one a file, e.g. x.svg"
    p.add_argument("--out", type=Path, default=Path("runs") / "figures", metavar="DIR", help=said)
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 if everything was written, 2 for missing input."""
    options = parse(parser(), arguments)
    return run_command(lambda console: _draw(options, console), options)


def _draw(options: argparse.Namespace, console: Console) -> Answer:
    items = {one_of("NAME", name, EVERYTHING): EVERYTHING[name] for name in options.names}
    files: list[str] = []
    try:
        for path in draw(items or FIGURES, options.runs, options.out):
            show_written(console, path)
            files.append(str(path))
    except OSError as error:
        raise unwritable(options.out, "--out", error) from None
    return Answer(0, {"files": files})


if __name__ == "__main__":
    sys.exit(main())
