"""Simulate a solution's flight: Basilisk's spacecraft under control, with chosen sources of error."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from Basilisk.architecture import sysModel
from Basilisk.utilities import SimulationBaseClass, macros
from scipy.spatial.transform import Rotation

from formulations.arrays import Array
from scp_recon.physics.frames import unit
from scp_recon.results.solution import Solution
from scp_recon.simulation.basilisk.control import build_flight_software
from scp_recon.simulation.basilisk.navigation import build_sensors
from scp_recon.simulation.basilisk.plant import STEP_S, SURROUNDINGS_S, Start, build_plant
from scp_recon.simulation.basilisk.power import Bus
from scp_recon.simulation.estimator import AttitudeFilter, SensorSigmas
from scp_recon.simulation.flight import Flight
from scp_recon.simulation.guidance import CONTROL_PERIOD_S, FlightPlan
from scp_recon.simulation.vehicle import Errors, Vehicle

ARCSEC = np.deg2rad(1.0 / 3600.0)


class Source(StrEnum):
    """A source of error; the names are those of the vehicle's errors."""

    SUN_SENSOR = "sun_sensor"
    STAR_TRACKER = "star_tracker"
    IMU = "imu"
    MICRO_THRUSTER = "micro_thruster"
    CHEMICAL_THRUSTER = "chemical_thruster"
    INITIAL_STATE = "initial_state"


@dataclass(frozen=True)
class Draws:
    """Errors drawn with one seed; leaving a source out does not change the others' draws."""

    initial: Array
    burns: Array
    pulses: Array
    seeds: dict[str, int]

    @classmethod
    def of(
        cls,
        plan: FlightPlan,
        initial_factor: Array,
        periods: int,
        seed: int,
        sources: Collection[Source],
    ) -> Draws:
        """Draw the errors of the sources; the initial state's by a factor (6, 6) of its covariance."""
        children = np.random.SeedSequence(seed).spawn(len(Source))
        stream = dict(zip(Source, children, strict=True))

        def normal(source: Source, *shape: int) -> Array:
            draws = np.random.default_rng(stream[source]).standard_normal(shape)
            return draws if source in sources else np.zeros(shape)

        errors, thrusters = plan.vehicle.errors, len(plan.vehicle.micro_thrusters.directions)
        return cls(
            initial=initial_factor @ normal(Source.INITIAL_STATE, 6),
            burns=errors.chemical_thruster * normal(Source.CHEMICAL_THRUSTER, len(plan.firings)),
            pulses=errors.micro_thruster_n * normal(Source.MICRO_THRUSTER, periods, thrusters),
            seeds={s.value: int(c.generate_state(1)[0]) for s, c in stream.items()},
        )


