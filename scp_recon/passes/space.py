"""The spaces of a scenario's passes: phases on the ring and times of burns within spans, by window.

A `Space` has all passes with one number of burns about one lighting window; `spaces_of` sets them up,
and `settled` makes the scenario of a pass.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta

import numpy as np
from scipy.optimize import linprog

from formulations.arrays import Array
from scp_recon.display import exact
from scp_recon.errors import InputError
from scp_recon.mission.feedback import felt_cut_offs_s
from scp_recon.mission.firing import Ring
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import RK4_STEP_MAX_S, Scene, make_grid
from scp_recon.mission.schedule import Schedule, burns_before, survey, timing_rules
from scp_recon.mission.windows import Window
from scp_recon.passes.ring import ephemeris_ring, flown_ring, home_ring
from scp_recon.physics.two_body import two_body
from scp_recon.scenario.body import Design
from scp_recon.scenario.schema import Scenario, ScheduleRules

BURNS_LEAST, BURNS_MAX = 3, 8
"""Numbers of burns of a design; the least is of one between given states."""
WINDOWS_MAX = 24
"""Lighting windows in the span of dates, at most; passes are planned about each."""
WINDOW_AT = 0.43
"""Share of the flight at which the window's middle is to begin with, as in Reconnaissance B."""
SECOND = 1.0

Span = tuple[float, float]


@dataclass(frozen=True)
class Pass:
    """A pass: phases of departure and arrival on the ring, rad, and the times of all burns.

    Times are in s past the design's epoch, the first the departure's and the last the arrival's.

    Attributes:
        phases: of departure and arrival.
        times_s: of all burns.
    """

    phases: tuple[float, float]
    times_s: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Space:
    """All passes with one number of burns about one window; times are past the design's epoch."""

    mission: Mission
    """Mission of any pass of the design, for body, limits, units and rules."""
    ring: Ring
    """Home orbit."""
    window_s: Window
    """Observation window."""
    phase_spans: tuple[Span, Span]
    """Least and greatest phase of departure and of arrival, rad."""
    time_spans: tuple[Span, ...]
    """Earliest and latest time of each burn, s; equal where it is fixed."""
    times_s: tuple[float, ...] = ()
    """Legal times from which its first passes start."""
    begin_s: float = 0.0
    """The design's epoch, past the scenario's."""
    number: int = 0
    """Number of the lighting window, from 0."""
    step_max_s: float = 2.0 * RK4_STEP_MAX_S
    """Longest Runge-Kutta step, s: the pass that is found is planned again with shorter ones."""

    @property
    def has_home(self) -> bool:
        """Whether passes begin and end on a home orbit; otherwise boundary states are given."""
        return self.mission.scenario.boundary.home is not None

    def before(self, times_s: Sequence[float]) -> int:
        """Burns between departure and window."""
        return burns_before(times_s, self.window_s)

    def nearest_legal(
        self, times_s: Sequence[float], room_s: float = 0.0
    ) -> tuple[float, ...] | None:
        """Times within its spans and rules, the nearest to given ones: see `nearest_legal`."""
        rules, window = self.mission.scenario.schedule, self.window_s
        kept = None if self.mission.kept_window_s is None else window
        before = self.before(times_s)
        return nearest_legal(times_s, self.time_spans, kept, before, rules, room_s)

    def coarser(self, factor: float) -> Space:
        """The same space with longer spacings of nodes and integration steps."""
        grid = {"step_max_s": factor * self.mission.scenario.grid.step_max_s}
        mission = replace(self.mission, scenario=unchecked(self.mission.scenario, grid=grid))
        return replace(self, mission=mission, step_max_s=factor * self.step_max_s)

    def mission_of(self, one: Pass) -> Mission:
        """The mission of a pass, without checks."""
        made = replace(
            self.mission,
            scenario=unchecked(self.mission.scenario, burns={"times_s": one.times_s}),
            initial_state=self.ring(one.phases[0]),
            final_state=self.ring(one.phases[1]),
            schedule=Schedule(self.window_s, (), ()),
            step_max_s=self.step_max_s,
        )
        cut_offs = felt_cut_offs_s(made.scene, self.window_s).values()
        times = *one.times_s, *self.window_s, *cut_offs
        return replace(made, times_s=make_grid(times, self.mission.scenario.grid.step_max_s))

    def with_policy_of(self, scenario: Scenario) -> Space:
        """The same space with a scenario's policy."""
        own = self.mission.scenario.model_copy(update={"policy": scenario.policy})
        return replace(self, mission=replace(self.mission, scenario=own))


def unchecked(scenario: Scenario, **tables: Mapping[str, object]) -> Scenario:
    """The same scenario with other entries in some tables, without checks or computed entries."""
    changed = {
        name: getattr(scenario, name).model_copy(update=dict(entries))
        for name, entries in tables.items()
    }
    return scenario.model_copy(update=changed)


