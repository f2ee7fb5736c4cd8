"""Draft, plan and write a first scenario for a site and a body, or for another tool's trajectory."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from datetime import datetime
from functools import partial
from itertools import product
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from scp_recon.api.inputs import PlanRequest, date_in_tdb
from scp_recon.api.planning import carry_out
from scp_recon.bodies.catalogue import DAY_S, J2000_TDB, body_names, packaged_body
from scp_recon.display import digits, exact, mm_s
from scp_recon.drafting import draft as drafting
from scp_recon.drafting.draft import Draft, Track
from scp_recon.errors import InputError, make_whole, number_between, option, path_of
from scp_recon.files import check_writable, write_for
from scp_recon.interop import tracks
from scp_recon.interop.ccsds import oem_track
from scp_recon.mission.intervals import DENSITIES, density
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.replanning.remainder import numbers
from scp_recon.results.solution import Solution
from scp_recon.results.verification import Verification
from scp_recon.scenario.schema import Scenario
from scp_recon.verification.causes import causes

NUMBERS = {
    "gm": (1e-6, 1e20, "m^3/s^2"),
    "radius": (1.0, 1e7, "m"),
    "period": (0.1, 1000.0, "h"),
}
"""Bounds and unit of each number of a body that is not packaged."""
LISTS = {"site": 2, "pole": 2, "orbit": 6}
OF_A_BODY = ("gm", "radius", "period", "pole", "orbit")
SOURCES = ("from_spice", "from_oem", "from_csv")
NEEDS = {None: ("epoch",), "from_spice": ("spacecraft", "begin", "end"), "from_csv": ("epoch",)}
"""What a trajectory, or none, needs besides."""
GOES_WITH = {
    "epoch": (None, "from_csv"),
    "spacecraft": ("from_spice",),
    **dict.fromkeys(("begin", "end"), SOURCES),
    **dict.fromkeys(OF_A_BODY, (None, "from_oem", "from_csv")),
}
"""Trajectories, or none, with which an option may be given; kernels contain the body."""
BOUNDARY_AT = {"initial": (0, "at --from"), "final": (-1, "at --to")}
"""Number of a boundary's state in a trajectory, and its time in words."""
METRES = {"km": 1e3, "m": 1.0, "mm": 1e-3}
"""Units of positions that files may have, m."""
HEAD_COLUMNS = 98
"""Width of the head of a scenario's file."""


