"""The schedule's durations, measured: `python -m experiments.timing_rules`.

The schedule allows so much for a slew to steady state, for heating the thruster and for a recharge
from empty. Half turns about many axes with noisy sensors and actuators and spinning wheels, and a
recharge in sun-pointing mode, are simulated; the durations go to OUT/timing_rules.csv and .md, the
slews to timing_rules_slews.csv.
"""

from __future__ import annotations

from scp_recon.command import starting

if __name__ == "__main__":
    starting()

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import track
from scipy.spatial.transform import Rotation

from experiments.studies import Cell, add_out, markdown, run, to_csv
from scp_recon import geometry
from scp_recon.errors import InputError
from scp_recon.files import write_atomically
from scp_recon.frames import unit
from scp_recon.mission import Mission
from scp_recon.options import whole
from scp_recon.scenario import load_scenario
from scp_recon.schedule import Leg, Mode
from scp_recon.spacecraft.flight import Flight
from scp_recon.spacecraft.guidance import FlightPlan, sun_pointing
from scp_recon.spacecraft.outcome import attitude_error, settling_time, state_of_charge
from scp_recon.spacecraft.panels import SolarArray, irradiance
from scp_recon.spacecraft.vehicle import Vehicle, load_vehicle

Array = npt.NDArray[np.float64]

NAME = "timing_rules"
DEFAULT_OUT = Path("runs") / NAME
SLEWS, SLEW_S, RECHARGE_S = 20, 2400.0, 1800.0
STEADY_DEG = (1.0, 0.5, 0.25)
"""Errors that steady state may mean; the last decides."""

FULL = 1.0 - 1e-9


@dataclass(frozen=True)
class Slew:
    """A half turn.

    Attributes:
        axis: body frame, shape (3,).
        wheel_share: largest wheel speed at its start over the largest there is.
        settling_s: until the attitude error stays below each of `STEADY_DEG`; inf if it never does.
        steady_deg: root mean square error in the last five minutes.
    """

    axis: Array
    wheel_share: float
    settling_s: tuple[float, ...]
    steady_deg: float


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


def coast(
    mission: Mission,
    vehicle: Vehicle,
    commands: Rotation,
    attitude: Rotation,
    speeds: Array,
    seed: int,
) -> Flight:
    """Fly sun-pointing mode along the mission's first arc with given commands, one a second.

    Args:
        mission: where.
        vehicle: what flies; its battery starts as charged as it says.
        commands: attitudes, from the body to J2000.
        attitude: the first one, at rest.
        speeds: of the wheels at the start, rad/s.
        seed: of all errors.

    Raises:
        InputError: if Basilisk is not installed.
    """
    try:
        from scp_recon.spacecraft.plant import Start
        from scp_recon.spacecraft.simulation import Draws, Simulator, Source, sensor_sigmas
    except ModuleNotFoundError as error:
        if not (error.name or "").startswith("Basilisk"):
            raise
        raise InputError("Basilisk", f"no module {error.name}", "needs the extra [sim]") from None
    times = np.arange(float(len(commands)))
    plan = FlightPlan(mission, vehicle, (), (Leg(Mode.SUN_POINTING, 0.0, times[-1]),), ())
    sources = frozenset(Source)
    draws = Draws.of(plan, np.zeros(6), len(times), seed, sources)
    start = Start(mission.initial_state, attitude, np.zeros(3), speeds)
    sigmas = sensor_sigmas(vehicle.errors, sources)
    sim = Simulator(plan, commands, start, draws, sigmas, times)
    sim.run()
    return sim.flight()


def measure_slew(mission: Mission, vehicle: Vehicle, index: int, seed: int) -> Slew:
    """A half turn about a principal axis (the first three) or a random one.

    It ends where the star tracker sees stars, as in every mode: otherwise the gyro's random walk
    leaves no steady state. The wheels start with a random momentum, below what is dumped.
    """
    rng = np.random.default_rng([seed, index])
    axis = np.eye(3)[index] if index < 3 else rng.normal(size=3)
    axis = unit(axis)
    end, sun = Rotation.random(rng=rng), mission.sun_direction(0.0)
    exclusion = np.deg2rad(vehicle.sensors.star_tracker_sun_exclusion_deg)
    while geometry.angle(end.apply(unit(vehicle.sensors.star_tracker)), sun) <= exclusion:
        end = Rotation.random(rng=rng)
    begin = end * Rotation.from_rotvec(np.pi * axis)
    # Speeds that the pseudo-inverse makes: none turn against each other.
    speeds = np.linalg.pinv(unit(vehicle.wheels.axes).T) @ rng.normal(size=3)
    share = vehicle.wheels.dump_start * rng.uniform()
    speeds *= share * vehicle.wheels.speed_max_rad_s / np.abs(speeds).max()
    commands = Rotation.concatenate([end] * int(SLEW_S))
    flight = coast(mission, vehicle, commands, begin, speeds, seed + index)
    error = np.rad2deg(attitude_error(flight))
    settling = [settling_time(error, limit) for limit in STEADY_DEG]
    return Slew(axis, share, tuple(settling), float(np.sqrt((error[-300:] ** 2).mean())))


def measure_recharge(mission: Mission, vehicle: Vehicle, seed: int, extra_w: float = 0.0) -> float:
    """Time in s until batteries that start empty are full, in sun-pointing mode; inf if never.

    Args:
        mission: where.
        vehicle: what flies.
        seed: of all errors.
        extra_w: drawn besides the quiescent load.
    """
    battery, loads = vehicle.battery, vehicle.loads
    empty = vehicle.model_copy(
        update={
            "battery": battery.model_copy(update={"initial_charge": 0.0}),
            "loads": loads.model_copy(update={"quiescent_w": loads.quiescent_w + extra_w}),
        }
    )
    times = np.arange(RECHARGE_S)
    panels = SolarArray.of(vehicle, irradiance(mission.scenario))
    sun, position = mission.sun_direction(times), mission.initial_state[:3]
    commands = Rotation.from_matrix(
        sun_pointing(panels, unit(vehicle.sensors.camera), sun, position)
    )
    speeds = np.zeros(len(vehicle.wheels.axes))
    flight = coast(mission, empty, commands, commands[0], speeds, seed)
    full = np.flatnonzero((state_of_charge(flight) >= FULL).all(axis=1))
    return float(full[0]) if len(full) else np.inf


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


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog=f"python -m experiments.{NAME}", description=__doc__)
    add_out(p, DEFAULT_OUT)
    p.add_argument(
        "--slews",
        type=whole(3, 10_000),
        default=SLEWS,
        metavar="N",
        help=f"half turns (default: {SLEWS})",
    )
    p.add_argument(
        "--seed",
        type=whole(0, 2**32 - 1),
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
    return run(_run, parser().parse_args(arguments))


def _run(options: argparse.Namespace) -> int:
    mission, vehicle = Mission.from_scenario(load_scenario()), load_vehicle(options.vehicle)
    indices = track(range(options.slews), "slews", console=Console(stderr=True))
    slews = [measure_slew(mission, vehicle, index, options.seed) for index in indices]
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
    return 0


if __name__ == "__main__":
    sys.exit(main())
