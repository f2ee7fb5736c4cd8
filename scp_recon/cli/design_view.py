"""Show the progress of `design`; write its map of trials and its primer."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic

import numpy as np
from rich.console import Console

from scp_recon.api.designing import Design, phases_deg
from scp_recon.cli.command import show_line
from scp_recon.cli.rendering import time_left
from scp_recon.display import mm_s
from scp_recon.errors import option
from scp_recon.files import PICTURE, check_own, write_atomically, writing
from scp_recon.passes.design import Trial
from scp_recon.planning.primer import WORTH, PrimerHistory
from scp_recon.results.read import read_solution
from scp_recon.results.solution import FILE_NAME

TABLE, MAP, SCENARIO, PRIMER = "design.csv", "design.png", "scenario.toml", "primer.png"
"""What a design writes besides its plan."""
OF_MAP = 4.0
"""Time of a design over that of its maps: 2.9 was measured for Nightingale, 4.9 for Sandpiper."""
RESIDUAL = 0.1
"""Largest residual of an optimum's multipliers: a primer errs by its residual."""


HEAD = "# Written by `scp-recon design`.\n"


def check_files(folder: Path) -> None:
    """Refuse, before the work, a folder with other files of these names.

    Raises:
        InputError: if one would be overwritten.
    """
    marks = {TABLE: b"step,window,problem,", SCENARIO: HEAD.encode(), MAP: PICTURE, PRIMER: PICTURE}
    for name, mark in marks.items():
        check_own(folder / name, option("out"), mark)


def keep(folder: Path, name: str, content: str | bytes) -> None:
    """Write a file into the folder of a run.

    Raises:
        InputError: if it cannot be written.
    """
    with writing(folder, option("out")):
        write_atomically(folder / name, content)


def keep_map(folder: Path, found: Design, console: Console, dv_m_s: float) -> None:
    """Write the map of the design with the delta-v of its plan, if matplotlib is installed."""
    given = found.best.mission.scenario.boundary.home is None
    if given or not any(one.result.converged for one in found.trials):
        return
    if not _can_draw():
        show_line(console, f"no {MAP}, no {PRIMER}: pip install 'scp_recon[report]' for them")
        return
    from scp_recon.reports.command_charts import draw_design

    keep(folder, MAP, draw_design(found.trials, found.best, dv_m_s))


def keep_primer(folder: Path, console: Console) -> None:
    """Show the result of the plan's primer, and draw it if matplotlib is installed."""
    if not (folder / FILE_NAME).exists():
        return
    solution = read_solution(folder)
    show_line(console, primer_says(solution.primer))
    if solution.primer is not None and _can_draw():
        from scp_recon.reports.command_charts import draw_primer

        keep(
            folder,
            PRIMER,
            draw_primer(solution.primer, [burn.t_s for _, burn in solution.executed]),
        )


def _can_draw() -> bool:
    return importlib.util.find_spec("matplotlib") is not None


@contextmanager
def progress(console: Console) -> Iterator[Callable[[Trial], None]]:
    """Yield a function that counts plans; the best plan of each step gets a line."""
    counts: dict[str, int] = {}
    least: dict[str, Trial] = {}

    def line(step: str) -> str:
        best, many = least[step], "s" if counts[step] > 1 else ""
        count = f"{step:10} {counts[step]:4} plan{many}"
        if not best.result.converged:
            return f"{count}, none that holds"
        phases = phases_deg(best.result)
        counted = best.result.mission.scenario.policy.cost if step == "corrected" else "nominal"
        between = "" if None in phases else " from {:.1f} to {:.1f} deg".format(*phases)
        return f"{count}, best {mm_s(best.result.dv_m_s, counted=counted)}{between}" + (
            ", without uncertainty" if step in ("map", "certain") else ""
        )

    begun, mapped, map_s = monotonic(), set[int](), 0.0

    def left(tried: Trial) -> str:
        """What is left of a map, and what follows it."""
        nonlocal map_s
        took_s = monotonic() - begun
        if tried.expected is None:
            time = time_left(took_s, OF_MAP * map_s, took_s)
            return f"; {time}, then its plan" if time else ""
        mapped.add(tried.result.space.number)
        total, done, map_s = tried.expected * len(mapped), counts[tried.step], took_s
        time = time_left(done, total, took_s)
        return f"; of {total}, {time}, then descents from the map's minima" if time else ""

    with console.status("designing") as status:

        def count(tried: Trial) -> None:
            step = tried.step
            if step not in counts and counts:
                console.print(line(next(reversed(counts))), highlight=False)
            counts[step] = counts.get(step, 0) + 1
            best = least.setdefault(step, tried)
            if tried.result.dv_m_s < best.result.dv_m_s:
                least[step] = tried
            status.update(line(step) + left(tried))

        yield count
    if counts:
        console.print(line(next(reversed(counts))), highlight=False)


def primer_says(primer: PrimerHistory | None) -> str:
    """Whether one more burn would help, by a plan's primer, in one line."""
    if primer is None:
        return "no primer: it needs a plan whose errors shrink with the burns"
    legal = np.flatnonzero(primer.legal)
    if len(legal) == 0:
        return "primer: no time is legal for another burn with the present ones kept"
    if primer.residual > RESIDUAL:
        left = (
            f"multipliers leave a residual of {primer.residual:.2g}, at most {RESIDUAL:g} expected"
        )
        return f"primer: its {left}: no conclusion about another burn"
    best = legal[np.argmax(np.array(primer.allowed)[legal])]
    most, when = primer.allowed[best], f"at {primer.t_s[best]:.0f} s"
    if most <= 1.0 + WORTH:
        return f"primer at most {most:.3f} at legal times ({when}): no additional small burn helps"
    return f"primer up to {most:.3f} at legal times: an additional burn {when} would help"
