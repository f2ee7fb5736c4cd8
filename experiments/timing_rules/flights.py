"""Slews and recharges of the simulated spacecraft, from which `timing_rules` takes its durations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import Leg, Mode
from scp_recon.physics import geometry
from scp_recon.physics.frames import unit
from scp_recon.spacecraft.basilisk.optional import needing_basilisk
from scp_recon.spacecraft.flight import Flight
from scp_recon.spacecraft.guidance import FlightPlan, sun_pointing
from scp_recon.spacecraft.outcome import attitude_error, settling_time, state_of_charge
from scp_recon.spacecraft.panels import SolarArray, irradiance
from scp_recon.spacecraft.vehicle import Vehicle

Array = npt.NDArray[np.float64]

SLEW_S, RECHARGE_S = 2400.0, 1800.0
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
    with needing_basilisk("python -m experiments.timing_rules"):
        from scp_recon.spacecraft.basilisk.plant import Start
        from scp_recon.spacecraft.basilisk.simulation import Draws, Simulator, Source, sensor_sigmas
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
