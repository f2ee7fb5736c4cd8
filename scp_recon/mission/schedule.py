"""Find the observation window, lay out the attitude modes, and list the legal times of burns.

A survey does the same for all lighting windows of a span of time. The rules are those of Echigo et
al., section V.A: delta-V mode starts one slew and one heating before a burn, observation mode one slew
before the window, and sun-pointing fills the rest, each time for at least one slew and one recharge.
`ScheduleRules` has the durations that follow.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from scipy.optimize import minimize_scalar

from formulations.arrays import Array
from scp_recon.display import Tabulated, digits, exact
from scp_recon.errors import InputError
from scp_recon.mission.scene import Scene
from scp_recon.mission.windows import (
    SCAN_STEP_S,
    Lighting,
    OfTime,
    Window,
    each_window,
    scan_step_s,
    whole_windows,
)
from scp_recon.physics.frames import unit
from scp_recon.physics.two_body import two_body
from scp_recon.scenario.schema import Scenario, ScheduleRules

Interval = tuple[float, float]
"""Earliest and latest time, s; empty where the first is above the second."""


class Mode(StrEnum):
    """Purpose of the attitude."""

    DELTA_V = "delta-V"
    SUN_POINTING = "sun-pointing"
    OBSERVATION = "observation"


@dataclass(frozen=True)
class Leg:
    """A mode and when it holds, s.

    Attributes:
        mode: of the attitude.
        start_s: past the epoch.
        end_s: past the epoch.
    """

    mode: Mode
    start_s: float
    end_s: float


@dataclass(frozen=True)
class Schedule:
    """Attitude modes, and the times to which each burn may move with the others kept."""

    window_s: Window
    """Observation window."""
    legs: tuple[Leg, ...]
    """Contiguous from the epoch, or a state in flight, to the last burn; the attitude of the first
    burn is acquired before."""
    firing_intervals_s: tuple[Interval, ...]
    """Earliest and latest time of each burn to be planned; both 0 for the flight's first, and the
    last has no latest time (infinity)."""

    def after(self, scenario: Scenario) -> Schedule:
        """The rest after a scenario's state in flight, if it has one; the window is kept whole."""
        if scenario.in_flight is None:
            return self
        at, flown = scenario.start_s, scenario.burns_flown
        earliest = at + scenario.navigation.lead_s
        legs = (replace(leg, start_s=max(leg.start_s, at)) for leg in self.legs if leg.end_s > at)
        intervals = self.firing_intervals_s[flown:]
        left = tuple((max(low, earliest), high) for low, high in intervals)
        return Schedule(self.window_s, tuple(legs), left)


def find_window(scenario: Scenario, lighting: Lighting, step_s: float = SCAN_STEP_S) -> Window:
    """The given window, or the first one wholly in the flight with the lighting required; s.

    Raises:
        InputError: if the given window is not inside the flight, or there is none; it names the
            windows near the flight and the epoch shifts that would bring them into it.
    """
    limits, end = scenario.observation, scenario.duration_s
    if limits.window_s is not None:
        first, last = limits.window_s
        if not 0.0 < first < last < end:
            needs = f"must be ascending and inside the flight, 0 to {exact(end)} s"
            raise InputError("observation.window_s", f"[{exact(first)}, {exact(last)}] s", needs)
        return first, last
    slack, flight = lighting.slack(limits), (0.0, end)
    found = next(whole_windows(each_window(slack, flight, step_s), flight), None)
    if found is not None:
        return found
    raise InputError(
        "observation",
        f"incidence at most {exact(limits.incidence_max_deg)} deg and local solar time "
        f"{exact(limits.local_solar_time_min_h)} to {exact(limits.local_solar_time_max_h)} h",
        f"the flight of {exact(end)} s must contain a whole window in which both hold; "
        + _other_windows(scenario, slack, lighting.incidence, step_s),
    )


