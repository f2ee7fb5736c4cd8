"""What the uncertainty study measured, as CSV and as Markdown, and what follows from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from experiments.studies import Cell, markdown
from experiments.uncertainty_sources.flights import (
    ATTITUDE,
    CHEMICAL,
    INITIAL,
    NO_ERRORS,
    TRANSLATION,
    Flown,
    fly_paths,
)
from experiments.uncertainty_sources.statistics import Normality, dispersion, normality
from scp_recon.monte_carlo.estimates import Estimate
from scp_recon.solution.file import Solution
from scp_recon.spacecraft.vehicle import Errors, Vehicle

Array = npt.NDArray[np.float64]

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
    """What a set of sources does.

    Attributes:
        error_sources: its key.
        flown_by: in what.
        deviation: of the flights' ends from that of the one without errors, J2000, m and m/s, (n, 6).
        offset_m: distance of their mean from the planned end.
        attitude_error_rad: largest before the last burn, NaN where no attitude is flown.
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
        """Of the final position by axis, if there are enough flights that differ."""
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
    for number, (error_sources, sources) in enumerate(sets.items()):
        states = fly_paths(solution, vehicle, sources, samples, seed + number)
        found[error_sources] = Measured(
            error_sources, PATH, states - planned, _offset(states, planned)
        )
    return found


def measure_flights(flown: Sequence[Flown], solution: Solution) -> dict[str, Measured]:
    """The sets that the whole spacecraft was flown with, among them the one without errors."""
    planned = np.array(solution.nodes.state[-1])
    found = {}
    for error_sources in dict.fromkeys(one.error_sources for one in flown):
        chosen = [one for one in flown if one.error_sources == error_sources]
        states = np.array([one.state for one in chosen])
        perfect = next(np.array(one.state) for one in flown if one.error_sources == NO_ERRORS)
        worst = max(one.attitude_error_rad for one in chosen)
        offset = _offset(states, planned)
        found[error_sources] = Measured(error_sources, SPACECRAFT, states - perfect, offset, worst)
    return found


def _offset(states: Array, planned: Array) -> float:
    return float(np.linalg.norm(states[:, :3].mean(axis=0) - planned[:3]))


def sigmas(errors: Errors) -> dict[str, str]:
    """The sources' 1-sigma in words."""
    return {
        NO_ERRORS: "",
        "sun_sensor": f"{errors.sun_sensor_rad:g} rad",
        "star_tracker": f"{errors.star_tracker_arcsec:g} arcsec",
        "imu": f"{errors.imu_rad_s:g} rad/s",
        "micro_thruster": f"{errors.micro_thruster_n:g} N",
        CHEMICAL: f"{100 * errors.chemical_thruster:g} % of the thrust",
        INITIAL: f"{100 * errors.initial_state:g} % of each component",
        "attitude": "the four above",
        BOTH: "the two above",
        "all": "all six",
    }


SIGNIFICANCE = 0.05

NAMES = {
    NO_ERRORS: "no errors",
    "sun_sensor": "sun sensor",
    "star_tracker": "star tracker",
    "imu": "IMU",
    "micro_thruster": "micro-thrusters",
    "attitude": "attitude sources together",
    INITIAL: "initial state",
    CHEMICAL: "chemical thruster",
    BOTH: "path sources together",
    "all": "all together",
}

ORDER = (NO_ERRORS, *ATTITUDE, "attitude", *TRANSLATION, BOTH, "all")


