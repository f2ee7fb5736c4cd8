"""Compute the paper's table of observation times.

Every row's burns are designed and flown many times; solution.json and montecarlo.json are written to
OUT/<row>/, the table to OUT/observation_table.csv. Variants change one reading or choice of the default
plan, and stand beside the table. The page compares the paper's statements and numbers with the rows.
After a stop the study continues with the missing rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.harness import Record, Session, Study, Tables, default_mission
from experiments.plans import TANGENT
from formulations.problem.flyby import Iterate
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.mission.mission import Mission
from scp_recon.mission.windows import SCAN_STEP_S, each_window, whole_windows
from scp_recon.monte_carlo.estimates import Estimate
from scp_recon.monte_carlo.flights import fly_many
from scp_recon.monte_carlo.limits import ALL, SCIENCE, measured, time_held
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.monte_carlo.summarise import summarise
from scp_recon.monte_carlo.summary import Summary
from scp_recon.physics import geometry
from scp_recon.planning import initial_guess
from scp_recon.results.solution import NOT_OPTIMISED, Solution, ballistic_arc, make_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.verification.reintegration import verify

SAMPLES = 10_000
PRINTED = {"OSIRIS-REx": (2930.0, 2785.0), "warm": (3043.0, 3017.0), "cold": (3271.0, 3397.0)}
"""Rows of the paper's table (Echigo et al., arXiv 2412.06816): mean and worst 1 sigma, s."""
SOON_S = 300.0
"""By which a still Sun moves neither edge of the window."""
LITTLE_S = 1000.0
"""What the paper says a flight seldom loses more of, where emission is beyond its limits."""

ONCE, AGAIN, P3 = (
    PlanOptions(facet_rounds=0),
    PlanOptions(facet_rounds=1),
    PlanOptions(problem="P3"),
)
IPOPT = PlanOptions(method="ipopt", facet_rounds=0)
SURROGATE, FLOWN = "OSIRIS-REx surrogate: ", "OSIRIS-REx"


class Row(NamedTuple):
    """A row of the table.

    Attributes:
        label: its name in the table.
        printed: the paper's row, a key of `PRINTED`.
        options: of planning; without them the ballistic arc is flown.
        guess: the start.
        changes: entries of the default scenario that are others here.
    """

    label: str
    printed: str = "cold"
    options: PlanOptions | None = ONCE
    guess: Callable[[Mission], Iterate] = initial_guess.cold
    changes: Mapping[str, Any] = {}


def in_the_printed_frame() -> dict[str, Any]:
    """The initial covariance diagonal in the axes of the printed boundary states."""
    scenario = load_scenario()
    at, fraction = scenario.boundary, scenario.uncertainty.initial_sigma_fraction
    sigma = np.abs([at.initial_position_m, at.initial_velocity_m_s]) * fraction
    return {
        "uncertainty.initial_sigma_position_m": sigma[0].tolist(),
        "uncertainty.initial_sigma_velocity_m_s": sigma[1].tolist(),
        "uncertainty.initial_frame": "sun_north",
    }


TABLE_1 = {"uncertainty.initial_sigma_fraction": 0.03, "uncertainty.execution_error": 0.1}
LITERAL = {"boundary.frame": "j2000"}
ROWS: Mapping[str, Row] = {
    "ballistic": Row(f"{SURROGATE}ballistic two-impulse arc", FLOWN, None),
    "p3": Row(f"{SURROGATE}P3 design, no uncertainty", FLOWN, P3),
    "scp_warm": Row("SCP, warm start", "warm", guess=initial_guess.ballistic),
    "scp_cold": Row("SCP, cold start"),
    "ipopt_warm": Row("IPOPT, warm start", "warm", IPOPT, initial_guess.ballistic),
    "ipopt_cold": Row("IPOPT, cold start", "cold", IPOPT),
    "settled": Row("SCP, facets settled", "cold", PlanOptions()),
    "facets_again": Row("facets chosen again at the solution", "cold", AGAIN),
    "cones_24": Row("cones of 24 facets", changes={"polytopes.cone": 24}),
    "tangent": Row("tangent spheres, cones of 12 facets", changes=TANGENT),
    "tangent_again": Row("the same, facets chosen again", "cold", AGAIN, changes=TANGENT),
    "spread_printed": Row(
        "initial covariance diagonal in the printed frame", changes=in_the_printed_frame()
    ),
    "errors_table_1": Row("the errors of the paper's table 1, 3 % and 10 %", changes=TABLE_1),
    "p3_j2000": Row("P3, boundary states read as J2000", "cold", P3, changes=LITERAL),
    "p2_j2000": Row("P2, boundary states read as J2000", changes=LITERAL),
}
"""The table's rows, two surrogates for the flight of OSIRIS-REx first, then variants by name."""


