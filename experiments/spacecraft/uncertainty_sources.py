"""Measure the dispersion that each source of uncertainty causes.

Each source of the vehicle's errors is flown alone, and all together. Sources that act on the path
directly are flown many times in the planner's dynamics. Sources that act through the attitude, and
all sources together, are flown a few times each in the simulation of the whole spacecraft (extra
[sim]). How far flights end from the one without errors goes to OUT/uncertainty_sources.csv.
Simulated flights are taken up again.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from functools import partial
from types import ModuleType

import numpy as np
from scipy.stats import chi2, probplot, shapiro

from experiments.harness import Findings, Record, Session, Study, claim, default_plan
from experiments.spacecraft.flown_plan import sampled_states
from formulations.arrays import Array
from scp_recon.errors import needing
from scp_recon.monte_carlo.estimates import CONFIDENCE, Estimate
from scp_recon.results.solution import Solution
from scp_recon.simulation.record import inputs_digest
from scp_recon.simulation.vehicle import Errors, Vehicle, load_vehicle

PATHS, FLIGHTS = 10_000, 4
INITIAL, CHEMICAL, BOTH, NO_ERRORS = "initial_state", "chemical_thruster", "path", "none"
PATH, SPACECRAFT = "planner's dynamics", "whole spacecraft"
ATTITUDE = ("sun_sensor", "star_tracker", "imu", "micro_thruster")
"""Sources that act on the path by way of the attitude; names are those of the vehicle's errors."""
PATH_SETS = {INITIAL: (INITIAL,), CHEMICAL: (CHEMICAL,), BOTH: (INITIAL, CHEMICAL)}
SPACECRAFT_SETS: dict[str, tuple[str, ...]] = {
    NO_ERRORS: (),
    **{source: (source,) for source in ATTITUDE},
    "attitude": ATTITUDE,
    "all": (*ATTITUDE, INITIAL, CHEMICAL),
}
"""Sources that err together, flown in the planner's dynamics and by the whole spacecraft."""
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
STATE = ("x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s")
NEGLIGIBLE = 0.01
"""Share of the variance that may be left out: no sigma changes by more than half a per cent."""
NORMAL_MIN = 8
"""Flights below which nothing is said about normality."""
TESTED_MAX = 5000
"""Samples up to which the p-values of Shapiro and Wilk's test are accurate."""
SIGNIFICANCE = 0.05
ROUNDING_M = 1e-6
"""Below it flights differ by rounding alone."""


def fly_paths(
    solution: Solution, vehicle: Vehicle, sources: Sequence[str], samples: int, seed: int
) -> Array:
    """Final states of flights in the planner's dynamics, J2000, m and m/s, shape (samples, 6).

    The initial state errs by component and each burn in size: a thrust error does not turn a burn.
    """
    mission, planned, errors = solution.mission, solution.burns_m_s, vehicle.errors
    sigma = errors.initial_state * np.abs(mission.initial_state) * (INITIAL in sources)
    beta = errors.chemical_thruster * (CHEMICAL in sources)

    def executed(draws: Array) -> Array:
        return planned * (1.0 + beta * draws[..., None])

    factor = np.diag(sigma)
    return sampled_states(mission, factor, executed, len(planned), samples, seed)[-1]


def simulator() -> ModuleType:
    """The simulation of the whole spacecraft, which takes seconds to import.

    Raises:
        InputError: if Basilisk is not there.
    """
    with needing("--flights", "sim", "Basilisk"):
        return importlib.import_module("scp_recon.simulation.basilisk.simulation")


def fly_spacecraft(solution: Solution, vehicle: Vehicle, case: tuple[str, int]) -> Record:
    """Simulate one flight, (key of `SPACECRAFT_SETS`, seed): a row of the flights' CSV.

    It has the state at the planned end, the last burn done, J2000, and the angle between attitude and
    command when the last burn begins.

    Raises:
        InputError: if Basilisk is not there.
    """
    simulation, (name, seed) = simulator(), case
    sources = [simulation.Source(source) for source in SPACECRAFT_SETS[name]]
    fraction = vehicle.errors.initial_state
    flight = simulation.simulate(
        solution, vehicle, seed, sources=sources, initial_sigma_fraction=fraction
    )
    at = int(np.searchsorted(flight.times_s, flight.plan.firings[-1].start_s))
    off = (flight.commands[at].inv() * flight.attitudes[at]).magnitude()
    ends = dict(zip(STATE, flight.terminal_state.tolist(), strict=True))
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


def normality(sample: Array) -> tuple[float, float]:
    """Test a sample, shape (n,), n > 3, whose values are not all the same.

    Returns:
        The p-value of Shapiro and Wilk's test; the correlation of the sample's quantiles with a
        normal variable's.
    """
    standard = (sample - sample.mean()) / sample.std(ddof=1)
    _, (_, _, correlation) = probplot(standard)
    return float(shapiro(standard[:TESTED_MAX]).pvalue), float(correlation)