@dataclass(frozen=True)
class NewOptions:
    """The checked arguments of `new`; dates in TDB."""

    name: str
    body: str
    site: tuple[float, ...]
    epoch: datetime | None = None
    gm: float | None = None
    radius: float | None = None
    period: float | None = None
    pole: tuple[float, ...] | None = None
    orbit: tuple[float, ...] | None = None
    from_spice: Path | None = None
    spacecraft: int | None = None
    from_oem: Path | None = None
    from_csv: Path | None = None
    begin: datetime | None = None
    end: datetime | None = None

    @classmethod
    def of(cls, *arguments: Any) -> NewOptions:
        """Convert and check the arguments of `api.verbs.new`, in order."""
        read: dict[str, Any] = dict(zip((one.name for one in fields(cls)), arguments, strict=True))
        for name in ("name", *SOURCES):
            if name == "name" or read[name] is not None:
                read[name] = path_of(option(name), read[name])
        read["name"] = str(read["name"]).removesuffix(".toml")
        for name, count in LISTS.items():
            if read[name] is not None or name == "site":
                given = numbers(option(name), read[name], (count,), f"{count} numbers")
                read[name] = tuple(given.tolist())
        for name, utc in (("epoch", False), ("begin", True), ("end", True)):
            read[name] = date_in_tdb(option(name), read[name], utc=utc)
        return cls(**read)

    def __post_init__(self) -> None:
        for name, (low, high, unit) in NUMBERS.items():
            if (given := getattr(self, name)) is not None:
                number_between(option(name), given, low, high, unit)
        latitude, longitude = self.site
        if not -90.0 <= latitude <= 90.0 or not -360.0 <= longitude <= 360.0:
            allowed = "must be within 90 deg of latitude and 360 of longitude"
            raise InputError(option("site"), f"{exact(latitude)},{exact(longitude)}", allowed)
        if self.spacecraft is not None:
            make_whole(self, "spacecraft", -(2**31) + 1, 2**31 - 1)
        # One trajectory at most, with all that it needs, and nothing that it has itself.
        sources = [name for name in SOURCES if getattr(self, name) is not None]
        if len(sources) > 1:
            raise InputError(
                ", ".join(map(option, sources)), "more than one", "must be one of them"
            )
        flag = "".join(map(option, sources))
        lacks = [name for name in NEEDS.get(self.source, ()) if getattr(self, name) is None]
        if missing := ", ".join(map(option, lacks)):
            if self.source is None:
                allowed = "must be given, or a trajectory to start from"
                raise InputError(missing, "nothing", allowed)
            raise InputError(flag, "not all that it needs", f"needs {missing}")
        idle = [
            name
            for name, sources_of in GOES_WITH.items()
            if getattr(self, name) is not None and self.source not in sources_of
        ]
        if idle:
            said = f"{flag} has it" if flag else "goes with a trajectory of another tool"
            values = ", ".join(f"{getattr(self, name)}" for name in idle)
            raise InputError(", ".join(map(option, idle)), values, f"must be left out: {said}")

    @property
    def title(self) -> str:
        """The scenario's name without its folder."""
        return Path(self.name).name

    @property
    def source(self) -> str | None:
        """The argument that names a trajectory of another tool, if any does."""
        return next((name for name in SOURCES if getattr(self, name) is not None), None)

    def draft_at(self, epoch: datetime) -> Draft:
        """The draft before the flyby is designed, for a packaged body or one given by numbers."""
        of_body: dict[str, Any] = {name: getattr(self, name) for name in OF_A_BODY}
        site = self.site[0], self.site[1]
        known = packaged_body(self.body)
        if known is not None:
            if extra := ", ".join(option(n) for n, value in of_body.items() if value is not None):
                allowed = f"is packaged: {extra} must be left out"
                raise InputError(option("body"), self.body, allowed)
            if not known.covers((epoch - J2000_TDB).total_seconds() / DAY_S):
                years = " to ".join(map(str, known.years))
                allowed = f"must be from {years}, for which mean elements of it are packaged"
                given = f"{epoch.isoformat()} of {self.body}"
                raise InputError(option("epoch"), given, allowed)
            name, radius = known.entries["name"], known.entries["reference_radius_m"]
            return Draft(self.title, str(name), None, site, epoch, float(radius))
        if missing := ", ".join(option(name) for name, value in of_body.items() if value is None):
            allowed = f"must be one of {', '.join(body_names())}, or needs {missing} too"
            raise InputError(option("body"), self.body, allowed)
        gm, radius, period, pole, orbit = of_body.values()
        dense = density(gm, radius)
        if not DENSITIES[0] <= dense <= DENSITIES[1]:  # before any search about such a body
            low, high = DENSITIES
            given = f"{exact(gm)} m^3/s^2, a density of {digits(dense, 3)} kg/m^3"
            allowed = f"must make {low:g} to {high:g} kg/m^3 with {option('radius')}"
            raise InputError(option("gm"), given, allowed)
        body = drafting.GivenBody(gm, radius, period, pole, orbit[:3], orbit[3:], 0.0)
        return Draft(self.title, self.body, body, site, epoch, radius)


@dataclass(frozen=True, eq=False)
class NewScenario:
    """A drafted scenario and its plan.

    Attributes:
        mission: of the scenario.
        solution: the result of planning it.
        verification: of the solution.
    """

    draft: Draft
    """Data of the scenario's file."""
    mission: Mission
    solution: Solution
    verification: Verification
    files: tuple[Path, ...] = ()
    """The scenario's, and with a trajectory the start's."""

    @property
    def scenario(self) -> Scenario:
        """The scenario as in the file."""
        return self.mission.scenario

    @property
    def is_verified(self) -> bool:
        """Whether planning converged, and the plan is verified."""
        return self.verification.ok

    @property
    def verdict(self) -> str:
        """The verdict on the plan in one line."""
        verdict = "verified" if self.is_verified else "not verified"
        return f"{self.solution.status}, {verdict}, {mm_s(self.solution.total_dv_m_s, 1)}"

    def __repr__(self) -> str:
        """One line."""
        return f"<NewScenario {self.draft.name}: {self.verdict}>"


def draft(options: NewOptions, progress: Callable[[str], None]) -> NewScenario:
    """See `api.verbs.new`."""
    path = Path(f"{options.name}.toml")
    start = path.with_name(f"{path.stem}_start.csv")
    for file in (path, start) if options.source else (path,):
        if file.exists():
            raise InputError(option("name"), str(file), "must not exist yet")
    if options.source is not None:
        return _from_track(options, options.source, path, start)
    assert options.epoch is not None
    first = options.draft_at(options.epoch)
    check_writable(path.parent, path.name, option("name"))
    tried: list[NewScenario] = []
    for one in drafting.drafts(first):
        tried.append(found := _planned(one, PlanRequest(drafting.scenario_of(one))))
        first_s, last_s = found.mission.schedule.window_s
        hours = f"local solar time {one.hours[0]:g} to {one.hours[1]:g} h"
        progress(f"{hours}, window of {last_s - first_s:.0f} s: {found.verdict}")
        if found.is_verified:
            break
    best = min(tried, key=lambda one: (not one.is_verified, one.solution.violation.total))
    text = drafting.draft_text(replace(best.draft, outcome=_outcome(best)))
    write_for(option("name"), path, text)
    return replace(best, files=(path,))


