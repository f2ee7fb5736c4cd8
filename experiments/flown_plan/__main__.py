"""Whether the spacecraft can fly a plan: `python -m experiments.flown_plan SOLUTION`.

The plan is simulated with every source of error, once for each seed. Charge, modes, pointing and the
flown path against the planned covariance go to OUT/flown_plan.csv, a line for each seed, and .md;
the flights themselves to OUT/seed_N/simulation.npz. Flights of the same scenario, burns and vehicle
that are there already are not flown again.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint, parse

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn
from scipy.stats import chi2

from experiments.flown_plan.samples import sample_distances
from experiments.studies import Cell, add_out, markdown, run, to_csv
from scp_recon.cli.options import int_between
from scp_recon.errors import InputError
from scp_recon.files import write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.solution.file import Solution
from scp_recon.solution.read import read_solution
from scp_recon.spacecraft.basilisk.optional import needing_basilisk
from scp_recon.spacecraft.record import (
    Record,
    inputs_digest,
    make_record,
    read_record,
    write_record,
)
from scp_recon.spacecraft.summary import Angles, FlightSummary, WindowPointing
from scp_recon.spacecraft.vehicle import Vehicle, load_vehicle

Array = npt.NDArray[np.float64]
Inside = npt.NDArray[np.bool_]

NAME = "flown_plan"
DEFAULT_OUT = Path("runs") / NAME
SEEDS, SAMPLES = 20, 10_000
RADIUS_SIGMA = 3.0
EXPECTED = float(chi2.cdf(RADIUS_SIGMA**2, 3))
"""Share of a normal position that lies within three sigma."""

ANGLES: dict[str, Callable[[WindowPointing], Angles]] = {
    "camera against command, in the window": lambda pointing: pointing.camera,
    "camera against the site, in the window": lambda pointing: pointing.site,
}


def fly(solution: Solution, vehicle: Vehicle, seed: int, folder: Path, *, fresh: bool) -> Record:
    """One flight: the one in the folder if it is of these burns, else simulated and written there.

    Raises:
        InputError: if Basilisk is not installed and the flight is not there.
        OSError: if the folder cannot be written.
    """
    found = None if fresh else _found(solution, vehicle, seed, folder)
    if found is not None:
        return found
    with needing_basilisk("python -m experiments.flown_plan"):
        from scp_recon.spacecraft.basilisk.simulation import simulate
    folder.mkdir(parents=True, exist_ok=True)
    record = make_record(simulate(solution, vehicle, seed), solution, seed)
    write_record(record, folder)
    return record


def _found(solution: Solution, vehicle: Vehicle, seed: int, folder: Path) -> Record | None:
    try:
        record = read_record(folder)
    except InputError:
        return None
    # Files of earlier versions lack the digests, and are flown again.
    flown = record.summary.seed, record.plan_hash, record.summary.inputs_sha256
    asked = seed, solution.plan_hash, inputs_digest(solution, vehicle)
    return record if flown == asked else None


def line(record: Record) -> dict[str, Cell]:
    """One line of the table."""
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


def to_markdown(records: Sequence[Record], mission: Mission, sampled: Sequence[Array]) -> str:
    """What all flights say together.

    Args:
        records: of the flights.
        mission: that they flew.
        sampled: distances in sigmas without a spacecraft, with the vehicle's and with the planner's
            error of the burns, shape (samples, nodes) each.
    """
    summaries = [record.summary for record in records]
    distances = np.array([record.arrays["node_sigma_distance"] for record in records])
    lines = [
        f"# A plan flown {len(records)} times",
        _power_and_end(records),
        "## Modes",
        markdown(
            ("mode", "shortest s", "at least s", "holds", "steady after s, worst", "in time"),
            _mode_lines(summaries),
        ),
        "## Pointing",
        "Burns of all flights together; of the camera, the mean and the quantiles of the worst flight.",
        markdown(("angle, deg", "mean", "95 %", "99.7 %", "largest"), _angle_lines(summaries)),
        "## Position against the planned covariance",
        f"A normal position lies within {RADIUS_SIGMA:g} sigma with probability {EXPECTED:.3f}. "
        f"The largest distance is {distances.max():.2f} sigma. The last two columns are "
        f"{len(sampled[0])} samples of the planner's dynamics: with the vehicle's error of thrust and "
        "with the planner's own error of each component.",
        markdown(
            (
                "within 3 sigma",
                "share",
                "95 % interval",
                "error of thrust",
                "planner's error",
            ),
            _within_lines([distances, *sampled], mission),
        ),
    ]
    return "\n\n".join(lines) + "\n"


def _power_and_end(records: Sequence[Record]) -> str:
    summaries = [record.summary for record in records]
    generated = np.concatenate([r.arrays["panel_w"][1:].sum(axis=1) for r in records])
    drawn = np.concatenate([r.arrays["consumed_w"][1:] for r in records])
    misses = [summary.terminal_miss.position_m for summary in summaries]
    return (
        f"Least state of charge {min(s.least_charge for s in summaries):.3f}; the floor is "
        f"{summaries[0].floor_charge:.2f}. Panels generate {generated.min():.0f} to "
        f"{generated.max():.0f} W, loads draw {drawn.min():.0f} to {drawn.max():.0f} W. Momentum is "
        f"dumped {np.mean([s.dumps for s in summaries]):.2f} times a flight. Flights end "
        f"{min(misses):.0f} to {max(misses):.0f} m from the planned mean."
    )


def _within_lines(distances: Sequence[Array], mission: Mission) -> list[tuple[str, ...]]:
    """Shares of the flights, with an interval, and of each sample, from distances (flights, nodes)."""
    flown, *sampled = [distance <= RADIUS_SIGMA for distance in distances]
    window = mission.window_nodes
    kinds: dict[str, Callable[[Inside], Inside]] = {
        "flights, at the final node": lambda inside: inside[:, -1],
        "flights, at every node of the window": lambda inside: inside[:, window].min(axis=1),
        "flights, at every node": lambda inside: inside.min(axis=1),
    }
    lines = [("positions at all nodes", f"{flown.mean():.3f}", "", *_means(sampled))]
    for name, kind in kinds.items():
        lines.append((name, *_share(kind(flown)), *_means([kind(x) for x in sampled])))
    return lines


def _means(samples: Sequence[Inside]) -> list[str]:
    return [f"{np.mean(sample):.3f}" for sample in samples]


def _mode_lines(summaries: Sequence[FlightSummary]) -> list[tuple[str, ...]]:
    lines: list[tuple[str, ...]] = []
    for legs in zip(*(summary.legs for summary in summaries), strict=True):
        shortest = min(leg.duration_s for leg in legs)
        holds = "yes" if all(leg.ok for leg in legs) else "no"
        settled = [np.inf if leg.settled_s is None else leg.settled_s for leg in legs]
        in_time = sum(leg.settled_in_time for leg in legs)
        row = (
            f"{shortest:.0f}",
            f"{legs[0].required_s:.0f}",
            holds,
            f"{max(settled):.0f}",
            f"{in_time} of {len(legs)}",
        )
        lines.append((f"{legs[0].mode}, from {legs[0].start_s:.0f} s", *row))
    return lines


def _angle_lines(summaries: Sequence[FlightSummary]) -> list[tuple[str, ...]]:
    burns = [burn for summary in summaries for burn in summary.burns]
    # At time zero the attitude is what it should be, by construction.
    starts = np.array([burn.pointing_deg for burn in burns if burn.t_s > 0.0])
    executed = np.array([burn.executed_pointing_deg for burn in burns])
    rows = {
        name: (angles, *np.quantile(angles, (0.95, 0.997, 1.0)))
        for name, angles in (
            ("thrust against burn, as it starts, but for the first", starts),
            ("velocity gained against burn", executed),
        )
    }
    for name, of in ANGLES.items():
        spreads = [of(summary.window_pointing_deg) for summary in summaries]
        means = np.array([spread.mean for spread in spreads])
        worst = np.array([(s.q95, s.q997, s.q100) for s in spreads]).max(axis=0)
        rows[name] = (means, *worst)
    return [
        (name, *(f"{x:.3f}" for x in (values.mean(), *worst)))
        for name, (values, *worst) in rows.items()
    ]


def _share(inside: Inside) -> tuple[str, str]:
    share = proportion(int(inside.sum()), len(inside))
    return f"{share.value:.2f}", f"{share.low:.2f} to {share.high:.2f}"


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog=f"python -m experiments.{NAME}", description=__doc__)
    p.add_argument(
        "solution", type=Path, metavar="SOLUTION", help="folder with a solution.json, or the file"
    )
    add_out(p, DEFAULT_OUT)
    p.add_argument(
        "--seeds",
        type=int_between(1, 10_000),
        default=SEEDS,
        metavar="N",
        help=f"flights, of the seeds from 0 on (default: {SEEDS})",
    )
    p.add_argument("--fresh", action="store_true", help="fly again what is there already")
    p.add_argument(
        "--vehicle", type=Path, metavar="FILE", help="vehicle file (default: the packaged DARE)"
    )
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 if everything was written, 2 for bad input."""
    return run(_run, parse(parser(), arguments))


def _run(options: argparse.Namespace) -> int:
    solution, vehicle = read_solution(options.solution), load_vehicle(options.vehicle)
    mission, out = Mission.from_scenario(solution.scenario), options.out
    columns = ("flights", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        records = [
            fly(solution, vehicle, seed, out / f"seed_{seed}", fresh=options.fresh)
            for seed in bar.track(range(options.seeds))
        ]
    sampled = [sample_distances(solution, errs, SAMPLES) for errs in (vehicle, None)]
    table = to_markdown(records, mission, sampled)
    files = {
        f"{NAME}.csv": to_csv([line(record) for record in records]),
        f"{NAME}.md": table,
    }
    print(table)
    for name, text in files.items():
        print(f"written: {write_atomically(out / name, text)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