def measure_paths(solution: Solution, vehicle: Vehicle) -> list[Record]:
    """Rows of the sources that act on the path, alone and together."""
    planned, rows = np.array(solution.nodes.state[-1]), list[Record]()
    for seed, (name, sources) in enumerate(PATH_SETS.items()):
        states = fly_paths(solution, vehicle, sources, PATHS, seed)
        rows.append(row(name, PATH, states, planned, planned, vehicle.errors))
    return rows


def measure_flights(flown: Sequence[Record], solution: Solution, vehicle: Vehicle) -> list[Record]:
    """Rows of the sets that the whole spacecraft was flown with, among them the one without errors."""
    planned, found = np.array(solution.nodes.state[-1]), list[Record]()
    ends = np.array([[one[name] for name in STATE] for one in flown])
    sets = np.array([one["error_sources"] for one in flown])
    off_deg = np.rad2deg([one["attitude_error_rad"] for one in flown])
    for name in dict.fromkeys(sets.tolist()):
        its, perfect = sets == name, ends[sets == NO_ERRORS][0]
        one = row(name, SPACECRAFT, ends[its], perfect, planned, vehicle.errors)
        found.append(one | {"attitude_error_deg": float(off_deg[its].max())})
    return found


def row(
    name: str, flown_by: str, ends: Array, perfect: Array, planned: Array, errors: Errors
) -> Record:
    """A row of the CSV, of flights' ends: one set of sources.

    `perfect` is the end of the flight without errors, J2000, m and m/s.
    """
    off, (label, sigma) = (ends - perfect)[:, :3], SOURCES[name]
    spread = dispersion(off)
    tested = len(off) >= NORMAL_MIN and spread.value >= ROUNDING_M
    found: Record = {
        "source": name,
        "label": label,
        "sigma": sigma(errors),
        "flown_by": flown_by,
        "flights": len(ends),
        "rms_m": spread.value,
        "rms_m_low": spread.low,
        "rms_m_high": spread.high,
        "mean_off_plan_m": float(np.linalg.norm((ends.mean(axis=0) - planned)[:3])),
        "attitude_error_deg": "",
    }
    for axis, sample in zip("xyz", off.T, strict=True):
        p_value, correlation = normality(sample) if tested else ("", "")
        found |= {f"p_value_{axis}": p_value, f"correlation_{axis}": correlation}
    return found


def claims(rows: Sequence[Record]) -> list[Record]:
    """Whether the attitude may be left out, and how normal the ends are."""
    by_name, found = {one["source"]: one for one in rows}, list[Record]()
    if "attitude" in by_name:
        own, path, low = by_name["attitude"], by_name[BOTH]["rms_m"], by_name[BOTH]["rms_m_low"]
        share, most = (
            a**2 / (a**2 + p**2) for a, p in ((own["rms_m"], path), (own["rms_m_high"], low))
        )
        words = (
            "the path may be planned without the attitude, whose four sources add little variance"
        )
        measured = f"{_shown(own)} m: {100 * share:.2g} %, at most {100 * most:.2g} %"
        threshold = f"less than {100 * NEGLIGIBLE:g} % of the total"
        found.append(claim(words, threshold, measured, bool(most < NEGLIGIBLE)))
    for own in (by_name[INITIAL], by_name[CHEMICAL]):
        if own["p_value_x"] == "":  # of flights that all end alike, nothing can be said
            continue
        rejected = [axis for axis in "xyz" if own[f"p_value_{axis}"] < SIGNIFICANCE]
        straight = min(own[f"correlation_{axis}"] for axis in "xyz")
        axes = ", ".join(rejected) or "none"
        measured = f"rejected for {axes}; quantiles correlate by {straight:.4f}"
        words = f"{own['label']}: final positions are normal on every axis"
        found.append(claim(words, f"p-value of at least {SIGNIFICANCE:g}", measured, not rejected))
    return found


def _shown(one: Record) -> str:
    return f"{one['rms_m']:.3g} ({one['rms_m_low']:.3g} to {one['rms_m_high']:.3g})"


def run(session: Session) -> Findings:
    """Fly every set of sources."""
    vehicle, solution = load_vehicle(), default_plan()
    # Seed by seed, so that an interrupted study has as many flights of every set.
    cases = [
        (name, seed)
        for seed in range(FLIGHTS)
        for name in SPACECRAFT_SETS
        if name != NO_ERRORS or not seed
    ]
    store = session.store("uncertainty_flights.jsonl", inputs=inputs_digest(solution, vehicle))
    if len(store) < len(cases):
        simulator()  # if it is not there, that is said once, and here
    flown = session.rows("flights", partial(fly_spacecraft, solution, vehicle), cases, store)
    rows = measure_paths(solution, vehicle) + measure_flights(flown, solution, vehicle)
    rows.sort(key=lambda one: [*SOURCES].index(one["source"]))
    tables = {"uncertainty_sources": rows, "uncertainty_flights": flown}
    return Findings(tables | {"claims": claims(rows)})


STUDY = Study(__doc__, run)