def nearest_legal(
    times_s: Sequence[float],
    spans_s: Sequence[Span],
    window_s: Window | None,
    before: int,
    rules: ScheduleRules,
    room_s: float = 0.0,
) -> tuple[float, ...] | None:
    """Times within spans and rules, the nearest to given ones by the sum of differences; or None.

    With some room, if wanted, to each rule.
    """
    n, wanted = len(times_s), np.array(times_s)
    matrix, least, _ = timing_rules(n, window_s, before, rules)
    apart = np.vstack([np.hstack([s * np.eye(n), -np.eye(n)]) for s in (1.0, -1.0)])
    result = linprog(
        np.r_[np.zeros(n), np.ones(n)],
        A_ub=np.vstack([apart, np.hstack([-matrix, np.zeros_like(matrix)])]),
        b_ub=np.r_[wanted, -wanted, -least - room_s],
        bounds=[*spans_s, *[(0.0, None)] * n],
    )
    return None if result.x is None else tuple(map(float, result.x[:n]))


def spaces_of(scenario: Scenario) -> list[Space]:
    """The spaces of a scenario's passes in order of time, each with legal burn times to start from.

    Raises:
        InputError: if there is no home orbit, no lighting window in the span of dates, too many, or
            none about which the burns can be legal; and as `Mission.from_scenario`.
    """
    home, spans = scenario.boundary.home, _spans(scenario, len(scenario.burns.times_s))
    _check_given(scenario)
    _check_spans(scenario, spans)
    axes, known = Scene.of(scenario).boundary_axes, None
    if home is None:
        known = _between_states(scenario, axes)
    elif home.ephemeris_file is not None:
        known = ephemeris_ring(scenario, home, axes)
    windows = _windows(scenario, (spans[0][0], spans[-1][1]))
    spaces: list[Space] = []
    for window in windows:
        if (times := _first_times(scenario, window)) is not None:
            space = _space(scenario, window, times, axes, known)
            spaces.append(replace(space, number=len(spaces)))
    if not spaces:
        given = f"departure in {_text(spans[0])} and arrival in {_text(spans[-1])}"
        there = f"those there: {'; '.join(map(_text, windows)) or 'none'}"
        must = f"must leave a legal schedule of {len(spans)} burns about a whole lighting window"
        left = _what_is_left(scenario, windows, spans)
        raise InputError("design", given, f"{must}; {there}{left}")
    return spaces


def has_given_times(scenario: Scenario) -> bool:
    """Whether the inner burns of a design stay where they are."""
    return scenario.design is not None and scenario.design.burn_times == "given"


def _spans(scenario: Scenario, burns: int) -> list[Span]:
    """Spans of the times of so many burns, s: of departure, of the burns between, of arrival."""
    design, times = scenario.design or Design(), scenario.burns.times_s
    departure = design.departure_s or (0.0, 0.0)
    arrival = design.arrival_s or (scenario.duration_s,) * 2
    inner = [(departure[0], arrival[1])] * (burns - 2)
    if has_given_times(scenario):
        inner = [(time, time) for time in times[1:-1]]
    return [departure, *inner, arrival]


def _check_given(scenario: Scenario) -> None:
    """Refuse what no design can begin with, and a design between given states without free times."""
    home, design, count = scenario.boundary.home, scenario.design, len(scenario.burns.times_s)
    least = scenario.safety.radius_min_m
    if scenario.in_flight is not None:
        raise InputError("in_flight", "a flight under way", "must be left out of a design")
    if home is not None and home.ephemeris_file is None and home.radius_m <= least:
        must = f"must exceed safety.radius_min_m, {exact(least)} m"
        raise InputError("boundary.home.radius_m", exact(home.radius_m), must)
    if count > BURNS_MAX:
        must = f"must be at most {BURNS_MAX} in a design"
        raise InputError("burns.times_s", f"{count} burns", must)
    if home is not None:
        return
    for name in ("departure_s", "arrival_s"):
        if span := getattr(design, name, None):
            last = exact(scenario.burns.times_s[-1])
            fixed = f"given states fix the first burn at 0 s and the last at {last} s"
            raise InputError(f"design.{name}", _text(span), f"goes with boundary.home: {fixed}")
    if has_given_times(scenario):
        must = "must be 'free', or there must be a boundary.home: nothing is left to design"
        raise InputError("design.burn_times", "'given'", must)
    if count < BURNS_LEAST:
        must = f"must be at least {BURNS_LEAST} where the boundary states are given"
        why = "the first and the last stay"
        raise InputError("burns.times_s", f"{count} burns", f"{must}: {why}")


