"""Rows of the paper's table of observation times: how each one's burns are found, and its figures.

The real flight's states come from the user's SPK; impulses fitted to them make a row, and a start.
Variants change one reading or choice of the default plan, and stand beside the table.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.optimize import brentq, least_squares

from experiments.harness import Record, default_mission
from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.bodies.catalogue import J2000_TDB
from scp_recon.bodies.kernels import read_states
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import Estimate
from scp_recon.monte_carlo.flights import FlightConfig, fly_many
from scp_recon.monte_carlo.observation_time import ALL, SCIENCE, measured, time_held
from scp_recon.monte_carlo.summarise import summarise
from scp_recon.monte_carlo.summary import ONE_SIGMA, Summary
from scp_recon.physics import geometry
from scp_recon.planning import initial_guess
from scp_recon.results.solution import (
    NOT_OPTIMISED,
    Solution,
    ballistic_arc,
    evaluated,
    make_solution,
)
from scp_recon.scenario.schema import Scenario
from scp_recon.verification.reintegration import verify

OSIRIS_REX_ID, BENNU_ID = -64, 2101955
"""NAIF codes in the kernels of the mission."""
PRINTED = {"OSIRIS-REx": (2930.0, 2785.0), "warm": (3043.0, 3017.0), "cold": (3271.0, 3397.0)}
"""Rows of the paper's table (Echigo et al., arXiv 2412.06816): mean and worst 1 sigma, s."""
SOON_S = 300.0
"""By which a still Sun moves neither edge of the window."""
LITTLE_S = 1000.0
"""What the paper says a flight seldom loses more of, where emission is beyond its limits."""

Design = Callable[[Mission], Solution]


class Row(NamedTuple):
    """A row of the table.

    Attributes:
        key: name of its folder.
        label: its name in the table.
        role: "reference" for the practice with which the planner is compared; a "variant" is no row
            of the paper's table.
        printed: the paper's row, a key of `PRINTED`.
        design: function that finds the burns.
        changes: entries of the default scenario that are others here.
    """

    key: str
    label: str
    role: str
    printed: str
    design: Design
    changes: Mapping[str, Any] = {}


def rows(as_flown: Path | None = None) -> list[Row]:
    """The table's rows in its order.

    With the flight's kernel the warm rows start from the flight, as the paper's do; without it from
    the ballistic arc.
    """
    warm: Callable[[Mission], Iterate] = initial_guess.ballistic
    label, reference = "warm start", "reference"
    if as_flown:
        warm, label = partial(flown_guess, as_flown), "warm start from the flight"
    surrogate, flight = "OSIRIS-REx surrogate: ", "OSIRIS-REx"
    p3 = planned(PlanOptions(problem="P3"))
    found = [
        Row("ballistic", f"{surrogate}ballistic two-impulse arc", reference, flight, ballistic_arc),
        Row("p3", f"{surrogate}P3 design, no uncertainty", reference, flight, p3),
    ]
    names: tuple[Literal["scp", "ipopt"], ...] = ("scp", "ipopt")
    for name in names:
        options = PlanOptions(method=name, facet_rounds=0)
        by_warm, by_cold = planned(options, warm), planned(options)
        found += [
            Row(f"{name}_warm", f"{name.upper()}, {label}", "planned", "warm", by_warm),
            Row(f"{name}_cold", f"{name.upper()}, cold start", "planned", "cold", by_cold),
        ]
    settled = planned(PlanOptions())
    found.append(Row("settled", "SCP, facets settled", "planned", "cold", settled))
    if as_flown:
        fitted = partial(as_flown_solution, as_flown)
        found.append(Row("as_flown", f"{flight} as flown (SPK)", reference, flight, fitted))
    return found