def make_schedule(
    times_s: tuple[float, ...], window_s: Window, rules: ScheduleRules, *, observed: bool = True
) -> Schedule:
    """Lay out the modes of a whole flight; without an observation its mode is left out.

    Raises:
        InputError: if a firing time breaks one of the rules, naming the rule.
    """
    observation = Leg(Mode.OBSERVATION, window_s[0] - rules.attitude_s, window_s[1])
    burns = [Leg(Mode.DELTA_V, time - rules.before_burn_s, time) for time in times_s[1:]]
    before = burns_before(times_s, window_s)
    # Everything that is not sun-pointing, in order, with the first burn as an instant at zero.
    busy = [Leg(Mode.DELTA_V, 0.0, 0.0), *burns[:before], observation, *burns[before:]]
    if not observed:
        busy.remove(observation)
        before = len(burns)
    following = [*(leg.start_s - rules.sun_leg_s for leg in busy[1:]), np.inf]
    intervals = [(0.0, 0.0)] + [
        (previous.end_s + rules.cycle_s, latest)
        for previous, leg, latest in zip(busy[:-1], busy[1:], following[1:], strict=True)
        if leg is not observation
    ]
    legs: list[Leg] = []
    for index, (previous, leg) in enumerate(itertools.pairwise(busy), start=1):
        if leg.start_s - previous.end_s < rules.sun_leg_s - 1e-6:
            broken = (
                "rule 'a sun-pointing leg lasts at least one slew and one recharge, "
                f"{rules.sun_leg_s:g} s' is broken: {previous.mode} mode ends at "
                f"{previous.end_s:g} s and {leg.mode} mode must start at {leg.start_s:g} s"
            )
            legal = _legal_times(times_s, window_s, rules) if observed else "nothing is observed"
            # The burn that ends the short leg; before the observation, the one that starts it.
            burn = index - 1 if index > before else index
            if burn == 0:  # which cannot move: the window has to
                given = f"[{digits(window_s[0])}, {digits(window_s[1])}] s"
                raise InputError("observation.window_s", given, f"{broken}; {legal}")
            early, late = intervals[burn]
            moved = (
                f"between {early:g} s and {late:g} s" if late < np.inf else f"from {early:g} s on"
            )
            moved = f"nowhere, from {early:g} s on but until {late:g} s" if early > late else moved
            needs = f"{broken}; with the others kept this burn may be {moved}; {legal}"
            raise InputError(f"burns.times_s.{burn}", f"{exact(times_s[burn])} s", needs)
        if leg.start_s > previous.end_s:
            legs.append(Leg(Mode.SUN_POINTING, previous.end_s, leg.start_s))
        legs.append(leg)
    return Schedule(window_s, tuple(legs), tuple(intervals))


def burns_before(times_s: Sequence[float], window_s: Window) -> int:
    """Number of burns between the first one and a window."""
    return sum(time <= 0.5 * (window_s[0] + window_s[1]) for time in times_s[1:])


def timing_rules(
    n_burns: int, window_s: Window | None, before: int, rules: ScheduleRules
) -> tuple[Array, Array, tuple[str, ...]]:
    """A and b of A t >= b, shapes (m, m) and (m,), for the times t of m burns in s; names of the rows.

    A burn comes a cycle after the burn or the window before it: slew and recharge, then slew and
    heating. Slew, recharge and another slew part a burn from the window after it. Echigo et al.,
    section V.A. The window is in the burns' time, None if nothing is observed; `before` counts burns
    between the first one and the window, at most m - 2.
    """
    rows = np.eye(n_burns - 1, n_burns, 1) - np.eye(n_burns - 1, n_burns)
    least = np.full(n_burns - 1, rules.cycle_s)
    cycle = f"at least {rules.cycle_s:g} s after"
    names = [f"burn {i + 2} {cycle} burn {i + 1}" for i in range(n_burns - 1)]
    if window_s is None:
        return rows, least, tuple(names)
    rows[before, before] = 0.0  # the window lies between these two
    least[before] += window_s[1]
    rows = np.vstack([rows, -np.eye(n_burns)[before]])
    names[before] = f"burn {before + 2} {cycle} the window"
    names.append(f"burn {before + 1} at least {rules.before_window_s:g} s before the window")
    return rows, np.r_[least, rules.before_window_s - window_s[0]], tuple(names)