def _check_spans(scenario: Scenario, spans: list[Span]) -> None:
    """Refuse an arrival that no burns reach in time, and one at another time than given."""
    departure, arrival, cycle = spans[0], spans[-1], scenario.schedule.cycle_s
    apart = len(spans) - 1 if scenario.policy.kind == "open" else 1
    if (least := departure[0] + apart * cycle) > arrival[1]:
        each = f"with {apart + 1} burns, each at least {cycle:g} s after the one before it"
        must = (
            f"must reach {least:g} s or later, after departure in {_text(departure)} {each}: "
            f"{least:g} to {arrival[1]:g} s is left"
        )
        raise InputError("design.arrival_s", _text(arrival), must)
    last = scenario.burns.times_s[-1]
    if has_given_times(scenario) and not arrival[0] <= last <= arrival[1]:
        given = f"the last of burns.times_s, {exact(last)} s, where design.burn_times is 'given'"
        raise InputError("design.arrival_s", _text(arrival), f"must contain {given}")


def _what_is_left(scenario: Scenario, windows: list[Window], spans: list[Span]) -> str:
    """Rules that leave a burn no time, and what span they leave, about the nearest window."""
    tries = [
        (_shortage(spans, window, before, scenario.schedule), _text(window))
        for window in windows
        for before in range(len(spans) - 1)
    ]
    if not tries:
        return ""
    (_, left), window = min(tries, key=lambda one: one[0][0])
    return f". About that of {window}: {left}"


def _shortage(
    spans: list[Span], window: Window, before: int, rules: ScheduleRules
) -> tuple[float, str]:
    """By how many seconds the worst burn's earliest time is after its latest, and that in words."""
    matrix, least, names = timing_rules(len(spans), window, before, rules)
    (early, late), said = np.array(spans, dtype=np.float64).T, [["", ""] for _ in spans]
    for i, name in enumerate(names[:-1]):
        if (bound := least[i] - matrix[i, i] * early[i]) > early[i + 1]:
            early[i + 1], said[i + 1][0] = bound, name
    if -least[-1] < late[before]:
        late[before], said[before][1] = -least[-1], names[-1]
    for i in reversed(range(len(spans) - 1)):
        if matrix[i, i] and late[i + 1] - least[i] < late[i]:
            late[i], said[i][1] = late[i + 1] - least[i], names[i]
    # All burns of a chain lack as much; one of them has a rule on either side.
    worst = max(range(len(spans)), key=lambda i: (round(early[i] - late[i], 6), all(said[i])))
    words = " and ".join(filter(None, said[worst]))
    left = f"burn {worst + 1} is left {_text((early[worst], late[worst]))} ({words})"
    return float(early[worst] - late[worst]), left


def _between_states(scenario: Scenario, axes: Array) -> Ring:
    """The given boundary states, at phases 0 and 1; axes (3, 3) rotate from boundary.frame to J2000."""
    given, turn = scenario.boundary, np.kron(np.eye(2), axes)
    first = turn @ np.r_[given.initial_position_m, given.initial_velocity_m_s]
    last = turn @ np.r_[given.final_position_m, given.final_velocity_m_s]
    return lambda phase: np.asarray(last if phase > 0.5 else first)


def _windows(scenario: Scenario, span: Span) -> list[Window]:
    given = scenario.observation.window_s
    if given is not None:
        return [given]
    windows = [window.edges_s for window in survey(scenario, span).windows]
    if len(windows) > WINDOWS_MAX:
        found = f"{len(windows)} lighting windows in {_text(span)}"
        must = f"must have at most {WINDOWS_MAX}: shorten the span of dates"
        raise InputError("design", found, must)
    return windows


def _first_times(scenario: Scenario, window: Window) -> tuple[float, ...] | None:
    """Legal times about a window that are nearest to those wanted; None if there are none."""
    for wanted, before in _wanted_times(scenario, window):
        spans = _spans(scenario, len(wanted))
        legal = nearest_legal(wanted, spans, window, before, scenario.schedule)
        if legal is not None:
            return legal
    return None


def _wanted_times(scenario: Scenario, window: Window) -> Iterator[tuple[list[float], int]]:
    """Burn times that would do, and how many come before the window after departure, the best first.

    The scenario's own, shifted with the window, with as many before it as there, or any other number.
    With feedback each burn corrects the errors of those before it: as many as there is time for, evenly
    spaced from the first departure, and as many after the window as in the scenario.
    """
    times, rules = np.array(scenario.burns.times_s), scenario.schedule
    departure, *_, arrival = _spans(scenario, len(times))
    if scenario.policy.kind == "feedback" and not has_given_times(scenario):
        after = max(int(np.sum(times > WINDOW_AT * times[-1])), 1)
        last, following = window[0] - rules.before_window_s, window[1] + rules.cycle_s
        late = np.linspace(following, arrival[1], after).tolist()
        for before in range(BURNS_MAX - 1 - after, -1, -1):
            yield [*np.linspace(departure[0], last, before + 1).tolist(), *late], before
        return
    middle = 0.5 * (window[0] + window[1])
    if not has_given_times(scenario):
        times = times + float(np.clip(middle - WINDOW_AT * times[-1], *departure))
    own = min(int(np.sum(times[1:] <= middle)), len(times) - 2)
    for before in sorted(range(len(times) - 1), key=lambda count: abs(count - own)):
        yield times.tolist(), before


