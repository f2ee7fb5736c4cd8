"""Sample flights of a plan, and derive histories with bands, probabilities and delta-v."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from formulations.arrays import Array, Booleans, Indices
from scp_recon.mission.constraints import (
    COMPANION,
    SAFETY,
    Measure,
    companion_distance_m,
    safety_margins,
)
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import binomial_quantile, proportion
from scp_recon.monte_carlo.limits import is_certain, kept_limits, limit_margins
from scp_recon.monte_carlo.observation_time import measured
from scp_recon.monte_carlo.sampling import Flyer, flown_mission
from scp_recon.physics import geometry
from scp_recon.physics.frames import unit
from scp_recon.reports.ground import Camera, GroundTrack, ground_track
from scp_recon.reports.subject import Subject
from scp_recon.reports.surfaces import Shape
from scp_recon.reports.tables import or_none
from scp_recon.results.table import Column, Table
from scp_recon.verification.probabilities import SAMPLES, SEED

LOOKS_IN_WINDOW = 121
SHARE = 0.99
"""Share of the flights whose delta-v stays below a budget."""
SO_FAR = "all of them, from the start so far"
"""Name of the share of flights that have broken no limit so far."""
SIGMAS = {1: (15.8655, 84.1345), 2: (2.2750, 97.7250), 3: (0.1350, 99.8650)}
"""Percentiles between which a normal variable is within so many sigma of its mean."""
DEGREES = float(np.rad2deg(1.0))
MEASURES: dict[Measure, tuple[str, float, float]] = {
    "distance": ("distance from the site (m)", 1.0, np.inf),
    "emission": ("emission (deg)", DEGREES, np.inf),
    "phase": ("phase (deg)", DEGREES, 180.0),
}
"""Title, unit, and from which value on a limit is none."""


@dataclass(frozen=True, eq=False)
class DrawnFlights:
    """Flights with the planner's dynamics and the same draws as the verification.

    Attributes:
        times_s: nodes, and even times in the window, shape (n,).
        window: indices of those in the rest of the window, shape (w,).
        positions: J2000, m, shape (n, flights, 3).
        executed_m_s: sizes of the burns as executed, shape (flights, m).
        commanded_m_s: sums of their sizes as commanded, shape (flights,).
        mission: as the flights have it, with their parameters.
    """

    times_s: Array
    window: Indices
    positions: Array
    executed_m_s: Array
    commanded_m_s: Array
    mission: Mission

    @property
    def window_s(self) -> Array:
        """Times in the window, shape (w,)."""
        return self.times_s[self.window]

    @property
    def samples(self) -> int:
        """Number of flights."""
        return len(self.executed_m_s)


def fly(subject: Subject, samples: int | None = None) -> DrawnFlights:
    """Fly a plan at its nodes' times and at even ones in the window, as often as the verification."""
    samples = samples or SAMPLES
    mission, burns = subject.mission, subject.solution.burns_m_s
    policy = subject.solution.corrections
    first, last = subject.window_s
    times = np.union1d(mission.times_s, subject.looks_s(LOOKS_IN_WINDOW))
    positions, executed, commanded = [], [], []
    for block in Flyer(mission, burns, policy).fly_blocks(times, samples, SEED):
        positions.append(block.states[..., :3])
        executed.append(np.linalg.norm(block.burns_m_s, axis=2))
        commanded.append(np.linalg.norm(block.commanded_m_s, axis=2).sum(axis=1))
    window = np.flatnonzero((times >= first) & (times <= last))
    sizes = np.concatenate(executed), np.concatenate(commanded)
    own = flown_mission(mission, SEED, samples)
    return DrawnFlights(times, window, np.concatenate(positions, axis=1), *sizes, own)


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
    mission, flown = plan.subject.mission, plan.flown
    mean, sampled = plan.subject.positions(flown.window_s), flown.positions[flown.window]
    return observed_over(mission, flown.mission, flown.window_s, mean, sampled)


def observed_over(
    mission: Mission, flown: Mission, times_s: Array, mean: Array, sampled: Array
) -> list[History]:
    """Distance from the site, emission and phase over time, with every limit on them.

    Args:
        mission: of the plan.
        flown: as the flights have it, with their parameters.
        times_s: shape (n,).
        mean: planned positions, J2000, m, shape (n, 3).
        sampled: those of flights, shape (n, flights, 3).
    """
    planned, each = measured(mission, times_s, mean), measured(flown, times_s, sampled)
    return [
        History(
            title,
            times_s,
            scale * planned[measure],
            bands_of(scale * each[measure], (1, 2)),
            tuple(
                (f"{limit.name}: at {'least' if limit.sense == 'min' else 'most'}", value)
                for limit in mission.limits
                if limit.measure == measure and (value := scale * limit.value) < without
            ),
        )
        for measure, (title, scale, without) in MEASURES.items()
    ]


def _measured(plan: Shown) -> tuple[dict[Measure, Array], dict[Measure, Array]]:
    """Distance, emission and phase in the window: of the mean, and of the sampled flights."""
    mission, flown = plan.subject.mission, plan.flown
    mean = measured(mission, flown.window_s, plan.subject.positions(flown.window_s))
    return mean, measured(flown.mission, flown.window_s, flown.positions[flown.window])


