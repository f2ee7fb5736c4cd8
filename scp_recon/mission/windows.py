"""Find the intervals in which a site is lit within a scenario's limits.

Their edges move with what is not known of the body's spin and the site.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from formulations.arrays import Array
from scp_recon.errors import InputError
from scp_recon.mission.knowledge import FAR
from scp_recon.physics import geometry
from scp_recon.physics.frames import Rotation
from scp_recon.scenario.schema import Observation

Window = tuple[float, float]
"""First and last time, s."""

OfTime = Callable[[Array], Array]

EDGE_MOVES_S, EDGE_PARTS = 0.1, 25
"""1 sigma up to which an edge of the window stays; and times within 3 sigma of it at which flights are
sampled: a flight's own edge is then missed by an eighth of a sigma at most."""
NEWTON_STEPS = 5
"""To the edge of another flight's window: from 300 s away it is then within 1e-6 s."""


@dataclass(frozen=True)
class Lighting:
    """A site on a turning body in the Sun.

    Attributes:
        site: on the body.
        rotation: of the body.
    """

    site: geometry.Site
    rotation: Rotation
    to_sun: OfTime
    """Unit vectors from the body to the Sun, J2000, shape (..., 3), of times in s."""

    def incidence(self, time_s: Array) -> Array:
        """Angle between the site's normal and the Sun, rad."""
        track = geometry.track(self.site, self.rotation, time_s)
        return geometry.incidence(track, self.to_sun(time_s))

    def local_solar_time(self, time_s: Array) -> Array:
        """Local solar time at the site, h; a rotation has 24 h."""
        return geometry.local_solar_time(self.site, self.rotation, self.to_sun(time_s), time_s)

    def slack(self, limits: Observation) -> OfTime:
        """Smallest distance from a limit as a function of time, h or deg: only its sign matters."""

        def slack(time_s: Array) -> Array:
            hour = self.local_solar_time(time_s)
            lit = limits.incidence_max_deg - np.rad2deg(self.incidence(time_s))
            early, late = hour - limits.local_solar_time_min_h, limits.local_solar_time_max_h - hour
            return np.minimum(np.minimum(lit, early), late)

        return slack


SCAN_STEP_S = 20.0
SCANS_PER_ROTATION = 500
"""Fewest scans of a rotation: lighting turns by less than a degree from one look to the next."""
SCANS_MAX = 2_000_000
"""Four hundred and sixty days of a body that turns in more than 2.8 hours."""
SCANS_AT_ONCE = 50_000


def scan_step_s(rate_rad_s: float, span_s: Window) -> float:
    """Step in s with which to scan for windows on a body that turns at a rate.

    Raises:
        InputError: if the span would take more than `SCANS_MAX` steps.
    """
    period = 2.0 * np.pi / max(abs(rate_rad_s), 1e-12)
    step = min(SCAN_STEP_S, period / SCANS_PER_ROTATION)
    if (length := span_s[1] - span_s[0]) > SCANS_MAX * step:
        raise InputError(
            "body",
            f"a rotation in {period:g} s",
            f"must turn at most {SCANS_MAX // SCANS_PER_ROTATION} times in the {length:g} s that are "
            f"searched for windows, which must be shorter than {SCANS_MAX * SCAN_STEP_S:g} s",
        )
    return step


def each_window(slack: OfTime, span_s: Window, step_s: float) -> Iterator[Window]:
    """Every interval of a span in which a function is not negative, its edges to 1e-6 s.

    The function is scanned. Where it comes near zero between two samples its extreme is searched for,
    so that an interval shorter than a step is found if the function is unimodal there. Intervals at
    the ends of the span are cut; the others are whole. The function must be continuous near zero, and
    the step well below the time in which it turns.
    """
    first, last = span_s
    times = np.linspace(first, last, max(1, int(np.ceil((last - first) / step_s))) + 1)
    parts = np.array_split(times, int(np.ceil(len(times) / SCANS_AT_ONCE)))
    values = np.concatenate([slack(part) for part in parts])
    times, values = _with_extremes(slack, times, values)
    lit = values >= 0.0
    changes = np.flatnonzero(lit[1:] != lit[:-1])
    # Edges are searched for as windows are asked for: who wants the first one pays for two.
    inner = (_edge(slack, *times[k : k + 2].tolist()) for k in changes)
    edges = chain([first] * bool(lit[0]), inner, [last] * bool(lit[-1]))
    return zip(edges, edges, strict=True)


