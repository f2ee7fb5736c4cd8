"""Every table and figure of the paper that the project can make: `python -m paper_figs`.

They are made from what `python -m experiments.observation_table` wrote: figures as PNG and PDF,
tables as Markdown and CSV, and `captions.md` that explains them. The studies of the spacecraft are
drawn where their folders are found.
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
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Protocol

from matplotlib.figure import Figure
from rich.console import Console

from paper_figs.drawing import PICTURES, plan_hash_of, save
from paper_figs.first import run_first
from paper_figs.inputs import TABLE, Runs, read_runs
from paper_figs.paper import (
    cone_polytopes,
    control_history,
    observation_geometry,
    observation_histories,
    observation_table,
    observation_times,
    parameters,
    terminal_normality,
    trajectories,
)
from paper_figs.studies import (
    attitude_and_actuators,
    battery_cones,
    flown_plan,
    frontier,
    model_fidelity,
    power_history,
    timing_rules,
    uncertainty_quantiles,
    uncertainty_sources,
)
from scp_recon.files import unwritable, write_atomically


class Drawn(Protocol):
    """A module of one figure."""

    def draw(self, runs: Runs) -> Figure:
        """The figure; nothing is written."""
        ...

    def caption(self, runs: Runs) -> str:
        """What it shows."""
        ...


class Tabulated(Protocol):
    """A module of one table."""

    def table(self, runs: Runs) -> str:
        """Markdown; nothing is written."""
        ...


class Study(Protocol):
    """A module of a figure that is drawn from a study's folder."""

    FOLDER: str
    COMMAND: str

    def read(self, folder: Path) -> Any:
        """What the study left in its folder."""
        ...

    def draw(self, found: Any) -> Figure:
        """The figure; nothing is written."""
        ...

    def caption(self, found: Any) -> str:
        """What it shows."""
        ...


FIGURES: dict[str, Drawn] = {
    "observation_geometry": observation_geometry,
    "cone_polytopes": cone_polytopes,
    "trajectories": trajectories,
    "control_history": control_history,
    "observation_histories": observation_histories,
    "observation_times": observation_times,
    "terminal_normality": terminal_normality,
}
STUDIES: dict[str, Study] = {
    "frontier": frontier,
    "battery_cones": battery_cones,
    "model_fidelity": model_fidelity,
    "uncertainty_sources": uncertainty_sources,
    "uncertainty_quantiles": uncertainty_quantiles,
    "attitude_and_actuators": attitude_and_actuators,
    "power_history": power_history,
    "flown_plan": flown_plan,
    "timing_rules": timing_rules,
}
TABLES: dict[str, Tabulated] = {"parameters": parameters, "observation_table": observation_table}


def make_all(runs: Runs, source: Path, out: Path, studies: Path | None = None) -> Iterator[Path]:
    """Write everything into a folder, yielding each file as it is done.

    Args:
        runs: what the figures are drawn from.
        source: folder of the table to copy.
        out: folder to write into.
        studies: folder in which the studies' folders are looked for.

    Raises:
        InputError: if a study's folder is unusable.
        OSError: if the folder cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    yield write_atomically(out / "parameters.md", parameters.table(runs))
    if runs.table:
        yield write_atomically(out / "observation_table.md", observation_table.table(runs))
        yield write_atomically(out / TABLE, (source / TABLE).read_bytes())
    captions = ["# Captions"]
    paper = ((name, drawn, runs) for name, drawn in FIGURES.items())
    for name, drawn, found in chain(paper, _read_studies(studies)):
        figure, caption = drawn.draw(found), drawn.caption(found)
        for ending in PICTURES:
            yield save(figure, out / f"{name}{ending}", plan_hash=plan_hash_of(found))
        captions.append(f"## {name}\n\n{caption}")
    yield write_atomically(out / "captions.md", "\n\n".join(captions) + "\n")


def _read_studies(folder: Path | None) -> Iterator[tuple[str, Study, Any]]:
    """Name and module of every study that is there, and what it left."""
    if folder is None:
        return
    for name, study in STUDIES.items():
        place = folder / study.FOLDER
        if place.is_dir():
            yield name, study, study.read(place)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 if everything was written, 2 for missing input."""
    p = argparse.ArgumentParser(prog="python -m paper_figs", description=__doc__)
    p.add_argument(
        "--runs",
        type=Path,
        default=Path("runs") / "paper",
        metavar="DIR",
        help="what experiments.observation_table wrote, or a plan of one's own (default: runs/paper)",
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
        help="folder for all of it (default: runs/figures)",
    )
    p.add_argument(
        "--all",
        action="store_true",
        help="run first whatever study has left nothing in its folder; hours, with all extras",
    )
    options = parse(p, arguments)
    return run_command(lambda console: _make(options, console), options)


def _make(options: argparse.Namespace, console: Console) -> Answer:
    if options.all:
        wanted = [(study.FOLDER, study.COMMAND) for study in STUDIES.values()]
        run_first(options.runs, options.studies, wanted, lambda line: show_line(console, line))
    runs = read_runs(options.runs)
    files: list[str] = []
    try:
        for path in make_all(runs, options.runs, options.out, options.studies):
            show_written(console, path)
            files.append(str(path))
    except OSError as error:
        raise unwritable(options.out, "--out", error) from None
    wanting = {
        name: study.COMMAND
        for name, study in STUDIES.items()
        if not (options.studies / study.FOLDER).is_dir()
    }
    for name, line in wanting.items():
        console.print(f"not drawn: {name}, for want of `{line}`", soft_wrap=True)
    return Answer(0, {"files": files, "not_drawn": wanting})


if __name__ == "__main__":
    sys.exit(main())
