"""Compute a row of the observation-time table in its folder, or read it from there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.optimize import brentq

from experiments.harness import Record
from experiments.observation_table.rows import (
    AS_FLOWN,
    KERNEL,
    PRINTED_CLOSEST_M,
    PRINTED_WINDOW_S,
    Printed,
    Row,
)
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import Estimate
from scp_recon.monte_carlo.flights import FlightConfig, fly_many
from scp_recon.monte_carlo.observation_time import (
    ALL,
    SCIENCE,
    joint_margins,
    measured,
    time_held,
)
from scp_recon.monte_carlo.sampling import sample_positions
from scp_recon.monte_carlo.summary import FILE_NAME, ONE_SIGMA, Summary, read_summary_as, summarise
from scp_recon.physics import geometry
from scp_recon.results.read import read_solution
from scp_recon.results.solution import FILE_NAME as SOLUTION_FILE
from scp_recon.results.solution import NOT_OPTIMISED, Solution
from scp_recon.scenario.fields import Section
from scp_recon.verification.reintegration import verify

UNIFORM_STEP_S = 232.0
"""The paper's time step, on a grid that need not contain the window's edges."""

SOON_S = 300.0
"""By which a still Sun moves neither edge of the window."""

LITTLE_S = 1000.0
"""What the paper says a flight seldom loses more of, where emission is beyond its limits."""

COUNTED_MAX = 10_000
"""Flights counted there; more would not fit memory and the difference is clear from these."""


class Counted(Section):
    """Observation times of flights sampled only at the nodes of the paper's uniform grid, s."""

    nodes: int
    mean_s: float
    worst_1_sigma_s: float


class RowSummary(Summary):
    """A Monte Carlo summary with this study's additions."""

    counted_on_uniform_grid: Counted


def run_row(
    row: Row, mission: Mission, folder: Path, *, samples: int, check: bool, fresh: bool = False
) -> tuple[Record, bool]:
    """Design the row's burns and fly them, unless the folder already holds the results.

    Writes solution.json and montecarlo.json. With `check` a plan is verified independently of its
    solver; `fresh` ignores existing results.

    Returns:
        A row of the CSV, SI, and whether nothing had to be computed for it.
    """
    mission = row.mission(mission)
    folder.mkdir(parents=True, exist_ok=True)
    if fresh:  # a row that then fails leaves nothing that looks like its result
        for name in (SOLUTION_FILE, FILE_NAME):
            (folder / name).unlink(missing_ok=True)
    solution = None if row.anew else _stored_solution(folder, mission, check)
    designed = solution is None
    if solution is None:
        solution = row.design(mission)
        if check and solution.algorithm != NOT_OPTIMISED:
            solution = solution.with_verification(verify(mission, solution))
        solution.write(folder)
    summary = _stored_summary(folder, solution, samples)
    flown = summary is None
    if summary is None:
        summary = _fly(mission, solution, samples)
        summary.write(folder)
    return _record(row, mission, solution, summary), not (designed or flown)


def failed(row: Row, reason: str) -> Record:
    """A row of the CSV without figures, with the reason of the failure."""
    return _about(row.key, row.label, row.role, f"failed: {reason}") | _printed(row.printed)


def not_flown() -> Record:
    """The real flight's row without its kernel: which it is, in the place of figures."""
    key, label, role, printed = AS_FLOWN
    status = f"not computed: give --as-flown the file {KERNEL} of NAIF's archive"
    return _about(key, label, role, status) | _printed(printed)


