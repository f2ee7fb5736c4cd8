"""Studies that fly a plan with the simulated spacecraft: as planned, and by three policies."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.interpolate import CubicHermiteSpline

from experiments.costs import LEAD_S
from experiments.harness import Record as Row
from experiments.harness import Session, Study, Tables, default_plan
from experiments.plans import measured
from formulations.arrays import Array, Indices
from scp_recon.api.options import PlanOptions
from scp_recon.api.plan_verbs import simulate
from scp_recon.api.planning import plan_mission
from scp_recon.api.verbs import design
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.monte_carlo.limits import ALL, joint_margins, time_held
from scp_recon.monte_carlo.sampling import Flyer, PolicyKind
from scp_recon.planning.initial_guess import from_burns
from scp_recon.results.read import read_solution
from scp_recon.results.solution import FILE_NAME, Solution, make_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.simulation.flight import Actuators, distance_in_sigmas
from scp_recon.simulation.record import (
    FlightSummary,
    Record,
    read_record,
    write_record,
)
from scp_recon.simulation.vehicle import load_vehicle
from scp_recon.verification.causes import shortfalls

# --- the default plan -----------------------------------------------------------------------------

SEEDS, SAMPLES = 20, 10_000
RADIUS_SIGMA = 3.0


def fly(solution: Solution, out: Path, seed: int) -> Row:
    """Simulate a flight, and write it to `seed_N` in a folder: a row of the table.

    Raises:
        InputError: if Basilisk is not installed.
        OSError: if the folder cannot be written.
    """
    record = simulate(solution, seed=seed)
    folder = out / f"seed_{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    write_record(record, folder)
    return row(record)


def row(record: Record) -> Row:
    """A flight as a row of the table."""
    summary = record.summary
    return {
        "seed": summary.seed,
        "least_charge": summary.least_charge,
        "modes_hold": all(leg.ok for leg in summary.legs),
        "settled_in_time": all(leg.settled_in_time for leg in summary.legs),
        "camera_max_deg": summary.window_pointing_deg.camera.q100,
        "dumps": summary.dumps,
        "terminal_miss_m": summary.terminal_miss.position_m,
        "largest_sigma": float(record.arrays["node_sigma_distance"].max()),
    }


def figures(rows: Sequence[Row], flights: Sequence[Record]) -> list[Row]:
    """Power, charge and misses of all flights together."""

    def joined(name: str) -> Array:
        return np.concatenate([one.arrays[name][1:] for one in flights])

    def column(name: str) -> Array:
        return np.array([one[name] for one in rows])

    generated, missed = joined("panel_w").sum(axis=1), column("terminal_miss_m")
    load, ratio = joined("consumed_w"), generated / joined("consumed_w")
    thrusting = [(one.arrays["actuators"] == Actuators.THRUSTERS).mean() for one in flights]
    found = {
        "flights": len(flights),
        "least generation, W": generated.min(),
        "most generation, W": generated.max(),
        "most load, W": load.max(),
        "least generation over load": ratio.min(),
        "mean of it": ratio.mean(),
        "most of it": ratio.max(),
        "fastest wheel, rad/s": np.abs(joined("wheel_speed_rad_s")).max(),
        "share of time on micro-thrusters": np.mean(thrusting),
        "least state of charge": column("least_charge").min(),
        "flights whose modes last long enough": column("modes_hold").sum(),
        "flights whose attitude is steady in time": column("settled_in_time").sum(),
        "momentum dumps a flight": column("dumps").mean(),
        "least miss of the final position, m": missed.min(),
        "most, m": missed.max(),
        "largest distance, sigma": column("largest_sigma").max(),
    }
    return [{"figure": name, "value": value} for name, value in found.items()]


def pointing(summaries: Sequence[FlightSummary]) -> list[Row]:
    """Mean and quantiles of angles: of all burns together, and of the worst flight's window."""
    burns = [burn for summary in summaries for burn in summary.burns]
    # At time zero the attitude is what it should be, by construction.
    starts = [burn.pointing_deg for burn in burns if burn.t_s > 0.0]
    executed = [burn.executed_pointing_deg for burn in burns]
    found = {
        name: (float(np.mean(angles)), float(np.quantile(angles, 0.95)), max(angles))
        for name, angles in (
            ("thrust against burn, as it starts, but for the first", starts),
            ("velocity gained against burn", executed),
        )
    }
    for name, target in (("camera", "command"), ("site", "the site")):
        spreads = [getattr(summary.window_pointing_deg, name) for summary in summaries]
        figures = [(spread.mean, spread.q95, spread.q100) for spread in spreads]
        means, *worst = zip(*figures, strict=True)
        found[f"camera against {target}, in the window"] = float(np.mean(means)), *map(max, worst)
    return [
        {"angle_deg": name, **dict(zip(("mean", "95", "largest"), own, strict=True))}
        for name, own in found.items()
    ]


