"""Fly the path or the whole spacecraft with chosen sources of uncertainty, and measure spread."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from scipy.stats import chi2, probplot, shapiro

from experiments.harness import Record
from formulations.arrays import Array
from scp_recon.errors import needing
from scp_recon.monte_carlo.estimates import CONFIDENCE, Estimate
from scp_recon.results.solution import Solution
from scp_recon.simulation.vehicle import Vehicle

INITIAL, CHEMICAL = "initial_state", "chemical_thruster"
TRANSLATION = (INITIAL, CHEMICAL)
"""Sources that act on the path directly."""

ATTITUDE = ("sun_sensor", "star_tracker", "imu", "micro_thruster")
"""Sources that act on the path by way of the attitude; names are those of the vehicle's errors."""

NO_ERRORS = "none"

SETS: dict[str, tuple[str, ...]] = {
    NO_ERRORS: (),
    **{source: (source,) for source in (*ATTITUDE, *TRANSLATION)},
    "attitude": ATTITUDE,
    "all": (*ATTITUDE, *TRANSLATION),
}
"""Sources that err together."""

BLOCK = 1000
STATE = ("x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s")


def fly_paths(
    solution: Solution, vehicle: Vehicle, sources: Iterable[str], samples: int, seed: int
) -> Array:
    """Final states of flights in the planner's dynamics, J2000, m and m/s, shape (samples, 6).

    The initial state errs by component and each burn in size: a thrust error does not turn a burn.
    """
    mission = solution.mission
    errors, units, chosen = vehicle.errors, mission.units, set(sources)
    sigma = errors.initial_state * np.abs(mission.initial_state) * (INITIAL in chosen)
    beta = errors.chemical_thruster * (CHEMICAL in chosen)
    ends = []
    for block, first in enumerate(range(0, samples, BLOCK)):
        draws = np.random.default_rng([seed, block]).standard_normal(
            (BLOCK, 6 + len(solution.burns))
        )[: samples - first]
        initial = (mission.initial_state + draws[:, :6] * sigma) / units.state
        executed = solution.burns_m_s * (1.0 + beta * draws[:, 6:, None]) / units.speed_m_s
        ends.append(mission.dynamics.rollout(initial, executed)[-1] * units.state)
    return np.concatenate(ends)


def simulator() -> ModuleType:
    """The simulation of the whole spacecraft, which takes seconds to import.

    Raises:
        InputError: if Basilisk is not there.
    """
    with needing("--flights", "sim", "Basilisk"):
        return importlib.import_module("scp_recon.simulation.basilisk.simulation")


def fly_spacecraft(solution: Solution, vehicle: Vehicle, job: tuple[str, int]) -> Record:
    """Simulate one flight, (key of `SETS`, seed): a row of the flights' CSV.

    It has the state at the planned end, the last burn done, J2000, and the angle between attitude and
    command when the last burn begins.

    Raises:
        InputError: if Basilisk is not there.
    """
    simulation = simulator()
    error_sources, seed = job
    flight = simulation.simulate(
        solution,
        vehicle,
        seed,
        sources=[simulation.Source(name) for name in SETS[error_sources]],
        initial_sigma_fraction=vehicle.errors.initial_state,
    )
    at = int(np.searchsorted(flight.times_s, flight.plan.firings[-1].start_s))
    off = (flight.commands[at].inv() * flight.attitudes[at]).magnitude()
    return {
        "error_sources": error_sources,
        "seed": seed,
        **dict(zip(STATE, flight.terminal_state.tolist(), strict=True)),
        "attitude_error_rad": float(off),
    }


TESTED_MAX = 5000
"""Samples up to which the p-values of Shapiro and Wilk's test are accurate."""

POINTS_MAX = 199
"""Of a quantile-quantile plot."""


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


@dataclass(frozen=True)
class Normality:
    """Tests of a sample's normality.

    Attributes:
        p_value: of Shapiro and Wilk's test, of the first 5000.
        correlation: of the sample's quantiles with a normal variable's; 1 on a straight line.
        expected, observed: quantiles of a standard normal and of the standardised sample.
    """

    p_value: float
    correlation: float
    expected: Array
    observed: Array


def normality(sample: Array) -> Normality:
    """Test a sample, shape (n,), n > 3, whose values are not all the same."""
    standard = (sample - sample.mean()) / sample.std(ddof=1)
    (expected, observed), (_, _, correlation) = probplot(standard)
    # Evenly spaced along the axis, so that the tails are seen.
    keep = np.unique(np.searchsorted(expected, np.linspace(expected[0], expected[-1], POINTS_MAX)))
    return Normality(
        float(shapiro(standard[:TESTED_MAX]).pvalue),
        float(correlation),
        expected[keep],
        observed[keep],
    )