def _record(row: Row, mission: Mission, solution: Solution, summary: RowSummary) -> Record:
    first, last = mission.schedule.window_s
    held, counted = summary.held_s[ALL], summary.counted_on_uniform_grid
    joint = {k: p.estimate for k, p in summary.probability.items() if k != ALL}
    lowest = min(joint, key=lambda name: joint[name].value)
    throughout = held.throughout.estimate
    return {
        **_about(row.key, row.label, row.role, _status(solution)),
        "samples": summary.samples,
        "window_s": last - first,
        "without_uncertainty_s": _nominal_time(mission, solution),
        **_ends("mean_s", held.mean.estimate),
        **_ends("worst_1_sigma_s", held.worst_1_sigma.estimate),
        # Surely no more than 15.9 % of flights lose any of the window.
        "full_window_at_worst_1_sigma": throughout.low >= 1.0 - ONE_SIGMA,
        **_ends("closest_0_3_percent_m", summary.closest_m.worst.estimate),
        "total_dv_m_s": solution.total_dv_m_s,
        **_ends("lowest_joint_probability", joint[lowest]),
        "lowest_joint_constraint": lowest,
        **_ends("lowest_probability_all_at_once", summary.probability[ALL].estimate),
        "mean_on_uniform_grid_s": counted.mean_s,
        "worst_1_sigma_on_uniform_grid_s": counted.worst_1_sigma_s,
        **_printed(row.printed),
        "paper_closest_m": PRINTED_CLOSEST_M if row.role == "planned" else "",
        "throughout": throughout.value,
        "remark": solution.message if row.anew else row.caveat,
        "burns_m_s": " ".join(f"{x:.9g}" for x in solution.burns_m_s.ravel()),
        **_losses(summary, last - first),
        **{k: v for name in SCIENCE for k, v in _ends(f"{name}_lowest", joint[name]).items()},
        **_without_errors(mission, solution),
        "violation_m": solution.violation.max,
        "facet_missed_m": middle_beyond_facet_m(solution),
        "still_sun_window_s": still_sun_window_s(mission),
        **{f"spread_{name}": r.value for name, r in summary.terminal.sigma_ratio.items()},
    }


def _about(key: str, label: str, role: str, status: str) -> Record:
    return {"row": key, "label": label, "role": role, "status": status}


def _printed(printed: Printed) -> Record:
    return {
        "paper_row": printed.name,
        "paper_without_uncertainty_s": PRINTED_WINDOW_S,
        "paper_mean_s": printed.mean_s,
        "paper_worst_1_sigma_s": printed.worst_1_sigma_s,
    }


def _losses(summary: RowSummary, window_s: float) -> Record:
    """How often each constraint breaks, and what that costs: shares of flights, and of those broken."""
    found: Record = {}
    for name in SCIENCE:
        held = summary.held_s[name]
        kept, bins = held.throughout.estimate, held.histogram
        ends = Estimate(1.0 - kept.value, 1.0 - kept.high, 1.0 - kept.low)
        found |= _ends(f"{name}_broken", ends)
        start, count = np.array(bins.start), np.array(bins.count)
        lost, broken = window_s - start - 0.5 * bins.bin, start + bins.bin < window_s
        flights = max(int(count[broken].sum()), 1)
        found |= {
            f"{name}_lost_s": float(lost[broken] @ count[broken]) / flights,
            f"{name}_lost_little": float(count[broken & (lost <= LITTLE_S)].sum()) / flights,
            f"{name}_lost_all": float(count[broken & (start < bins.bin)].sum()) / flights,
        }
    return found


def _without_errors(mission: Mission, solution: Solution) -> Record:
    """The planned flight: burns, and the mean against limits that the other columns do not have."""
    burns, state = solution.burns_m_s, np.array(solution.nodes.state)
    fired = burns.any(axis=1)
    sun = mission.sun_direction(mission.times_s[mission.burn_nodes])
    angle = np.rad2deg(geometry.angle(burns[fired], sun[fired]))
    sizes, window = np.linalg.norm(burns, axis=1), mission.window_nodes
    seen = measured(mission, mission.times_s[window], state[window, :3])
    return {
        "inner_burns": float(sizes[1:-1].sum() / sizes.sum()),
        "largest_inner_over_least_outer": float(sizes[1:-1].max() / min(sizes[0], sizes[-1])),
        "largest_burn_m_s": float(sizes.max()),
        "nearest_sun_line_deg": float(np.minimum(angle, 180.0 - angle).min()),
        "nominal_closest_m": float(np.linalg.norm(state[:, :3], axis=1).min()),
        "nominal_emission_at_close_deg": float(np.rad2deg(seen["emission"][-1])),
        "nominal_site_distance_least_m": float(seen["distance"].min()),
        "nominal_site_distance_most_m": float(seen["distance"].max()),
    }


