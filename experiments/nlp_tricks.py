"""What each trick gains the nonlinear program: `python -m experiments.nlp_tricks`.

P2 of the default scenario from SCP's P3 solution, the facets chosen there. First the tricks that lead
from the program as the paper prints it to the tuned one, each on top of those before it; then what
was tried instead of one of them. The table goes to OUT/nlp_tricks.csv and .md.
"""

from __future__ import annotations

from formulations.problem.facets import choose_facets
from scp_recon.cli.command import exit_on_sigint, parse, run_command

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import csv
import io
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING

from rich.console import Console

from experiments.kept import Kept
from scp_recon.files import write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import plan
from scp_recon.scenario.load import load_scenario

if TYPE_CHECKING:
    from formulations.nlp.solve import Variant

DEFAULT_OUT = Path("runs") / "nlp_tricks"
HEAD = (
    "trick", "status", "delta-v m/s", "unknowns", "rows", "iterations",
    "build s", "IPOPT s", "of it evaluating s", "processor s",
)  # fmt: skip

FOR_SPRAL = {"OMP_CANCELLATION": "TRUE", "OMP_PROC_BIND": "TRUE"}
"""What SPRAL wants of OpenMP, before it is loaded."""


Row = tuple[str, ...]
"""Figures in the order of `HEAD`, as they are printed."""


@dataclass(frozen=True)
class Trick:
    """A variant by what distinguishes it."""

    name: str
    variant: Variant


def tricks() -> list[Trick]:
    """From printed to tuned, and the alternatives."""
    from formulations.nlp.covariance import Covariance, Factor, initial_deviation
    from formulations.nlp.multiple_shooting import MultipleShooting
    from formulations.nlp.single_shooting import SingleShooting
    from formulations.nlp.solve import (
        VARIANTS,
        Settings,
        Variant,
        paper_covariance,
        scaled_covariance,
    )
    from formulations.problem.flyby import FlybyProblem

    def unique(problem: FlybyProblem) -> Covariance:
        return Covariance(problem, unique=True)

    def factor(problem: FlybyProblem) -> Factor:
        return Factor(problem, unit=initial_deviation(problem))

    plain, adaptive = Settings(), Settings(barrier="adaptive")
    printed, tuned = VARIANTS["printed"], VARIANTS["tuned"]
    shooting = MultipleShooting(paper_covariance, arcs="called", whole=True)
    signed = Variant(shooting, plain, plain, screened=False)
    entries = replace(signed, transcription=replace(shooting, spread=unique))
    scaled = replace(signed, transcription=replace(shooting, spread=scaled_covariance))
    screened = replace(scaled, screened=True)
    short = MultipleShooting(scaled_covariance, arcs="called")
    cut = replace(screened, transcription=short)
    barrier = replace(cut, p3=adaptive, p2=adaptive)
    mapped = replace(barrier, transcription=replace(short, arcs="mapped"))
    by_factor = replace(tuned, transcription=MultipleShooting(factor, arcs="differentiated"))
    bfgs = replace(adaptive, hessian="limited-memory")
    spral = replace(adaptive, linear_solver="spral")
    single = SingleShooting()
    return [
        Trick("as printed: 36 entries, angles as ratios", printed),
        Trick("+ margins as signed distances", signed),
        Trick("+ 21 unique entries", entries),
        Trick("+ covariance in units of the initial one", scaled),
        Trick("+ facets far from binding left out", screened),
        Trick("+ covariance up to the last facet only", cut),
        Trick("+ adaptive barrier", barrier),
        Trick("+ one map over all arcs", mapped),
        Trick("+ derivatives arc by arc = tuned", tuned),
        Trick("tuned, but a factor instead of the covariance", by_factor),
        Trick("tuned, but L-BFGS instead of exact Hessians", replace(tuned, p2=bfgs)),
        Trick("tuned, but SPRAL instead of MUMPS", replace(tuned, p2=spral)),
        Trick("single shooting, exact Hessians", Variant(single, adaptive, adaptive)),
        Trick("single shooting, L-BFGS = shooting", Variant(single, adaptive, bfgs)),
    ]


def measure(
    mission: Mission, chosen: Sequence[Trick], kept: Kept, tell: Callable[[str], None]
) -> list[Row]:
    """Solve P2 with each, from the same P3 solution; what is kept is not solved again."""
    from scp_recon.planning.ipopt import IpoptStages, casadi_arcs

    start = plan(mission, initial_guess.cold(mission), problem="P3").final.result.lin
    mean, factor = start.iterate.mean, start.factor
    facets = choose_facets(mission.problem, mission.polytopes, mean, factor)
    arcs = casadi_arcs(mission.dynamics)
    rows: list[Row] = []

    def solved(trick: Trick) -> dict[str, str]:
        solver = IpoptStages(mission, arcs, trick.variant)
        begin = process_time()
        rows_ = solver.chance_rows(facets, start)
        stage = solver.solve("P2", rows_, start, lambda *_: None)
        run = stage.runs[-1]
        row = (
            trick.name,
            f"{stage.result.status.value.name.replace('_', ' ')} ({run.status})",
            f"{stage.result.lin.iterate.total_dv * mission.units.speed_m_s:.6f}",
            str(run.unknowns),
            str(run.rows),
            str(max(len(run.iterations) - 1, 0)),
            f"{run.build_s:.2f}",
            f"{run.solve_s:.2f}",
            f"{run.evaluate_s:.2f}",
            f"{process_time() - begin:.2f}",
        )
        return dict(zip(HEAD, row, strict=True))

    for trick in chosen:
        found = kept.row(trick.name, partial(solved, trick))
        row = tuple(found[name] for name in HEAD)
        rows.append(row)
        tell(", ".join(f"{name} {value}" for name, value in zip(HEAD, row, strict=True)))
    return rows


def to_csv(rows: Sequence[Row]) -> str:
    """With a header."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([HEAD, *rows])
    return text.getvalue()


def to_markdown(rows: Sequence[Row]) -> str:
    """As a table."""
    lines = [HEAD, ["---"] * len(HEAD), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    p = argparse.ArgumentParser(prog="python -m experiments.nlp_tricks", description=__doc__)
    p.add_argument("--out", type=Path, default=DEFAULT_OUT, metavar="DIR")
    options = parse(p, arguments)
    return run_command(lambda console: _run(options.out, console), options)


def _run(out: Path, console: Console) -> int:
    os.environ.update(FOR_SPRAL)
    chosen = tricks()
    mission = Mission.from_scenario(load_scenario())
    kept = Kept(out / "nlp_tricks_partial.jsonl", __file__, {})
    rows = measure(mission, chosen, kept, lambda line: console.print(line, highlight=False))
    for name, text in {"nlp_tricks.csv": to_csv(rows), "nlp_tricks.md": to_markdown(rows)}.items():
        console.print(f"written: {write_atomically(out / name, text)}", highlight=False)
    kept.forget()
    return 0


if __name__ == "__main__":
    sys.exit(main())
