"""Read what a plan is made from: a request, its scenario and start; overrides and dates."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import NamedTuple, TypedDict

import numpy as np

from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from scp_recon.api.options import PlanOptions
from scp_recon.display import exact
from scp_recon.errors import InputError, option, shortened
from scp_recon.mission.checks import check_scene, later_end
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import Scene
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.results.policy import with_policy
from scp_recon.results.read import read_solution
from scp_recon.results.runs import resolve_run
from scp_recon.results.solution import Solution
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.load import load_scenario, naming_files, override
from scp_recon.scenario.schema import Scenario
from scp_recon.scenario.time_scales import tdb_of_utc

Init = Iterate | Plan | Solution | str | Path | Array
"""A start: "cold", "warm", a guess, a plan or a solution, its file, or a table of states."""
GUESSES = ("cold", "warm")
"""Starts that are made on a mission's own grid."""
UNCERTAIN = ("risk", "policy", "navigation", "polytopes")
"""Tables of entries that a plan without uncertainty does not use."""
ABOUT_LIGHT = ("site.", "sun.", "body.pole", "body.prime_meridian", "body.rotation")
"""Beginnings of the entries that decide when a site is lit."""


class PlannerArguments(TypedDict, total=False):
    """Arguments of `planner.plan` that are known before planning."""

    target: float | None
    p3_resolution: float
    once: bool
    others: bool


@dataclass(frozen=True, eq=False)
class PlanRequest:
    """What to plan, and how.

    Attributes:
        scenario: itself, its mission, its file or a packaged name; None for that of `init`, or recon_b.
        init: see `api.verbs.plan`; or a guess; a plan of the same mission is continued.
        options: of planning.
        overrides: `section.entry=value` each.
        called: name of the start in the solution file; None for the name that `init` has.
        known: arguments of `planner.plan`, for sequential convex programming.
        finish: what to make of the plan before it is verified.
        remade: makes it anew with overrides, where its mission is made of more than a scenario.
    """

    scenario: Mission | Scenario | str | Path | None = None
    init: Init = "cold"
    options: PlanOptions = field(default_factory=PlanOptions)
    overrides: Sequence[str] = ()
    called: str | None = None
    known: PlannerArguments = field(default_factory=PlannerArguments)
    finish: Callable[[Plan], Plan] = lambda plan: plan
    remade: Callable[[Sequence[str]], PlanRequest] | None = None

    def again(self, overrides: Sequence[str]) -> PlanRequest:
        """The request with further overrides.

        Raises:
            InputError: if they are not valid.
        """
        if self.remade is not None:
            return self.remade(overrides)
        scenario = self.scenario
        given = scenario.scenario if isinstance(scenario, Mission) else scenario
        return replace(self, scenario=given, overrides=(*self.overrides, *overrides))


class Loaded(NamedTuple):
    """What a request names, read from its files."""

    scenario: Mission | Scenario
    init: Init
    called: str


class Resolved(NamedTuple):
    """A mission, the start of its plan, and the name of the start in the solution file."""

    mission: Mission
    start: Iterate | Plan
    called: str


def load(request: PlanRequest) -> Loaded:
    """Read the scenario of a request, and its start if that is a solution file.

    Raises:
        InputError: if an argument is not valid, or a file cannot be used.
    """
    init, scenario = request.init, request.scenario
    called = request.called or _called(init)
    if isinstance(init, str | Path) and init not in GUESSES and is_solution(Path(init)):
        init = read_solution(Path(init))
    if scenario is None:
        scenario = "recon_b"
        if isinstance(init, Plan):
            scenario = init.mission.scenario
        elif isinstance(init, Solution):
            scenario = init.scenario
    if not isinstance(scenario, Mission):
        with naming_files(scenario, request.overrides):
            scenario = scenario_of(scenario, request.overrides)
    return Loaded(scenario, init, called)


def resolve(loaded: Loaded, request: PlanRequest) -> Resolved:
    """Make the mission of a scenario, and the initial guess on its grid.

    Raises:
        InputError: if the scenario has no mission, the start is unusable, or an option does not suit
            the scenario.
    """
    mission, init = loaded.scenario, loaded.init
    if isinstance(mission, Mission) and isinstance(init, Plan):
        return Resolved(mission, init, loaded.called)
    if not isinstance(mission, Mission):
        with naming_files(request.scenario, request.overrides):
            mission = _mission_of(mission)
    start = _start(mission, init)
    request.options.check(mission.scenario)
    doubts = tuple(_doubts(request, mission.scenario))
    if doubts:
        mission = replace(mission, warnings=(*mission.warnings, *doubts))
    return Resolved(mission, start, loaded.called)


