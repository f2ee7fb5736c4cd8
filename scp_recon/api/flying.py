"""Fly a plan many times with errors, to a number or a tolerance, or once with the spacecraft."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from scp_recon.api.files import AnyPlan, solution_of
from scp_recon.api.keeping import results_beside
from scp_recon.api.planning import plan_left
from scp_recon.errors import (
    InputError,
    imported,
    make_whole,
    number_between,
    one_of,
    option,
    path_of,
    whole_number,
)
from scp_recon.files import writing
from scp_recon.jobs.cluster import check_workers, executor_for
from scp_recon.jobs.cores import one_thread
from scp_recon.mission.constraints import Miss, check_miss, drift_probability, planned_misses
from scp_recon.mission.gravity import TruthModel
from scp_recon.monte_carlo.closed_loop import replans
from scp_recon.monte_carlo.drifts import fly_drifts, safety_of
from scp_recon.monte_carlo.flights import (
    LIMITS,
    SAMPLES_MAX,
    SAMPLES_MIN,
    SEED_MAX,
    FlightConfig,
    FlightTally,
    fly_many,
)
from scp_recon.monte_carlo.sampling import AnyPolicy, ErrorModel, PolicyKind, policy_kind
from scp_recon.monte_carlo.summarise import summarise
from scp_recon.monte_carlo.summary import FILE_NAME, MARK, Contingency, Summary
from scp_recon.replanning.flown import FlownPlan
from scp_recon.replanning.remainder import Delivery, mission_left, with_goal
from scp_recon.results.solution import Solution, burns_of_plan, require_whole_flight
from scp_recon.simulation import record as records
from scp_recon.simulation.vehicle import Vehicle, load_vehicle


@dataclass(frozen=True)
class FlyOptions:
    """The checked options of `fly`.

    Attributes: those that `api.plan_verbs.fly` describes.

    Raises:
        InputError: if an option is out of range, or in conflict with another.
    """

    samples: int = 10_000
    until: float | None = None
    truth: TruthModel = "planner"
    errors: ErrorModel | None = None
    seed: int = 0
    workers: int | None = None
    scheduler: str | None = None
    policy: PolicyKind | None = None
    miss: int | None = None
    then: Literal["return"] | None = None

    def __post_init__(self) -> None:
        make_whole(self, "samples", SAMPLES_MIN, SAMPLES_MAX)
        make_whole(self, "seed", 0, SEED_MAX)
        if (
            self.until is not None
            and not 0.0 < number_between(option("until"), self.until, 0, 1) < 1
        ):
            raise InputError(option("until"), repr(self.until), "must be a width between 0 and 1")
        one_of(option("truth"), self.truth, get_args(TruthModel))
        if self.errors is not None:
            one_of(option("errors"), self.errors, get_args(ErrorModel))
        if self.policy is not None:
            one_of(option("policy"), self.policy, get_args(PolicyKind))
        if self.then is not None:
            one_of(option("then"), self.then, ("return",))
            if self.miss is None:
                raise InputError(option("then"), self.then, f"goes with {option('miss')}")
        workers = check_workers(self.workers, self.scheduler, 1)
        object.__setattr__(self, "workers", workers)


@dataclass(frozen=True)
class Watcher:
    """Observes the flights, and may stop them.

    Attributes:
        progress: called with the number of flights so far.
        stop: returns whether to stop.
        say: called with each line worth showing.
    """

    progress: Callable[[int], None] | None = None
    stop: Callable[[], bool] = lambda: False
    say: Callable[[str], None] = lambda _: None


def flown_summary(plan: Solution, options: FlyOptions) -> Summary:
    """Fly a plan and summarise its flights."""
    config = config_of(plan, options)
    flown = _fly(config, options, Watcher())
    return _with_drift(summarise(flown, plan), plan, config, options)


@dataclass(frozen=True)
class SavedFlights:
    """Flights of a plan, summarised in a file.

    Attributes:
        flights: what was counted.
        path: file of the summary.
        summary: of the flights.
        interrupted: whether the flights were stopped before all were flown.
    """

    flights: FlightTally
    path: Path
    summary: Summary
    interrupted: bool


def fly_into(
    folder: Path, plan: Solution, options: FlyOptions, config: FlightConfig, watcher: Watcher
) -> SavedFlights:
    """Fly a plan, and write the summary into its folder, also of fewer flights after an interrupt.

    `config` is that of `config_of`.

    Raises:
        InputError: if the folder cannot be written, or holds another plan.
    """
    own = "feedback" if plan.corrections else "open"
    kind = policy_kind(config.policy)
    name = FILE_NAME if kind == own else f"montecarlo_{kind}.json"
    if options.miss is not None:
        name = f"{name.removesuffix('.json')}_miss_{options.miss}.json"
    with results_beside(folder, plan, name, "folder", MARK):
        flown = _fly(config, options, watcher)
        interrupted = watcher.stop() and flown.samples < options.samples
        summary = summarise(flown, plan)
        if not interrupted:
            summary = _with_drift(summary, plan, config, options)
        with writing(folder, "folder"):
            path = summary.write(folder, name)
    return SavedFlights(flown, path, summary, interrupted)


def config_of(plan: Solution, options: FlyOptions) -> FlightConfig:
    """The flights of a plan that options ask for.

    Raises:
        InputError: if the plan cannot be flown so.
    """
    burns, policy = plan.burns_m_s, _policy(plan, options.policy)
    check_miss(plan.scenario, options.miss)
    if options.then and options.miss == len(plan.scenario.burns.times_s):
        needs = "must leave a burn: `scp-recon replan --goal return` takes more in burns.times_s"
        raise InputError(option("then"), f"{options.then} after the last burn", needs)
    how = policy, options.truth, options.errors
    return FlightConfig(plan.mission, burns, *how, seed=options.seed)


def _with_drift(
    summary: Summary, plan: Solution, config: FlightConfig, options: FlyOptions
) -> Summary:
    """The summary with the drifts of its flights after the burn that is missed, if one is."""
    if options.miss is None:
        return summary
    mission, miss = config.mission, Miss(options.miss)
    flown = fly_drifts(config, [miss], config.first_draws(summary.samples, config.seed))
    required = (
        drift_probability(mission.scenario) if miss in planned_misses(mission.scenario) else None
    )
    found = safety_of(mission, miss, flown[0], required)
    then = None if options.then is None else _contingency(plan, options.miss, options)
    return summary.model_copy(update={"drift": found, "then": then})


def _contingency(plan: Solution, miss: int, options: FlyOptions) -> Contingency:
    """Plan home from the mean state at a missed burn, and fly that plan."""
    mission = plan.mission
    index = miss - 1 - mission.scenario.burns_flown
    state = np.array(plan.nodes.state[mission.burn_nodes[index]])
    state[3:] -= plan.burns_m_s[index]
    at_s = mission.scenario.burns.times_s[miss - 1]
    parent, delivery = (
        FlownPlan.of(plan),
        Delivery.of(at_s, state, measured={miss: np.zeros(3)}),
    )
    left = mission_left(parent, delivery, with_goal(parent, "return", None))
    home = plan_left(parent, left)
    flown = flown_summary(solution_of(home), replace(options, miss=None, then=None))
    return Contingency(
        status=home.status.value.name,
        total_dv_m_s=home.total_dv_m_s,
        burn_times_s=home.mission.scenario.burn_times_s,
        burns_m_s=tuple(burn.dv_m_s for burn in burns_of_plan(home)),
        whole_flight=flown.whole_flight,
    )


def _policy(plan: Solution, kind: PolicyKind | None) -> AnyPolicy:
    """Find the policy that commands the burns of a plan.

    Raises:
        InputError: if the plan cannot be flown by that policy.
    """
    if kind == "open":
        return ()
    if kind == "replan":
        if plan.problem != "P2":
            raise InputError(
                option("policy"), "'replan' of a plan of P3", "must be of a plan of P2"
            )
        return replans(plan.mission, plan.burns_m_s)
    if kind == "feedback" and not plan.corrections:
        raise InputError(
            option("policy"),
            "'feedback' of a plan without gains",
            "must be 'open' or 'replan', or the plan made with policy.kind = \"feedback\"",
        )
    return plan.corrections


@one_thread
def _fly(config: FlightConfig, options: FlyOptions, watcher: Watcher) -> FlightTally:
    workers = options.workers if options.workers != 1 else None  # this process is one
    executor = executor_for(workers or 0, options.scheduler, LIMITS, watcher.say)
    return fly_many(
        config,
        samples=options.samples,
        until=options.until,
        executor=executor,
        progress=watcher.progress,
        stop=watcher.stop,
    )


@dataclass(frozen=True, eq=False)
class Simulation:
    """A simulated flight that is checked and not flown yet.

    Attributes:
        solution: of the plan.
        seed: of all errors.
        policy: what commands its burns.
        craft: the vehicle.
        miss: number of the burn that does not happen, if one does not.
    """

    solution: Solution
    seed: int
    policy: AnyPolicy
    craft: Vehicle
    miss: int | None = None

    @one_thread
    def fly(self, progress: Callable[[float], None] | None = None) -> records.Record:
        """Fly it; `progress` is called with the time of the flight, s."""
        from scp_recon.simulation.basilisk import simulation

        flight = simulation.simulate(
            self.solution,
            self.craft,
            self.seed,
            progress=progress,
            policy=self.policy,
            miss=self.miss,
        )
        return records.make_record(flight, self.solution, self.seed)


def simulation_of(
    plan: AnyPlan,
    seed: int,
    policy: PolicyKind | None,
    vehicle: str | Path | None,
    miss: int | None = None,
) -> Simulation:
    """Check the arguments of `plan_verbs.simulate`.

    Raises:
        InputError: naming the argument, what was given and what is allowed.
    """
    imported("simulate", "sim", "Basilisk")
    seed = whole_number(option("seed"), seed, 0, SEED_MAX)
    solution = solution_of(plan)
    if policy is not None:
        one_of(option("policy"), policy, get_args(PolicyKind))
    craft = load_vehicle(None if vehicle is None else path_of(option("vehicle"), vehicle))
    require_whole_flight(solution.scenario, option("plan"))
    check_miss(solution.scenario, miss)
    return Simulation(solution, seed, _policy(solution, policy), craft, miss)
