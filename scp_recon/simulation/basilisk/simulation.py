"""Simulate a solution's flight: Basilisk's spacecraft under control, with chosen sources of error."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from Basilisk.architecture import sysModel
from Basilisk.utilities import SimulationBaseClass, macros
from scipy.spatial.transform import Rotation

from formulations.arrays import Array
from scp_recon.errors import InputError
from scp_recon.mission.constraints import require_without
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.closed_loop import MEASURED
from scp_recon.monte_carlo.drifts import reach_s
from scp_recon.monte_carlo.sampling import AnyPolicy, policy_kind, start_loop
from scp_recon.results.solution import Solution
from scp_recon.simulation.basilisk.control import Sensors, build_flight_software
from scp_recon.simulation.basilisk.plant import STEP_S, SURROUNDINGS_S, Plant, Start
from scp_recon.simulation.estimator import AttitudeFilter, SensorSigmas
from scp_recon.simulation.flight import Flight
from scp_recon.simulation.guidance import CONTROL_PERIOD_S, FlightPlan
from scp_recon.simulation.vehicle import Errors, Vehicle

ARCSEC = np.deg2rad(1.0 / 3600.0)
REPORT_S = 200.0


class Source(StrEnum):
    """A source of error; names that the vehicle's errors have are theirs.

    A new one goes last, so that the others' draws stay as they are.
    """

    SUN_SENSOR = "sun_sensor"
    STAR_TRACKER = "star_tracker"
    IMU = "imu"
    MICRO_THRUSTER = "micro_thruster"
    CHEMICAL_THRUSTER = "chemical_thruster"
    INITIAL_STATE = "initial_state"
    NAVIGATION = "navigation"


@dataclass(frozen=True)
class Draws:
    """Errors drawn with one seed; leaving a source out does not change the others' draws.

    Those of sensors are drawn by Basilisk, with the sigmas and the seeds of the sources.
    """

    initial: Array
    burns: Array
    pulses: Array
    measured: Array
    sigmas: SensorSigmas
    seeds: dict[str, int]

    @classmethod
    def of(
        cls,
        plan: FlightPlan,
        initial_factor: Array,
        periods: int,
        seed: int,
        sources: Collection[Source],
        cut_offs: int = 0,
    ) -> Draws:
        """Draw the errors of the sources.

        The initial state's by a factor (6, 6) of its covariance; those of states measured at cut-offs
        are standard normal numbers, shape (1, 6 cut_offs).
        """
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
            measured=normal(Source.NAVIGATION, 1, MEASURED * cut_offs),
            sigmas=sensor_sigmas(errors, sources),
            seeds={s.value: int(c.generate_state(1)[0]) for s, c in stream.items()},
        )


def simulate(
    solution: Solution,
    vehicle: Vehicle,
    seed: int = 0,
    *,
    sources: Collection[Source] = frozenset(Source),
    progress: Callable[[float], None] | None = None,
    policy: AnyPolicy = (),
    miss: int | None = None,
) -> Flight:
    """Simulate a solution's flight; a source of error that is left out is perfect.

    `progress` is called now and then with the simulated time in s. A policy commands burns at their
    cut-offs, from the true state then with the errors of its measurement. If a burn is missed, no burn
    follows, and the flight goes on until the end of the drift.

    Raises:
        InputError: if the solution's scenario has no window or breaks a rule of the schedule, or its
            body has a companion or tumbles.
    """
    mission = solution.mission
    body = mission.scenario.body
    if body.companion is not None or body.attitude is not None:
        entry, given = "body.companion", f"a companion of {body.name}"
        if body.attitude is not None:
            entry, given = "body.attitude", f"{body.name} tumbling"
        raise InputError(entry, given, "cannot be simulated: one body alone turns evenly there")
    needs = "montecarlo: one known body is simulated"
    require_without(("knowledge",), mission.scenario, needs)
    plan, burns = FlightPlan.of(solution, mission, vehicle), solution.burns_m_s
    end_s = plan.end_s
    if miss is not None:
        burns[miss - 1 :] = 0.0
        plan = plan.with_burns(burns)
        policy = policy[: sum(one.burn < miss - 1 for one in policy)]
        end_s = max(end_s, plan.firings[miss - 1].start_s + reach_s(mission))
    times = CONTROL_PERIOD_S * np.arange(round(end_s / CONTROL_PERIOD_S) + 1.0)
    draws = Draws.of(plan, mission.initial_factor, len(times), seed, sources, len(policy))
    commands = plan.attitudes(times)
    start = Start(
        mission.initial_state + draws.initial,
        commands[0],
        (commands[0].inv() * commands[1]).as_rotvec() / CONTROL_PERIOD_S,
        np.zeros(len(vehicle.wheels.axes)),
    )
    sim = Simulator(plan, commands, start, draws, times)
    sim.run(progress, Commander(mission, burns, policy, draws.measured))
    return replace(sim.flight(), policy=policy_kind(policy), miss=miss)


def sensor_sigmas(errors: Errors, sources: Collection[Source]) -> SensorSigmas:
    """1-sigma of the measurements, zero where a source is left out."""
    return SensorSigmas(
        star_tracker=errors.star_tracker_arcsec * ARCSEC * (Source.STAR_TRACKER in sources),
        gyro=errors.imu_rad_s * CONTROL_PERIOD_S * (Source.IMU in sources),
        sun_sensor=errors.sun_sensor_rad * (Source.SUN_SENSOR in sources),
    )


class Commander:
    """Commands the burns of one flight by a policy, from its measurements; J2000, m and m/s.

    Args:
        mission: that is flown.
        burns_m_s: planned, shape (m, 3).
        policy: that commands them.
        draws: standard normal numbers of its measurements, shape (1, 6 k).
    """

    def __init__(self, mission: Mission, burns_m_s: Array, policy: AnyPolicy, draws: Array) -> None:
        self._planned, self._policy, self._measured = burns_m_s, policy, 0
        self._loop = start_loop(mission, burns_m_s, policy, draws)
        # The last control period before a cut-off at its burn, which is commanded at its start.
        firing = mission.scenario.burn_times_s
        self.stops_s: list[float] = [
            CONTROL_PERIOD_S
            * math.floor(min(one.cut_off_s / CONTROL_PERIOD_S, firing[one.burn] - 1.0))
            for one in policy
        ]

    def burns_m_s(self, state: Array) -> Array:
        """All burns as they stand after the next stop with the true state (6,), shape (m, 3)."""
        now, until = self.stops_s[self._measured], self._policy[self._measured].cut_off_s
        state = state + np.concatenate([(until - now) * state[3:], np.zeros(3)])
        self._loop.measure(state[:, None])
        self._measured += 1
        burns = self._planned.copy()
        for one in self._policy[: self._measured]:
            correction = self._loop.correction(one.burn)
            burns[one.burn] += 0.0 if correction is None else correction[0]
        return burns


class Simulator:
    """Basilisk's simulation of a flight, ready to run; commands are from the body to J2000."""

    def __init__(
        self,
        plan: FlightPlan,
        commands: Rotation,
        start: Start,
        draws: Draws,
        times_s: Array,
    ) -> None:
        self.plan, self.times_s = plan, times_s
        field = plan.mission.scene.harmonics
        self.plant = Plant(plan.mission, plan.vehicle, start, field=field)
        sensors = Sensors(self.plant, draws.sigmas, draws.seeds)
        # Designed for all errors: the filter cannot know which sources are left out, and one that took
        # the gyro for perfect would in time ignore the star tracker.
        expected = sensor_sigmas(plan.vehicle.errors, frozenset(Source))
        estimate = AttitudeFilter(
            start.attitude.as_quat(scalar_first=True), expected, expected.star_tracker
        )
        software, self.navigator, self.allocator, self.firer = build_flight_software(
            plan, commands, self.plant, sensors, estimate, times_s, draws.pulses, draws.burns
        )
        period = macros.sec2nano(CONTROL_PERIOD_S)
        self._states = self.plant.hub.scStateOutMsg.recorder(period)
        self._wheels = self.plant.wheels.rwSpeedOutMsg.recorder(period)
        tasks: dict[str, tuple[float, list[sysModel.SysModel]]] = {
            "surroundings": (SURROUNDINGS_S, [self.plant.surroundings]),
            "dynamics": (STEP_S, [*self.plant.effectors[1:], self.plant.hub]),
            "software": (CONTROL_PERIOD_S, [*sensors.models, *software]),
            "record": (CONTROL_PERIOD_S, [self._states, self._wheels]),
        }
        self.sim = SimulationBaseClass.SimBaseClass()
        process = self.sim.CreateNewProcess("flight")
        for rank, (name, (period_s, models)) in enumerate(tasks.items()):  # in their order
            process.addTask(self.sim.CreateNewTask(name, macros.sec2nano(period_s)), -rank)
            for model in models:
                self.sim.AddModelToTask(name, model)

    def run(
        self,
        progress: Callable[[float], None] | None = None,
        commander: Commander | None = None,
    ) -> None:
        """Fly to the end; a commander changes burns at its cut-offs."""
        self.sim.InitializeSimulation()
        end = float(self.times_s[-1])
        stops = [] if commander is None else commander.stops_s
        for time in sorted({*np.arange(REPORT_S, end, REPORT_S).tolist(), *stops, end}):
            self.sim.ConfigureStopTime(macros.sec2nano(time))
            self.sim.ExecuteSimulation()
            if commander is not None and time in stops:
                now = self.plant.hub.scStateOutMsg.read()
                state = np.concatenate([now.r_CN_N, now.v_CN_N])
                self.plan = self.plan.with_burns(commander.burns_m_s(state))
                self.allocator.plan = self.firer.plan = self.plan
                k = int(np.searchsorted(self.times_s, time, side="right"))
                past, coming = self.navigator.commands[:k], self.plan.attitudes(self.times_s)[k:]
                self.navigator.follow(Rotation.concatenate([past, coming]))
            if progress is not None:
                progress(time)

    def flight(self) -> Flight:
        """The recorded flight."""
        states = self._states
        return Flight(
            plan=self.plan,
            times_s=self.times_s,
            states=np.hstack([states.r_CN_N, states.v_CN_N]),
            attitudes=Rotation.from_mrp(states.sigma_BN),
            commands=self.navigator.commands,
            estimates=Rotation.from_quat(self.navigator.estimates, scalar_first=True),
            rates_rad_s=states.omega_BN_B,
            in_use=self.allocator.in_use,
            wheel_speeds_rad_s=self._wheels.wheelSpeeds[:, : len(self.plan.vehicle.wheels.axes)],
            micro_on_s=self.firer.on_time_s,
            burn_error=self.firer.burn_error,
            dumps=self.allocator.dumps,
        )