def _mission_of(scenario: Scenario) -> Mission:
    """Resolve a user's scenario; a refusal of its window names the entries that explain it.

    Named are entries that decide when the site is lit: doubtful ones, and other readings that were
    tried and have a mission.

    Raises:
        InputError: as `Mission.from_scenario`.
    """
    try:
        return Mission.from_scenario(scenario)
    except InputError as error:
        said = [error.allowed]
        if error.entry.startswith(("observation", "burns.times_s")):
            with suppress(InputError):  # this one again
                doubts = check_scene(Scene.of(scenario))
                said += [str(doubt) for doubt in doubts if doubt.entry.startswith(ABOUT_LIGHT)]
            for question, changes in _other_readings(scenario):
                with suppress(InputError):
                    Mission.from_scenario(scenario.replace(changes))
                    entry, value = next(iter(changes.items()))
                    shown = exact(value) if isinstance(value, float) else value
                    said.append(f"tried, and accepted: {entry} = {shown} ({question})")
        full = InputError(error.entry, error.given, "\n".join(said))
        raise read_in_degrees(scenario, full, Mission.from_scenario) from None


def read_in_degrees(
    scenario: Scenario, error: InputError, resolve: Callable[[Scenario], object]
) -> InputError:
    """Begin a refusal with a small angle that, in degrees instead of radians, is accepted.

    Args:
        scenario: that is refused.
        error: the refusal.
        resolve: raises an `InputError` if a scenario is refused.
    """
    for entry, value in _small_angles(scenario):
        right = math.degrees(value)
        with suppress(InputError):
            resolve(scenario.replace({entry: right}))
            allowed = f"tried, and accepted: {right:.6g}; degrees?\n{error}"
            return InputError(entry, f"{value:.12g} deg", allowed)
    return error


def _small_angles(scenario: Scenario) -> Iterator[tuple[str, float]]:
    """Angles that may be in radians, by entry."""
    for table in ("site", "body", "observation"):
        for key, value in getattr(scenario, table):
            if key.endswith("_deg") and value is not None and 0.0 < abs(value) < 2.0 * math.pi:
                yield f"{table}.{key}", value


def _other_readings(scenario: Scenario) -> Iterator[tuple[str, dict[str, object]]]:
    """Other readings of entries that decide when the site is lit: a question, and the changes."""
    site, sun, body = scenario.site, scenario.sun, scenario.body
    for entry, given, side in (
        ("site.longitude_deg", site.longitude_deg, "west"),
        ("site.latitude_deg", site.latitude_deg, "south"),
    ):
        if given is not None:
            yield f"counted to the {side}?", {entry: -given}
    yield (
        "from the body to the Sun?",
        {
            "sun.body_position_km": [-x for x in sun.body_position_km],
            "sun.body_velocity_km_s": [-x for x in sun.body_velocity_km_s],
        },
    )
    if (period := body.rotation_period_h) is not None:
        for question, factor in (("backwards?", -1.0), ("in days?", 24.0), ("in minutes?", 1 / 60)):
            yield question, {"body.rotation_period_h": factor * period}
    else:
        yield "backwards?", {"body.prime_meridian_rate_deg_day": -body.prime_meridian_rate_deg_day}


def _doubts(request: PlanRequest, scenario: Scenario) -> Iterator[ScenarioWarning]:
    """Overrides that have no effect on the plan that is asked for, or end the flight later."""
    certain, is_open = request.options.problem == "P3", scenario.policy.kind == "open"
    is_exact = scenario.risk.allocation == "exact"
    for text in request.overrides:
        entry, _, given = (part.strip() for part in text.partition("="))
        if certain and entry.partition(".")[0] in UNCERTAIN:
            yield ScenarioWarning.of(entry, given, "has no effect on a plan of P3")
        elif is_open and entry == "policy.cost":
            yield ScenarioWarning.of(entry, given, 'has no effect with policy.kind = "open"')
        elif entry.partition(".")[0] == "design":
            words = "has no effect on a plan at given times: `design` chooses them"
            yield ScenarioWarning.of(entry, given, words)
        elif is_exact and entry.startswith("polytopes"):
            yield ScenarioWarning.of(entry, given, 'has no effect with risk.allocation = "exact"')
        elif entry == "burns.times_s":
            others = [one for one in request.overrides if one != text]
            with suppress(InputError):  # burns that alone make the others right
                before = load(replace(request, overrides=others)).scenario
                if isinstance(before, Scenario):
                    yield from later_end(before, scenario)


