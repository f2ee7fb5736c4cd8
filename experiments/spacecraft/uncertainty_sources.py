"""Measure the dispersion that each source of uncertainty causes.

Each source of the vehicle's errors is flown alone, and all together. Sources that act on the path
directly are flown many times in the planner's dynamics. Sources that act through the attitude, and
all sources together, are flown a few times each in the simulation of the whole spacecraft (extra
[sim]). How far flights end from the one without errors goes to OUT/uncertainty_sources.csv.
A run that was stopped continues with the missing flights.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.stats import chi2

from experiments.harness import Record, Session, Study, Tables, default_plan
from experiments.spacecraft.flown_plan import erring
from formulations.arrays import Array
from scp_recon.errors import needing
from scp_recon.monte_carlo.estimates import CONFIDENCE, Estimate
from scp_recon.monte_carlo.sampling import sample_positions
from scp_recon.results.solution import Solution
from scp_recon.simulation.vehicle import Errors, Vehicle, load_vehicle

PATHS, FLIGHTS = 10_000, 4
INITIAL, CHEMICAL, NO_ERRORS = "initial_state", "chemical_thruster", "none"
ATTITUDE = ("sun_sensor", "star_tracker", "imu", "micro_thruster")
"""Sources that act on the path by way of the attitude; names are those of the vehicle's errors."""
SETS: dict[str, tuple[str, tuple[str, ...], Callable[[Errors], str]]] = {
    NO_ERRORS: ("no errors", (), lambda _: ""),
    "sun_sensor": ("sun sensor", ATTITUDE[:1], lambda e: f"{e.sun_sensor_rad:g} rad"),
    "star_tracker": ("star tracker", ATTITUDE[1:2], lambda e: f"{e.star_tracker_arcsec:g} arcsec"),
    "imu": ("IMU", ATTITUDE[2:3], lambda e: f"{e.imu_rad_s:g} rad/s"),
    "micro_thruster": ("micro-thrusters", ATTITUDE[3:], lambda e: f"{e.micro_thruster_n:g} N"),
    "attitude": ("attitude sources together", ATTITUDE, lambda _: "the four above"),
    INITIAL: ("initial state", (INITIAL,), lambda e: f"{100 * e.initial_state:g} % of each component"),
    CHEMICAL: ("chemical thruster", (CHEMICAL,),
        lambda e: f"{100 * e.chemical_thruster:g} % of the thrust"),
    "path": ("path sources together", (INITIAL, CHEMICAL), lambda _: "the two above"),
    "all": ("all together", (*ATTITUDE, INITIAL, CHEMICAL), lambda _: "all six"),
}  # fmt: skip
"""Sources that err together, in the order of the table: label, members, their 1 sigma in words."""
PATH_SETS = (INITIAL, CHEMICAL, "path")
"""Those that are flown in the planner's dynamics; the others are flown by the whole spacecraft."""
POSITION = ("x_m", "y_m", "z_m")


def fly_spacecraft(solution: Solution, vehicle: Vehicle, case: tuple[str, int]) -> Record:
    """Simulate one flight, (key of `SETS`, seed): a row of the flights' CSV.

    It has the position at the planned end, J2000, and the angle between attitude and command when the
    last burn begins.
    """
    from scp_recon.simulation.basilisk import simulation  # takes seconds

    name, seed = case
    sources = [simulation.Source(source) for source in SETS[name][1]]
    entries = erring(initial=vehicle.errors.initial_state)
    solution = replace(solution, scenario=solution.scenario.replace(entries))
    flight = simulation.simulate(solution, vehicle, seed, sources=sources)
    at = int(np.searchsorted(flight.times_s, flight.plan.firings[-1].start_s))
    off = (flight.commands[at].inv() * flight.attitudes[at]).magnitude()
    ends = dict(zip(POSITION, flight.terminal_state[:3].tolist(), strict=True))
    return {"error_sources": name, "seed": seed, **ends, "attitude_error_rad": float(off)}


