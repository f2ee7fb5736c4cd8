"""Find all lighting windows of a scenario over a span of time, and the legal burn times of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from scp_recon.display import Tabulated
from scp_recon.errors import InputError
from scp_recon.mission.scene import Scene
from scp_recon.mission.schedule import Interval, burns_before, legal_burns, legal_shifts
from scp_recon.mission.windows import (
    Lighting,
    OfTime,
    Window,
    each_window,
    scan_step_s,
    whole_windows,
)
from scp_recon.physics.frames import unit
from scp_recon.physics.two_body import two_body
from scp_recon.scenario.schema import Scenario


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
    lighting = Lighting(scene.site, scene.rotation, _to_sun(scenario, longest))
    slack = lighting.slack(scenario.observation)
    times, given = scenario.burns.times_s, scenario.observation.window_s
    own = given or next(whole_windows(each_window(slack, flight, step), flight), None)
    others = len(times) - 2  # between the first burn and the last
    before = min(burns_before(times, own), others) if own else others // 2
    found = list(each_window(slack, span_s, step))
    windows = [
        LitWindow(
            edges_s=edges,
            least_incidence_rad=_least(lighting.incidence, edges),
            local_solar_time_h=_at_edges(lighting.local_solar_time, edges),
            burns_s=tuple(
                legal_burns(edges, duration, before, len(times) - 1 - before, scenario.schedule)
            ),
            shifts_s=tuple(legal_shifts(edges, times, scenario.schedule)),
        )
        for edges in whole_windows(found, span_s)
    ]
    return Survey(scenario, lighting, span_s, tuple(windows), found == [span_s], before)


def _to_sun(scenario: Scenario, span_s: Window) -> OfTime:
    sun = scenario.sun
    try:
        position = two_body(sun.body_position_km, sun.body_velocity_km_s, span_s)
    except ValueError as error:
        given = f"{list(sun.body_position_km)} km"
        raise InputError("sun.body_position_km", given, f"must be an orbit: {error}") from None
    return lambda time_s: -unit(position(time_s))


def _at_edges(of_time: OfTime, edges: Sequence[float]) -> tuple[float, float]:
    first, last = of_time(np.array(edges)).tolist()
    return first, last


def _least(of_time: OfTime, edges: Window) -> float:
    """Smallest value in a window, by a scan and a search about its lowest sample."""
    times = np.linspace(*edges, 101)
    values = of_time(times)
    k = int(np.argmin(values))
    bracket = times[max(k - 1, 0)], times[min(k + 1, len(times) - 1)]
    found = minimize_scalar(lambda t: float(of_time(np.array(t))), bounds=bracket, method="bounded")
    return min(float(values[k]), float(found.fun))
