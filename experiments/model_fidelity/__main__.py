"""How good a model the planner needs: `python -m experiments.model_fidelity`.

A flight under the degree-8 field, light pressure on the vehicle's plates in their commanded attitude
and finite burns is the truth. Each of these is replaced by its cruder models in turn, and the distance
at the end of the flight decides: of every effect the crudest model that stays within 10 m is named.
Written are OUT/model_fidelity.csv, .md and, with the distances over time, model_fidelity_history.csv.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint, parse

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from experiments.kept import Kept
from experiments.model_fidelity.compared import compare, flown_models
from experiments.model_fidelity.models import Flight
from experiments.model_fidelity.report import history, records, to_markdown, verdicts
from experiments.observation_table.rows import rows
from experiments.studies import add_out, run, to_csv
from scp_recon.files import write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.scenario.load import load_scenario
from scp_recon.solution.read import read_solution
from scp_recon.spacecraft.vehicle import Vehicle, load_vehicle

Array = npt.NDArray[np.float64]

NAME = "model_fidelity"
HISTORY = f"{NAME}_history.csv"
DEFAULT_OUT = Path("runs") / NAME


def flights(mission: Mission, vehicle: Vehicle, solution: Path | None) -> list[Flight]:
    """The departure burn alone, as the paper flies it, and a plan."""
    designs = {row.key: row.design for row in rows(ipopt=False)}
    arc = designs["ballistic"](mission)
    plan = read_solution(solution) if solution else designs["scp_cold"](mission)
    same = Mission.from_scenario(plan.scenario)
    return [
        Flight.of("ballistic arc", arc, mission, vehicle),
        Flight.of("plan", plan, same, vehicle),
    ]


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog=f"python -m experiments.{NAME}", description=__doc__)
    add_out(p, DEFAULT_OUT)
    p.add_argument(
        "--solution",
        type=Path,
        metavar="DIR",
        help="plan to fly (default: the default scenario's from a cold start)",
    )
    p.add_argument(
        "--vehicle", type=Path, metavar="FILE", help="vehicle file (default: the packaged DARE)"
    )
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 if everything was written, 2 for bad input."""
    return run(_run, parse(parser(), arguments))


def _run(options: argparse.Namespace) -> int:
    mission, vehicle = Mission.from_scenario(load_scenario()), load_vehicle(options.vehicle)
    options.out.mkdir(parents=True, exist_ok=True)
    cases = flights(mission, vehicle, options.solution)
    flown = {case.name: json.dumps(case.burns_m_s.tolist()) for case in cases}
    kept = Kept(
        options.out / f"{NAME}_partial.jsonl", __file__, {**flown, "vehicle": repr(vehicle)}
    )
    columns = (TextColumn("flights"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=sum(map(flown_models, cases)))
        entries = [e for case in cases for e in compare(case, kept, lambda: progress.advance(task))]
    files = {
        f"{NAME}.csv": to_csv(records(entries)),
        f"{NAME}.md": to_markdown(entries),
        HISTORY: to_csv(history(entries)),
    }
    written = [write_atomically(options.out / name, text) for name, text in files.items()]
    kept.forget()
    for line in verdicts(entries):
        print(line)
    for path in written:
        print(f"written: {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