# --- a row's figures ------------------------------------------------------------------------------


def run_row(out: Path, key: str) -> Record:
    """Design a row's burns, verify and fly them: a row of the CSV, SI, its files in OUT/key."""
    row, mission, folder = ROWS[key], default_mission(), out / key
    if row.changes:
        mission = Mission.from_scenario(mission.scenario.replace(row.changes))
    folder.mkdir(parents=True, exist_ok=True)
    if row.options is None:
        solution = ballistic_arc(mission)
    else:
        solution = make_solution(plan_mission(mission, row.guess(mission), row.options))
        solution = solution.with_verification(verify(mission, solution))
    solution.write(folder)
    flown = fly_many(Flyer(mission, solution.burns_m_s), samples=SAMPLES)
    summary = summarise(flown, solution)
    summary.write(folder)
    held, (first, last) = summary.held_s[ALL], mission.schedule.window_s
    joint = {k: p.estimate for k, p in summary.probability.items() if k != ALL}
    lowest = min(joint, key=lambda name: joint[name].value)
    mean, worst = PRINTED[row.printed]
    return {
        "row": key,
        "label": row.label,
        **status(solution),
        "paper_mean_s": mean,
        "paper_worst_1_sigma_s": worst,
        "window_s": last - first,
        "without_uncertainty_s": nominal_time_s(mission, solution),
        **ends("mean_s", held.mean.estimate),
        **ends("worst_1_sigma_s", held.worst_1_sigma.estimate),
        **ends("closest_0_3_percent_m", summary.closest_m.worst.estimate),
        "total_dv_m_s": solution.total_dv_m_s,
        **ends("lowest_joint_probability", joint[lowest]),
        "lowest_joint_constraint": lowest.replace("_", " "),
        "throughout": held.throughout.estimate.value,
        **losses(summary, last - first),
        **{k: v for name in SCIENCE for k, v in ends(f"{name}_lowest", joint[name]).items()},
        **without_errors(mission, solution),
        "violation_m": solution.violation.max,
        "facet_missed_m": middle_beyond_facet_m(solution),
        "still_sun_window_s": still_sun_window_s(mission),
        **{f"spread_{name}": r.value for name, r in summary.terminal.sigma_ratio.items()},
    }


def status(solution: Solution) -> Record:
    """Columns on how the design ended, and whether it was verified."""
    if solution.algorithm == NOT_OPTIMISED:
        return {"status": "given, not optimised", "ended": "given"}
    ended = f"{solution.problem} {solution.status}".replace("_", " ")
    checked = solution.verification
    verified = "" if checked is None else ", verified" if checked.ok else ", not verified"
    return {"status": ended + verified, "ended": ended}


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
        start, count = np.array(bins.start), np.array(bins.count)
        lost, broken = window_s - start - 0.5 * bins.bin, start + bins.bin < window_s
        flights = max(int(count[broken].sum()), 1)
        found |= {
            f"{name}_broken": 1.0 - kept.value,
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


def still_sun_window_s(mission: Mission) -> float:
    """Length of the window were the Sun's direction that of the epoch, s."""
    sun, (first, last) = mission.sun_direction(0.0), mission.schedule.window_s
    lighting = replace(mission.scene.lighting, to_sun=lambda t: np.broadcast_to(sun, (*t.shape, 3)))
    slack, span_s = lighting.slack(mission.scenario.observation), (first - SOON_S, last + SOON_S)
    ((opens, closes),) = whole_windows(each_window(slack, span_s, SCAN_STEP_S), span_s)
    return closes - opens


def nominal_time_s(mission: Mission, solution: Solution) -> float:
    """Time for which the mean itself keeps all observation constraints, s."""
    window = mission.window_nodes
    states = np.array(solution.nodes.state)[window, None]
    return float(time_held(mission, mission.times_s[window], states)[ALL].duration[0])


def run(session: Session) -> Tables:
    """Design and fly every row."""
    return {"observation_table": session.rows("rows", partial(run_row, session.out), ROWS)}


STUDIES = {"observation_table": Study(__doc__, run, folder="paper")}