def _planned(draft: Draft, request: PlanRequest) -> NewScenario:
    """Plan and verify a draft; return both, on the grid that planning may have refined."""
    outcome, given = carry_out(request), drafting.scenario_of(draft)
    if outcome.verification is None:
        raise KeyboardInterrupt
    mission = outcome.plan.mission
    step = mission.scenario.grid.step_max_s
    if step != given.grid.step_max_s:
        comment = "s between nodes at most; finer than recon_b's, for covariances"
        grid = {"grid": [("step_max_s", step, comment)]}
        draft = replace(draft, instead={**draft.instead, **grid})
    return NewScenario(draft, mission, outcome.solution, outcome.verification)


def _from_track(options: NewOptions, source: str, path: Path, start: Path) -> NewScenario:
    """Draft and plan a scenario from a trajectory; write the start beside the scenario."""
    about, track = _track_draft(options, source)
    flown = about(track)
    try:
        mission = Mission.from_scenario(drafting.scenario_of(flown))
    except InputError as error:
        raise _of_the_file(error, track, about) from None
    doubts = (*track.doubts, *tracks.step_doubts(track), *tracks.pull_doubts(mission, track))
    mission = replace(mission, warnings=(*mission.warnings, *doubts))
    check_writable(path.parent, path.name, option("name"))
    guess = initial_guess.from_states(mission, drafting.start_table(track), track.source)
    found = _planned(flown, PlanRequest(mission, guess, called=start.name))
    outcome = _outcome(found, f" --init {start.name}")
    outcome += [f"warning: {doubt}" for doubt in doubts]
    entry = option("name")
    write_for(entry, start, drafting.start_csv(track, list(initial_guess.COLUMNS.values())))
    write_for(entry, path, drafting.draft_text(replace(found.draft, outcome=outcome)))
    return replace(found, files=(path, start))


def _of_the_file(error: InputError, track: Track, about: Callable[[Track], Draft]) -> InputError:
    """A refused boundary state as one of the trajectory's file, with units that are accepted."""
    which = error.entry.removeprefix("boundary.").partition("_")[0]
    if which not in BOUNDARY_AT:
        return error
    (at, when), unit = BOUNDARY_AT[which], track.unit
    far, fast = np.linalg.norm(track.states[at].reshape(2, 3), axis=1) / METRES[unit]
    given = f"{digits(far)} {unit} from the centre at {digits(fast)} {unit}/s"
    place, allowed = f"{track.entry}, {track.where[at] if track.where else when}", str(error)
    for position, speed in product(METRES, repeat=2):
        factors = np.repeat([METRES[position], METRES[speed]], 3) / METRES[unit]
        read = replace(track, states=factors * track.states)
        with suppress(InputError):
            mission = Mission.from_scenario(drafting.scenario_of(about(read)))
            if not any((*tracks.step_doubts(read), *tracks.pull_doubts(mission, read))):
                units = f"{unit} and {unit}/s, not {position} and {speed}/s"
                return InputError(place, given, f"must be in {units}?\n{allowed}")
    return InputError(place, given, allowed)


def _track_draft(options: NewOptions, source: str) -> tuple[Callable[[Track], Draft], Track]:
    """What drafts a scenario about a trajectory, and the trajectory."""
    known: drafting.Tables = {}
    packaged = packaged_body(options.body)
    if source == "from_spice":
        given: Any = options  # which has all of these, as was checked
        number, radius, known = tracks.spice_body(
            given.from_spice, options.body, packaged, given.begin
        )
        span = given.begin, given.end
        track = tracks.spice_track(given.from_spice, given.spacecraft, number, span)
        site = options.site[0], options.site[1]
        draft = Draft(options.title, options.body, None, site, track.epoch, radius)
    else:
        center = str(packaged.entries["name"]) if packaged else options.body
        if options.from_oem is not None:
            track = oem_track(options.from_oem, center)
        else:
            assert options.from_csv is not None
            assert options.epoch is not None
            track = tracks.csv_track(options.from_csv, options.epoch)
        track = tracks.cut(track, options.begin, options.end)
        draft = options.draft_at(track.epoch)  # at which orbit and meridian are
    return partial(drafting.flown_draft, replace(draft, epoch=track.epoch), known), track


def _outcome(found: NewScenario, options: str = "") -> list[str]:
    """Lines on the outcome of planning, for the head of the file."""
    lines = [f"python -m scp_recon.solve --scenario FILE{options} gave: {found.verdict}."]
    if found.is_verified:
        return lines
    said = list(causes(found.mission, found.verification))
    if found.solution.violation.by_constraint:
        said.append(f"violated: {', '.join(found.solution.violation.by_constraint)}")
    said.append("no remedy was tried; the command above tries some, and shows what suffices")
    for line in said:
        lines += wrap(line, HEAD_COLUMNS, subsequent_indent="  ")
    return lines
