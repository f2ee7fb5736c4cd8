"""Check whether the spacecraft can fly the default plan.

The plan is simulated with every source of error, once for each seed. OUT/flown_plan.csv has a row
for each seed, the other tables charge, pointing and the flown path against the planned covariance;
the flights themselves go to OUT/seed_N/simulation.npz. A run that was stopped continues with the
missing flights.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.harness import Record as Row
from experiments.harness import Session, Study, Tables, default_plan
from formulations.arrays import Array, Indices
from scp_recon.api.plan_verbs import simulate
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.monte_carlo.sampling import sample_positions
from scp_recon.results.solution import Solution
from scp_recon.simulation.flight import Actuators, distance_in_sigmas
from scp_recon.simulation.record import (
    FlightSummary,
    Record,
    read_record,
    write_record,
)
from scp_recon.simulation.vehicle import load_vehicle

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
    positions = sample_positions(mission, burns_m_s, mission.times_s, samples)
    return distance_in_sigmas(np.moveaxis(positions, 0, 1), solution)


def run(session: Session) -> Tables:
    """Fly the plan once for each seed, and sample its dispersion without a spacecraft."""
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


STUDY = Study(__doc__, run)