def simulate(
    solution: Solution,
    vehicle: Vehicle,
    seed: int = 0,
    *,
    sources: Collection[Source] = frozenset(Source),
    initial_sigma_fraction: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> Flight:
    """Simulate a solution's flight; a source of error that is left out is perfect.

    The initial state's 1 sigma is a fraction of each component, or the scenario's uncertainty.
    `progress` is called now and then with the simulated time in s.

    Raises:
        InputError: if the solution's scenario has no window or breaks a rule of the schedule.
    """
    mission = solution.mission
    plan = FlightPlan.of(solution, mission, vehicle)
    times = CONTROL_PERIOD_S * np.arange(round(plan.end_s / CONTROL_PERIOD_S) + 1.0)
    factor = mission.initial_factor
    if initial_sigma_fraction is not None:
        factor = np.diag(initial_sigma_fraction * np.abs(mission.initial_state))
    draws = Draws.of(plan, factor, len(times), seed, sources)
    commands = plan.attitudes(times)
    start = Start(
        mission.initial_state + draws.initial,
        commands[0],
        (commands[0].inv() * commands[1]).as_rotvec() / CONTROL_PERIOD_S,
        np.zeros(len(vehicle.wheels.axes)),
    )
    sigmas = sensor_sigmas(vehicle.errors, sources)
    sim = Simulator(plan, commands, start, draws, sigmas, times)
    sim.run(progress)
    return sim.flight()


def sensor_sigmas(errors: Errors, sources: Collection[Source]) -> SensorSigmas:
    """1-sigma of the measurements, zero where a source is left out."""
    return SensorSigmas(
        star_tracker=errors.star_tracker_arcsec * ARCSEC * (Source.STAR_TRACKER in sources),
        gyro=errors.imu_rad_s * CONTROL_PERIOD_S * (Source.IMU in sources),
        sun_sensor=errors.sun_sensor_rad * (Source.SUN_SENSOR in sources),
    )


class Simulator:
    """Basilisk's simulation of a flight, ready to run; commands are from the body to J2000."""

    def __init__(
        self,
        plan: FlightPlan,
        commands: Rotation,
        start: Start,
        draws: Draws,
        sigmas: SensorSigmas,
        times_s: Array,
    ) -> None:
        self.plan, self.times_s = plan, times_s
        field = plan.mission.truth_field
        self.plant = build_plant(plan.mission, plan.vehicle, start, field=field)
        sensors = build_sensors(
            self.plant.hub.scStateOutMsg,
            self.plant.surroundings,
            plan.vehicle,
            sigmas,
            draws.seeds,
        )
        # Designed for all errors: the filter cannot know which sources are left out, and one that took
        # the gyro for perfect would in time ignore the star tracker.
        expected = sensor_sigmas(plan.vehicle.errors, frozenset(Source))
        estimate = AttitudeFilter(
            start.attitude.as_quat(scalar_first=True), expected, expected.star_tracker
        )
        software, self.navigator, self.allocator, self.firer = build_flight_software(
            plan, commands, self.plant, sensors, estimate, times_s, draws.pulses, draws.burns
        )
        self.bus = Bus(plan, self.plant, self.firer, times_s)
        period = macros.sec2nano(CONTROL_PERIOD_S)
        self._states = self.plant.hub.scStateOutMsg.recorder(period)
        self._wheels = self.plant.wheels.rwSpeedOutMsg.recorder(period)
        self.sim = _schedule(
            {
                "surroundings": (SURROUNDINGS_S, [self.plant.surroundings]),
                "dynamics": (STEP_S, [*self.plant.effectors[1:], self.plant.hub]),
                "software": (CONTROL_PERIOD_S, [*sensors.models, *software]),
                "power": (CONTROL_PERIOD_S, [*self.bus.models(), self._states, self._wheels]),
            }
        )

    def run(self, progress: Callable[[float], None] | None = None) -> None:
        """Fly to the end."""
        self.sim.InitializeSimulation()
        for time in np.append(np.arange(REPORT_S, self.times_s[-1], REPORT_S), self.times_s[-1]):
            self.sim.ConfigureStopTime(macros.sec2nano(float(time)))
            self.sim.ExecuteSimulation()
            if progress is not None:
                progress(float(time))
        self.bus.close()

    def flight(self) -> Flight:
        """The recorded flight."""
        states, bus = self._states, self.bus
        flown = np.hstack([states.r_CN_N, states.v_CN_N])
        attitudes = Rotation.from_mrp(states.sigma_BN)
        burns = self._executed_burns(attitudes)
        terminal = flown[-1]
        if self.plan.firings:
            last = round(self.plan.firings[-1].start_s / CONTROL_PERIOD_S)
            terminal = flown[last] + np.concatenate([np.zeros(3), burns[-1]])
        return Flight(
            plan=self.plan,
            times_s=self.times_s,
            states=flown,
            attitudes=attitudes,
            commands=self.navigator.commands,
            estimates=Rotation.from_quat(self.navigator.estimates, scalar_first=True),
            rates_rad_s=states.omega_BN_B,
            in_use=self.allocator.in_use,
            wheel_speeds_rad_s=self._wheels.wheelSpeeds[:, : len(self.plan.vehicle.wheels.axes)],
            micro_on_s=self.firer.on_time_s,
            panels_w=bus.generated,
            consumed_w=bus.consumed,
            lost_w=bus.lost,
            unused_w=bus.unused,
            short_w=bus.short,
            stored_wh=bus.stored_wh,
            burns_m_s=burns,
            dumps=self.allocator.dumps,
            terminal_state=terminal,
        )

    def _executed_burns(self, attitudes: Rotation) -> Array:
        """Executed burns, J2000, m/s: impulse over mass at the flown attitudes, shape (m, 3)."""
        directions = attitudes.apply(unit(self.plan.vehicle.chemical_thruster.direction))
        burns = np.zeros((len(self.plan.firings), 3))
        for i, firing in enumerate(self.plan.firings):
            if not firing.duration_s:
                continue
            during = slice(*np.searchsorted(self.times_s, [firing.start_s, firing.end_s]).tolist())
            ends = slice(during.start + 1, during.stop + 1)
            mean = 0.5 * (directions[during] + directions[ends]).mean(axis=0)
            size = np.linalg.norm(firing.dv_m_s) * (1.0 + self.firer.burn_error[i])
            burns[i] = size * mean
        return burns


REPORT_S = 200.0


def _schedule(
    tasks: Mapping[str, tuple[float, Sequence[sysModel.SysModel]]],
) -> SimulationBaseClass.SimBaseClass:
    """A simulation of tasks: period in s and models of each, all in the order of their execution."""
    sim = SimulationBaseClass.SimBaseClass()
    process = sim.CreateNewProcess("flight")
    for rank, (name, (period_s, models)) in enumerate(tasks.items()):
        process.addTask(sim.CreateNewTask(name, macros.sec2nano(period_s)), -rank)
        for model in models:
            sim.AddModelToTask(name, model)
    return sim
