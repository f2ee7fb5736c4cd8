"""Every table and figure of the paper that the project can make: `python -m paper_figs`.

They are made from what `python -m experiments.observation_table` wrote: figures as PNG and PDF,
tables as Markdown and CSV, and `captions.md` that explains them.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

from matplotlib.figure import Figure

from paper_figs import (
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
from paper_figs.drawing import PICTURES, save
from paper_figs.inputs import TABLE, Runs, read_runs
from scp_recon.errors import InputError
from scp_recon.solution import write_atomically


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


FIGURES: dict[str, Drawn] = {
    "observation_geometry": observation_geometry,
    "cone_polytopes": cone_polytopes,
    "trajectories": trajectories,
    "control_history": control_history,
    "observation_histories": observation_histories,
    "observation_times": observation_times,
    "terminal_normality": terminal_normality,
}
TABLES: dict[str, Tabulated] = {"parameters": parameters, "observation_table": observation_table}


def make_all(runs: Runs, source: Path, out: Path) -> Iterator[Path]:
    """Write everything into a folder, yielding each file as it is done.

    Raises:
        OSError: if the folder cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    for name, tabulated in TABLES.items():
        yield write_atomically(out / f"{name}.md", tabulated.table(runs))
    yield Path(shutil.copyfile(source / TABLE, out / TABLE))
    captions = ["# Captions"]
    for name, drawn in FIGURES.items():
        figure = drawn.draw(runs)
        for ending in PICTURES:
            yield save(figure, out / f"{name}{ending}")
        captions.append(f"## {name}\n\n{drawn.caption(runs)}")
    yield write_atomically(out / "captions.md", "\n\n".join(captions) + "\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 if everything was written, 2 for missing input."""
    p = argparse.ArgumentParser(prog="python -m paper_figs", description=__doc__)
    p.add_argument(
        "--runs",
        type=Path,
        default=Path("runs") / "paper",
        metavar="DIR",
        help="what experiments.observation_table wrote (default: runs/paper)",
    )
    p.add_argument(
        "--out",
        type=Path,
        default=Path("runs") / "figures",
        metavar="DIR",
        help="folder for all of it (default: runs/figures)",
    )
    options = p.parse_args(arguments)
    try:
        for path in make_all(read_runs(options.runs), options.runs, options.out):
            print(f"written: {path}", flush=True)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: cannot write to {options.out}: {error.strerror}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
