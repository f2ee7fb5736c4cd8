"""Draw the observation constraints at mid-window, to scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, Wedge

from formulations.arrays import Array
from paper_figs.drawing import legend, page
from paper_figs.inputs import Runs
from paper_figs.paper.observed import planned_positions
from scp_recon.mission.mission import Mission
from scp_recon.physics import geometry
from scp_recon.physics.frames import unit

ARROW_M = 800.0
"""Of the directions, which have no length of their own."""

INCIDENCE_LABEL_M = (-480.0, 50.0)
"""Outside the narrow angle that it names, with a line to it."""


@dataclass(frozen=True)
class Sight:
    """The geometry at one time, in the plane of the site's normal and the line of sight.

    Attributes:
        time_s: the time.
        distance_m: from the site to the spacecraft.
        emission, phase, incidence: deg.
        craft_at, sun_at: azimuths in the plane, deg, 90 for the normal.
        sun_off_plane: angle between the Sun and the plane, deg.
        centre_m: body's centre in the plane, relative to the site.
        disc_m: radius in the plane of the sphere through the site.
    """

    time_s: float
    distance_m: float
    emission: float
    phase: float
    incidence: float
    craft_at: float
    sun_at: float
    sun_off_plane: float
    centre_m: Array
    disc_m: float


def sight(mission: Mission, burns_m_s: Array, time_s: float) -> Sight:
    """The geometry of the plan at a time."""
    times = np.array([time_s])
    track = geometry.track(mission.site, mission.rotation, times)
    position, sun = planned_positions(mission, burns_m_s, times), mission.sun_direction(times)
    normal, line = track.normal[0], position[0] - track.position[0]
    across = unit(line - (line @ normal) * normal)
    in_plane = np.array([sun[0] @ across, sun[0] @ normal])
    centre = -np.array([track.position[0] @ across, track.position[0] @ normal])
    return Sight(
        time_s=time_s,
        distance_m=float(np.linalg.norm(line)),
        emission=float(np.rad2deg(geometry.emission(position, track)[0])),
        phase=float(np.rad2deg(geometry.phase(position, track, sun)[0])),
        incidence=float(np.rad2deg(geometry.incidence(track, sun)[0])),
        craft_at=float(np.rad2deg(np.arctan2(line @ normal, line @ across))),
        sun_at=float(np.rad2deg(np.arctan2(in_plane[1], in_plane[0]))),
        sun_off_plane=float(np.rad2deg(np.arccos(np.linalg.norm(in_plane)))),
        centre_m=centre,
        disc_m=float(np.linalg.norm(centre)),
    )


def draw(runs: Runs) -> Figure:
    """Site, normal, Sun, spacecraft, and the angles and the distance with their limits."""
    mission, burns = runs.plan.mission, runs.plan.solution.burns_m_s
    seen = sight(mission, burns, float(np.mean(mission.schedule.window_s)))
    with page(5.15) as figure:
        axes = figure.subplots()
        _regions(axes, mission, seen)
        _directions(axes, seen)
        _angles(axes, mission, seen)
        _window_track(axes, mission, burns)
        axes.set(
            xlabel="along the surface, towards the spacecraft (m)",
            ylabel="along the site's normal (m)",
            xlim=(-860.0, 860.0),
            ylim=(-170.0, 900.0),
            aspect="equal",
        )
        axes.set_axisbelow(True)
        legend(figure, 2, "outside lower center")
    return figure


def _regions(axes: Axes, mission: Mission, seen: Sight) -> None:
    """Shade the region allowed by emission and distance, and the cones about the Sun line."""
    limits, battery = mission.scenario.observation, mission.scenario.battery
    low, high = limits.site_distance_min_m, limits.site_distance_max_m
    start, end = 90.0 - limits.emission_max_deg, 90.0 - limits.emission_min_deg
    allowed = Wedge(
        (0.0, 0.0), high, start, end, width=high - low, facecolor="0.85", edgecolor="0.3",
        label="allowed by emission and site distance",
    )  # fmt: skip
    axes.add_patch(allowed)
    cone = battery.observation_cone_deg
    keep_out = Wedge(
        (0.0, 0.0), ARROW_M, seen.sun_at - cone, seen.sun_at + cone, facecolor="none",
        edgecolor="0.55", hatch="///", lw=0.8, label=f"battery keep-out, {cone:g} deg",
    )  # fmt: skip
    axes.add_patch(keep_out)
    inner = Wedge(
        (0.0, 0.0), ARROW_M, seen.sun_at - limits.phase_min_deg, seen.sun_at + limits.phase_min_deg,
        facecolor="0.78", edgecolor="0.3", lw=0.8, ls="--",
        label=f"phase keep-out, {limits.phase_min_deg:g} deg",
    )  # fmt: skip
    axes.add_patch(inner)
    body = Circle(
        tuple(seen.centre_m), seen.disc_m, facecolor="0.93", edgecolor="k", lw=0.8, hatch="....",
        label=f"{mission.scenario.body.name}, sphere through the site",
    )  # fmt: skip
    axes.add_patch(body)


def _directions(axes: Axes, seen: Sight) -> None:
    for azimuth, text in ((90.0, "site normal"), (seen.sun_at, "to the Sun")):
        tip = ARROW_M * _direction(azimuth)
        axes.annotate(
            "", (tip[0], tip[1]), (0.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": "k"}
        )
        _label(axes, text, (1.06 if azimuth == 90.0 else 1.1) * tip)
    craft = seen.distance_m * _direction(seen.craft_at)
    axes.plot(*np.array([[0.0, 0.0], craft]).T, "k-", lw=1.2)
    axes.plot(*craft, "ko", ms=7, zorder=5)
    axes.plot(0.0, 0.0, "k^", ms=7)


def _angles(axes: Axes, mission: Mission, seen: Sight) -> None:
    """Arcs with their values and limits, and the length of the line of sight."""
    limits = mission.scenario.observation
    least, most = limits.emission_min_deg, limits.emission_max_deg
    near, far = limits.site_distance_min_m, limits.site_distance_max_m
    for radius, start, end in (
        (170.0, 90.0, seen.sun_at),
        (230.0, seen.craft_at, 90.0),
        (400.0, seen.craft_at, seen.sun_at),
    ):
        axes.add_patch(Arc((0.0, 0.0), 2 * radius, 2 * radius, theta1=start, theta2=end, lw=1.2))
    leader = np.array([INCIDENCE_LABEL_M, 170.0 * _direction(115.0)])
    axes.plot(*leader.T, color="0.3", lw=0.8)
    for text, at in (
        (f"incidence {seen.incidence:.1f} deg\n(at most {limits.incidence_max_deg:g} deg)",
         INCIDENCE_LABEL_M),
        (f"emission {seen.emission:.1f} deg\n({least:g} to {most:g} deg)", (330.0, 150.0)),
        (f"phase {seen.phase:.1f} deg\n(at least {limits.phase_min_deg:g} deg)", (-30.0, 470.0)),
        (f"spacecraft,\nsite distance {seen.distance_m:.0f} m\n({near:g} to {far:g} m)",
         (640.0, 390.0)),
        (mission.scenario.site.name, (155.0, 22.0)),
    ):  # fmt: skip
        _label(axes, text, np.array(at))


def _label(axes: Axes, text: str, at: Array) -> None:
    box = {"facecolor": "w", "edgecolor": "none", "pad": 1.0}
    axes.text(float(at[0]), float(at[1]), text, ha="center", va="center", bbox=box)


def _window_track(axes: Axes, mission: Mission, burns: Array) -> None:
    """The plan through the window by distance and emission, as if it stayed in this plane."""
    times = np.linspace(*mission.schedule.window_s, 31)
    track = geometry.track(mission.site, mission.rotation, times)
    position = planned_positions(mission, burns, times)
    distance, emission = geometry.distance(position, track), geometry.emission(position, track)
    axes.plot(
        distance * np.sin(emission), distance * np.cos(emission), color="0.35", lw=3,
        solid_capstyle="butt", label="plan through the window, turned into this plane",
    )  # fmt: skip


def _direction(azimuth_deg: float) -> Array:
    angle = np.deg2rad(azimuth_deg)
    return np.array([np.cos(angle), np.sin(angle)])


def caption(runs: Runs) -> str:
    """Describe the figure."""
    mission = runs.plan.mission
    limits = mission.scenario.observation
    seen = sight(mission, runs.plan.solution.burns_m_s, float(np.mean(mission.schedule.window_s)))
    return (
        f"Observation constraints at {mission.scenario.site.name} in the middle of the window, "
        f"{seen.time_s:.0f} s, with the plan's values and, in brackets, the limits. The plane is "
        "that of the site's normal and the spacecraft, to scale. The Sun stands "
        f"{seen.sun_off_plane:.1f} deg off it: its direction and its cones are drawn projected on it, "
        "so that incidence and phase look a little different from the numbers, which are exact. "
        "Incidence and local solar time (here "
        f"{limits.local_solar_time_min_h:g} to {limits.local_solar_time_max_h:g} h) alone define "
        "the window; the spacecraft is kept in the grey region, out of both cones about the Sun "
        "line, and everything holds around the normal, not only in this plane."
    )
