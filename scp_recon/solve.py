"""Plan a flyby: `python -m scp_recon.solve --init cold`."""

from __future__ import annotations

from scp_recon.cli.command import (
    NOT_VERIFIED,
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
from collections.abc import Callable, Sequence
from pathlib import Path

from pydantic import ValidationError
from rich.console import Console

from formulations.problem.flyby import Iterate
from scp_recon.cli.documents import plan_document
from scp_recon.cli.keeping import UNVERIFIED, point_latest, run_folder, write_plan
from scp_recon.cli.live import Progress, live_progress
from scp_recon.cli.method import check_risk, planning
from scp_recon.cli.options import (
    add_certify,
    add_overrides,
    int_between,
    named_folder,
)
from scp_recon.cli.plan_options import add_method, add_objective, add_starts
from scp_recon.cli.view import plan_tables
from scp_recon.cli.view.infeasible import show_what_would_do, undoing
from scp_recon.cli.warnings import show_warnings
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.method import (
    FACET_ROUNDS_MAX,
    PROBLEMS,
)
from scp_recon.planning.plan import Plan
from scp_recon.scenario.load import base_names, load_scenario, override
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status
from scp_recon.solution.file import FILE_NAME, Solution
from scp_recon.solution.from_plan import make_solution
from scp_recon.solution.read import read_solution
from scp_recon.solution.start import is_solution, start_from
from scp_recon.verification.reintegration import verify


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="python -m scp_recon.solve", description=__doc__)
    p.add_argument(
        "--scenario",
        type=Path,
        metavar="FILE",
        help=f"TOML file, complete or with base = a file or one of {', '.join(base_names())} (default: "
        "recon_b)",
    )
    add_overrides(p)
    p.add_argument(
        "--init",
        default="cold",
        type=_start,
        metavar="cold|warm|FILE",
        help="straight line; ballistic arc; a solution file (and its scenario, unless --scenario is "
        "given) or a CSV of states t, x, y, z, vx, vy, vz in SI, J2000 (default: cold)",
    )
    p.add_argument(
        "--problem",
        choices=PROBLEMS,
        default="P2",
        help="with uncertainty, or without it (default: P2)",
    )
    add_starts(p)
    add_method(p)
    p.add_argument(
        "--report",
        action="store_true",
        help="write report.html too, a page to look at; the extra [report]",
    )
    p.add_argument(
        "--facet-rounds",
        type=int_between(0, FACET_ROUNDS_MAX),
        default=0,
        metavar="N",
        help="choose the facets again at the solution and solve again, up to N times (default: 0; what "
        "is infeasible is tried again without being asked)",
    )
    add_objective(p)
    add_certify(p)
    p.add_argument(
        "--out",
        type=named_folder,
        metavar="DIR",
        help="folder for solution.json (default: runs/NAME/UTC with the scenario's name, to which "
        "runs/latest then points); a verified plan there gives way to a verified one only",
    )
    return p


def _start(text: str) -> str:
    if not text:
        raise argparse.ArgumentTypeError("got ''; must be cold, warm or a file")
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    options = parse(parser(), arguments)
    return run_command(lambda console: _solve(options, console), options)


def _solve(options: argparse.Namespace, console: Console) -> Answer:
    make_plan = planning(options)
    if options.report:
        from scp_recon.report.write import check_extra

        check_extra()
    mission, start = _inputs(options)
    check_risk(options, mission.scenario)
    with run_folder(options.out, mission.scenario.name) as folder:
        answer = plan_into(
            folder,
            mission,
            lambda seen: make_plan(mission, start, seen),
            console,
            start=start,
            instead=undoing(options),
        )
        if options.objective == "probability" and answer.status == 0:
            _tell_largest(options.dv_budget, answer, console)
        if options.report and answer.status != Status.INTERRUPTED.value.exit_code:
            _report(folder, console)
    point_latest(options.out, folder, answer.status)
    return answer


def plan_into(
    folder: Path,
    mission: Mission,
    make_plan: Callable[[Progress], Plan],
    console: Console,
    *,
    start: Iterate | None = None,
    instead: Sequence[str] = (),
) -> Answer:
    """Plan, verify, show and write.

    Args:
        folder: for the files.
        mission: to plan.
        make_plan: does it.
        console: where to show it.
        start: where the plan begins, if it is known; and so one that is proposed instead.
        instead: options that the command needs besides to plan what is proposed.

    Returns:
        The exit status of the plan, and its document.

    Raises:
        InputError: if its figures are not finite, or the folder cannot be written.
    """
    plan_tables.show_mission(console, mission)
    console.print()
    try:
        with live_progress(console, mission) as observe:
            result = make_plan(observe)
        solution = make_solution(result)
    except ValidationError:  # which only numbers that are not finite can cause
        raise InputError(
            "scenario",
            "magnitudes for which the dynamics are not finite along the guess",
            "the units of body, boundary and burns must fit together",
        ) from None
    # Written before it is verified, so that an interrupt from here on loses nothing.
    path, aside = write_plan(solution, folder)
    plan_tables.show_solution(console, solution)
    status = Status.named(solution.status)
    if status is Status.INTERRUPTED:
        show_warnings(console, solution.warnings)
        show_written(console, path)
        return Answer(status.value.exit_code, plan_document(solution, [path]))
    mission = result.mission  # certifying may have added nodes
    verification = verify(mission, solution)
    checked = solution.model_copy(update={"verification": verification})
    path, more = write_plan(checked, folder)
    plan_tables.show_verification(console, mission, verification, mission.warnings)
    for old in [*aside, *more]:
        show_line(console, f"set aside, as it is of another plan: {old}")
    if path.name == UNVERIFIED:
        show_line(console, f"kept, as it is verified: {folder / FILE_NAME}")
    show_written(console, path)
    if status is Status.INFEASIBLE:
        show_what_would_do(console, result, start, instead)
    code = status.value.exit_code or (0 if verification.ok else NOT_VERIFIED)
    return Answer(code, plan_document(checked, [path]))


def _tell_largest(budget_m_s: float | None, answer: Answer, console: Console) -> None:
    """What was found beside what it was allowed to cost."""
    plan = answer.document["plan"]
    most = "any delta-v" if budget_m_s is None else f"at most {budget_m_s:g} m/s"
    found = f"{plan['risk']['asked']:.5g}, for {plan['total_dv_m_s']:.6f} m/s"
    show_line(console, f"largest probability found for {most}: {found}")


def _report(folder: Path, console: Console) -> None:
    """Of the plan that was just written, be it the verified one or the one beside it."""
    from scp_recon.report import write

    aside = folder / UNVERIFIED
    if aside.is_file():
        path = write.write_report([aside], aside.with_name(write.UNVERIFIED_NAME))
    else:
        path = write.write_report([folder], folder / write.FILE_NAME)
    show_written(console, path)


def _inputs(options: argparse.Namespace) -> tuple[Mission, Iterate]:
    """The mission and the initial guess that the options ask for."""
    path = Path(options.init)
    named = options.init in ("cold", "warm") or not is_solution(path)
    given = None if named else read_solution(path)
    mission = Mission.from_scenario(_scenario(options, given))
    if given is None:
        return mission, start_from(mission, options.init, "--init")
    return mission, initial_guess.from_burns(mission, given.burns_m_s, "--init")


def _scenario(options: argparse.Namespace, given: Solution | None) -> Scenario:
    if options.scenario is None and given is not None:
        return override(given.scenario, options.overrides)
    return load_scenario(options.scenario, options.overrides)


if __name__ == "__main__":
    sys.exit(main())