def within(flown: Array, sampled: Sequence[Array], window: Indices) -> list[Row]:
    """Shares within 3 sigma of flights, with intervals, and of samples.

    All are distances in planned sigmas, shape (flights, nodes); `sampled` are those without a
    spacecraft, with the vehicle's and with the planner's error of the burns.
    """
    everything = slice(None)
    found = list[Row]()
    for name, nodes in (
        ("positions at all nodes", everything),
        ("flights, at the final node", [-1]),
        ("flights, at every node of the window", window),
        ("flights, at every node", everything),
    ):
        inside = [distance[:, nodes] <= RADIUS_SIGMA for distance in (flown, *sampled)]
        if name.startswith("flights"):
            inside = [np.asarray(one.all(axis=1)) for one in inside]
        own = proportion(int(inside[0].sum()), inside[0].size)
        alone = inside[0].ndim > 1  # nodes of a flight are not independent
        found.append(
            {
                "within_3_sigma": name,
                "share": f"{own.value:.{3 if alone else 2}f}",
                "95_interval": None if alone else f"{own.low:.2f} to {own.high:.2f}",
                "error_of_thrust": float(inside[1].mean()),
                "planner_s_error": float(inside[2].mean()),
            }
        )
    return found


def erring(thruster: float | None = None, initial: float | None = None) -> dict[str, Any]:
    """Entries of a scenario whose burns err in size, as by a thruster, and its state by component.

    Each is 1 sigma as a fraction; None leaves the scenario's own errors.
    """
    found: dict[str, Any] = {}
    if thruster is not None:
        names = ("magnitude_fixed_m_s", "pointing_fixed_m_s", "pointing_proportional_rad")
        gates = dict.fromkeys(names, 0.0) | {"magnitude_proportional": thruster}
        found = {f"uncertainty.gates.{name}": value for name, value in gates.items()}
    return found if initial is None else found | {"uncertainty.initial_sigma_fraction": initial}


def sample_distances(solution: Solution, thruster: float | None, samples: int) -> Array:
    """Distances of sampled positions from the mean, in planned sigmas, shape (samples, nodes).

    The initial state errs as the scenario says, each burn in size by a fraction of 1 sigma; without
    the fraction burns err as the planner expects.
    """
    mission, burns_m_s = solution.mission.changed(erring(thruster)), solution.burns_m_s
    positions = Flyer(mission, burns_m_s).first_positions(mission.times_s, samples)
    return distance_in_sigmas(np.moveaxis(positions, 0, 1), solution)


def flown_plan(session: Session) -> Tables:
    """Check whether the spacecraft can fly the default plan.

    The plan is simulated with every source of error, once for each seed. OUT/flown_plan.csv has a
    row for each seed, the other tables charge, pointing and the flown path against the planned
    covariance; the flights themselves go to OUT/seed_N/simulation.npz. A run that was stopped
    continues with the missing flights.
    """
    solution, thruster = default_plan(), load_vehicle().errors.chemical_thruster
    rows = session.rows("flights", partial(fly, solution, session.out), range(SEEDS))
    flights = [read_record(session.out / f"seed_{seed}") for seed in range(SEEDS)]
    distances = np.array([flight.arrays["node_sigma_distance"] for flight in flights])
    sampled = [sample_distances(solution, errs, SAMPLES) for errs in (thruster, None)]
    window = solution.mission.window_nodes
    return {
        "flown_plan": rows,
        "figures": figures(rows, flights),
        "pointing": pointing([flight.summary for flight in flights]),
        "position_against_the_planned_covariance": within(distances, sampled, window),
    }


# --- three policies -------------------------------------------------------------------------------

