"""Check whether the spacecraft can fly a plan.

The plan is simulated with every source of error, once for each seed. OUT/flown_plan.csv has a row
for each seed, the other tables charge, pointing and the flown path against the planned covariance;
the flights themselves go to OUT/seed_N/simulation.npz. Existing flights of the same plan
and vehicle are kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from experiments.harness import (
    FRESH,
    VEHICLE,
    Claim,
    Findings,
    Session,
    Study,
    number,
    option,
    plan_or_default,
    records,
)
from experiments.harness import Record as Row
from formulations.arrays import Array, Booleans
from scp_recon.api.flights import simulate
from scp_recon.jobs.job import Job
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import execution_errors
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.results.solution import Solution
from scp_recon.results.table import Table, Value
from scp_recon.simulation.flight import Actuators, distance_in_sigmas
from scp_recon.simulation.record import (
    FlightSummary,
    Record,
    inputs_digest,
    read_record,
    write_record,
)
from scp_recon.simulation.vehicle import Vehicle, load_vehicle

SEEDS, SAMPLES, BLOCK = 20, 10_000, 1000
RADIUS_SIGMA = 3.0
EXPECTED = float(chi2.cdf(RADIUS_SIGMA**2, 3))
"""Share of a normal position that lies within three sigma."""


def fly(solution: Solution, vehicle: Path | None, out: Path, seed: int) -> Row:
    """Simulate a flight, and write it to `seed_N` in a folder: a row of the table.

    Raises:
        InputError: if Basilisk is not installed.
        OSError: if the folder cannot be written.
    """
    record = simulate(solution, seed=seed, vehicle=vehicle)
    folder = folder_of(out, seed)
    folder.mkdir(parents=True, exist_ok=True)
    write_record(record, folder)
    return row(record)


def folder_of(out: Path, seed: int) -> Path:
    """Folder of a flight."""
    return out / f"seed_{seed}"


def row(record: Record) -> Row:
    """A flight as a row of the table."""
    summary, distance = record.summary, record.arrays["node_sigma_distance"]
    camera, site = summary.window_pointing_deg.camera, summary.window_pointing_deg.site
    return {
        "seed": summary.seed,
        "least_charge": summary.least_charge,
        "modes_hold": all(leg.ok for leg in summary.legs),
        "settled_in_time": all(leg.settled_in_time for leg in summary.legs),
        "burn_start_max_deg": max(burn.pointing_deg for burn in summary.burns),
        "burn_executed_max_deg": max(burn.executed_pointing_deg for burn in summary.burns),
        "camera_mean_deg": camera.mean,
        "camera_max_deg": camera.q100,
        "site_mean_deg": site.mean,
        "site_max_deg": site.q100,
        "dumps": summary.dumps,
        "ledger_error": summary.ledger_error,
        "terminal_miss_m": summary.terminal_miss.position_m,
        "terminal_sigma": float(distance[-1]),
        "largest_sigma": float(distance.max()),
        "nodes_within_3_sigma": float((distance <= RADIUS_SIGMA).mean()),
    }


def summed_up(
    flights: Sequence[Record], mission: Mission, sampled: Sequence[Array]
) -> dict[str, Table]:
    """Tables of all flights together by the names of their files.

    `sampled` has distances in sigmas without a spacecraft, with the vehicle's and with the planner's
    error of the burns, shape (samples, nodes) each.
    """
    summaries = [record.summary for record in flights]
    distances = np.array([record.arrays["node_sigma_distance"] for record in flights])
    generated = np.concatenate([r.arrays["panel_w"][1:].sum(axis=1) for r in flights])
    drawn = np.concatenate([r.arrays["consumed_w"][1:] for r in flights])
    ratio = generated / drawn
    wheels = max(float(np.abs(r.arrays["wheel_speed_rad_s"]).max()) for r in flights)
    thrusters = np.mean([np.mean(r.arrays["actuators"] == Actuators.THRUSTERS) for r in flights])
    misses = [summary.terminal_miss.position_m for summary in summaries]
    figures: dict[str, float] = {
        "flights": len(flights),
        "least generation, W": float(generated.min()),
        "most generation, W": float(generated.max()),
        "least load, W": float(drawn.min()),
        "most load, W": float(drawn.max()),
        "least generation over load": float(ratio.min()),
        "mean of it": float(ratio.mean()),
        "most of it": float(ratio.max()),
        "fastest wheel, rad/s": wheels,
        "share of time on micro-thrusters": float(thrusters),
        "least state of charge": min(s.least_charge for s in summaries),
        "momentum dumps a flight": float(np.mean([s.dumps for s in summaries])),
        "least miss of the final position, m": min(misses),
        "most, m": max(misses),
        "largest distance, sigma": float(distances.max()),
    }
    angles = ("mean", "95 %", "99.7 %", "largest")
    within = ("within 3 sigma", "share", "95 % interval", "error of thrust", "planner's error")
    return {
        "figures.csv": Table.of("", ("figure", "value"), list(figures.items())),
        "pointing.csv": Table.of("", ("angle, deg", *angles), _angle_lines(summaries)),
        "position_against_the_planned_covariance.csv": Table.of(
            "", within, _within_lines([distances, *sampled], mission)
        ),
    }


def claims(summaries: Sequence[FlightSummary]) -> list[Claim]:
    """Claims that charge and modes hold in every flight."""
    least, floor = min(s.least_charge for s in summaries), summaries[0].floor_charge
    found = [
        Claim("least state of charge", f"at least {floor:.2f}", f"{least:.3f}", least >= floor)
    ]
    for words, name in (
        ("every mode lasts long enough", "ok"),
        ("the attitude is steady in time", "settled_in_time"),
    ):
        good = sum(all(getattr(leg, name) for leg in s.legs) for s in summaries)
        measured = f"{good} of {len(summaries)} flights"
        found.append(Claim(words, "every flight", measured, good == len(summaries)))
    return found


def _within_lines(distances: Sequence[Array], mission: Mission) -> list[tuple[Value, ...]]:
    """Shares within 3 sigma of flights, with intervals, and of samples; distances (flights, nodes)."""
    flown, *sampled = [distance <= RADIUS_SIGMA for distance in distances]
    window = mission.window_nodes
    kinds: dict[str, Callable[[Booleans], Booleans]] = {
        "flights, at the final node": lambda inside: inside[:, -1],
        "flights, at every node of the window": lambda inside: inside[:, window].min(axis=1),
        "flights, at every node": lambda inside: inside.min(axis=1),
    }
    lines: list[tuple[Value, ...]] = [
        ("positions at all nodes", f"{flown.mean():.3f}", None, *map(_mean, sampled))
    ]
    for name, kind in kinds.items():
        lines.append((name, *_share(kind(flown)), *(_mean(kind(x)) for x in sampled)))
    return lines


def _mean(inside: Booleans) -> float:
    return float(np.mean(inside))


def _angle_lines(summaries: Sequence[FlightSummary]) -> list[tuple[Value, ...]]:
    burns = [burn for summary in summaries for burn in summary.burns]
    # At time zero the attitude is what it should be, by construction.
    starts = np.array([burn.pointing_deg for burn in burns if burn.t_s > 0.0])
    executed = np.array([burn.executed_pointing_deg for burn in burns])
    lines: list[tuple[Value, ...]] = [
        (name, float(angles.mean()), *np.quantile(angles, (0.95, 0.997, 1.0)).tolist())
        for name, angles in (
            ("thrust against burn, as it starts, but for the first", starts),
            ("velocity gained against burn", executed),
        )
    ]
    for name, target in (("camera", "command"), ("site", "the site")):
        spreads = [getattr(summary.window_pointing_deg, name) for summary in summaries]
        worst = np.array([(s.q95, s.q997, s.q100) for s in spreads]).max(axis=0)
        mean = float(np.mean([spread.mean for spread in spreads]))
        lines.append((f"camera against {target}, in the window", mean, *worst.tolist()))
    return lines


def _share(inside: Booleans) -> tuple[str, str]:
    share = proportion(int(inside.sum()), len(inside))
    return f"{share.value:.2f}", f"{share.low:.2f} to {share.high:.2f}"


def sample_distances(
    solution: Solution, vehicle: Vehicle | None, samples: int, seed: int = 0
) -> Array:
    """Distances of sampled positions from the mean, in planned sigmas, shape (samples, nodes).

    The initial state errs as the scenario says, each burn in size as the vehicle's thruster does;
    without a vehicle burns err as the planner expects.
    """
    mission, planned = solution.mission, solution.burns_m_s
    units, model, found = mission.units, execution_errors(mission.scenario), []
    for block, first in enumerate(range(0, samples, BLOCK)):
        rng = np.random.default_rng([seed, block])
        numbers = planned.size if vehicle else model.draws(len(planned))
        draws = rng.standard_normal((min(BLOCK, samples - first), 6 + numbers))
        if vehicle is None:
            executed = model.execute(planned, draws[:, 6:])
        else:
            sizes = draws[:, 6:].reshape(-1, *planned.shape)[..., :1]
            executed = planned * (1.0 + vehicle.errors.chemical_thruster * sizes)
        initial = mission.initial_state + draws[:, :6] @ mission.initial_factor.T
        states = mission.dynamics.rollout(initial / units.state, executed / units.speed_m_s)
        positions = np.moveaxis(states, 0, 1)[..., :3] * units.length_m
        found.append(distance_in_sigmas(positions, solution))
    return np.concatenate(found)


def run(session: Session) -> Findings:
    """Fly the plan once for each seed, and sample its dispersion without a spacecraft."""
    options, out = session.options, session.out
    solution, vehicle = plan_or_default(options.solution), load_vehicle(options.vehicle)
    store = session.store("flown_plan.jsonl", inputs=inputs_digest(solution, vehicle))
    if options.fresh:
        store.forget()
    work = partial(fly, solution, options.vehicle, out)
    jobs = [Job(seed, seed) for seed in range(options.seeds)]
    rows = session.rows("flights", work, jobs, store)
    flights = [read_record(folder_of(out, seed)) for seed in range(options.seeds)]
    sampled = [sample_distances(solution, errs, SAMPLES) for errs in (vehicle, None)]
    tables = summed_up(flights, solution.mission, sampled)
    return Findings(
        {"flown_plan.csv": records(rows), **tables}, claims([flight.summary for flight in flights])
    )


STUDY = Study(
    __doc__,
    run,
    (
        option(
            "solution",
            nargs="?",
            type=Path,
            metavar="SOLUTION",
            help="folder with a solution.json, or the file (default: the default plan)",
        ),
        number("--seeds", SEEDS, 1, 10_000, "flights, of the seeds from 0 on"),
        FRESH,
        VEHICLE,
    ),
)
