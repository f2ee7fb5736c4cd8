"""Read what a plan is made from: a request, its scenario and start; overrides and dates."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from formulations.registry import FULL
from scp_recon.api.options import PlanOptions
from scp_recon.display import exact
from scp_recon.errors import InputError, option, shortened
from scp_recon.mission.checks import check_scene, later_end
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import Scene
from scp_recon.mission.schedule import BURNS_TO_MEET
from scp_recon.planning import initial_guess
from scp_recon.planning.method import ALGORITHM, FORMULATION, SETTLE
from scp_recon.planning.plan import Plan, ended
from scp_recon.planning.records import Parent
from scp_recon.replanning.flown import FlownPlan
from scp_recon.replanning.remainder import Delivery, mission_left, path_planned, with_free_times
from scp_recon.results.policy import with_policy
from scp_recon.results.read import read_solution, resolve_run
from scp_recon.results.solution import Solution
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.load import load_scenario, naming_files, override
from scp_recon.scenario.schema import Scenario
from scp_recon.scenario.time_scales import tdb_of_utc
from scp_recon.scp.status import Status

Init = Iterate | Plan | Solution | str | Path | Array
"""A start: "cold", "warm", a guess, a plan or a solution, its file, or a table of states."""
GUESSES = ("cold", "warm")
"""Starts that are made on a mission's own grid."""
UNCERTAIN = ("risk.", "policy.", "navigation.", "polytopes.")
"""Beginnings of the entries that a plan without uncertainty does not use."""
ABOUT_LIGHT = ("site.", "sun.", "body.pole", "body.prime_meridian", "body.rotation")
"""Beginnings of the entries that decide when a site is lit."""
P3_RESOLUTION = 1e-3
"""Relative reduction of the merit at which P3 stops in flight if P2 follows: the end of P3 only
places the facets. Newton's steps then still converge to about 1e-6, with one iteration less."""


@dataclass(frozen=True, eq=False)
class PlanRequest:
    """What to plan, and how.

    Attributes:
        scenario: itself, its mission, its file or a packaged name, or the rest of a flight; None for
            that of `init`, or recon_b.
        init: see `api.verbs.plan`; or a guess; a plan of the same mission is continued.
        options: of planning; the rest of a flight takes only `certify`, the others are its plan's.
        overrides: `section.entry=value` each.
        called: name of the start in the solution file; empty for the name that `init` has.
    """

    scenario: Mission | Scenario | RestOfFlight | str | Path | None = None
    init: Init = "cold"
    options: PlanOptions = field(default_factory=PlanOptions)
    overrides: Sequence[str] = ()
    called: str = ""

    @property
    def is_in_flight(self) -> bool:
        """Whether the rest of a flight is planned."""
        return isinstance(self.scenario, RestOfFlight)

    def again(self, overrides: Sequence[str]) -> PlanRequest:
        """The request with further overrides."""
        given = self.scenario
        scenario = given.scenario if isinstance(given, Mission) else given
        return replace(self, scenario=scenario, overrides=(*self.overrides, *overrides))


class Resolved(NamedTuple):
    """A mission, the start of its plan, and the request with all that follows from its files.

    `known` are arguments of `planner.plan` that the rest of a flight fixes.
    """

    mission: Mission
    start: Iterate | Plan
    asked: PlanRequest
    known: Mapping[str, Any] = {}


def load(request: PlanRequest) -> PlanRequest:
    """The request with its scenario, and its start if that is a solution file, read."""
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
    if not isinstance(scenario, Mission | RestOfFlight):
        with naming_files(scenario, request.overrides):
            scenario = scenario_of(scenario, request.overrides)
    overrides = request.overrides if request.is_in_flight else ()
    return replace(request, scenario=scenario, init=init, called=called, overrides=overrides)


def resolve(request: PlanRequest) -> Resolved:
    """Load a request, make the mission of its scenario, and the initial guess on its grid.

    Raises:
        InputError: if the scenario has no mission, the start is unusable, or an option does not suit
            the scenario.
    """
    loaded = load(request)
    mission, init = loaded.scenario, loaded.init
    if isinstance(mission, RestOfFlight):
        return mission.resolved(loaded)
    if isinstance(mission, Mission) and isinstance(init, Plan):
        return Resolved(mission, init, loaded)
    if not isinstance(mission, Mission):
        assert isinstance(mission, Scenario)
        with naming_files(request.scenario, request.overrides):
            mission = _mission_of(mission)
    start = _start(mission, init)
    if isinstance(init, str | Path) and init not in GUESSES:  # a pipe can be read only once
        loaded = replace(loaded, init=start)
    request.options.check(mission.scenario)
    if doubts := tuple(_doubts(request, mission.scenario)):
        mission = replace(mission, warnings=(*mission.warnings, *doubts))
    return Resolved(mission, start, loaded)


