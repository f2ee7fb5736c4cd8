"""Draft a scenario for one's own site and body: `python -m scp_recon.new NAME --body Bennu ...`."""

from __future__ import annotations

from scp_recon.cli.command import (
    NOT_VERIFIED,
    Answer,
    exit_on_sigint,
    parse,
    run_command,
    show_written,
)

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console

from scp_recon.cli.documents import plan_document
from scp_recon.cli.from_track import add_track_options, source_of, track_draft
from scp_recon.cli.options import date_tdb, number_between
from scp_recon.cli.view import plan_tables
from scp_recon.draft.draft import Draft, GivenBody
from scp_recon.draft.drafting import drafts, scenario_of
from scp_recon.draft.flown import start_csv, start_table
from scp_recon.draft.text import draft_text
from scp_recon.environment.catalogue import DAY_S, J2000_TDB, body_names, packaged_body
from scp_recon.errors import InputError
from scp_recon.exchange.track_doubts import pull_doubts, step_doubts
from scp_recon.files import check_writable, unwritable, write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess, state_table
from scp_recon.planning.planner import plan
from scp_recon.scp.status import Status
from scp_recon.solution.file import Solution
from scp_recon.solution.from_plan import make_solution
from scp_recon.solution.verdict import Verification
from scp_recon.verification.reintegration import verify

NUMBERS = ("gm", "radius", "period", "pole", "orbit")
"""Options that a body needs which is not packaged."""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="python -m scp_recon.new", description=__doc__)
    p.add_argument(
        "name",
        type=lambda text: text.removesuffix(".toml"),
        metavar="NAME",
        help="of the scenario, written to NAME.toml",
    )
    p.add_argument(
        "--body",
        required=True,
        metavar="NAME",
        help=f"{', '.join(body_names())}; or another, with the last five options",
    )
    p.add_argument(
        "--site",
        required=True,
        type=_numbers(2),
        metavar="LAT,LON",
        help="planetocentric latitude and east longitude in deg; as --site=-20,30 where it is south",
    )
    p.add_argument(
        "--epoch",
        type=date_tdb,
        metavar="TDB",
        help="earliest time of the first burn, TDB, e.g. 2020-01-21T20:33:17; where no trajectory is "
        "given",
    )
    p.add_argument("--gm", type=number_between(1e-6, 1e20), metavar="GM", help="in m^3/s^2")
    p.add_argument("--radius", type=number_between(1.0, 1e7), metavar="R", help="in m; a sphere")
    p.add_argument(
        "--period",
        type=number_between(0.1, 1000.0),
        metavar="H",
        help="sidereal spin period in h, right-handed about the pole",
    )
    p.add_argument("--pole", type=_numbers(2), metavar="RA,DEC", help="spin pole in deg, J2000")
    p.add_argument(
        "--orbit",
        type=_numbers(6),
        metavar="X,Y,Z,VX,VY,VZ",
        help="the body from the Sun at --epoch in km and km/s, J2000",
    )
    add_track_options(p)
    return p


