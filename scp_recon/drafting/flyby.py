"""Design a flyby from the terminator orbit past the site and back: its boundary states.

A pass is an arc of two-body motion through a point above the site at the window's middle. Lambert
arcs join the pass to circular orbits in the terminator plane. The search takes the cheapest pass
and places on the orbit that keep the limits in the window. The planner starts from this flyby, and
adds uncertainty, J2 and sunlight.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from operator import itemgetter

import numpy as np
from scipy.integrate import solve_ivp

from formulations.arrays import Array
from scp_recon.mission.scene import Scene
from scp_recon.mission.windows import Window
from scp_recon.physics import geometry
from scp_recon.physics.two_body import lambert
from scp_recon.scenario.body import HomeOrbit
from scp_recon.scenario.schema import Scenario, ScheduleRules

HOME_RADII, SLACK_S = 4.0, 500.0
"""Home orbit in reference radii; and how far burns stay from the edges of what is legal."""
AZIMUTHS, PLACES, LOOKS = 16, 24, 25
TURNS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Share of the body's rotation with which a pass moves along."""
ENOUGH = 0.3
"""Share of the way from a limit to the middle of its range that a pass should keep where it can."""
SUN_LINE_COST = 2.0
"""A burn too near the Sun line counts as so many."""


@dataclass(frozen=True)
class Design:
    """Boundary states and burn times of a flyby, with its delta-v by two-body motion."""

    times_s: tuple[float, float, float, float]
    """Four burns, s."""
    initial_state: Array
    """On the home orbit before the first burn, Sun-North at the epoch, shape (6,)."""
    final_state: Array
    """On the home orbit after the last burn, shape (6,)."""
    burns_m_s: Array
    """Sizes, by two-body motion, shape (4,)."""


def window_opens_s(rules: ScheduleRules) -> float:
    """Earliest opening of a window with one burn before it and some margin, s."""
    return rules.cycle_s + rules.before_window_s + 3.0 * SLACK_S


def burn_times(window_s: Window, rules: ScheduleRules) -> tuple[float, float, float, float]:
    """Times of one burn before the window, as late as legal, and two after it, with some margin, s."""
    second = window_s[0] - rules.before_window_s - SLACK_S
    third = window_s[1] + rules.cycle_s + SLACK_S
    return 0.0, round(second), round(third), round(third + rules.cycle_s + SLACK_S)


def design_flyby(scene: Scene, window_s: Window) -> Design:
    """Search passes and places on the home orbit; ignores the scenario's boundary and burns."""
    times = burn_times(window_s, scene.scenario.schedule)
    passes = _passes(scene, window_s, times)
    margins = np.array([margin for margin, _, _ in passes])
    enough = min(ENOUGH, float(margins.max()))
    kept = (one for margin, *one in passes if margin >= enough)
    designs = [found for one in kept if (found := _joined(scene, times, *one)) is not None]
    assert designs, "no arc joins the home orbit to any pass"
    return min(designs, key=lambda design: float(design.burns_m_s.sum()))


def _passes(
    scene: Scene, window_s: Window, times: tuple[float, ...]
) -> list[tuple[float, Array, Array]]:
    """Margin, and states at the second and the third burn, of all passes."""
    limits, body = scene.scenario.observation, scene.scenario.body
    rotation, middle = scene.rotation, 0.5 * (window_s[0] + window_s[1])
    track = geometry.track(scene.site, rotation, np.array(middle))
    spin = rotation.rate * rotation.pole
    emission = np.deg2rad(0.5 * (limits.emission_min_deg + limits.emission_max_deg))
    distance = 0.5 * (limits.site_distance_min_m + limits.site_distance_max_m)
    east = np.cross(rotation.pole, track.normal)
    if np.linalg.norm(east) < 1e-6:
        east = np.cross([1.0, 0.0, 0.0], track.normal)
    east /= np.linalg.norm(east)
    north = np.cross(track.normal, east)
    starts = []
    azimuths = np.linspace(0.0, 2.0 * np.pi, AZIMUTHS, endpoint=False)
    for azimuth, turn in itertools.product(azimuths, TURNS):
        across = np.cos(azimuth) * north + np.sin(azimuth) * east
        sight = np.cos(emission) * track.normal + np.sin(emission) * across
        position = track.position + distance * sight
        starts.append(np.concatenate([position, turn * np.cross(spin, position)]))
    samples_s, field = np.linspace(*window_s, LOOKS), (body.gm_m3_s2, 0.5 * body.reference_radius_m)
    early, late = samples_s[samples_s <= middle][::-1], samples_s[samples_s > middle]
    back = _flown(np.array(starts), middle, np.append(early, times[1]), *field)
    forth = _flown(np.array(starts), middle, np.append(late, times[2]), *field)
    seen = np.concatenate([back[:, -2::-1], forth[:, :-1]], axis=1)
    margins = _margins(scene, samples_s, seen[:, :, :3])
    return list(zip(margins.tolist(), back[:, -1], forth[:, -1], strict=True))