def range_histories(plan: Shown) -> list[History]:
    """Range to the surface below, along the line to the centre, and to the centre; with 3 sigma."""
    mission, flown, times = plan.subject.mission, plan.flown, plan.flown.times_s
    body = mission.rotation.body_to_j2000(times)
    each = flown.mission.rotation.body_to_j2000(times[:, None])
    mean = plan.subject.positions(times)

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
    mission, times = plan.subject.mission, np.linspace(0.0, plan.subject.nodes_s[-1], 401)
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


@dataclass(frozen=True, eq=False)
class Achieved:
    """A probability over time with its 95 % interval, shape (n,) each."""

    name: str
    times_s: Array
    value: Array
    low: Array
    high: Array


def achieved(subject: Subject, flown: DrawnFlights) -> list[Achieved]:
    """Probabilities of every joint constraint at each time, and of all constraints so far."""
    certain = is_certain(subject.mission, subject.solution.burns_m_s)
    at = flown.mission, flown.times_s, flown.positions, flown.window
    kept = kept_limits(limit_margins(*at, certain=certain))
    still = np.ones((len(flown.times_s), flown.samples), dtype=bool)
    for times, those in kept.values():
        still[np.isin(flown.times_s, times)] &= those
    unbroken = np.logical_and.accumulate(still, axis=0)
    found = [_estimated(name, times, those) for name, (times, those) in kept.items()]
    return [*found, _estimated(SO_FAR, flown.times_s, unbroken)]


def _estimated(name: str, times: Array, held: Booleans) -> Achieved:
    estimates = [proportion(int(count), held.shape[1]) for count in held.sum(axis=1)]
    value, low, high = np.array(estimates).T
    return Achieved(name, times, value, low, high)


@dataclass(frozen=True, eq=False)
class Budget:
    """Sizes of burns, m/s.

    Attributes:
        first: number of the first burn, more than 1 in flight.
        planned_m_s: shape (m,).
        mean_m_s: of the executions, shape (m,).
        high_m_s: quantile `SHARE` of the executions of each burn, shape (m,).
        total_mean_m_s: of a flight's total.
        total_high_m_s: quantile `SHARE` of the flights' totals.
        interval_m_s: 95 % confidence interval of that.
    """

    first: int
    planned_m_s: Array
    mean_m_s: Array
    high_m_s: Array
    total_mean_m_s: float
    total_high_m_s: float
    interval_m_s: tuple[float, float]


def budget_of(subject: Subject, flown: DrawnFlights) -> Budget:
    """Budget of a plan; the interval is that of an order statistic, for any distribution."""
    executed = flown.executed_m_s
    totals = np.sort(executed.sum(axis=1))
    ranks = [binomial_quantile(level, len(totals), SHARE) for level in (0.025, 0.975)]
    low, high = totals[np.clip(ranks, 0, len(totals) - 1)]
    return Budget(
        1 + subject.solution.scenario.burns_flown,
        np.linalg.norm(subject.solution.burns_m_s, axis=1),
        executed.mean(axis=0),
        np.quantile(executed, SHARE, axis=0),
        float(totals.mean()),
        float(np.quantile(totals, SHARE)),
        (float(low), float(high)),
    )


def budget_table(budget: Budget, corrected: bool = False) -> Table:
    """Sizes of each burn and of the whole flight, of burns that gains correct or of planned ones."""
    each = zip(budget.planned_m_s, budget.mean_m_s, budget.high_m_s, strict=True)
    rows = [
        [str(i), *or_none(sizes[0] > 0.0, *map(float, sizes))]
        for i, sizes in enumerate(each, start=budget.first)
    ]
    rows.append([
        *("whole flight", float(budget.planned_m_s.sum())),
        *(budget.total_mean_m_s, budget.total_high_m_s),
    ])  # fmt: skip
    low, high = budget.interval_m_s
    percent = f"{100.0 * SHARE:g} %"
    names = ("planned", "executed, mean", f"executed, {percent} stay below")
    return Table.of(
        "Delta-v budget",
        ("burn", *(Column(name, "m/s", ".3f", shown_unit="mm/s") for name in names)),
        rows,
        key="budget",
        note=f"95 % interval of the flights' {percent}: {1e3 * low:.3f} to {1e3 * high:.3f} mm/s. "
        "Of the planned burns with their execution errors; "
        + ("corrected by gains." if corrected else "no burns to correct them."),
    )


@dataclass(frozen=True, eq=False)
class Shown:
    """A plan with the content of its page."""

    subject: Subject
    shape: Shape
    camera: Camera
    flown: DrawnFlights
    achieved: list[Achieved]
    budget: Budget
    ground: GroundTrack

    @classmethod
    def of(
        cls, subject: Subject, shape: Shape, camera: Camera, samples: int | None = None
    ) -> Shown:
        """Fly a plan and compute the content of its page."""
        flown, ground = fly(subject, samples), ground_track(subject, shape, camera)
        found, budget = achieved(subject, flown), budget_of(subject, flown)
        return cls(subject, shape, camera, flown, found, budget, ground)