def legal_burns(
    window_s: Window,
    duration_s: float,
    before: int,
    after: int,
    rules: ScheduleRules,
    starts_s: Interval | None = None,
) -> list[Interval]:
    """Legal times of each burn of a flight that observes in a window, s, the others free to move.

    The flight lasts `duration_s` from first to last burn; `before` burns lie between the first one and
    the window, and `after`, at least one, behind it. The first interval is that of the first burn:
    `starts_s`, (0, 0) at the epoch; or if not given all that is legal, in the window's time, which is
    empty where the flight is too short.
    """
    cycle, end = rules.cycle_s, window_s[1]
    latest = window_s[0] - rules.before_window_s - before * cycle
    early, late = starts_s or (end + after * cycle - duration_s, latest)
    before_window = [(early + i * cycle, latest + i * cycle) for i in range(1, before + 1)]
    after_window = [
        (end + i * cycle, late + duration_s - (after - i) * cycle) for i in range(1, after)
    ]
    return [(early, late), *before_window, *after_window, (early + duration_s, late + duration_s)]


def legal_additions(
    times_s: Sequence[float], window_s: Window | None, rules: ScheduleRules
) -> list[Interval]:
    """Legal times of one more burn among burns that keep the rules and stay; no empty intervals."""
    found, gap = [], None if window_s is None else burns_before(times_s, window_s)
    for index, (time, following) in enumerate(itertools.pairwise(times_s)):
        if window_s is not None and index == gap:
            found.append((time + rules.cycle_s, window_s[0] - rules.before_window_s))
            time = window_s[1]
        found.append((time + rules.cycle_s, following - rules.cycle_s))
    return [(first, last) for first, last in found if first <= last]


def legal_shifts(
    window_s: Window, times_s: Sequence[float], rules: ScheduleRules
) -> list[tuple[int, Interval]]:
    """Epoch shifts, least and greatest, s, by which a window falls legally between burns that stay.

    Each interval comes with the index of the burn before its gap; gaps too short are left out.
    """
    opens, closes = window_s[0] - rules.before_window_s, window_s[1] + rules.cycle_s
    found = enumerate((closes - after, opens - time) for time, after in itertools.pairwise(times_s))
    return [(index, (low, high)) for index, (low, high) in found if low <= high]


ROOM_S = 1.0
"""Margin in s with which free times keep the rules, so that they may be rounded."""


BEYOND_S, SHOWN = 2 * 86_400.0, 3
"""How far before and after the flight to look for other windows, and how many to tell."""


def _other_windows(scenario: Scenario, slack: OfTime, incidence: OfTime, step_s: float) -> str:
    """Describe the windows near a flight that contains none, and epoch shifts that would include them.

    `slack` (of the limits on lighting) and `incidence` (rad) are functions of times in s.
    """
    span = -BEYOND_S, scenario.duration_s + BEYOND_S
    windows = list(each_window(slack, span, step_s))
    if windows == [span]:
        return "both hold all the time: give observation.window_s"
    whole = list(whole_windows(windows, span))
    if not whole:
        least = float(np.rad2deg(incidence(np.linspace(*span, 2000))).min())
        return (
            f"nor is there one within {BEYOND_S / 86_400:g} days of it, in which the least "
            f"incidence is {least:.1f} deg"
        )
    nearest = sorted(whole, key=lambda window: abs(sum(window) - scenario.duration_s))[:SHOWN]
    times, rules = scenario.burns.times_s, scenario.schedule
    lines = [f"{_edges(window)}: {_shift(window, times, rules)}" for window in sorted(nearest)]
    return "\n".join(["windows near it, in seconds past epoch.tdb:", *lines])


