"""Draw quantities over time: the plan, bands of its flights, limits, probabilities, knowledge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from formulations.arrays import Array
from scp_recon.mission.constraints import (
    COMPANION,
    SAFETY,
    Measure,
    companion_distance_m,
    safety_margins,
)
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.limits import measured
from scp_recon.physics import geometry
from scp_recon.physics.frames import unit
from scp_recon.planning.initial_guess import nondimensional
from scp_recon.reports.marks import DASHES, LOGARITHMIC, PLANS, Chart, Panels, labelled
from scp_recon.reports.shown import SO_FAR, Shown

SIGMAS = {1: (15.8655, 84.1345), 2: (2.2750, 97.7250), 3: (0.1350, 99.8650)}
"""Percentiles between which a normal variable is within so many sigma of its mean."""
DEGREES = float(np.rad2deg(1.0))
MEASURES: dict[Measure, tuple[str, float, float]] = {
    "distance": ("distance from the site (m)", 1.0, np.inf),
    "emission": ("emission (deg)", DEGREES, np.inf),
    "phase": ("phase (deg)", DEGREES, 180.0),
}
"""Title, unit, and from which value on a limit is none."""
SHADES = {1: 0.34, 2: 0.2, 3: 0.14}
"""Opacity of a band by its sigmas."""
WORDS = {1: "1 sigma of the flights", 2: "2 sigma", 3: "3 sigma"}


Measured = dict[Measure, Array]


@dataclass(frozen=True, eq=False)
class History:
    """A quantity over time.

    Attributes:
        title: of its axis, with the unit.
        times_s: shape (n,).
        planned: of the mean, shape (n,).
        bands: of the sampled flights, by sigmas: low and high, shape (n,) each; none if it is certain.
        limits: limits on the quantity, by name.
    """

    title: str
    times_s: Array
    planned: Array
    bands: dict[int, tuple[Array, Array]]
    limits: tuple[tuple[str, float], ...] = ()


def bands_of(sampled: Array, sigmas: tuple[int, ...]) -> dict[int, tuple[Array, Array]]:
    """Percentiles of samples (n, flights)."""
    levels = [level for sigma in sigmas for level in SIGMAS[sigma]]
    edges = np.percentile(sampled, levels, axis=1)
    return {sigma: (edges[2 * i], edges[2 * i + 1]) for i, sigma in enumerate(sigmas)}


def observation_histories(plan: Shown) -> list[History]:
    """Distance from the site, emission and phase in the window, with every limit on them."""
    return observed_over(plan.mission, plan.flown.window_s, *_measured(plan))


def observed_over(
    mission: Mission, times_s: Array, planned: Measured, sampled: Measured
) -> list[History]:
    """Distance from the site, emission and phase over time, with every limit on them.

    Args:
        mission: whose limits are shown.
        times_s: shape (n,).
        planned: of the mean, shape (n,) each, m and rad.
        sampled: of flights, shape (n, flights) each.
    """
    return [
        History(
            title,
            times_s,
            scale * planned[measure],
            bands_of(scale * sampled[measure], (1, 2)),
            tuple(
                (f"{limit.name}: at {'least' if limit.sense == 'min' else 'most'}", value)
                for limit in mission.limits
                if limit.measure == measure and (value := scale * limit.value) < without
            ),
        )
        for measure, (title, scale, without) in MEASURES.items()
    ]


def _measured(plan: Shown) -> tuple[Measured, Measured]:
    """Distance, emission and phase in the window: of the mean, and of the sampled flights."""
    mission, flown = plan.mission, plan.flown
    mean = measured(mission, flown.window_s, plan.positions(flown.window_s))
    return mean, measured(flown.mission, flown.window_s, flown.positions[flown.window])


def range_histories(plan: Shown) -> list[History]:
    """Range to the surface below, along the line to the centre, and to the centre; with 3 sigma."""
    mission, flown, times = plan.mission, plan.flown, plan.flown.times_s
    body = mission.rotation.body_to_j2000(times)
    each = flown.mission.rotation.body_to_j2000(times[:, None])
    mean = plan.positions(times)

    def altitude(position: Array, matrix: Array) -> Array:
        fixed = np.einsum("n...ji,n...j->n...i", matrix, position)
        size = np.linalg.norm(fixed, axis=-1)
        return size - plan.shape.radius(unit(fixed))

    safety = (f"{SAFETY}: at least", mission.scenario.safety.radius_min_m)
    found = [
        History(
            "range to the surface (m)",
            times,
            altitude(mean, body),
            bands_of(altitude(flown.positions, each), (1, 3)),
        ),
        History(
            "distance from the centre (m)",
            times,
            np.linalg.norm(mean, axis=1),
            bands_of(np.linalg.norm(flown.positions, axis=2), (1, 3)),
            (safety,),
        ),
    ]
    scenario, least = mission.scenario, companion_distance_m(mission.scenario)
    if scenario.body.companion is not None:
        means, sampled = (
            safety_margins(one.scene, times, position)[COMPANION] + least
            for one, position in ((mission, mean), (flown.mission, flown.positions))
        )
        title = f"distance from the centre of {scenario.body.companion.name} (m)"
        limit = (f"{COMPANION}: at least", least)
        found.append(History(title, times, means, bands_of(sampled, (1, 3)), (limit,)))
    return found


def lighting_histories(plan: Shown) -> list[History]:
    """Incidence and local solar time at the site throughout the flight; both are certain."""
    mission, times = plan.mission, np.linspace(0.0, plan.nodes_s[-1], 401)
    limits = mission.scenario.observation
    sun = mission.sun_direction(times)
    track = geometry.track(mission.site, mission.rotation, times)
    hours = geometry.local_solar_time(mission.site, mission.rotation, sun, times)
    # A line from 24 to 0 h would cross the chart: the last hour before is left open.
    hours = np.where(np.abs(np.diff(hours, append=hours[-1])) > 12.0, np.nan, hours)
    return [
        History(
            "incidence (deg)",
            times,
            np.rad2deg(geometry.incidence(track, sun)),
            {},
            (("incidence: at most", limits.incidence_max_deg),),
        ),
        History(
            "local solar time (h)",
            times,
            hours,
            {},
            (
                ("local solar time: from", limits.local_solar_time_min_h),
                ("local solar time: to", limits.local_solar_time_max_h),
            ),
        ),
    ]


def resolution_histories(plan: Shown) -> list[History]:
    """Ground that a pixel sees at the site: across the line of sight, and along the slope."""
    pixel_rad = np.deg2rad(plan.camera.field_deg) / plan.camera.pixels
    found = _measured(plan)
    across = [100.0 * pixel_rad * each["distance"] for each in found]
    along = [cm / np.cos(each["emission"]) for cm, each in zip(across, found, strict=True)]
    return [
        History(f"pixel {name} (cm)", plan.flown.window_s, mean, bands_of(sampled, (1, 2)))
        for name, (mean, sampled) in (
            ("across the line of sight", across),
            ("along the slope", along),
        )
    ]


def history_chart(
    key: str,
    plans: Sequence[Shown],
    of: Callable[[Shown], Sequence[History]],
    *,
    marked: bool = False,
) -> Chart:
    """Panels of the histories `of` each plan, those of several laid over each other.

    `marked`: the observation window is marked behind them.
    """
    each = [(plan.name, of(plan)) for plan in plans]
    alone, panels = len(plans) == 1, Panels([history.title for history in each[0][1]])
    if marked:
        panels.window(plans[0].mission.schedule.window_s)
    for number, (name, histories) in enumerate(each):
        for panel, history in enumerate(histories):
            times, first = history.times_s, panel == 0
            for sigmas in sorted(history.bands, reverse=True):
                if alone or sigmas == max(history.bands):
                    said = labelled(name, WORDS[sigmas], alone)
                    edges, shade = history.bands[sigmas], SHADES[sigmas]
                    panels.band(times, edges, said, number, panel, shade, legend=first)
            shown = "plan" if alone else name
            panels.curve(times, history.planned, shown, number, panel, legend=first)
            for limit, value in history.limits:
                panels.limit(limit, value, panel)
    return panels.chart(key)


def probability_chart(plans: Sequence[Shown]) -> Chart:
    """Probability of every joint constraint, and of all so far, over time with 95 % intervals.

    Of several plans only the latter is shown, to which a probability required at nodes does not apply.
    """
    panels = Panels(["probability (1)"], panel_px=300)
    alone, lowest = len(plans) == 1, 1.0
    for number, plan in enumerate(plans):
        # Several plans are told apart by colour: of each no more than what all of it comes to.
        shown = [one for one in plan.achieved if alone or one.name == SO_FAR]
        for i, one in enumerate(shown):
            colour = (i if alone else number) % len(PLANS)
            name = labelled(plan.name, one.name, alone)
            panels.band(one.times_s, (one.low, one.high), name, colour, 0, 0.2, legend=False)
            panels.curve(one.times_s, one.value, name, colour)
            lowest = min(lowest, float(one.low.min()))
        risk, whole = plan.solution.scenario.risk, "of whole flights"
        said = whole if risk.scope == "flight" else "of each at every node"
        if plan.solution.problem == "P2" and (alone or said == whole):
            lowest = min(lowest, risk.p_chance)
            panels.limit(f"required {said}: at least", risk.p_chance, 0)
    panels.window(plans[0].mission.schedule.window_s)
    panels.y_axis(0, range=[max(0.0, lowest - 0.06), 1.02])
    return panels.chart("probability")


def is_corrected(plan: Shown) -> bool:
    """Whether a plan has corrections."""
    return None not in (plan.solution.policy, plan.solution.nodes.knowledge)


def uncorrected(plan: Shown) -> Array:
    """Covariances at the nodes with the planned burns alone, J2000, m and m/s, shape (n, 6, 6)."""
    mission, solution = plan.mission, plan.solution
    path = nondimensional(mission, solution.burns_m_s, np.array(solution.nodes.state))
    factor = mission.dynamics.linearise(mission.problem, path).factor
    factor = factor * mission.units.state[:, None]
    return np.asarray(factor @ factor.swapaxes(1, 2))


def knowledge_chart(plans: Sequence[Shown]) -> Chart:
    """Dispersion with and without corrections, and knowledge, over time."""
    panels = Panels(["position, 1 sigma (m)", "velocity, 1 sigma (mm/s)"])
    panels.window(plans[0].mission.schedule.window_s)
    alone = len(plans) == 1
    for number, plan in enumerate(plans):
        curves = {
            "dispersion": np.array(plan.solution.nodes.covariance),
            "dispersion without corrections": uncorrected(plan),
            "knowledge: error of the estimate": np.array(plan.solution.nodes.knowledge),
        }
        for i, (name, covariance) in enumerate(curves.items()):
            said, colour = labelled(plan.name, name, alone), i if alone else number
            variance = np.diagonal(covariance, axis1=1, axis2=2)
            for panel, (part, scale) in enumerate(((slice(3), 1.0), (slice(3, 6), 1000.0))):
                sigma = scale * np.sqrt(variance[:, part].sum(axis=1))
                dash = {"dash": DASHES[i]}
                panels.curve(plan.nodes_s, sigma, said, colour, panel, legend=panel == 0, line=dash)
    for panel in range(2):
        panels.y_axis(panel, **LOGARITHMIC)
    return panels.chart("knowledge")