def dispersion(deviation: Array) -> Estimate:
    """Root mean square length of deviations that should be zero on average, m.

    Its square, the trace of their second moments S, is taken as chi-squared with Satterthwaite's
    degrees of freedom, n (tr S)^2 / tr S^2. For normal deviations that is exact along one axis; in
    three, the few degrees of freedom that a small sample shows make the interval somewhat too wide.

    Args:
        deviation: shape (n, 3).
    """
    moments = deviation.T @ deviation / len(deviation)
    trace = float(np.trace(moments))
    if trace == 0.0:
        return Estimate(0.0, 0.0, 0.0)
    freedom = len(deviation) * trace**2 / float(np.sum(moments**2))
    tail = 0.5 * (1.0 - CONFIDENCE)
    high, low = (freedom / float(chi2.ppf(p, freedom)) for p in (tail, 1.0 - tail))
    return Estimate(np.sqrt(trace), np.sqrt(trace * low), np.sqrt(trace * high))


def measure_paths(solution: Solution, vehicle: Vehicle) -> list[Record]:
    """Rows of the sources that act on the path, alone and together, in the planner's dynamics."""
    mission, errors, rows = solution.mission, vehicle.errors, list[Record]()
    planned = np.array(solution.nodes.state[-1])[:3]
    for seed, name in enumerate(PATH_SETS):
        sources, initial, thruster = SETS[name][1], errors.initial_state, errors.chemical_thruster
        entries = erring(thruster * (CHEMICAL in sources), initial * (INITIAL in sources))
        own, ends_s = mission.changed(entries), mission.times_s[-1:]
        (ends,) = sample_positions(own, solution.burns_m_s, ends_s, PATHS, seed)
        rows.append(row(name, ends, planned, errors))
    return rows


def measure_flights(flown: Sequence[Record], errors: Errors) -> list[Record]:
    """Rows of the sets that the whole spacecraft was flown with, among them the one without errors."""
    rows = list[Record]()
    sets: dict[str, list[Record]] = {}
    for one in flown:
        sets.setdefault(one["error_sources"], []).append(one)
    ends = {key: np.array([[one[x] for x in POSITION] for one in own]) for key, own in sets.items()}
    for name, own in sets.items():
        found = row(name, ends[name], ends[NO_ERRORS][0], errors)
        off = max(one["attitude_error_rad"] for one in own)
        rows.append(found | {"attitude_error_deg": float(np.rad2deg(off))})
    return rows


def row(name: str, ends: Array, perfect: Array, errors: Errors) -> Record:
    """A row of the CSV: a set of sources, from where its flights end, J2000, m, shape (n, 3).

    `perfect` is the end of the flight without errors.
    """
    spread, (label, _, sigma) = dispersion(ends - perfect), SETS[name]
    return {
        "source": name,
        "label": label,
        "sigma": sigma(errors),
        "flights": len(ends),
        "rms_m": spread.value,
        "rms_m_low": spread.low,
        "rms_m_high": spread.high,
        "attitude_error_deg": "",
    }


def run(session: Session) -> Tables:
    """Fly every set of sources."""
    vehicle, solution = load_vehicle(), default_plan()
    with needing("uncertainty_sources", "sim", "Basilisk"):
        importlib.import_module("scp_recon.simulation.basilisk.simulation")
    # Seed by seed, so that an interrupted study has as many flights of every set.
    cases = [
        (name, seed)
        for seed in range(FLIGHTS)
        for name in SETS
        if name not in PATH_SETS and (name != NO_ERRORS or not seed)
    ]
    flown = session.rows("flights", partial(fly_spacecraft, solution, vehicle), cases)
    rows = measure_paths(solution, vehicle) + measure_flights(flown, vehicle.errors)
    rows.sort(key=lambda one: [*SETS].index(one["source"]))
    return {"uncertainty_sources": rows, "uncertainty_flights": flown}


STUDY = Study(__doc__, run)