def variants(scenario: Scenario) -> list[Row]:
    """The default plan from the cold start with another reading of the paper, or another choice."""
    at, errors = scenario.boundary, scenario.uncertainty
    printed = np.array([*at.initial_position_m, *at.initial_velocity_m_s])
    sigma = (np.abs(printed) * errors.initial_sigma_fraction).tolist()
    spread = {
        "uncertainty.initial_sigma_position_m": sigma[:3],
        "uncertainty.initial_sigma_velocity_m_s": sigma[3:],
        "uncertainty.initial_frame": "sun_north",
    }
    table_1 = {"uncertainty.initial_sigma_fraction": 0.03, "uncertainty.execution_error": 0.1}
    tangent = {"polytopes.ball": "tangent", "polytopes.cone": 12}
    literal = {"boundary.frame": "j2000"}
    plain, again = (PlanOptions(facet_rounds=rounds) for rounds in (0, 1))
    p3 = PlanOptions(problem="P3")
    made: tuple[tuple[str, str, PlanOptions, Mapping[str, Any]], ...] = (
        ("facets_again", "facets chosen again at the solution", again, {}),
        ("cones_24", "cones of 24 facets", plain, {"polytopes.cone": 24}),
        ("tangent", "tangent spheres, cones of 12 facets", plain, tangent),
        ("tangent_again", "the same, facets chosen again", again, tangent),
        ("spread_printed", "initial covariance diagonal in the printed frame", plain, spread),
        ("errors_table_1", "the errors of the paper's table 1, 3 % and 10 %", plain, table_1),
        ("p3_j2000", "P3, boundary states read as J2000", p3, literal),
        ("p2_j2000", "P2, boundary states read as J2000", plain, literal),
    )
    return [
        Row(key, label, "variant", "cold", planned(options), changes)
        for key, label, options, changes in made
    ]


def planned(
    options: PlanOptions, guess: Callable[[Mission], Iterate] = initial_guess.cold
) -> Design:
    """A design by the planner."""
    return lambda mission: make_solution(plan_mission(mission, guess(mission), options))


# --- the flight's kernel --------------------------------------------------------------------------


def flown_guess(kernel: Path, mission: Mission) -> Iterate:
    """The flight as an initial guess: the paper's warm start.

    Raises:
        InputError: if spiceypy is missing, or the kernel does not cover the flight.
    """
    states = flown_states(kernel, mission)
    return initial_guess.from_states(mission, np.column_stack([mission.times_s, states]))


def flown_states(kernel: Path, mission: Mission) -> Array:
    """States of OSIRIS-REx about Bennu at the mission's nodes, J2000, m and m/s, shape (n, 6)."""
    epoch = (mission.scenario.epoch.tdb - J2000_TDB).total_seconds()
    return read_states([kernel], OSIRIS_REX_ID, BENNU_ID, epoch + mission.times_s, "--as-flown")


def as_flown_solution(kernel: Path, mission: Mission) -> Solution:
    """The impulses that follow the flight's kernel best, as a solution that is no plan."""
    burns, distance_m = as_flown_burns(kernel, mission)
    message = (
        f"Not a plan: impulses fitted to {kernel.name}, "
        f"which they follow within {distance_m:.1f} m in the observation window."
    )
    return evaluated(mission, burns, "as_flown", message)


def as_flown_burns(kernel: Path, mission: Mission) -> tuple[Array, float]:
    """Fit impulses at the firing times to the kernel.

    The flight also fired at other times, and its forces are not quite the planner's; so all burns but
    the last are fitted to the positions by least squares. The last one meets the final velocity.

    Returns:
        Burns in m/s, shape (m, 3), and the largest distance from the kernel in the window, m.

    Raises:
        InputError: if spiceypy is missing, or the kernel does not cover the flight.
    """
    start, scale = flown_guess(kernel, mission), mission.units.length_m
    target = flown_states(kernel, mission)[:-1, :3] / scale

    def flight(free: Array) -> Array:
        """Node states with the free burns and no last one."""
        burns = np.vstack([free.reshape(-1, 3), np.zeros(3)])
        return mission.dynamics.rollout(mission.problem.initial_state, burns)

    def miss(free: Array) -> Array:
        return (flight(free)[:-1, :3] - target).ravel()

    free = least_squares(miss, start.burns[:-1].ravel(), x_scale="jac", method="lm").x
    flown = flight(free)
    last = mission.problem.final_state[3:] - flown[-1, 3:]
    window = mission.window_nodes
    off = np.linalg.norm(flown[window, :3] - target[window], axis=1) * scale
    return np.vstack([free.reshape(-1, 3), last]) * mission.units.speed_m_s, float(off.max())


# --- a row's figures ------------------------------------------------------------------------------