def middle_beyond_facet_m(solution: Solution) -> float | str:
    """How far the middle of two points that keep P2's tightest facet lies beyond it, m; "" without P2.

    One point is the plan's mean and covariance; the other the mean on the facet without covariance.
    A constraint that were convex in both would be kept in the middle.
    """
    if solution.facets is None:
        return ""
    table, state = solution.facets, np.array(solution.nodes.state)[:, :3]
    node, normal = np.array(table.node, dtype=np.intp), np.array(table.normal)
    covariance = np.array(solution.nodes.covariance)[node, :3, :3]
    variance = np.einsum("mi,mij,mj->m", normal, covariance, normal)
    room = np.array(table.offset_m) - np.einsum("mi,mi->m", normal, state[node])
    quantile = np.array(table.quantile)
    tight = int(np.argmin(room - quantile * np.sqrt(variance)))
    beyond = quantile[tight] * np.sqrt(0.5 * variance[tight]) - 0.5 * room[tight]
    return float(beyond)


def _ends(name: str, e: Estimate) -> Record:
    """Columns of a value and its interval, whose ends may be missing."""
    low, high = (end if np.isfinite(end) else "" for end in (e.low, e.high))
    return {name: e.value, f"{name}_low": low, f"{name}_high": high}


def _status(solution: Solution) -> str:
    """Status of the design, and whether it was verified."""
    if solution.algorithm == NOT_OPTIMISED:
        return "given, not optimised"
    v = solution.verification
    words = "" if v is None else ", verified" if v.ok else f", not verified: {', '.join(v.failed)}"
    return f"{solution.problem} {solution.status}{words}"


def still_sun_window_s(mission: Mission) -> float | str:
    """Length of the window were the Sun's direction that of the epoch, s.

    "" where the limit of incidence is not what opens and closes the window.
    """
    sun, limit = mission.sun_direction(0.0), mission.scenario.observation.incidence_max_deg

    def beyond(time_s: float) -> float:
        track = geometry.track(mission.site, mission.rotation, np.array([time_s]))
        return float(np.rad2deg(geometry.incidence(track, sun[None])[0])) - limit

    first, last = mission.schedule.window_s
    near = ((first - SOON_S, first + SOON_S), (last - SOON_S, last + SOON_S))
    if any(beyond(a) * beyond(b) >= 0.0 for a, b in near):
        return ""
    opens, closes = (brentq(beyond, *ends) for ends in near)
    return float(closes - opens)


def _stored_solution(folder: Path, mission: Mission, check: bool) -> Solution | None:
    try:
        solution = read_solution(folder)
    except InputError:
        return None
    planned = solution.algorithm != NOT_OPTIMISED
    if solution.scenario != mission.scenario or (check and planned and not solution.verification):
        return None
    return solution


def _stored_summary(folder: Path, solution: Solution, samples: int) -> RowSummary | None:
    """The summary in the folder, if it is of this plan and of the required number of flights."""
    try:
        found = read_summary_as(RowSummary, folder / FILE_NAME)
    except InputError:
        return None
    setting = found.samples, found.seed, found.truth, found.errors
    as_asked = setting == (samples, 0, "planner", "componentwise")
    return found if as_asked and found.is_of(solution) else None


def _fly(mission: Mission, solution: Solution, samples: int) -> RowSummary:
    flown = fly_many(FlightConfig(mission, solution.burns_m_s), samples=samples)
    counted = _counted(mission, solution, min(samples, COUNTED_MAX))
    return RowSummary(**dict(summarise(flown, solution)), counted_on_uniform_grid=counted)


def _nominal_time(mission: Mission, solution: Solution) -> float:
    """Time for which the mean itself keeps all observation constraints, s."""
    window = mission.window_nodes
    states = np.array(solution.nodes.state)[window, None]
    return float(time_held(mission, mission.times_s[window], states)[ALL].duration[0])


def _counted(mission: Mission, solution: Solution, samples: int) -> Counted:
    """Observation time as the share of the paper's uniform nodes at which all constraints hold."""
    end, (first, last) = mission.times_s[-1], mission.schedule.window_s
    grid = np.linspace(0.0, end, int(end // UNIFORM_STEP_S) + 1)
    nodes = grid[(grid >= first) & (grid <= last)]
    positions = sample_positions(mission, solution.burns_m_s, nodes, samples)
    joint = joint_margins(mission, nodes, positions)
    holds = np.logical_and.reduce([joint[name] >= 0.0 for name in SCIENCE])
    seconds = holds.mean(axis=0) * (last - first)
    return Counted(
        nodes=len(nodes),
        mean_s=float(seconds.mean()),
        worst_1_sigma_s=float(np.quantile(seconds, ONE_SIGMA)),
    )