@dataclass(frozen=True, eq=False)
class RestOfFlight:
    """What is left of a flight: planned near the plan in flight, by the method of that plan.

    With one or two burns left, the final state determines the burns. An infeasible case is then
    infeasible from every start and with all facets, so planning ends at once. A method that cannot
    plan the rest, with exact risk or with a miss of the final state, is replaced by the default.

    Attributes:
        flown: the plan in flight.
        delivery: the state from which the rest is planned.
        free_times: whether burns that are left may move: see `with_free_times`.
    """

    flown: FlownPlan
    delivery: Delivery
    free_times: bool = False

    def resolved(self, request: PlanRequest) -> Resolved:
        """Make the mission that is left, its start along the plan in flight, and its options."""
        flown = self.flown
        mission = mission_left(flown, self.delivery, request.overrides)
        scenario, made = mission.scenario, flown.method.formulation
        exact = scenario.risk.allocation == "exact"
        determined = len(scenario.burn_times_s) <= BURNS_TO_MEET
        options = PlanOptions(
            problem=flown.solution.problem,
            facet_rounds=0 if determined else SETTLE,
            formulation=FORMULATION if exact and made not in FULL else made,
            algorithm=flown.method.algorithm if mission.must_meet else ALGORITHM,
            solver=flown.method.solver,
            certify=request.options.certify,
            starts=1,
        )
        options.check(scenario)
        if self.free_times:
            mission = with_free_times(flown, mission)
        resolution = P3_RESOLUTION if flown.solution.problem == "P2" else 0.0
        known = {"p3_resolution": resolution, "once": determined}
        asked = replace(request, called=f"the path of {flown.name}", options=options)
        return Resolved(mission, path_planned(flown, mission), asked, known)

    def finished(self, plan: Plan, mission: Mission) -> Plan:
        """A plan of the mission that is left, with its parent and all warnings.

        It is lost if it misses the final state by more than `FlownPlan.is_lost` allows.
        """
        flown, at_s = self.flown, mission.scenario.start_s
        commanded = flown.commanded(mission.initial_state, at_s)
        commanded_m_s = None if commanded is None else tuple(commanded.tolist())
        parent = Parent(flown.name, flown.solution.plan_hash, at_s, commanded_m_s)
        warnings = tuple(dict.fromkeys((*plan.mission.warnings, *mission.warnings)))
        plan = replace(plan, mission=replace(plan.mission, warnings=warnings), parent=parent)
        lost = flown.is_lost(plan.states[-1] - mission.final_state)
        return ended(plan, Status.LOST) if lost and plan.status is Status.CONVERGED else plan


def _mission_of(scenario: Scenario) -> Mission:
    """Resolve a user's scenario; a refusal of its window names the entries that explain it.

    Named are entries that decide when the site is lit: doubtful ones, and other readings that were
    tried and have a mission.
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
    """Begin a refusal with a small angle that in degrees, not radians, `resolve` does not refuse."""
    for table in ("site", "body", "observation"):
        for key, value in getattr(scenario, table):
            if not key.endswith("_deg") or not 0.0 < abs(value or 0.0) < 2.0 * math.pi:
                continue
            entry, right = f"{table}.{key}", math.degrees(value)
            with suppress(InputError):
                resolve(scenario.replace({entry: right}))
                allowed = f"tried, and accepted: {right:.6g}; degrees?\n{error}"
                return InputError(entry, f"{value:.12g} deg", allowed)
    return error


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
    idle = (
        (UNCERTAIN, certain, "on a plan of P3"),
        (("policy.cost.",), is_open, 'with policy.kind = "open"'),
        (("design.",), True, "on a plan at given times: `design` chooses them"),
        (("polytopes.",), is_exact, 'with risk.allocation = "exact"'),
    )
    for text in request.overrides:
        entry, _, given = (part.strip() for part in text.partition("="))
        for beginnings, applies, words in idle:
            if applies and f"{entry}.".startswith(beginnings):
                yield ScenarioWarning.of(entry, given, f"has no effect {words}")
                break
        if entry == "burns.times_s":
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
    """Make the initial guess of a mission."""
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
    """Read a scenario that is given as itself, by name, or by its file, with overrides."""
    check_overrides(overrides)
    if isinstance(given, Scenario):
        return override(given, overrides)
    if not isinstance(given, str | Path):
        raise InputError("scenario", shortened(given), "must be a scenario, its name, or a file")
    return load_scenario(given, overrides)


def check_overrides(given: object) -> None:
    """Refuse overrides that are not a list of `section.entry=value`."""
    if isinstance(given, list | tuple) and all(isinstance(text, str) for text in given):
        return
    raise InputError(option("overrides"), shortened(given), "must be a list of section.entry=value")


def date_in_tdb(entry: str, given: datetime | str | None, *, utc: bool = False) -> datetime | None:
    """A date in TDB, converted from UTC if `utc`."""
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