def whole_windows(windows: Iterable[Window], span_s: Window) -> Iterator[Window]:
    """Select the windows that are not cut by the ends of the span."""
    return (edges for edges in windows if edges[0] > span_s[0] and edges[1] < span_s[1])


def _with_extremes(slack: OfTime, times: Array, values: Array) -> tuple[Array, Array]:
    """Add to a scan the extremes between its samples that lie on the other side of zero."""
    places, extra = [], []
    for sign in (1.0, -1.0):
        f = np.pad(sign * values, 1, mode="edge")
        here, rise = f[1:-1], np.abs(np.diff(f))
        # A concave function rises from its highest sample by less than it rose to it.
        near = here + 2.0 * np.maximum(rise[:-1], rise[1:]) >= 0.0
        peaks = (here <= 0.0) & (here >= f[:-2]) & (here >= f[2:]) & near
        for k in np.flatnonzero(peaks).tolist():
            bracket = float(times[max(k - 1, 0)]), float(times[min(k + 1, len(times) - 1)])
            found = minimize_scalar(
                lambda t, sign=sign: -sign * float(slack(np.array(t))),
                bounds=bracket,
                method="bounded",
                options={"xatol": 1e-7},
            )
            if (value := -sign * found.fun) * sign > 0.0:
                places.append(float(found.x))
                extra.append(value)
    at = np.searchsorted(times, places)
    return np.insert(times, at, places), np.insert(values, at, extra)


def _edge(slack: OfTime, before: float, after: float) -> float:
    """Time at which the function changes its sign."""
    ends = [float(slack(np.array(t))) for t in (before, after)]
    if ends[0] * ends[1] > 0.0:  # it is zero at one of them, but for rounding
        return before if abs(ends[0]) < abs(ends[1]) else after
    return float(brentq(lambda t: float(slack(np.array(t))), before, after, xtol=1e-6))


def moved_edges(slack: OfTime, window: Window) -> Array:
    """Edges of a window in flights with a lighting of their own, s, shape (2, flights).

    Newton's steps from the edges of the mean, at most half the window's length away: farther edges are
    no longer its own. Times of `slack` are one a flight.
    """
    half, found = 0.5 * (window[1] - window[0]), []
    for edge in window:
        time = np.full(np.shape(slack(np.array(edge))) or (1,), edge)
        for _ in range(NEWTON_STEPS):
            here = slack(time)
            slope = slack(time + 1.0) - here
            step = np.divide(-here, slope, out=np.zeros_like(here), where=slope != 0.0)
            time = np.clip(time + step, edge - half, edge + half)
        found.append(time)
    return np.array(found)


@dataclass(frozen=True, eq=False)
class WindowEdges:
    """Edges of the observation window, and when flights observe.

    Attributes:
        window_s: from the first node on; None if it is over, or observation is not required.
        sigmas_s: 1 sigma of the edges, shape (2,); None where they stay.
        flight_s: first and last node.
    """

    window_s: Window | None
    sigmas_s: Array | None
    flight_s: Window

    @property
    def watched_s(self) -> Window | None:
        """When flights' limits of the observation may count: the window, and 3 sigma of its edges."""
        if self.window_s is None or self.sigmas_s is None:
            return self.window_s
        (first, last), (early, late) = self.window_s, FAR * self.sigmas_s
        return max(first - early, self.flight_s[0]), min(last + late, self.flight_s[1])

    @property
    def samples_s(self) -> Array:
        """Times about the edges where those of flights are mostly, s; none where they stay."""
        if self.window_s is None or self.sigmas_s is None:
            return np.zeros(0)
        pairs = zip(self.window_s, FAR * self.sigmas_s, strict=True)
        times = np.concatenate([np.linspace(at - far, at + far, EDGE_PARTS) for at, far in pairs])
        return times[(times > self.flight_s[0]) & (times < self.flight_s[1])]
