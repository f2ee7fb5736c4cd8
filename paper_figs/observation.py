"""Draw the observation: geometry at mid-window and over time, times held, the final state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, Wedge
from scipy.stats import norm

from formulations.arrays import Array
from paper_figs.drawing import Look, history
from paper_figs.inputs import FlownPlan, Runs
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.observation_time import measured
from scp_recon.monte_carlo.sampling import flown_mission, sample_positions
from scp_recon.monte_carlo.summary import COMPONENTS
from scp_recon.physics import geometry
from scp_recon.physics.frames import unit
from scp_recon.results.pictures import legend, page
from scp_recon.results.solution import Solution
from scp_recon.scenario.uncertainty import Uncertainty

SAMPLES, SEED = 2000, 1
DEGREES = float(np.rad2deg(1.0))
BEFORE_AND_AFTER_S = 1500.0
"""Time shown before the window and after it, s."""
ARROW_M = 800.0
"""Length of the arrows that show directions, m."""
INCIDENCE_LABEL_M = (-480.0, 50.0)
"""Place of the incidence's label; a line leads to the narrow angle."""
BINS = 34
"""Bins across the window, of about a hundred seconds each."""
REACH = 4.0
"""Standard deviations shown; the outermost of the quantiles lies at 2.3 of a normal variable's."""


@dataclass(frozen=True)
class Quantity:
    """One observed quantity.

    Attributes:
        label: with its unit, for an axis.
        plan: of the planned flight, shape (n,).
        sampled: of sampled flights, shape (n, samples).
        limits: its limits.
    """

    label: str
    plan: Array
    sampled: Array
    limits: list[float]


def observed(solution: Solution, times_s: Array, samples: int = SAMPLES) -> list[Quantity]:
    """Site distance (m), emission and phase (deg) at times of the flight, shape (n,)."""
    mission, burns, policy = solution.mission, solution.burns_m_s, solution.corrections
    plan = measured(mission, times_s, planned_positions(mission, burns, times_s))
    flights = sample_positions(mission, burns, times_s, samples, SEED, policy)
    own, limits = flown_mission(mission, SEED, samples), mission.scenario.observation
    sampled = measured(own, times_s, flights)
    looks = (
        ("site distance (m)", 1.0, (limits.site_distance_min_m, limits.site_distance_max_m)),
        ("emission (deg)", DEGREES, (limits.emission_min_deg, limits.emission_max_deg)),
        ("phase (deg)", DEGREES, (limits.phase_min_deg, limits.phase_max_deg)),
    )
    return [
        Quantity(label, scale * mean, scale * sampled[of], [x for x in both if x is not None])
        for (of, mean), (label, scale, both) in zip(plan.items(), looks, strict=True)
    ]


def planned_positions(mission: Mission, burns_m_s: Array, times_s: Array) -> Array:
    """Positions without errors, J2000, m, shape (n, 3)."""
    nothing = {"uncertainty": Uncertainty.none()}
    certain = Mission.from_scenario(mission.scenario.model_copy(update=nothing))
    return sample_positions(certain, burns_m_s, times_s, 1, SEED)[:, 0]


def observation_histories(runs: Runs) -> Figure:
    """Emission, phase and distance with their spread, limits in the window, and the reference."""
    first, last = runs.plan.mission.schedule.window_s
    times = np.linspace(first - BEFORE_AND_AFTER_S, last + BEFORE_AND_AFTER_S, 107)
    pairs = zip(
        observed(runs.plan.solution, times),
        observed(runs.reference.solution, times, samples=1),
        strict=True,
    )
    distance, emission, phase = pairs
    with page(5.6) as figure:
        panels = figure.subplots(3, 1, sharex=True)
        for axes, (own, other) in zip(panels, (emission, phase, distance), strict=True):
            history(axes, times, own.sampled, own.plan, own.limits, (first, last))
            axes.plot(times, other.plan, "k:", lw=1.4, label=runs.reference.label)
            for edge in (first, last):
                axes.axvline(edge, color="0.4", lw=0.8)
            axes.set_ylabel(own.label)
        panels[0].set_title(f"observation window, {last - first:.0f} s")
        panels[-1].set_xlabel("time past the epoch (s)")
        legend(figure, 5)
    return figure


