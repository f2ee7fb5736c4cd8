"""Decide whether flights keep the limits on their position, and for how long those of the observation.

One rule serves certification, verification and every count of flights: a flight keeps a limit whose
margin is not negative. Flights that are certain (`Flyer.certain`) have one path, and are judged like
the plan's mean, which may violate a limit between nodes by `MEAN_TOLERANCE`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from formulations.arrays import Array, Booleans, Indices
from scp_recon.mission.constraints import COMPANION, SAFETY, Measure, safety_margins
from scp_recon.mission.mission import Mission
from scp_recon.physics import geometry
from scp_recon.physics.flow import interpolate

Kept = dict[str, tuple[Array, Booleans]]
"""By joint constraint the times at which it counts, s, shape (k,), and whether flights keep it there,
shape (k, flights)."""

EVERYWHERE = SAFETY, COMPANION
"""Joint constraints that count throughout the flight; all others count in the window."""
OUTSIDE = 1e-3
"""Margin a second outside the flight's own window: only its sign counts."""
MEAN_TOLERANCE = {"m": 0.5, "rad": 1e-3}
"""Amount by which the mean may violate a limit between nodes, where it binds at nodes; at the default
mission's scale."""


def limit_margins(
    mission: Mission,
    times_s: Array,
    position: Array,
    observed: Indices | Booleans | slice,
    everywhere: Indices | slice = slice(None),
    *,
    certain: bool = False,
) -> dict[str, tuple[Array, Array]]:
    """Times at which each joint constraint counts, s, shape (k,), and its margins, shape (k, flights).

    Args:
        mission: that is flown.
        times_s: ascending, shape (n,).
        position: J2000, m, shape (n, flights, 3).
        observed: which times count for the limits of the observation.
        everywhere: which times count for safety distances.
        certain: whether the flights are; the mean's tolerance is then added.
    """
    clear = safety_margins(mission.scene, times_s[everywhere], position[everywhere])
    found = {name: (times_s[everywhere], margin) for name, margin in clear.items()}
    if len(window := times_s[observed]):
        seen = joint_margins(mission, window, position[observed])
        found |= {name: (window, in_own_window(mission, window, m)) for name, m in seen.items()}
    if certain:
        found = {
            name: (at, margin + allowed(mission, name)) for name, (at, margin) in found.items()
        }
    return found


def in_own_window(mission: Mission, times_s: Array, margin: Array) -> Array:
    """Margins (k,) or (k, flights), positive outside each flight's own window where edges move."""
    if mission.deviation is None or mission.edges.sigmas_s is None:
        return margin
    first, last = mission.own_edges_s
    time = times_s.reshape(-1, *[1] * (margin.ndim - 1))
    return np.maximum(margin, OUTSIDE * np.maximum(first - time, time - last))


def allowed(mission: Mission, name: str) -> float:
    """The mean's tolerance in a joint constraint of a mission, m or rad."""
    unit = "m" if name in (*EVERYWHERE, "site_distance") else "rad"
    return mission.units.tolerance(MEAN_TOLERANCE[unit], unit)


def kept_limits(margins: dict[str, tuple[Array, Array]], *, at_once: bool = False) -> Kept:
    """Whether flights keep each joint constraint of `limit_margins`, and the observation's at once."""
    kept = {name: (at, np.asarray(margin >= 0.0)) for name, (at, margin) in margins.items()}
    if at_once and kept.keys() >= set(SCIENCE):
        at, _ = kept[SCIENCE[0]]
        kept[ALL] = at, np.logical_and.reduce([kept[name][1] for name in SCIENCE])
    return kept


Margins = dict[str, tuple[Literal["m", "rad"], Array]]

SCIENCE = ("site_distance", "emission", "phase")
"""Observation constraints whose time is counted; the battery's is not one of them."""

ALL = "all"
BISECTIONS = 12


def observation_margins(mission: Mission, times_s: Array, position: Array) -> Margins:
    """Margins of the original observation constraints, m or rad, >= 0 where they hold.

    Times are in s, shape (n,), positions J2000, m, shape (n, ..., 3).
    """
    found = measured(mission, times_s, position)
    return {
        limit.name: (limit.unit, limit.margin(found[limit.measure])) for limit in mission.limits
    }


def measured(mission: Mission, times_s: Array, position: Array) -> dict[Measure, Array]:
    """Distance from the site, m, emission and phase, rad, of positions (n, ..., 3), J2000, m.

    With parameters of each flight positions have shape (n, flights, 3), or are one of each flight.
    """
    wide = (slice(None),) + (None,) * (position.ndim - 2)
    if mission.deviation is None:
        track = geometry.track(mission.site, mission.rotation, times_s)
        site = geometry.SiteTrack(track.position[wide], track.normal[wide])
    else:
        site = geometry.track(mission.site, mission.rotation, times_s[wide])
    return {
        "distance": geometry.distance(position, site),
        "emission": geometry.emission(position, site),
        "phase": geometry.phase(position, site, mission.sun_direction(times_s)[wide]),
    }


