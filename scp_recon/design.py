"""Design a whole pass from a home orbit: `python -m scp_recon.design SCENARIO`."""

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
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console

from scp_recon.certification.certify import certify
from scp_recon.cli.keeping import point_latest, run_folder
from scp_recon.cli.live import Progress
from scp_recon.cli.options import add_certify, add_overrides, named_folder
from scp_recon.cli.view.design_tables import as_csv, primer_says, progress, why_nothing
from scp_recon.errors import InputError
from scp_recon.files import unwritable, write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.certifying import flights_needed
from scp_recon.pass_design.design import Designer, Tried
from scp_recon.pass_design.near import Found
from scp_recon.pass_design.setting import settled
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.write import scenario_text
from scp_recon.scp.status import Status
from scp_recon.solution.file import FILE_NAME
from scp_recon.solution.read import read_solution
from scp_recon.solve import plan_into

Array = npt.NDArray[np.float64]

TABLE, MAP, SCENARIO, PRIMER = "design.csv", "design.png", "scenario.toml", "primer.png"
FACET_ROUNDS = 3
"""Of the plan in the end, whose facets are chosen as `solve` chooses them."""
INIT = "design"


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="python -m scp_recon.design", description=__doc__)
    p.add_argument(
        "scenario",
        metavar="SCENARIO",
        help="TOML file with boundary.home, or a packaged one's name",
    )
    add_overrides(p)
    add_certify(p)
    p.add_argument(
        "--out",
        type=named_folder,
        metavar="DIR",
        help=f"folder for solution.json, {SCENARIO}, {TABLE} and pictures (default: runs/NAME/UTC)",
    )
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    options = parse(parser(), arguments)
    return run_command(lambda console: _design(options, console), options)


def _design(options: argparse.Namespace, console: Console) -> Answer:
    scenario = load_scenario(options.scenario, options.overrides)
    exact = scenario.risk.allocation == "exact"
    if options.certify is not None and not exact:
        raise InputError("--certify", options.certify, "goes with risk.allocation = exact only")
    certified = exact and options.certify != "no"
    if certified:
        flights_needed(scenario.risk.p_chance)  # or says at once that they are too many
    with run_folder(options.out, scenario.name) as folder:
        with progress(console) as observe:
            designer = Designer(scenario, observe)
            space, found = designer.run()
        _keep(folder, TABLE, as_csv(designer.tried))
        _keep_map(folder, designer.tried, found, console)
        if not found.converged:
            show_line(console, why_nothing(found, len(designer.tried)))
            show_written(console, folder / TABLE)
            return Answer(Status.INFEASIBLE.value.exit_code, {"files": [str(folder / TABLE)]})
        fixed = settled(scenario, space, found.at)
        _keep(folder, SCENARIO, scenario_text(fixed))
        mission = Mission.from_scenario(fixed)
        burns = found.burns_m_s
        answer = plan_into(
            folder, mission, lambda seen: _plan(mission, burns, seen, certified=certified), console
        )
        _keep_primer(folder, console)
    point_latest(options.out, folder, answer.status)
    return answer


def _plan(mission: Mission, burns_m_s: Array, observe: Progress, *, certified: bool) -> Plan:
    """The plan of the design as `solve` makes it, begun at its burns."""
    start = from_burns(mission, burns_m_s, INIT)
    rounds = 0 if mission.scenario.risk.allocation == "exact" else FACET_ROUNDS
    if certified:
        return certify(
            mission,
            start,
            lambda m, s, aim: plan(m, s, aim=aim, init=INIT, observe=observe),
            observe.round,
        )
    return plan(mission, start, facet_rounds=rounds, init=INIT, observe=observe)


def _keep(folder: Path, name: str, content: str | bytes) -> None:
    try:
        write_atomically(folder / name, content)
    except OSError as error:
        raise unwritable(folder, "--out", error) from None


def _keep_primer(folder: Path, console: Console) -> None:
    """What the plan's primer says, and its picture if there is matplotlib."""
    if not (folder / FILE_NAME).exists():
        return
    solution = read_solution(folder)
    show_line(console, primer_says(solution.primer))
    if solution.primer is not None and _can_draw():
        from scp_recon.cli.view.primer_chart import draw

        _keep(folder, PRIMER, draw(solution.primer, [burn.t_s for burn in solution.burns]))


def _can_draw() -> bool:
    return importlib.util.find_spec("matplotlib") is not None


def _keep_map(folder: Path, tried: Sequence[Tried], found: Found, console: Console) -> None:
    if not any(one.found.converged for one in tried):
        return
    if not _can_draw():
        show_line(console, f"no {MAP}, no {PRIMER}: pip install 'scp_recon[report]' for them")
        return
    from scp_recon.cli.view.design_map import draw

    _keep(folder, MAP, draw(tried, found))


if __name__ == "__main__":
    sys.exit(main())