def _space(
    scenario: Scenario, window: Window, times: tuple[float, ...], axes: Array, known: Ring | None
) -> Space:
    """The space about a window, times past the first of legal burns, on a known ring or its own."""
    home, begin = scenario.boundary.home, times[0]
    circling = unchecked(scenario, policy={"kind": "open"})
    if home is not None:
        circle = {"flown": False, "ephemeris_file": None, "spacecraft_id": None} | {
            f"{end}_deg": (getattr(home, f"{end}_deg")[0],) * 2 for end in ("departure", "arrival")
        }
        circling = unchecked(circling, boundary={"home": home.model_copy(update=circle)})
    past = tuple(time - begin for time in times)
    fixed = at_epoch(circling, begin).replace(
        {"burns.times_s": past, "observation.window_s": [edge - begin for edge in window]}
    )
    mission, phases = Mission.from_scenario(fixed), ((0.0, 0.0), (1.0, 1.0))
    if home is None:
        assert known is not None
        ring = known
    else:
        first, last = np.deg2rad([home.departure_deg, home.arrival_deg]).tolist()
        phases = (first[0], first[1]), (last[0], last[1])
        flown = flown_ring(home, mission.forces, axes) if home.flown else None
        ring = known or flown or home_ring(home, scenario.body.gm_m3_s2, axes)
    spans = tuple((low - begin, high - begin) for low, high in _spans(scenario, len(times)))
    return Space(mission, ring, mission.schedule.window_s, phases, spans, past, begin)


def at_epoch(scenario: Scenario, shift_s: float) -> Scenario:
    """The same scenario at a later epoch: the Sun by two-body motion, given times shifted."""
    if shift_s == 0.0:
        return scenario
    sun, grid, contacts = scenario.sun, scenario.grid, scenario.navigation.contacts
    later = contacts.past(shift_s) if contacts else {}
    motion = two_body(sun.body_position_km, sun.body_velocity_km_s, (0.0, shift_s))
    return scenario.replace(
        {
            "epoch.tdb": (scenario.epoch.tdb + timedelta(seconds=shift_s)).isoformat(),
            "sun.body_position_km": motion(shift_s).tolist(),
            "sun.body_velocity_km_s": motion(shift_s, 1).tolist(),
            "grid.nodes_s": [node - shift_s for node in grid.nodes_s if node >= shift_s],
            **{f"navigation.contacts.{entry}": value for entry, value in later.items()},
        }
    )


def settled(scenario: Scenario, space: Space, one: Pass) -> Scenario:
    """The scenario of a pass: boundary states and times fixed, no home orbit, nothing free."""
    begin = one.times_s[0]
    base = at_epoch(space.mission.scenario, begin)
    axes = Scene.of(base).boundary_axes
    ends, home = {}, scenario.boundary.home
    for which, phase in zip(("initial", "final"), one.phases if home else (), strict=False):
        position, velocity = space.ring(phase).reshape(2, 3)
        ends[f"{which}_position_m"] = tuple((axes.T @ position).tolist())
        ends[f"{which}_velocity_m_s"] = tuple((axes.T @ velocity).tolist())
    times = tuple(
        time - begin if low == high else round(time - begin, 1)
        for time, (low, high) in zip(one.times_s, space.time_spans, strict=True)
    )
    window = space.window_s[0] - begin, space.window_s[1] - begin
    fixed = unchecked(
        base.model_copy(update={"design": None, "policy": scenario.policy}),
        boundary={**ends, "home": None},
        burns={"times_s": times},
        observation={"window_s": None},
    )
    if scenario.observation.window_s is not None or not _finds(fixed, window):
        fixed = unchecked(fixed, observation={"window_s": window})
    return Scenario.validated(fixed.model_dump(mode="json", exclude_none=True))


def _finds(scenario: Scenario, window: Window) -> bool:
    """Whether a mission finds this window by itself, not an earlier one in the flight."""
    try:
        own = Mission.from_scenario(scenario).schedule.window_s
    except InputError:  # about an earlier window the burns break a rule
        return False
    return bool(np.allclose(own, window, rtol=0.0, atol=SECOND))


def _text(span: Span) -> str:
    return f"{span[0]:.6g} to {span[1]:.6g} s"
