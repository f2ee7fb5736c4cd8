"""Plan a flyby: `python -m scp_recon.solve --init cold`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from formulations.problem import Iterate
from formulations.subproblem import FORMULATIONS
from scp_recon import guess, report
from scp_recon.errors import InputError
from scp_recon.mission import Mission
from scp_recon.planner import plan
from scp_recon.results import make_solution
from scp_recon.scenario import base_names, load_scenario, validate_scenario
from scp_recon.scenario_schema import Scenario
from scp_recon.solution import Solution, read_solution, write_atomically
from scp_recon.status import Status
from scp_recon.verification import verify

BAD_INPUT, NOT_VERIFIED = 2, 4


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="python -m scp_recon.solve", description=__doc__)
    p.add_argument(
        "--scenario",
        type=Path,
        metavar="FILE",
        help=f"TOML file, complete or with base = one of {', '.join(base_names())} (default: recon_b)",
    )
    p.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="PATH=VALUE",
        dest="overrides",
        help="override one entry of the scenario, e.g. risk.p_chance=0.8; may be repeated",
    )
    p.add_argument(
        "--init",
        default="cold",
        metavar="cold|warm|FILE",
        help="straight line; ballistic arc; a solution file (and its scenario, unless --scenario is "
        "given) or a CSV of states t, x, y, z, vx, vy, vz in SI, J2000 (default: cold)",
    )
    p.add_argument(
        "--problem",
        choices=("P2", "P3"),
        default="P2",
        help="with uncertainty, or without it (default: P2)",
    )
    p.add_argument(
        "--formulation",
        choices=sorted(FORMULATIONS),
        default="condensed",
        help="of the convex subproblem (default: condensed)",
    )
    p.add_argument(
        "--facet-rounds",
        type=_count,
        default=0,
        metavar="N",
        help="choose the facets again at the solution and solve again, N times (default: 0)",
    )
    p.add_argument(
        "--out",
        type=Path,
        default=Path("runs") / "latest",
        metavar="DIR",
        help="folder for solution.json (default: runs/latest)",
    )
    return p


def _count(text: str) -> int:
    if not text.isdigit() or int(text) > 100:
        raise argparse.ArgumentTypeError(f"got {text!r}; must be a whole number from 0 to 100")
    return int(text)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    options = parser().parse_args(arguments)
    console, errors = Console(), Console(stderr=True)
    try:
        return _solve(options, console)
    except InputError as error:
        errors.print(f"error: {error}", style="red", markup=False, highlight=False)
        return BAD_INPUT
    except KeyboardInterrupt:
        errors.print("interrupted", style="red")
        return Status.INTERRUPTED.value.exit_code


def _solve(options: argparse.Namespace, console: Console) -> int:
    mission, start = _inputs(options)
    _check_writable(options.out)
    report.show_mission(console, mission)
    console.print()
    with report.live_iterations(console, mission) as observe:
        result = plan(
            mission,
            start,
            problem=options.problem,
            formulation=options.formulation,
            facet_rounds=options.facet_rounds,
            observe=observe,
        )
    lin = result.final.result.lin
    if not (np.isfinite(lin.iterate.mean).all() and np.isfinite(lin.factor).all()):
        raise InputError(
            "scenario",
            "magnitudes for which the dynamics are not finite along the guess",
            "the units of body, boundary and burns must fit together",
        )
    solution = make_solution(mission, result, options.init, options.formulation)
    # Written before it is verified, so that an interrupt from here on loses nothing.
    path = _write(solution, options.out)
    report.show_solution(console, solution)
    status = Status.named(solution.status)
    if status is Status.INTERRUPTED:
        report.show_files(console, path)
        return status.value.exit_code
    verification = verify(mission, solution)
    path = _write(solution.model_copy(update={"verification": verification}), options.out)
    report.show_verification(console, mission, verification)
    report.show_files(console, path)
    return status.value.exit_code or (0 if verification.ok else NOT_VERIFIED)


def _inputs(options: argparse.Namespace) -> tuple[Mission, Iterate]:
    """The mission and the initial guess that the options ask for."""
    if options.init in ("cold", "warm"):
        mission = Mission.from_scenario(load_scenario(options.scenario, options.overrides))
        return mission, (guess.cold if options.init == "cold" else guess.ballistic)(mission)
    path = Path(options.init)
    given = read_solution(path) if path.is_dir() or _looks_like_json(path) else None
    mission = Mission.from_scenario(_scenario(options, given))
    if given is None:
        return mission, guess.from_table(mission, path)
    return mission, guess.from_burns(mission, given.burns_m_s)


def _scenario(options: argparse.Namespace, given: Solution | None) -> Scenario:
    if options.scenario is None and given is not None:
        return validate_scenario(given.scenario.model_dump(mode="json"), options.overrides)
    return load_scenario(options.scenario, options.overrides)


def _looks_like_json(path: Path) -> bool:
    return path.suffix == ".json"


def _check_writable(folder: Path) -> None:
    """Fail before the work, not after it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / ".probe", "").unlink()
    except OSError as error:
        reason = (error.strerror or "unwritable").lower()
        raise InputError("--out", f"{folder} ({reason})", "must be a folder to write to") from None


def _write(solution: Solution, folder: Path) -> Path:
    try:
        return solution.write(folder)
    except OSError as error:
        reason = (error.strerror or "unwritable").lower()
        raise InputError("--out", f"{folder} ({reason})", "must be a folder to write to") from None


if __name__ == "__main__":
    sys.exit(main())