def _numbers(count: int) -> Callable[[str], tuple[float, ...]]:
    def parse(text: str) -> tuple[float, ...]:
        try:
            found = tuple(float(word) for word in text.split(","))
        except ValueError:
            found = ()
        if len(found) != count or not np.isfinite(found).all():
            raise argparse.ArgumentTypeError(f"got {text!r}; must be {count} numbers with commas")
        return found

    return parse


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; the exit status of planning what was drafted, or 2."""
    options = parse(parser(), arguments)
    return run_command(lambda console: _new(options, console), options)


@dataclass(frozen=True)
class Planned:
    """A draft and what planning it came to."""

    draft: Draft
    mission: Mission
    solution: Solution
    verification: Verification

    @property
    def status(self) -> int:
        """As `python -m scp_recon.solve` would end."""
        code = Status.named(self.solution.status).value.exit_code
        return code or (0 if self.verification.ok else NOT_VERIFIED)

    @property
    def verdict(self) -> str:
        """In a line."""
        verdict = "verified" if self.verification.ok else "not verified"
        return f"{self.solution.status}, {verdict}, {self.solution.total_dv_m_s:.4f} m/s"


def _new(options: argparse.Namespace, console: Console) -> Answer:
    path, source = Path(f"{options.name}.toml"), source_of(options)
    start = path.with_name(f"{path.stem}_start.csv")
    for file in (path, start) if source else (path,):
        if file.exists():
            raise InputError("NAME", str(file), "must not exist yet")
    if source is not None:
        return _from_track(options, source, (path, start), console)
    first = _first(options)
    check_writable(path.parent, path.name, "NAME")
    tried: list[Planned] = []
    for draft in drafts(first):
        planned = _planned(draft)
        tried.append(planned)
        first_s, last_s = planned.mission.schedule.window_s
        console.print(
            f"local solar time {draft.hours[0]:g} to {draft.hours[1]:g} h, window of "
            f"{last_s - first_s:.0f} s: {planned.verdict}",
            highlight=False,
        )
        if planned.status == 0:
            break
    best = min(tried, key=lambda planned: (planned.status != 0, planned.solution.violation.total))
    _write(path, draft_text(replace(best.draft, outcome=_outcome(best))))
    return _shown(best, [path], console)


def _from_track(
    options: argparse.Namespace, source: str, files: tuple[Path, Path], console: Console
) -> Answer:
    """A scenario about a trajectory, planned from it, and the start beside it."""
    path, start = files
    flown, track = track_draft(options, source, lambda: _first(options))
    mission = Mission.from_scenario(flown.scenario)
    doubts = (*track.doubts, *step_doubts(track), *pull_doubts(mission, track))
    mission = replace(mission, warnings=(*mission.warnings, *doubts))
    check_writable(path.parent, path.name, "NAME")
    guess = state_table.from_states(mission, start_table(track), track.source)
    solution = make_solution(plan(mission, guess, init=start.name))
    planned = Planned(flown.draft, mission, solution, verify(mission, solution))
    outcome = [
        *_outcome(planned, f" --init {start.name}"),
        *(f"warning: {doubt}" for doubt in doubts),
    ]
    _write(start, start_csv(track, list(state_table.COLUMNS.values())))
    _write(path, draft_text(replace(flown.draft, outcome=outcome), flown.tables))
    return _shown(planned, [path, start], console)


def _shown(best: Planned, files: Sequence[Path], console: Console) -> Answer:
    plan_tables.show_mission(console, best.mission)
    plan_tables.show_solution(console, best.solution)
    plan_tables.show_verification(console, best.mission, best.verification, best.mission.warnings)
    for file in files:
        show_written(console, file)
    checked = best.solution.model_copy(update={"verification": best.verification})
    return Answer(best.status, plan_document(checked, files))


def _planned(draft: Draft) -> Planned:
    mission = Mission.from_scenario(scenario_of(draft))
    solution = make_solution(plan(mission, initial_guess.cold(mission), init="cold"))
    return Planned(draft, mission, solution, verify(mission, solution))


def _outcome(planned: Planned, options: str = "") -> list[str]:
    """What the head of the file says of planning it."""
    lines = [f"python -m scp_recon.solve --scenario FILE{options} ended so: {planned.verdict}."]
    if planned.status == 0:
        return lines
    broken = ", ".join(planned.solution.violation.by_constraint) or "none"
    return [
        *lines,
        f"Constraints that are violated: {broken}. To change, in this order: narrower",
        "observation.local_solar_time_*_h, wider observation.emission_*_deg and site_distance_*_m, a",
        "smaller uncertainty.execution_error, a larger burns.dv_max_m_s, another boundary.",
    ]


def _first(options: argparse.Namespace) -> Draft:
    """The draft before anything is designed."""
    latitude, longitude = options.site
    if not -90.0 <= latitude <= 90.0 or not -360.0 <= longitude <= 360.0:
        given = f"{latitude:g},{longitude:g}"
        raise InputError("--site", given, "must be within 90 deg of latitude and 360 of longitude")
    numbers = {name: getattr(options, name) for name in NUMBERS}
    missing = [f"--{name}" for name, value in numbers.items() if value is None]
    known = packaged_body(options.body)
    if known is not None:
        if len(missing) < len(NUMBERS):
            extra = ", ".join(f"--{n}" for n, value in numbers.items() if value is not None)
            raise InputError("--body", options.body, f"is packaged: {extra} must be left out")
        days = (options.epoch - J2000_TDB).total_seconds() / DAY_S
        if not known.covers(days):
            first, last = known.years
            allowed = f"must be from {first} to {last}, for which mean elements of it are packaged"
            raise InputError("--epoch", f"{options.epoch.isoformat()} of {options.body}", allowed)
        return Draft(
            Path(options.name).name,
            str(known.entries["name"]),
            None,
            options.site,
            options.epoch,
            float(known.entries["reference_radius_m"]),
        )
    if missing:
        names = ", ".join(body_names())
        raise InputError(
            "--body", options.body, f"must be one of {names}, or needs {', '.join(missing)} too"
        )
    body = GivenBody(
        options.gm,
        options.radius,
        options.period,
        options.pole,
        options.orbit[:3],
        options.orbit[3:],
        0.0,
    )
    name = Path(options.name).name
    return Draft(name, options.body, body, options.site, options.epoch, options.radius)


def _write(path: Path, text: str) -> None:
    try:
        write_atomically(path, text)
    except OSError as error:
        raise unwritable(path.parent, "NAME", error) from None


if __name__ == "__main__":
    sys.exit(main())
