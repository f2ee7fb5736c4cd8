"""Whether the spacecraft can fly a plan: `python -m experiments.flown_plan SOLUTION`.

The plan is simulated with every source of error, once for each seed. Charge, modes, pointing and the
flown path against the planned covariance go to OUT/flown_plan.csv, a line for each seed, and .md;
the flights themselves to OUT/seed_N/simulation.npz.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn
from scipy.stats import chi2

from experiments.studies import Cell, add_out, markdown, run, to_csv, whole
from scp_recon.errors import InputError
from scp_recon.estimates import proportion
from scp_recon.mission import Mission
from scp_recon.solution import Solution, read_solution, write_atomically
from scp_recon.spacecraft.vehicle import Vehicle, load_vehicle

Array = npt.NDArray[np.float64]

NAME = "flown_plan"
DEFAULT_OUT = Path("runs") / NAME
SEEDS = 20
RADIUS_SIGMA = 3.0
EXPECTED = float(chi2.cdf(RADIUS_SIGMA**2, 3))
"""Share of a normal position that lies within three sigma."""


@dataclass(frozen=True)
class Flown:
    """What is kept of one simulated flight.

    Attributes:
        seed: of its errors.
        least_charge: of any battery.
        legs: modes after the first burn: name, duration and least duration in s.
        burn_pointing_deg: thrust against planned burn when it starts, shape (m,).
        camera_deg: camera against command in the window, shape (w,).
        site_deg: camera against the site in the window, shape (w,).
        sigma_distance: of the position at the nodes from the planned mean, shape (n,).
        dumps: of the wheels' momentum.
        miss_m: of the final position.
    """

    seed: int
    least_charge: float
    legs: tuple[tuple[str, float, float], ...]
    burn_pointing_deg: Array
    camera_deg: Array
    site_deg: Array
    sigma_distance: Array
    dumps: int
    miss_m: float

    @property
    def modes_hold(self) -> bool:
        """Whether no mode is shorter than its rule, but for one control period."""
        return all(duration >= least - 1.0 for _, duration, least in self.legs)


def fly(solution: Solution, vehicle: Vehicle, seed: int, folder: Path) -> Flown:
    """Simulate one flight and write it into a folder.

    Raises:
        InputError: if Basilisk is not installed.
    """
    try:
        from scp_recon.spacecraft.outcome import pointing
        from scp_recon.spacecraft.record import make_record, write_record
        from scp_recon.spacecraft.simulation import simulate
    except ImportError as error:
        raise InputError("Basilisk", f"no module {error.name}", "needs the extra [sim]") from None
    flight = simulate(solution, vehicle, seed)
    record, angles = make_record(flight, solution, seed), pointing(flight)
    folder.mkdir(parents=True, exist_ok=True)
    write_record(record, folder)
    summary = record.summary
    return Flown(
        seed=seed,
        least_charge=summary["least_charge"],
        legs=tuple((leg["mode"], leg["duration_s"], leg["required_s"]) for leg in summary["legs"]),
        burn_pointing_deg=np.rad2deg(angles.burns),
        camera_deg=np.rad2deg(angles.camera),
        site_deg=np.rad2deg(angles.site),
        sigma_distance=record.arrays["node_sigma_distance"],
        dumps=summary["dumps"],
        miss_m=summary["terminal_miss"]["position_m"],
    )


def record_of(flown: Flown) -> dict[str, Cell]:
    """One line of the table."""
    distance = flown.sigma_distance
    return {
        "seed": flown.seed,
        "least_charge": flown.least_charge,
        "modes_hold": flown.modes_hold,
        "burn_pointing_max_deg": float(flown.burn_pointing_deg.max()),
        "camera_mean_deg": float(flown.camera_deg.mean()),
        "camera_max_deg": float(flown.camera_deg.max()),
        "site_mean_deg": float(flown.site_deg.mean()),
        "site_max_deg": float(flown.site_deg.max()),
        "dumps": flown.dumps,
        "terminal_miss_m": flown.miss_m,
        "terminal_sigma": float(distance[-1]),
        "largest_sigma": float(distance.max()),
        "nodes_within_3_sigma": float((distance <= RADIUS_SIGMA).mean()),
    }


def to_markdown(flights: Sequence[Flown], mission: Mission, floor: float) -> str:
    """What all flights say together."""
    within = np.array([flight.sigma_distance <= RADIUS_SIGMA for flight in flights])
    window, n = mission.window_nodes, len(flights)
    shares = [
        ("at the final node", within[:, -1]),
        ("at every node of the window", within[:, window].all(axis=1)),
        ("at every node", within.all(axis=1)),
    ]
    lines = [
        f"# A plan flown {n} times",
        f"Least state of charge {min(f.least_charge for f in flights):.3f}; the floor is {floor:.2f}.",
        "## Modes",
        markdown(("mode", "shortest s", "at least s", "holds"), _mode_lines(flights)),
        "## Pointing",
        markdown(
            ("angle, deg", "mean", "median", "95 %", "99.7 %", "largest"), _angle_lines(flights)
        ),
        "## Position against the planned covariance",
        f"A normal position lies within {RADIUS_SIGMA:g} sigma with probability {EXPECTED:.3f}. "
        f"Over all flights and nodes {within.mean():.3f} of the positions do.",
        markdown(
            ("flights within 3 sigma", "share", "95 % interval"),
            [(name, *_share(int(inside.sum()), n)) for name, inside in shares],
        ),
    ]
    return "\n\n".join(lines) + "\n"


def _mode_lines(flights: Sequence[Flown]) -> list[tuple[str, ...]]:
    lines: list[tuple[str, ...]] = []
    for index, (mode, _, least) in enumerate(flights[0].legs):
        shortest = min(flight.legs[index][1] for flight in flights)
        holds = "yes" if shortest >= least - 1.0 else "no"
        lines.append((mode, f"{shortest:.0f}", f"{least:.0f}", holds))
    return lines


def _angle_lines(flights: Sequence[Flown]) -> list[tuple[str, ...]]:
    pooled = {
        "thrust against burn, as it starts": [f.burn_pointing_deg for f in flights],
        "camera against command, in the window": [f.camera_deg for f in flights],
        "camera against the site, in the window": [f.site_deg for f in flights],
    }
    lines: list[tuple[str, ...]] = []
    for name, parts in pooled.items():
        angle = np.concatenate(parts)
        figures = (angle.mean(), *np.quantile(angle, (0.5, 0.95, 0.997, 1.0)))
        lines.append((name, *(f"{x:.3f}" for x in figures)))
    return lines


def _share(successes: int, n: int) -> tuple[str, str]:
    share = proportion(successes, n)
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
        type=whole(1, 10_000),
        default=SEEDS,
        metavar="N",
        help=f"flights, of the seeds from 0 on (default: {SEEDS})",
    )
    p.add_argument(
        "--vehicle", type=Path, metavar="FILE", help="vehicle file (default: the packaged DARE)"
    )
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 if everything was written, 2 for bad input."""
    return run(_run, parser().parse_args(arguments))


def _run(options: argparse.Namespace) -> int:
    solution, vehicle = read_solution(options.solution), load_vehicle(options.vehicle)
    mission = Mission.from_scenario(solution.scenario)
    columns = ("flights", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        seeds = bar.track(range(options.seeds))
        flights = [fly(solution, vehicle, i, options.out / f"seed_{i}") for i in seeds]
    table = to_markdown(flights, mission, vehicle.battery.floor_charge)
    files = {
        f"{NAME}.csv": to_csv([record_of(flown) for flown in flights]),
        f"{NAME}.md": table,
    }
    print(table)
    for name, text in files.items():
        print(f"written: {write_atomically(options.out / name, text)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
