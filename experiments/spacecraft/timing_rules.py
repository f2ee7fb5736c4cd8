"""Measure the durations that the schedule's rules assume.

The rules are for a slew to steady state, for heating the thruster and for a recharge from empty. Half
turns about many axes with noisy sensors and actuators and spinning wheels, and a recharge in
sun-pointing mode, are simulated; the durations go to OUT/timing_rules.csv, the slews to
timing_rules_slews.csv.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.harness import Findings, Record, Session, Study, default_mission
from formulations.arrays import Array
from scp_recon.errors import needing
from scp_recon.mission.schedule import Leg, Mode
from scp_recon.physics import geometry
from scp_recon.physics.frames import unit
from scp_recon.simulation.flight import Flight, attitude_error, settling_time, state_of_charge
from scp_recon.simulation.guidance import FlightPlan, sun_pointing
from scp_recon.simulation.panels import SolarArray, irradiance
from scp_recon.simulation.vehicle import Vehicle, load_vehicle

SLEWS, SEED = 20, 0
SLEW_S, RECHARGE_S = 2400.0, 1800.0
STEADY_DEG = (1.0, 0.5, 0.25)
"""Errors that steady state may mean; the last decides."""

FULL = 1.0 - 1e-9
SETTLED = {limit: f"settled_{limit:g}_deg_s" for limit in STEADY_DEG}
"""Columns of the times until the attitude error stays below each; inf if it never does."""


def coast(
    vehicle: Vehicle,
    commands: Rotation,
    attitude: Rotation,
    speeds: Array,
    seed: int,
) -> Flight:
    """Fly sun-pointing mode along the default flight's first arc with given commands, one a second.

    Attitudes lead from the body to J2000; the first one is at rest. The wheels start with `speeds`,
    rad/s, the battery with the vehicle's initial charge.

    Raises:
        InputError: if Basilisk is not installed.
    """
    with needing("python -m experiments timing_rules", "sim", "Basilisk"):
        from scp_recon.simulation.basilisk.plant import Start
        from scp_recon.simulation.basilisk.simulation import Draws, Simulator, Source, sensor_sigmas
    mission, times = default_mission(), np.arange(float(len(commands)))
    plan = FlightPlan(mission, vehicle, (), (Leg(Mode.SUN_POINTING, 0.0, times[-1]),), ())
    sources = frozenset(Source)
    draws = Draws.of(plan, np.zeros(6), len(times), seed, sources)
    start = Start(mission.initial_state, attitude, np.zeros(3), speeds)
    sigmas = sensor_sigmas(vehicle.errors, sources)
    sim = Simulator(plan, commands, start, draws, sigmas, times)
    sim.run()
    return sim.flight()


def measure_slew(index: int) -> Record:
    """A half turn about a principal axis of the body (the first three) or a random one: a row.

    The turn ends where the star tracker sees stars, as in every mode: otherwise the gyro's random walk
    leaves no steady state. The wheels start with a random momentum below that of a dump. The row has
    the wheels' largest speed over the largest allowed, and the error's root mean square in the last
    five minutes.
    """
    rng, vehicle = np.random.default_rng([SEED, index]), load_vehicle()
    axis = unit(np.eye(3)[index] if index < 3 else rng.normal(size=3))
    end, sun = Rotation.random(rng=rng), default_mission().sun_direction(0.0)
    exclusion = np.deg2rad(vehicle.sensors.star_tracker_sun_exclusion_deg)
    while geometry.angle(end.apply(unit(vehicle.sensors.star_tracker)), sun) <= exclusion:
        end = Rotation.random(rng=rng)
    begin = end * Rotation.from_rotvec(np.pi * axis)
    # Speeds that the pseudo-inverse makes: none turn against each other.
    speeds = np.linalg.pinv(unit(vehicle.wheels.axes).T) @ rng.normal(size=3)
    share = vehicle.wheels.dump_start * rng.uniform()
    speeds *= share * vehicle.wheels.speed_max_rad_s / np.abs(speeds).max()
    commands = Rotation.concatenate([end] * int(SLEW_S))
    flight = coast(vehicle, commands, begin, speeds, SEED + index)
    error = np.rad2deg(attitude_error(flight))
    return {
        **dict(zip(("axis_x", "axis_y", "axis_z"), axis.tolist(), strict=True)),
        "wheel_share": share,
        **{column: settling_time(error, limit) for limit, column in SETTLED.items()},
        "steady_rms_deg": float(np.sqrt((error[-300:] ** 2).mean())),
    }


def measure_recharge(vehicle: Vehicle, extra_w: float = 0.0) -> float:
    """Time in s until batteries that start empty are full, in sun-pointing mode; inf if never.

    `extra_w` is drawn besides the quiescent load.
    """
    battery, loads = vehicle.battery, vehicle.loads
    empty = vehicle.model_copy(
        update={
            "battery": battery.model_copy(update={"initial_charge": 0.0}),
            "loads": loads.model_copy(update={"quiescent_w": loads.quiescent_w + extra_w}),
        }
    )
    mission, times = default_mission(), np.arange(RECHARGE_S)
    panels = SolarArray.of(vehicle, irradiance(mission.scenario))
    sun, position = mission.sun_direction(times), mission.initial_state[:3]
    commands = Rotation.from_matrix(
        sun_pointing(panels, unit(vehicle.sensors.camera), sun, position)
    )
    speeds = np.zeros(len(vehicle.wheels.axes))
    flight = coast(empty, commands, commands[0], speeds, SEED)
    full = np.flatnonzero((state_of_charge(flight) >= FULL).all(axis=1))
    return float(full[0]) if len(full) else np.inf


def rules(vehicle: Vehicle, slews: Sequence[Record], recharges_s: Sequence[float]) -> list[Record]:
    """Rows of the schedule's durations beside the measured ones.

    The recharge has two rows: quiescent, and with the attitude control's reserve drawn.
    """
    allowed, loads = default_mission().scenario.schedule, vehicle.loads
    worst = max(slew[SETTLED[STEADY_DEG[-1]]] for slew in slews)
    heating = vehicle.chemical_thruster.heating_s
    found = [
        ("slew to steady state", worst, allowed.attitude_s, f"worst of {len(slews)} half turns"),
        ("thruster heating", heating, allowed.heating_s, "the thruster's data"),
    ]
    for extra_w, time_s in zip((0.0, loads.attitude_control_w), recharges_s, strict=True):
        drawn = f"{loads.quiescent_w + extra_w:g} W drawn"
        found.append(("recharge from empty", time_s, allowed.recharge_s, drawn))
    names = ("name", "measured_s", "allowed_s", "how", "holds")
    return [dict(zip(names, (*rule, rule[1] <= rule[2]), strict=True)) for rule in found]


def figures(slews: Sequence[Record], vehicle: Vehicle) -> list[Record]:
    """The steady error of the half turns, and the charge that a warm-up in the dark leaves.

    Full batteries alone carry the warm-up; a charge below zero says that they cannot.
    """
    battery = vehicle.battery
    drawn_wh = vehicle.loads.warm_up_w * vehicle.chemical_thruster.heating_s / 3600.0
    left = 1.0 - drawn_wh / battery.efficiency / (battery.count * battery.capacity_wh)
    steady = max(slew["steady_rms_deg"] for slew in slews)
    found = {
        "error in steady state, largest root mean square, deg": steady,
        "charge after a warm-up that no panel helps": left,
        "floor of the charge": battery.floor_charge,
    }
    return [{"figure": figure, "value": value} for figure, value in found.items()]


def run(session: Session) -> Findings:
    """Simulate half turns and recharges."""
    vehicle = load_vehicle()
    slews = session.rows("slews", measure_slew, range(SLEWS), session.store())
    extra_w = (0.0, vehicle.loads.attitude_control_w)
    found = rules(vehicle, slews, [measure_recharge(vehicle, more) for more in extra_w])
    tables = {"timing_rules": found, "timing_rules_slews": slews}
    return Findings(tables | {"figures": figures(slews, vehicle)})


STUDY = Study(__doc__, run)