def run_row(row: Row, folder: Path, samples: int) -> Record:
    """Design a row's burns, verify and fly them, and write solution.json and montecarlo.json.

    Returns a row of the CSV, SI.
    """
    mission = default_mission()
    if row.changes:
        mission = Mission.from_scenario(mission.scenario.replace(row.changes))
    folder.mkdir(parents=True, exist_ok=True)
    solution = row.design(mission)
    if solution.algorithm != NOT_OPTIMISED:
        solution = solution.with_verification(verify(mission, solution))
    solution.write(folder)
    flown = fly_many(FlightConfig(mission, solution.burns_m_s), samples=samples)
    summary = summarise(flown, solution)
    summary.write(folder)
    held, (first, last) = summary.held_s[ALL], mission.schedule.window_s
    joint = {k: p.estimate for k, p in summary.probability.items() if k != ALL}
    lowest = min(joint, key=lambda name: joint[name].value)
    throughout = held.throughout.estimate
    words = status(solution)
    return {
        **about(row, words),
        "ended": words.split(",")[0],
        "converged": " converged" in words,
        "samples": summary.samples,
        "window_s": last - first,
        "without_uncertainty_s": nominal_time_s(mission, solution),
        **ends("mean_s", held.mean.estimate),
        **ends("worst_1_sigma_s", held.worst_1_sigma.estimate),
        # Surely no more than 15.9 % of flights lose any of the window.
        "full_window_at_worst_1_sigma": throughout.low >= 1.0 - ONE_SIGMA,
        **ends("closest_0_3_percent_m", summary.closest_m.worst.estimate),
        "total_dv_m_s": solution.total_dv_m_s,
        **ends("lowest_joint_probability", joint[lowest]),
        "lowest_joint_constraint": lowest.replace("_", " "),
        "throughout": throughout.value,
        "remark": solution.message if row.key == "as_flown" else "",
        "burns_m_s": " ".join(f"{x:.9g}" for x in solution.burns_m_s.ravel()),
        **losses(summary, last - first),
        **{k: v for name in SCIENCE for k, v in ends(f"{name}_lowest", joint[name]).items()},
        **without_errors(mission, solution),
        "violation_m": solution.violation.max,
        "facet_missed_m": middle_beyond_facet_m(solution),
        "still_sun_window_s": still_sun_window_s(mission),
        **{f"spread_{name}": r.value for name, r in summary.terminal.sigma_ratio.items()},
    }


def about(row: Row, words: str) -> Record:
    """Columns that every row has, a failed one too."""
    mean, worst = PRINTED[row.printed]
    return {
        "row": row.key,
        "label": row.label,
        "role": row.role,
        "status": words,
        "paper_mean_s": mean,
        "paper_worst_1_sigma_s": worst,
    }


def status(solution: Solution) -> str:
    """Status of the design, and whether it was verified."""
    if solution.algorithm == NOT_OPTIMISED:
        return "given, not optimised"
    v = solution.verification
    words = "" if v is None else ", verified" if v.ok else f", not verified: {', '.join(v.failed)}"
    return f"{solution.problem} {solution.status}{words}"


def ends(name: str, e: Estimate) -> Record:
    """Columns of a value and its interval, whose ends may be missing."""
    low, high = (end if np.isfinite(end) else "" for end in (e.low, e.high))
    return {name: e.value, f"{name}_low": low, f"{name}_high": high}


def losses(summary: Summary, window_s: float) -> Record:
    """How often each constraint breaks, and what that costs: shares of flights, and of those broken."""
    found: Record = {}
    for name in SCIENCE:
        held = summary.held_s[name]
        kept, bins = held.throughout.estimate, held.histogram
        found |= ends(f"{name}_broken", Estimate(1.0 - kept.value, 1.0 - kept.high, 1.0 - kept.low))
        start, count = np.array(bins.start), np.array(bins.count)
        lost, broken = window_s - start - 0.5 * bins.bin, start + bins.bin < window_s
        flights = max(int(count[broken].sum()), 1)
        found |= {
            f"{name}_lost_s": float(lost[broken] @ count[broken]) / flights,
            f"{name}_lost_little": float(count[broken & (lost <= LITTLE_S)].sum()) / flights,
            f"{name}_lost_all": float(count[broken & (start < bins.bin)].sum()) / flights,
        }
    return found


def without_errors(mission: Mission, solution: Solution) -> Record:
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
    return float(quantile[tight] * np.sqrt(0.5 * variance[tight]) - 0.5 * room[tight])


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
    opens, closes = (brentq(beyond, *edges) for edges in near)
    return float(closes - opens)


def nominal_time_s(mission: Mission, solution: Solution) -> float:
    """Time for which the mean itself keeps all observation constraints, s."""
    window = mission.window_nodes
    states = np.array(solution.nodes.state)[window, None]
    return float(time_held(mission, mission.times_s[window], states)[ALL].duration[0])