def observation_times(runs: Runs) -> Figure:
    """Times for which flights keep limits: the plan's filled, the reference's in outline."""
    first, last = runs.plan.mission.schedule.window_s
    edges = np.linspace(0.0, last - first, BINS + 1)
    with page(4.6) as figure:
        panels = figure.subplots(2, 1, sharex=True, sharey=True)
        for axes, name in zip(panels, ("emission", "site_distance"), strict=True):
            _times(axes, runs, name, edges)
            axes.set_title(f"{name.replace('_', ' ')} limits held", loc="left")
            axes.set(ylabel="share of flights (%)", yscale="log", xlim=(edges[0], edges[-1]))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.set_axisbelow(True)
        panels[-1].set_xlabel("time held in the observation window (s)")
        legend(figure, 2)
    return figure


def _times(axes: Axes, runs: Runs, name: str, edges: Array) -> None:
    """Shares of flights in coarser bins than the summary's."""
    least, words = 50.0 / max(runs.plan.summary.samples, runs.reference.summary.samples), []
    plan: Look = {"fill": True, "facecolor": "0.75", "edgecolor": "k", "lw": 0.6}
    reference: Look = {"fill": False, "edgecolor": "k", "ls": "--", "lw": 1.2}
    flights: tuple[tuple[FlownPlan, Look], ...] = ((runs.plan, plan), (runs.reference, reference))
    for flown, look in flights:
        held = flown.summary.held_s[name]
        middles = np.array(held.histogram.start) + 0.5 * held.histogram.bin
        inside = np.clip(middles, edges[0], edges[-1])
        counts = np.histogram(inside, edges, weights=held.histogram.count)[0]
        shares = 100.0 * counts / flown.summary.samples
        axes.stairs(shares, edges, label=flown.label, baseline=least, **look)
        whole = 100.0 * held.throughout.estimate.value
        words.append(f"{flown.label}: {whole:.1f} % throughout the window")
    axes.set_ylim(least, 200.0)
    box: Look = {"facecolor": "w", "edgecolor": "none", "alpha": 0.9, "pad": 1.0}
    look = {"transform": axes.transAxes, "ha": "center", "va": "top", "bbox": box}
    axes.text(0.5, 0.96, "\n".join(words), **look)


def terminal_normality(runs: Runs) -> Figure:
    """A quantile-quantile panel per component of the final state, J2000."""
    tests = runs.plan.summary.terminal.normality
    with page(4.8) as figure:
        panels = figure.subplots(2, 3, sharex=True, sharey=True)
        for axes, name in zip(panels.flat, COMPONENTS, strict=True):
            test, reach = tests[name], (-REACH, REACH)
            axes.axline((0.0, 0.0), slope=1.0, color="0.5", lw=1.0, ls="--", label="normal")
            expected = norm.ppf(test.levels)
            axes.plot(expected, test.quantiles, "o", ms=2.5, color="k", label="sampled flights")
            axes.set_title(f"{name}: p-value {test.p_value:.1g}", loc="left")
            axes.set(xlim=reach, ylim=reach, aspect="equal")
            axes.set(xlabel="normal quantile (sigma)", ylabel="sampled quantile (sigma)")
        for axes in panels.flat:
            axes.label_outer()
        legend(figure, 2)
    return figure