def _edges(window: Window) -> str:
    return f"{window[0]:.1f} to {window[1]:.1f} s"


def _shift(window: Window, times: Sequence[float], rules: ScheduleRules) -> str:
    """The epoch shifts nearest to none that bring a window between the burns as they are."""
    shifts = legal_shifts(window, times, rules)
    if not shifts:
        needed = window[1] - window[0] + rules.before_window_s + rules.cycle_s
        return f"no gap between burns is long enough: expected at least {needed:.0f} s"
    index, (low, high) = min(shifts, key=lambda found: max(found[1][0], -found[1][1]))
    return (
        f"legal between burns.times_s.{index} and {index + 1} with epoch.tdb moved by "
        f"{low:+.0f} to {high:+.0f} s"
    )


def _legal_times(times_s: Sequence[float], window_s: Window, rules: ScheduleRules) -> str:
    """Describe a window and the legal times of each burn about it, the others free to move."""
    before = burns_before(times_s, window_s)
    after, duration = len(times_s) - 1 - before, times_s[-1]
    (earliest, latest), *_ = legal_burns(window_s, duration, before, after, rules)
    text = f"the window is {_edges(window_s)}"
    if latest < 0.0:
        opens = (
            f"with {before} burns before it has to open at {window_s[0] - latest:.1f} s or later"
        )
        return f"{text}, and {opens}; {_shift(window_s, times_s, rules)}"
    last = f"{duration + earliest:.1f} s on"
    if earliest > 0.0:
        return f"{text}, and with {after} burns after it the last is legal from {last}"
    intervals = legal_burns(window_s, duration, before, after, rules, (0.0, 0.0))
    words = [f"{i} from {a:.1f} to {b:.1f} s" for i, (a, b) in enumerate(intervals[1:-1], start=1)]
    legal = ", ".join([*words, f"{len(times_s) - 1} from {last}"])
    return f"{text}, and if the other burns give way, legal are burns.times_s.{legal}"


SAME_S = 1e-6
"""Tolerance for equal times, s: differences of times agree within it."""

BURNS_TO_MEET = 2
"""Burns that meet a final state: it has six components, and a burn three."""

MISS_WEIGHT = 10.0
"""Price of each component of the final state's miss where fewer are left, in units of length and speed.

A speed that is missed takes a later burn as large, and a distance one of its size over a unit of time:
a weight of one would leave it open whether to burn or to miss. With ten the burn goes as near to the
final state as its limits let it, whatever that costs, as the program weighs a miss in any case.
"""


def check_in_flight(scenario: Scenario) -> None:
    """Refuse a state in flight after which no burn, or no time, is left to plan.

    Raises:
        InputError: if no burn is left, the next one is nearer than the lead time, or the
            number of burns given is not that of the burns flown.
    """
    flight = scenario.in_flight
    if flight is None:
        return
    entry, at, times = "in_flight.at_s", flight.at_s, scenario.burns.times_s
    lead = scenario.navigation.lead_s
    if not scenario.burn_times_s:
        raise InputError(
            entry,
            f"{exact(at)} s, at or after the last burn at {exact(times[-1])} s",
            f"must leave a burn to plan: at most {times[-1] - lead:g} s, or with later burns added to "
            "burns.times_s (two reach a final state)",
        )
    following, flown = scenario.burn_times_s[0], scenario.burns_flown
    if following - at < lead - SAME_S:
        later = (
            "" if flown + 1 == len(times) else f", or {following:g} s and more, once it is flown"
        )
        raise InputError(
            entry,
            f"{exact(at)} s, {following - at:g} s before burn {flown + 1} at {following:g} s",
            f"must leave the lead time, navigation.lead_s = {lead:g} s, before the next burn: "
            f"at most {following - lead:g} s{later}",
        )
    if len(flight.flown_m_s) != flown:
        needs = f"must be the {flown} burns at or before in_flight.at_s, {exact(at)} s"
        raise InputError("in_flight.flown_m_s", f"{len(flight.flown_m_s)} burns", needs)