SITE = "kingfisher"
POLICIES: tuple[PolicyKind, ...] = ("open", "feedback", "replan")
FLOWN = ("whole", "window_s", "observed_s", "commanded_m_s", "terminal_miss_m")
"""Columns that a flight lacks which could not be flown."""


def planned(out: Path) -> Solution:
    """The plan of the pass, kept in a folder.

    The pass is designed with measurements at the burns, and planned again for a lead in which the
    spacecraft can turn.

    Raises:
        InputError: if no pass is found.
    """
    if (out / FILE_NAME).is_file():
        return read_solution(out)
    found = design(load_scenario(SITE).replace(measured() | {"risk.p_chance": 0.9})).plan
    if found is None:
        raise InputError("design", SITE, "must be found")
    mission = Mission.from_scenario(found.mission.scenario.replace(measured(lead_s=LEAD_S)))
    start, options = from_burns(mission, found.burns_m_s), PlanOptions(certify=False, starts=1)
    solution = make_solution(plan_mission(mission, start, options))
    out.mkdir(parents=True, exist_ok=True)
    solution.write(out)
    return solution


def fly_policy(solution: Solution, case: tuple[PolicyKind, int]) -> Row:
    """Simulate a flight of a plan by a policy: a row."""
    policy, seed = case
    begun = {"policy": policy, "seed": seed}
    try:
        record = simulate(solution, seed=seed, policy=policy)
    except InputError as error:  # as of a burn that the thruster cannot give in its time
        return begun | {"shortfalls": str(error)}
    commanded = [np.linalg.norm(burn.planned_m_s) for burn in record.summary.burns]
    more: Row = {
        "commanded_m_s": float(sum(commanded)),
        "shortfalls": "; ".join(shortfalls(record.summary, solution)),
    }
    return begun | row(record) | observed(record, solution.mission) | more


def observed(record: Record, mission: Mission) -> Row:
    """Time for which a flight observes, and whether it keeps every limit on its path."""
    times, states = record.arrays["t_s"], record.arrays["state"]
    first, last = mission.schedule.window_s
    samples_s = np.unique([first, last, *times[(times > first) & (times < last)]])
    path = CubicHermiteSpline(times, states[:, :3], states[:, 3:])
    seen = np.hstack([path(samples_s), path(samples_s, 1)])[:, None]
    margins = joint_margins(mission, samples_s, seen[..., :3]).values()
    radius = np.linalg.norm(states[:, :3], axis=1).min() - mission.scenario.safety.radius_min_m
    return {
        "observed_s": float(time_held(mission, samples_s, seen)[ALL].duration[0]),
        "window_s": last - first,
        "whole": bool(min(radius, *(float(margin.min()) for margin in margins)) >= 0.0),
    }


def by_policy(rows: Sequence[Row]) -> list[Row]:
    """A row for each policy."""
    found = []
    table = pd.DataFrame(rows, columns=[*dict.fromkeys((*chain(*rows), *FLOWN))])
    for policy, own in table.groupby("policy", sort=False):
        whole = int(own.whole.eq(True).sum())
        share = proportion(whole, len(own))
        found.append(
            {
                "policy": policy,
                "flights": len(own),
                "whole": whole,
                "whole_low": share.low,
                "whole_high": share.high,
                "window_s": own.window_s.max(),
                "observed_mean_s": own.observed_s.mean(),
                "commanded_mean_m_s": own.commanded_m_s.mean(),
                "miss_m": np.sqrt((own.terminal_miss_m.astype(float) ** 2).mean()),
                "as_required": int(own.shortfalls.eq("").sum()),
            }
        )
    return found


def flown_policies(session: Session) -> Tables:
    """Fly a pass of Kingfisher with the spacecraft: as planned, corrected by gains, and planned again.

    OUT/flown_policies.csv has a row for each policy, flown_policies_flights.csv one for each
    flight. A run that was stopped continues with the missing flights; the plan in OUT/kingfisher is
    kept.
    """
    solution = planned(session.out / SITE)
    cases = product(POLICIES, range(SEEDS))
    rows = session.rows("flights", partial(fly_policy, solution), cases)
    return {"flown_policies": by_policy(rows), "flown_policies_flights": rows}


STUDIES = {
    "flown_plan": Study(flown_plan.__doc__, flown_plan),
    "flown_policies": Study(flown_policies.__doc__, flown_policies),
}