def observation_geometry(runs: Runs) -> Figure:
    """Angles and distance at mid-window with their limits, in the plane of normal and line of sight.

    The Sun stands off that plane: its direction and its cones are drawn projected on it.
    """
    mission, burns = runs.plan.mission, runs.plan.solution.burns_m_s
    times = np.array([np.mean(mission.schedule.window_s)])
    track = geometry.track(mission.site, mission.rotation, times)
    position, sun = planned_positions(mission, burns, times), mission.sun_direction(times)
    normal, line = track.normal[0], position[0] - track.position[0]
    across = unit(line - (line @ normal) * normal)
    plane = np.stack([across, normal])
    craft, centre = plane @ line, -plane @ track.position[0]
    craft_at, sun_at = (np.rad2deg(np.arctan2(*(plane @ to)[::-1])) for to in (line, sun[0]))
    emission, phase, incidence = (
        float(np.rad2deg(angle[0]))
        for angle in (
            geometry.emission(position, track),
            geometry.phase(position, track, sun),
            geometry.incidence(track, sun),
        )
    )
    limits, arrow = mission.scenario.observation, {"arrowstyle": "-|>", "color": "k"}
    with page(5.15) as figure:
        axes = figure.subplots()
        _regions(axes, mission, sun_at, centre)
        for azimuth, text, far in ((90.0, "site normal", 1.06), (sun_at, "to the Sun", 1.1)):
            tip = ARROW_M * _direction(azimuth)
            axes.annotate("", (tip[0], tip[1]), (0.0, 0.0), arrowprops=arrow)
            _label(axes, text, far * tip)
        axes.plot(*np.array([[0.0, 0.0], craft]).T, "k-", lw=1.2)
        axes.plot(*craft, "ko", ms=7, zorder=5)
        axes.plot(0.0, 0.0, "k^", ms=7)
        for size, start, end in (
            (340, 90.0, sun_at),
            (460, craft_at, 90.0),
            (800, craft_at, sun_at),
        ):
            axes.add_patch(Arc((0.0, 0.0), size, size, theta1=start, theta2=end, lw=1.2))
        leader = np.array([INCIDENCE_LABEL_M, 170.0 * _direction(115.0)])
        axes.plot(*leader.T, color="0.3", lw=0.8)
        ends = (f"{limits.emission_min_deg:g} to {limits.emission_max_deg:g} deg",
                f"{limits.site_distance_min_m:g} to {limits.site_distance_max_m:g} m")  # fmt: skip
        away = float(np.linalg.norm(line))
        for text, at in (
            (f"incidence {incidence:.1f} deg\n(at most {limits.incidence_max_deg:g} deg)",
             INCIDENCE_LABEL_M),
            (f"emission {emission:.1f} deg\n({ends[0]})", (330.0, 150.0)),
            (f"phase {phase:.1f} deg\n(at least {limits.phase_min_deg:g} deg)", (-30.0, 470.0)),
            (f"spacecraft,\nsite distance {away:.0f} m\n({ends[1]})", (640.0, 390.0)),
            (mission.scenario.site.name, (155.0, 22.0)),
        ):  # fmt: skip
            _label(axes, text, np.array(at))
        _window_track(axes, mission, burns)
        axes.set_xlabel("along the surface, towards the spacecraft (m)")
        axes.set_ylabel("along the site's normal (m)")
        axes.set(xlim=(-860.0, 860.0), ylim=(-170.0, 900.0), aspect="equal", axisbelow=True)
        legend(figure, 2, "outside lower center")
    return figure


def _regions(axes: Axes, mission: Mission, sun_at: float, centre: Array) -> None:
    """Shade what emission and distance allow, the cones about the Sun line, and the body's sphere."""
    limits, cone = mission.scenario.observation, mission.scenario.battery.observation_cone_deg
    low, high, phase = limits.site_distance_min_m, limits.site_distance_max_m, limits.phase_min_deg
    start, end = 90.0 - limits.emission_max_deg, 90.0 - limits.emission_min_deg
    allowed: Look = {"facecolor": "0.85", "edgecolor": "0.3", "width": high - low}
    label, site = "allowed by emission and site distance", (0.0, 0.0)
    axes.add_patch(Wedge(site, high, start, end, label=label, **allowed))
    battery: Look = {"facecolor": "none", "edgecolor": "0.55", "hatch": "///", "lw": 0.8}
    inner: Look = {"facecolor": "0.78", "edgecolor": "0.3", "ls": "--", "lw": 0.8}
    for name, angle, look in (("battery", cone, battery), ("phase", phase, inner)):
        label = f"{name} keep-out, {angle:g} deg"
        axes.add_patch(Wedge(site, ARROW_M, sun_at - angle, sun_at + angle, label=label, **look))
    look = {"facecolor": "0.93", "edgecolor": "k", "hatch": "....", "lw": 0.8}
    label = f"{mission.scenario.body.name}, sphere through the site"
    axes.add_patch(Circle(tuple(centre), float(np.linalg.norm(centre)), label=label, **look))


def _label(axes: Axes, text: str, at: Array) -> None:
    box: Look = {"facecolor": "w", "edgecolor": "none", "pad": 1.0}
    axes.text(float(at[0]), float(at[1]), text, ha="center", va="center", bbox=box)


def _window_track(axes: Axes, mission: Mission, burns: Array) -> None:
    """The plan through the window by distance and emission, as if it stayed in this plane."""
    times = np.linspace(*mission.schedule.window_s, 31)
    track = geometry.track(mission.site, mission.rotation, times)
    position = planned_positions(mission, burns, times)
    distance, emission = geometry.distance(position, track), geometry.emission(position, track)
    look: Look = {"color": "0.35", "lw": 3, "solid_capstyle": "butt"}
    label = "plan through the window, turned into this plane"
    axes.plot(distance * np.sin(emission), distance * np.cos(emission), label=label, **look)


def _direction(azimuth_deg: float) -> Array:
    angle = np.deg2rad(azimuth_deg)
    return np.array([np.cos(angle), np.sin(angle)])
