"""Measure the dispersion that each source of uncertainty causes.

Each source of the vehicle's errors is flown alone, and all together. Sources that act on the path
directly are flown many times in the planner's dynamics. Sources that act through the attitude, and
all sources together, are flown a few times each in the simulation of the whole spacecraft (extra
[sim]). How far flights end from the one without errors goes to OUT/uncertainty_sources.csv, and
their quantiles to uncertainty_quantiles.csv. Simulated flights are taken up again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import compress

import numpy as np

from experiments.harness import (
    PLAN,
    SEED,
    VEHICLE,
    Claim,
    Findings,
    Record,
    Session,
    Study,
    number,
    plan_or_default,
    records,
)
from experiments.spacecraft.uncertainty_sources import flights
from experiments.spacecraft.uncertainty_sources.flights import (
    CHEMICAL,
    INITIAL,
    NO_ERRORS,
    SETS,
    STATE,
    TRANSLATION,
    Normality,
    dispersion,
    fly_paths,
    normality,
)
from formulations.arrays import Array
from scp_recon.jobs.job import Job, here
from scp_recon.jobs.processes import Processes
from scp_recon.monte_carlo.estimates import Estimate
from scp_recon.results.solution import Solution
from scp_recon.results.table import Table
from scp_recon.simulation.record import inputs_digest
from scp_recon.simulation.vehicle import Errors, Vehicle, load_vehicle

PATHS, FLIGHTS = 10_000, 8

AXES = ("x", "y", "z")
PATH, SPACECRAFT = "planner's dynamics", "whole spacecraft"
BOTH = "path"
"""Key of the row in which both sources err that act on the path directly."""

NEGLIGIBLE = 0.01
"""Share of the variance that may be left out: no sigma changes by more than half a per cent."""

NORMAL_MIN = 8
"""Flights below which nothing is said about normality."""

ROUNDING_M = 1e-6
"""Below it flights differ by rounding alone."""


@dataclass(frozen=True)
class Measured:
    """Flights with a set of error sources.

    Deviations are of the flights' ends from that of the one without errors, J2000, m and m/s, (n, 6),
    the offset is that of their mean from the planned end. The attitude error is the largest before the
    last burn, NaN where no attitude is flown.
    """

    error_sources: str
    flown_by: str
    deviation: Array
    offset_m: float
    attitude_error_rad: float = np.nan

    @property
    def rms(self) -> Estimate:
        """Root mean square distance from the end of the flight without errors, m."""
        return dispersion(self.deviation[:, :3])

    @property
    def normality(self) -> dict[str, Normality]:
        """Normality of the final position by axis, if enough flights differ."""
        if len(self.deviation) < NORMAL_MIN or self.rms.value < ROUNDING_M:
            return {}
        return {axis: normality(self.deviation[:, i]) for i, axis in enumerate(AXES)}


def measure_paths(
    solution: Solution, vehicle: Vehicle, samples: int, seed: int
) -> dict[str, Measured]:
    """The sources that act on the path, each alone and both; without errors it ends as planned."""
    planned = np.array(solution.nodes.state[-1])
    sets = {INITIAL: (INITIAL,), CHEMICAL: (CHEMICAL,), BOTH: TRANSLATION}
    found = {}
    for k, (error_sources, sources) in enumerate(sets.items()):
        states = fly_paths(solution, vehicle, sources, samples, seed + k)
        found[error_sources] = Measured(
            error_sources, PATH, states - planned, _offset(states, planned)
        )
    return found


def measure_flights(flown: Sequence[Record], solution: Solution) -> dict[str, Measured]:
    """The sets that the whole spacecraft was flown with, among them the one without errors."""
    planned = np.array(solution.nodes.state[-1])
    found = {}
    ends = np.array([[one[name] for name in STATE] for one in flown])
    sets = np.array([one["error_sources"] for one in flown])
    for error_sources in dict.fromkeys(sets.tolist()):
        chosen = sets == error_sources
        states, perfect = ends[chosen], ends[sets == NO_ERRORS][0]
        worst = max(one["attitude_error_rad"] for one in compress(flown, chosen))
        offset = _offset(states, planned)
        found[error_sources] = Measured(error_sources, SPACECRAFT, states - perfect, offset, worst)
    return found


def _offset(states: Array, planned: Array) -> float:
    return float(np.linalg.norm(states[:, :3].mean(axis=0) - planned[:3]))


SIGNIFICANCE = 0.05

SOURCES: dict[str, tuple[str, Callable[[Errors], str]]] = {
    NO_ERRORS: ("no errors", lambda _: ""),
    "sun_sensor": ("sun sensor", lambda e: f"{e.sun_sensor_rad:g} rad"),
    "star_tracker": ("star tracker", lambda e: f"{e.star_tracker_arcsec:g} arcsec"),
    "imu": ("IMU", lambda e: f"{e.imu_rad_s:g} rad/s"),
    "micro_thruster": ("micro-thrusters", lambda e: f"{e.micro_thruster_n:g} N"),
    "attitude": ("attitude sources together", lambda _: "the four above"),
    INITIAL: ("initial state", lambda e: f"{100 * e.initial_state:g} % of each component"),
    CHEMICAL: ("chemical thruster", lambda e: f"{100 * e.chemical_thruster:g} % of the thrust"),
    BOTH: ("path sources together", lambda _: "the two above"),
    "all": ("all together", lambda _: "all six"),
}
"""In the order of the tables: their label, and their 1 sigma in words."""
NAMES = {key: label for key, (label, _) in SOURCES.items()}


def row(entry: Measured, errors: Errors) -> Record:
    """A row of the CSV."""
    normal = entry.normality
    figures: Record = {
        "source": entry.error_sources,
        "label": NAMES[entry.error_sources],
        "sigma": SOURCES[entry.error_sources][1](errors),
        "flown_by": entry.flown_by,
        "flights": len(entry.deviation),
        "rms_m": entry.rms.value,
        "rms_m_low": entry.rms.low,
        "rms_m_high": entry.rms.high,
        "mean_off_plan_m": entry.offset_m,
        "attitude_error_deg": "",
    }
    if np.isfinite(entry.attitude_error_rad):
        figures["attitude_error_deg"] = float(np.rad2deg(entry.attitude_error_rad))
    for axis in AXES:
        has = axis in normal
        figures[f"p_value_{axis}"] = normal[axis].p_value if has else ""
        figures[f"correlation_{axis}"] = normal[axis].correlation if has else ""
    return figures


def quantiles(entries: Sequence[Measured]) -> list[Record]:
    """Points of the quantile-quantile plots in long form."""
    return [
        {"source": entry.error_sources, "axis": axis, "expected": e, "observed": o}
        for entry in entries
        if entry.flown_by == PATH
        for axis, n in entry.normality.items()
        for e, o in zip(n.expected.tolist(), n.observed.tolist(), strict=True)
    ]


def _shown(e: Estimate) -> str:
    return f"{e.value:.3g} ({e.low:.3g} to {e.high:.3g})"


def claims(entries: Sequence[Measured]) -> list[Claim]:
    """Whether the attitude may be left out, whether both ways to fly agree, how normal the ends are."""
    found, rows = {entry.error_sources: entry for entry in entries}, []
    path = found[BOTH].rms
    if "attitude" in found:
        rows.append(_decoupling(found["attitude"].rms, path))
    if "all" in found:
        total = found["all"].rms
        agree = total.low <= path.high and path.low <= total.high
        words = "all sources in the whole spacecraft spread the end as the path's two do"
        measured = f"{_shown(total)} m and {_shown(path)} m"
        rows.append(Claim(words, "intervals overlap", measured, bool(agree)))
    for error_sources in (INITIAL, CHEMICAL):
        normal = found[error_sources].normality
        if not normal:  # of flights that all end alike, nothing can be said
            continue
        straight = min(n.correlation for n in normal.values())
        rejected = [axis for axis, n in normal.items() if n.p_value < SIGNIFICANCE]
        measured = (
            f"rejected for {', '.join(rejected) or 'none'}; quantiles correlate by {straight:.4f}"
        )
        words = f"{NAMES[error_sources]}: final positions are normal on every axis"
        rows.append(Claim(words, f"p-value of at least {SIGNIFICANCE:g}", measured, not rejected))
    return rows


def _decoupling(attitude: Estimate, path: Estimate) -> Claim:
    """Whether the sources that act by way of the attitude may be left out of the plan."""
    share, most = (
        r**2 / (r**2 + p**2) for r, p in ((attitude.value, path.value), (attitude.high, path.low))
    )
    return Claim(
        "the path may be planned without the attitude, whose four sources add little variance",
        f"less than {100 * NEGLIGIBLE:g} % of the total",
        f"{_shown(attitude)} m: {100 * share:.2g} %, at most {100 * most:.2g} %",
        bool(most < NEGLIGIBLE),
    )


def run(session: Session) -> Findings:
    """Fly every set of sources."""
    options = session.options
    vehicle, solution = load_vehicle(options.vehicle), plan_or_default(options.solution)
    # Seed by seed, so that an interrupted study has as many flights of every set.
    wanted = [
        (error_sources, options.seed + k)
        for k in range(options.flights)
        for error_sources in SETS
        if error_sources not in TRANSLATION and (error_sources != NO_ERRORS or k == 0)
    ]
    store = session.store("uncertainty_flights.jsonl", inputs=inputs_digest(solution, vehicle))
    jobs = [Job(f"{error_sources} {seed}", (error_sources, seed)) for error_sources, seed in wanted]
    if any(job.key not in store for job in jobs):
        flights.simulator()  # if it is not there, that is said once, and here
    work = partial(flights.fly_spacecraft, solution, vehicle)
    executor = Processes(options.workers) if options.workers > 1 else here
    flown = session.rows("flights", work, jobs, store, executor=executor)
    found = measure_flights(flown, solution)
    found |= measure_paths(solution, vehicle, options.paths, options.seed)
    entries = [found[error_sources] for error_sources in SOURCES if error_sources in found]
    files: dict[str, Table] = {
        "uncertainty_sources.csv": records([row(e, vehicle.errors) for e in entries]),
        "uncertainty_quantiles.csv": records(quantiles(entries)),
    }
    if flown:
        files["uncertainty_flights.csv"] = records(flown)
    return Findings(files, claims(entries))


STUDY = Study(
    __doc__,
    run,
    (
        number(
            "--paths",
            PATHS,
            20,
            10_000_000,
            "flights in the planner's dynamics for each set of sources",
        ),
        number(
            "--flights",
            FLIGHTS,
            0,
            100_000,
            "simulated flights for each set, about a minute each; 0 for none",
        ),
        number("--workers", 1, 1, 256, "processes"),
        SEED,
        PLAN,
        VEHICLE,
    ),
)