def _flown(starts: Array, from_s: float, times_s: Array, gm: float, core: float) -> Array:
    """Two-body motion of many states, shape (n, 6), at times, shape (n, times, 6).

    Within the radius `core`, m, gravity falls linearly to zero.
    """

    def rate(_: float, y: Array) -> Array:
        state = y.reshape(-1, 6)
        radius = np.linalg.norm(state[:, :3], axis=1, keepdims=True)
        radius = np.maximum(radius, core)  # a pass that falls in is no use, but has to end
        return np.concatenate([state[:, 3:], -gm * state[:, :3] / radius**3], axis=1).ravel()

    span = from_s, float(times_s[-1])
    flown = solve_ivp(rate, span, starts.ravel(), "DOP853", times_s, rtol=1e-7)
    return np.moveaxis(flown.y.reshape(*starts.shape, -1), -1, 1)


def _margins(scene: Scene, times_s: Array, positions: Array) -> Array:
    """Least margin in the window, as a share of half of a limit's range, shape (n,)."""
    scenario, o = scene.scenario, scene.scenario.observation
    track = geometry.track(scene.site, scene.rotation, times_s)
    distance = geometry.distance(positions, track)
    sun = scene.sun_direction(times_s)
    emission, phase = (
        np.rad2deg(geometry.angle(positions - track.position, axis)) for axis in (track.normal, sun)
    )
    least_phase = max(o.phase_min_deg, scenario.battery.observation_cone_deg)
    radius = np.linalg.norm(positions, axis=-1)
    half_m = 0.5 * (o.site_distance_max_m - o.site_distance_min_m)
    half_deg = 0.5 * (o.emission_max_deg - o.emission_min_deg)
    shares = [
        (distance - o.site_distance_min_m) / half_m,
        (o.site_distance_max_m - distance) / half_m,
        (emission - o.emission_min_deg) / half_deg,
        (o.emission_max_deg - emission) / half_deg,
        (phase - least_phase) / 20.0,
        (radius / scenario.safety.radius_min_m - 1.0) / 0.3,
    ]
    return np.min(shares, axis=(0, 2))


def _joined(
    scene: Scene, times: tuple[float, float, float, float], before: Array, after: Array
) -> Design | None:  # fmt: skip
    """Join a pass to the cheapest places on the home orbits before and after it."""
    scenario, sun, axes = scene.scenario, scene.sun_direction(0.0), scene.axes("sun_north")
    gm, cone = scenario.body.gm_m3_s2, np.deg2rad(scenario.battery.delta_v_cone_deg + 3.0)

    def cost(burn: Array) -> float:
        size = float(np.linalg.norm(burn))
        near = abs(float(burn @ sun)) > size * np.cos(cone)
        return size * (SUN_LINE_COST if near else 1.0)

    orbit, found = list(_home_orbit(scenario, axes)), []
    there = [(home, before, times[1] - times[0]) for home in orbit]
    back = [(after, home, times[3] - times[2]) for home in orbit]
    for legs in (there, back):
        joined = []
        for start, end, duration in legs:
            if (arc := lambert(start[:3], end[:3], duration, gm)) is not None:
                burns = np.array([arc[0] - start[3:], end[3:] - arc[1]])
                sizes = np.linalg.norm(burns, axis=1)
                joined.append((cost(burns[0]) + cost(burns[1]), start, end, sizes))
        if not joined:
            return None
        found.append(min(joined, key=itemgetter(0)))
    (_, first, _, sizes), (_, _, last, other_sizes) = found
    turn = np.kron(np.eye(2), axes.T)
    return Design(times, turn @ first, turn @ last, np.concatenate([sizes, other_sizes]))


def _home_orbit(scenario: Scenario, axes: Array) -> Iterator[Array]:
    """States on the circle in the terminator plane, both ways round, J2000, shape (6,)."""
    radius, gm = HOME_RADII * scenario.body.reference_radius_m, scenario.body.gm_m3_s2
    home = HomeOrbit(radius_m=radius, normal=(1.0, 0.0, 0.0))
    for phase in np.linspace(0.0, 2.0 * np.pi, PLACES, endpoint=False).tolist():
        state = home.state(phase, gm).reshape(2, 3) @ axes.T
        for way in (1.0, -1.0):
            yield np.concatenate([state[0], way * state[1]])