def _called(init: Init) -> str:
    """Name of a start in the solution file."""
    if isinstance(init, np.ndarray):
        return "a table"
    return {Plan: "a plan", Solution: "a solution", Iterate: "given"}.get(type(init), str(init))


def _start(mission: Mission, init: Init) -> Iterate:
    """Make the initial guess of a mission.

    Raises:
        InputError: if it is no start, or the file or the table is unusable.
    """
    entry = option("init")
    if isinstance(init, Iterate):
        return init
    if isinstance(init, np.ndarray):
        return initial_guess.from_states(mission, init, entry)
    if isinstance(init, Plan):
        return initial_guess.from_burns(mission, init.burns_m_s, entry)
    if isinstance(init, Solution):
        return _of_solution(mission, init, entry)
    if not isinstance(init, str | Path):
        allowed = "must be cold, warm, a file, a plan or an array of shape (n, 7)"
        raise InputError(entry, shortened(init), allowed)
    if init == "cold":
        return initial_guess.cold(mission)
    if init == "warm":
        return initial_guess.ballistic(mission, entry)
    return initial_guess.from_table(mission, Path(init), entry)


def _of_solution(mission: Mission, init: Solution, entry: str) -> Iterate:
    """Burns of a solution, and its gains where the mission corrects the same burns."""
    start = initial_guess.from_burns(mission, init.burns_m_s, entry)
    feedback, corrected = mission.problem.feedback, [one.burn for one in init.corrections]
    if feedback is None or corrected != feedback.burns.tolist():
        return start
    lin = mission.dynamics.linearise(mission.problem, start)
    return with_policy(mission, lin, init.corrections).iterate


def is_solution(path: Path) -> bool:
    """Whether a path is a folder, or a file of JSON by its first brace; tables have none."""
    path = resolve_run(path)
    try:
        if path.is_dir() or path.suffix == ".json":
            return True
        if not path.is_file():  # a pipe can be read only once
            return False
        with path.open("rb") as file:
            return file.read(100).lstrip().startswith(b"{")
    except (OSError, ValueError):  # which the reader explains
        return False


def scenario_of(given: Scenario | str | Path, overrides: Sequence[str] = ()) -> Scenario:
    """Read a scenario that is given as itself, by name, or by its file.

    Args:
        given: the scenario, its name, or its file.
        overrides: `section.entry=value` each.

    Raises:
        InputError: if `given` is none of these, or cannot be read.
    """
    check_overrides(overrides)
    if isinstance(given, Scenario):
        return override(given, overrides)
    if not isinstance(given, str | Path):
        raise InputError("scenario", shortened(given), "must be a scenario, its name, or a file")
    return load_scenario(given, overrides)


def check_overrides(given: object) -> None:
    """Refuse overrides that are not a list of `section.entry=value`.

    Raises:
        InputError: if they are not.
    """
    if isinstance(given, list | tuple) and all(isinstance(text, str) for text in given):
        return
    raise InputError(option("overrides"), shortened(given), "must be a list of section.entry=value")


def date_in_tdb(entry: str, given: datetime | str | None, *, utc: bool = False) -> datetime | None:
    """A date in TDB, converted from UTC if `utc`.

    Raises:
        InputError: if it is no date.
    """
    if given is None:
        return None
    try:
        date = given if isinstance(given, datetime) else datetime.fromisoformat(given)
        if utc:
            return tdb_of_utc(date)
        if date.tzinfo is not None:
            raise ValueError
    except (TypeError, ValueError) as error:
        scale = "UTC" if utc else "TDB, without a zone"
        reason = f", {error.allowed}" if isinstance(error, InputError) else ""
        allowed = f"must be a date and time such as 2020-01-21T20:33:17, {scale}{reason}"
        raise InputError(entry, shortened(given), allowed) from None
    return date