@dataclass(frozen=True)
class LitWindow:
    """A window, its lighting, and the legal burn times of the scenario's flight about it.

    Times are seconds past the scenario's epoch.
    """

    edges_s: Window
    """First and last time."""
    least_incidence_rad: float
    """Smallest angle between the site's normal and the Sun in it."""
    local_solar_time_h: tuple[float, float]
    """At its edges."""
    burns_s: tuple[Interval, ...]
    """Legal times of each burn with epoch and other burns free to move; the first is the flight's
    epoch. An empty interval has its first above its second."""
    shifts_s: tuple[tuple[int, Interval], ...]
    """Epoch shifts with which the burns are legal as they are, by the index of the burn before the
    window."""


@dataclass(frozen=True)
class Survey(Tabulated):
    """Windows in a span, in seconds past the scenario's epoch, by two-body motion.

    Attributes:
        scenario: the scenario searched.
        lighting: of the site.
        span_s: first and last time searched.
    """

    scenario: Scenario
    lighting: Lighting
    span_s: Window
    windows: tuple[LitWindow, ...]
    """Windows that the span's ends do not cut."""
    always: bool
    """Whether the site keeps the limits throughout the span."""
    before: int
    """Burns between the first one and the window, in `LitWindow.burns_s`."""

    def __repr__(self) -> str:
        """One line."""
        first_s, last_s = self.span_s
        return f"<Survey: {len(self.windows)} windows from {first_s:.0f} to {last_s:.0f} s>"


def survey(scenario: Scenario, span_s: Window) -> Survey:
    """Find all windows of a span.

    The body moves by `two_body` from the scenario's heliocentric state, so that the span may be long.
    As many burns come before a window as before the flight's own; if the flight has none, as many as
    before its middle.

    Raises:
        InputError: if the body turns too often in the span, or falls into the Sun.
    """
    scene, duration = Scene.of(scenario), scenario.duration_s
    flight = 0.0, duration
    longest = min(span_s[0], 0.0), max(span_s[1], duration)
    step = scan_step_s(scene.rotation.rate, longest)
    sun = scenario.sun
    try:
        position = two_body(sun.body_position_km, sun.body_velocity_km_s, longest)
    except ValueError as error:
        given_km = f"{list(sun.body_position_km)} km"
        raise InputError("sun.body_position_km", given_km, f"must be an orbit: {error}") from None
    lighting = Lighting(scene.site, scene.rotation, lambda time_s: -unit(position(time_s)))
    slack = lighting.slack(scenario.observation)
    times, given = scenario.burns.times_s, scenario.observation.window_s
    own = given or next(whole_windows(each_window(slack, flight, step), flight), None)
    others = len(times) - 2  # between the first burn and the last
    before = min(burns_before(times, own), others) if own else others // 2
    found, windows = list(each_window(slack, span_s, step)), []
    for edges in whole_windows(found, span_s):
        least = _least(lighting.incidence, edges)
        opens, closes = lighting.local_solar_time(np.array(edges)).tolist()
        after = len(times) - 1 - before
        legal = tuple(legal_burns(edges, duration, before, after, scenario.schedule))
        shifts = tuple(legal_shifts(edges, times, scenario.schedule))
        windows.append(LitWindow(edges, least, (opens, closes), legal, shifts))
    return Survey(scenario, lighting, span_s, tuple(windows), found == [span_s], before)


def _least(of_time: OfTime, edges: Window) -> float:
    """Smallest value in a window, by a scan and a search about its lowest sample."""
    times = np.linspace(*edges, 101)
    values = of_time(times)
    k = int(np.argmin(values))
    bracket = times[max(k - 1, 0)], times[min(k + 1, len(times) - 1)]
    found = minimize_scalar(lambda t: float(of_time(np.array(t))), bounds=bracket, method="bounded")
    return min(float(values[k]), float(found.fun))