def record(entry: Measured, sigma: str) -> dict[str, Cell]:
    """A row of the CSV."""
    normal = entry.normality
    figures: dict[str, Cell] = {
        "source": entry.error_sources,
        "label": NAMES[entry.error_sources],
        "sigma": sigma,
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


def quantiles(entries: Sequence[Measured]) -> list[dict[str, Cell]]:
    """Points of the quantile-quantile plots in long form."""
    return [
        {"source": entry.error_sources, "axis": axis, "expected": e, "observed": o}
        for entry in entries
        if entry.flown_by == PATH
        for axis, n in entry.normality.items()
        for e, o in zip(n.expected.tolist(), n.observed.tolist(), strict=True)
    ]


def planned_rms_m(solution: Solution) -> float:
    """What the plan's covariance says of the final position, m."""
    return float(np.sqrt(np.trace(np.array(solution.nodes.covariance[-1])[:3, :3])))


def to_markdown(entries: Sequence[Measured], words: Mapping[str, str], solution: Solution) -> str:
    """The table, normality by axis, and the verdicts."""
    header = (
        "source",
        "1 sigma",
        "flown by",
        "flights",
        "rms distance at the end (m)",
        "mean off the plan (m)",
        "attitude error at the end (deg)",
    )
    lines = [
        (
            NAMES[entry.error_sources],
            words[entry.error_sources],
            entry.flown_by,
            str(len(entry.deviation)),
            _shown(entry.rms),
            f"{entry.offset_m:.2f}",
            f"{np.rad2deg(entry.attitude_error_rad):.4f}" if entry.flown_by == SPACECRAFT else "",
        )
        for entry in entries
    ]
    normal_header = ("source", *(f"{axis}: p-value, correlation" for axis in AXES))
    normal_lines = [
        (
            NAMES[e.error_sources],
            *(f"{n.p_value:.2g}, {n.correlation:.4f}" for n in e.normality.values()),
        )
        for e in entries
        if e.normality
    ]
    parts = [
        "# Sources of uncertainty",
        markdown(header, lines),
        "Root mean square distance of the final positions from that of the flight without errors, "
        "with 95 % intervals. Errors of the path are flown in the planner's dynamics; what acts by "
        "way of the attitude needs the whole spacecraft, of which there are few flights, hence the "
        "wide intervals. The attitude error is the largest when the last burn begins.",
        "## Normality of the final position",
        markdown(normal_header, normal_lines),
        "Shapiro and Wilk's test (of at most 5000 flights; so many reject small departures too) and "
        "the correlation of the quantiles with a normal variable's, 1 on a straight line; J2000.",
        "## What follows",
        "\n".join(f"- {verdict}" for verdict in verdicts(entries, solution)),
    ]
    return "\n\n".join(parts) + "\n"


def _shown(e: Estimate) -> str:
    return f"{e.value:.3g} ({e.low:.3g} to {e.high:.3g})"


def verdicts(entries: Sequence[Measured], solution: Solution) -> list[str]:
    """Which sources dominate, whether the attitude may be left out, and how normal the ends are."""
    found = {entry.error_sources: entry for entry in entries}
    words = [_dominance(found)]
    if "attitude" in found:
        words.append(_decoupling(found["attitude"].rms, found[BOTH].rms))
    if "all" in found:
        total, path = found["all"].rms, found[BOTH].rms
        agree = total.low <= path.high and path.low <= total.high
        words.append(
            f"All sources in the whole spacecraft give {_shown(total)} m, the path's two in the "
            f"planner's dynamics {_shown(path)} m: the intervals {'' if agree else 'do not '}overlap."
        )
    u, said = solution.scenario.uncertainty, "its scenario's uncertainty"
    if u.initial_sigma_fraction is not None and u.execution_error is not None:
        initial, burns = 100 * u.initial_sigma_fraction, 100 * u.execution_error
        said = f"{initial:g} % and {burns:g} % of each component"
    words.append(
        f"The plan's covariance, with {said}, says "
        f"{planned_rms_m(solution):.0f} m; the vehicle's errors give {found[BOTH].rms.value:.0f} m."
    )
    for error_sources in (INITIAL, CHEMICAL):
        normal = found[error_sources].normality
        if not normal:  # of flights that all end alike, nothing can be said
            continue
        straight = min(n.correlation for n in normal.values())
        rejected = [axis for axis, n in normal.items() if n.p_value < SIGNIFICANCE]
        kept = f"rejected for {', '.join(rejected)}" if rejected else "not rejected for any axis"
        words.append(
            f"{NAMES[error_sources]}: quantiles lie on a straight line with a correlation of "
            f"{straight:.4f} or more; normality is {kept} at the {100 * SIGNIFICANCE:g} % level."
        )
    return words


def _dominance(found: Mapping[str, Measured]) -> str:
    alone = {e: found[e].rms for e in (*ATTITUDE, *TRANSLATION) if e in found}
    ranked = sorted(alone, key=lambda name: -alone[name].value)
    listed = ", ".join(
        f"{NAMES[error_sources]} {alone[error_sources].value:.3g} m" for error_sources in ranked
    )
    return f"Alone, from the largest: {listed}."


def _decoupling(attitude: Estimate, path: Estimate) -> str:
    """Whether the sources that act by way of the attitude may be left out of the plan."""
    share, most = (
        r**2 / (r**2 + p**2) for r, p in ((attitude.value, path.value), (attitude.high, path.low))
    )
    holds = "may" if most < NEGLIGIBLE else "may NOT"
    return (
        f"The four sources of the attitude together move the end by {_shown(attitude)} m, "
        f"{100 * share:.2g} % of the total variance and at most {100 * most:.2g} %: the path {holds} "
        f"be planned without the attitude (limit {100 * NEGLIGIBLE:g} %)."
    )
