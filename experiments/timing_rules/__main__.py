"""The schedule's durations, measured: `python -m experiments.timing_rules`.

The schedule allows so much for a slew to steady state, for heating the thruster and for a recharge
from empty. Half turns about many axes with noisy sensors and actuators and spinning wheels, and a
recharge in sun-pointing mode, are simulated; the durations go to OUT/timing_rules.csv and .md, the
slews to timing_rules_slews.csv.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint, parse

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import track

from experiments.kept import Kept
from experiments.studies import Cell, add_out, markdown, run, to_csv
from experiments.timing_rules.flights import STEADY_DEG, Slew, measure_recharge, measure_slew
from scp_recon.cli.options import int_between
from scp_recon.files import write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.scenario.load import load_scenario
from scp_recon.spacecraft.vehicle import Vehicle, load_vehicle

Array = npt.NDArray[np.float64]

NAME = "timing_rules"
DEFAULT_OUT = Path("runs") / NAME
SLEWS = 20


@dataclass(frozen=True)
class Rule:
    """A duration of the schedule against the measured one, s."""

    name: str
    measured_s: float
    allowed_s: float
    how: str

    @property
    def holds(self) -> bool:
        """Whether the schedule allows enough."""
        return self.measured_s <= self.allowed_s


def rules(
    mission: Mission, vehicle: Vehicle, slews: Sequence[Slew], recharges_s: tuple[float, float]
) -> list[Rule]:
    """The three of them, the last twice: quiescent, and with the attitude control's reserve drawn."""
    allowed, loads = mission.scenario.schedule, vehicle.loads
    worst = max(slew.settling_s[-1] for slew in slews)
    heating = vehicle.chemical_thruster.heating_s
    quiet_w, busy_w = loads.quiescent_w, loads.quiescent_w + loads.attitude_control_w
    return [
        Rule(
            "slew to steady state", worst, allowed.attitude_s, f"worst of {len(slews)} half turns"
        ),
        Rule("thruster heating", heating, allowed.heating_s, "the thruster's data"),
        *(
            Rule("recharge from empty", time, allowed.recharge_s, f"{load:g} W drawn")
            for time, load in zip(recharges_s, (quiet_w, busy_w), strict=True)
        ),
    ]


def dark_charge(vehicle: Vehicle) -> float:
    """Charge left when full batteries alone carry a warm-up; below zero if they cannot."""
    battery = vehicle.battery
    drawn = vehicle.loads.warm_up_w * vehicle.chemical_thruster.heating_s / 3600.0
    return 1.0 - drawn / battery.efficiency / (battery.count * battery.capacity_wh)


def to_markdown(found: Sequence[Rule], slews: Sequence[Slew], vehicle: Vehicle) -> str:
    """The table, and what lies behind it."""
    lines = [
        (
            r.name,
            f"{r.measured_s / 60:.1f}",
            f"{r.allowed_s / 60:.0f}",
            "yes" if r.holds else "no",
            r.how,
        )
        for r in found
    ]
    table = markdown(("rule", "measured min", "schedule min", "holds", "how"), lines)
    settling = markdown(
        ("error stays below", "median min", "worst min"),
        [
            (f"{limit:g} deg", f"{np.median(times) / 60:.1f}", f"{max(times) / 60:.1f}")
            for limit, times in zip(
                STEADY_DEG, zip(*(slew.settling_s for slew in slews), strict=True), strict=True
            )
        ],
    )
    steady = max(slew.steady_deg for slew in slews)
    return (
        f"# The schedule's durations for {vehicle.name}\n\n{table}\n\n## Half turns\n\n{settling}\n\n"
        f"In steady state the error is at most {steady:.3f} deg in root mean square. A warm-up that no "
        f"panel helps leaves a charge of {dark_charge(vehicle):.2f}; the floor is "
        f"{vehicle.battery.floor_charge:.2f}.\n"
    )


def record(slew: Slew) -> dict[str, Cell]:
    """One line of the slews' table."""
    x, y, z = slew.axis.tolist()
    settled = {
        f"settled_{limit:g}_deg_s": time
        for limit, time in zip(STEADY_DEG, slew.settling_s, strict=True)
    }
    return {
        "axis_x": x,
        "axis_y": y,
        "axis_z": z,
        "wheel_share": slew.wheel_share,
        **settled,
        "steady_rms_deg": slew.steady_deg,
    }


def as_kept(slew: Slew) -> dict[str, Cell]:
    """All of it, in a row of one kind of figures."""
    x, y, z = slew.axis.tolist()
    settled = {f"settled_{i}": time for i, time in enumerate(slew.settling_s)}
    figures = {"wheel_share": slew.wheel_share, "steady_deg": slew.steady_deg}
    return {"x": x, "y": y, "z": z, **figures, **settled}


def from_kept(row: Mapping[str, Cell]) -> Slew:
    """The slew of a row of `as_kept`."""
    return Slew(
        np.array([row["x"], row["y"], row["z"]], dtype=float),
        float(row["wheel_share"]),
        tuple(float(row[f"settled_{i}"]) for i in range(len(STEADY_DEG))),
        float(row["steady_deg"]),
    )


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog=f"python -m experiments.{NAME}", description=__doc__)
    add_out(p, DEFAULT_OUT)
    p.add_argument(
        "--slews",
        type=int_between(3, 10_000),
        default=SLEWS,
        metavar="N",
        help=f"half turns (default: {SLEWS})",
    )
    p.add_argument(
        "--seed",
        type=int_between(0, 2**32 - 1),
        default=0,
        metavar="N",
        help="of all errors (default: 0)",
    )
    p.add_argument(
        "--vehicle", type=Path, metavar="FILE", help="vehicle file (default: the packaged DARE)"
    )
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 if everything was written, 2 for bad input."""
    return run(_run, parse(parser(), arguments))


def _run(options: argparse.Namespace) -> int:
    mission, vehicle = Mission.from_scenario(load_scenario()), load_vehicle(options.vehicle)
    indices = track(range(options.slews), "slews", console=Console(stderr=True))
    setting = {"seed": options.seed, "vehicle": repr(vehicle)}
    kept = Kept(options.out / f"{NAME}_partial.jsonl", __file__, setting)

    def figures(index: int) -> dict[str, Cell]:
        return as_kept(measure_slew(mission, vehicle, index, options.seed))

    slews = [from_kept(kept.row(f"{index}", partial(figures, index))) for index in indices]
    recharges = (
        measure_recharge(mission, vehicle, options.seed),
        measure_recharge(mission, vehicle, options.seed, vehicle.loads.attitude_control_w),
    )
    found = rules(mission, vehicle, slews, recharges)
    table = to_markdown(found, slews, vehicle)
    options.out.mkdir(parents=True, exist_ok=True)
    files = {
        f"{NAME}.csv": to_csv([{**vars(rule), "holds": rule.holds} for rule in found]),
        f"{NAME}.md": table,
        f"{NAME}_slews.csv": to_csv([record(slew) for slew in slews]),
    }
    print(table)
    for name, text in files.items():
        print(f"written: {write_atomically(options.out / name, text)}")
    kept.forget()
    return 0


if __name__ == "__main__":
    sys.exit(main())