def joint_margins(mission: Mission, times_s: Array, position: Array) -> dict[str, Array]:
    """Smallest margin of each joint constraint, shape of `position` without its last axis."""
    margins = observation_margins(mission, times_s, position)
    joints: dict[str, list[Array]] = {}
    for limit in mission.limits:
        joints.setdefault(limit.joint, []).append(margins[limit.name][1])
    return {joint: np.minimum.reduce(parts) for joint, parts in joints.items()}


@dataclass(frozen=True)
class HoldingTime:
    """Time for which a constraint holds in the window, by flight; all of shape (flights,), s.

    `entry` and `exit` are the first and the last time at which it holds, NaN where it never does.
    """

    duration: Array
    entry: Array
    exit: Array


def time_held(mission: Mission, times_s: Array, states: Array) -> dict[str, HoldingTime]:
    """Time for which each observation constraint holds, and all of them at once.

    States are J2000, m and m/s, shape (n, flights, 6), at ascending times that span the window, shape
    (n,). Crossings are bisected on a cubic Hermite interpolation of the states to 1/4096 of the
    spacing. Dips and peaks between two times are the vertices of parabolas through three margins.
    """
    margins = _counted(joint_margins(mission, times_s, states[..., :3]))
    holds = np.stack(list(margins.values())) >= 0.0
    which, k, flight = np.nonzero(holds[:, 1:] != holds[:, :-1])
    crossing = _bisect(mission, times_s, states, (which, k, flight), holds[which, k, flight])
    held = {}
    for i, (name, margin) in enumerate(margins.items()):
        mine = which == i
        held[name] = _held(times_s, margin, k[mine], flight[mine], crossing[mine])
    return held


def _counted(joint: dict[str, Array]) -> dict[str, Array]:
    """Margins of the science constraints, and a function with the sign of the smallest of them."""
    science = {name: joint[name] for name in SCIENCE}
    signs = [science["site_distance"] / 100.0, science["emission"], science["phase"]]
    return science | {ALL: np.minimum.reduce(signs)}


def _held(times: Array, margin: Array, k: Indices, flight: Indices, crossing: Array) -> HoldingTime:
    """Holding time by margins (n, flights) of one constraint and its crossings in the arcs after k."""
    holds = margin >= 0.0
    steps = np.diff(times)
    duration = (steps[:, None] * (holds[1:] & holds[:-1])).sum(axis=0)
    duration += _vertices(steps, margin)
    any_held = holds.any(axis=0)
    first, last = np.argmax(holds, axis=0), len(times) - 1 - np.argmax(holds[::-1], axis=0)
    entry = np.where(any_held, times[first], np.nan)
    exit_ = np.where(any_held, times[last], np.nan)

    rises = holds[k + 1, flight]
    share = np.where(rises, times[k + 1] - crossing, crossing - times[k])
    np.add.at(duration, flight, share)
    opens = rises & (k + 1 == first[flight])
    closes = ~rises & (k == last[flight])
    entry[flight[opens]] = crossing[opens]
    exit_[flight[closes]] = crossing[closes]
    return HoldingTime(duration, entry, exit_)


def _bisect(
    mission: Mission,
    times: Array,
    states: Array,
    events: tuple[Indices, Indices, Indices],
    holds_before: Booleans,
) -> Array:
    """Times at which margins change sign, all events at once, shape (events,).

    An event is the number of a constraint, the time k before it, and a flight.
    """
    which, k, flight = events
    low, high = times[k].copy(), times[k + 1].copy()
    if not len(k):
        return low
    start, step = low.copy(), (high - low)[:, None]
    before, after = ((s[:, :3], s[:, 3:]) for s in (states[k, flight], states[k + 1, flight]))
    event, own = np.arange(len(k)), mission.some_flights(flight)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        position, _ = interpolate(before, after, step, (middle - start)[:, None] / step)
        margins = np.stack(list(_counted(joint_margins(own, middle, position)).values()))
        same = (margins[which, event] >= 0.0) == holds_before
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return 0.5 * (low + high)


def _vertices(steps: Array, margin: Array) -> Array:
    """Time to add for peaks above and dips below zero between the given times, (flights,).

    Through three equally spaced margins with second difference c and first difference d, the vertex
    is v = m - d^2 / (8 c), and the parabola lies beyond zero for sqrt(-8 v / c) spacings. Spacings
    that differ by a per cent or two change that by as much.
    """
    m, before, after = margin[1:-1], margin[:-2], margin[2:]
    c, d = before - 2.0 * m + after, after - before
    with np.errstate(divide="ignore", invalid="ignore"):
        vertex = m - d**2 / (8.0 * c)
        width = np.sqrt(np.maximum(-8.0 * vertex / c, 0.0)) * steps[1:, None]
    all_hold = np.minimum(m, np.minimum(before, after)) >= 0.0
    none_holds = np.maximum(m, np.maximum(before, after)) < 0.0
    near = np.abs(d) <= np.abs(c)  # the vertex belongs to the middle time
    dips = all_hold & near & (c > 0.0) & (vertex < 0.0)
    peaks = none_holds & near & (c < 0.0) & (vertex > 0.0)
    return np.where(peaks, width, 0.0).sum(axis=0) - np.where(dips, width, 0.0).sum(axis=0)
