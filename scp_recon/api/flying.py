"""Fly a plan many times with errors, to a number or a tolerance, or once with the spacecraft."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np

from scp_recon.api.files import AnyPlan, results_beside, solution_of
from scp_recon.api.planning import plan_left
from scp_recon.errors import (
    InputError,
    imported,
    make_whole,
    number_between,
    one_of,
    only_with,
    option,
    path_of,
    whole_number,
)
from scp_recon.files import writing
from scp_recon.jobs.cluster import check_workers, executor_for
from scp_recon.jobs.cores import one_thread
from scp_recon.mission.constraints import Miss, check_miss, drift_probability, planned_misses
from scp_recon.mission.scene import TruthModel
from scp_recon.monte_carlo.closed_loop import replans
from scp_recon.monte_carlo.drifts import fly_drifts, safety_of
from scp_recon.monte_carlo.flights import (
    LIMITS,
    SAMPLES_MAX,
    SAMPLES_MIN,
    SEED_MAX,
    FlightTally,
    fly_many,
)
from scp_recon.monte_carlo.sampling import AnyPolicy, ErrorModel, Flyer, PolicyKind, policy_kind
from scp_recon.monte_carlo.summarise import summarise
from scp_recon.monte_carlo.summary import FILE_NAME, MARK, Contingency, Summary
from scp_recon.replanning.flown import FlownPlan
from scp_recon.replanning.remainder import Delivery, with_goal
from scp_recon.results.solution import Solution, burns_of_plan, require_whole_flight
from scp_recon.simulation import record as records
from scp_recon.simulation.vehicle import Vehicle, load_vehicle

Then = Literal["return"]


@dataclass(frozen=True)
class FlyOptions:
    """The checked options of `fly`.

    Attributes: those that `api.plan_verbs.fly` describes.
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
    then: Then | None = None

    def __post_init__(self) -> None:
        make_whole(self, "samples", SAMPLES_MIN, SAMPLES_MAX)
        make_whole(self, "seed", 0, SEED_MAX)
        until = self.until
        if until is not None and not 0.0 < number_between(option("until"), until, 0, 1) < 1:
            raise InputError(option("until"), repr(until), "must be a width between 0 and 1")
        one_of(option("truth"), self.truth, get_args(TruthModel))
        for name, kind in (("errors", ErrorModel), ("policy", PolicyKind), ("then", Then)):
            if (given := getattr(self, name)) is not None:
                one_of(option(name), given, get_args(kind))
        if self.miss is None:
            only_with(option("miss"), then=self.then)
        workers = check_workers(self.workers, self.scheduler, 1)
        object.__setattr__(self, "workers", workers)


class SavedFlights(NamedTuple):
    """Flights of a plan, summarised in a file; `widest` is the interval of all joint probabilities."""

    path: Path
    summary: Summary
    widest: float
    interrupted: bool


@dataclass(frozen=True, eq=False)
class Flights:
    """Many flights of a plan that are checked and not flown yet."""

    plan: Solution
    options: FlyOptions
    config: Flyer

    @classmethod
    def of(cls, plan: Solution, options: FlyOptions) -> Flights:
        """Check that a plan can be flown so."""
        how = _policy(plan, options.policy), options.truth, options.errors
        check_miss(plan.scenario, options.miss)
        if options.then and options.miss == len(plan.scenario.burns.times_s):
            needs = (
                "must leave a burn: `scp-recon replan --goal return` takes more in burns.times_s"
            )
            raise InputError(option("then"), f"{options.then} after the last burn", needs)
        config = Flyer(plan.mission, plan.burns_m_s, *how, seed=options.seed)
        return cls(plan, options, config)

    def summary(self) -> Summary:
        """Fly them and summarise."""
        return self._with_drift(summarise(self._tally(), self.plan))

    def into(
        self,
        folder: Path,
        progress: Callable[[int], None],
        stop: Callable[[], bool],
        say: Callable[[str], None],
    ) -> SavedFlights:
        """Fly them, and write the summary into the plan's folder, of fewer after an interrupt.

        `progress` is called with the number of flights so far; `stop` says whether to stop; `say` is
        called with each line worth showing.

        Raises:
            InputError: if the folder cannot be written, or holds another plan.
        """
        plan, options = self.plan, self.options
        own = "feedback" if plan.corrections else "open"
        kind = policy_kind(self.config.policy)
        name = FILE_NAME if kind == own else f"montecarlo_{kind}.json"
        if options.miss is not None:
            name = f"{name.removesuffix('.json')}_miss_{options.miss}.json"
        with results_beside(folder, plan, name, "folder", MARK):
            flown = self._tally(progress, stop, say)
            interrupted = stop() and flown.samples < options.samples
            summary = summarise(flown, plan)
            if not interrupted:
                summary = self._with_drift(summary)
            with writing(folder, "folder"):
                path = summary.write(folder, name)
        return SavedFlights(path, summary, flown.widest_interval(), interrupted)

    @one_thread
    def _tally(
        self,
        progress: Callable[[int], None] | None = None,
        stop: Callable[[], bool] = lambda: False,
        say: Callable[[str], None] = lambda _: None,
    ) -> FlightTally:
        options = self.options
        workers = options.workers if options.workers != 1 else None  # this process is one
        return fly_many(
            self.config,
            samples=options.samples,
            until=options.until,
            executor=executor_for(workers or 0, options.scheduler, LIMITS, say),
            progress=progress,
            stop=stop,
        )

    def _with_drift(self, summary: Summary) -> Summary:
        """The summary with the drifts of its flights after the burn that is missed, if one is."""
        number, mission = self.options.miss, self.config.mission
        if number is None:
            return summary
        miss, scenario = Miss(number), mission.scenario
        draws = self.config.first_draws(summary.samples)
        (flown,) = fly_drifts(self.config, [miss], draws)
        required = drift_probability(scenario) if miss in planned_misses(scenario) else None
        drift = safety_of(mission, miss, flown, required)
        then = self._home(number) if self.options.then else None
        return summary.model_copy(update={"drift": drift, "then": then})

    def _home(self, miss: int) -> Contingency:
        """Plan home from the mean state at a missed burn, and fly that plan."""
        plan, mission = self.plan, self.plan.mission
        index = miss - 1 - mission.scenario.burns_flown
        state = np.array(plan.nodes.state[mission.burn_nodes[index]])
        state[3:] -= plan.burns_m_s[index]
        at_s, parent = mission.scenario.burns.times_s[miss - 1], FlownPlan.of(plan)
        delivery = Delivery.of(at_s, state, measured={miss: np.zeros(3)})
        home = plan_left(parent, delivery, with_goal(parent, "return", None))
        options = replace(self.options, miss=None, then=None)
        return Contingency(
            status=home.status.value.name,
            total_dv_m_s=home.total_dv_m_s,
            burn_times_s=home.mission.scenario.burn_times_s,
            burns_m_s=tuple(burn.dv_m_s for burn in burns_of_plan(home)),
            whole_flight=Flights.of(solution_of(home), options).summary().whole_flight,
        )


def _policy(plan: Solution, kind: PolicyKind | None) -> AnyPolicy:
    """Find the policy that commands the burns of a plan."""
    if kind == "open":
        return ()
    if kind == "replan":
        if plan.problem != "P2":
            given = "'replan' of a plan of P3"
            raise InputError(option("policy"), given, "must be of a plan of P2")
        return replans(plan.mission, plan.burns_m_s)
    if kind == "feedback" and not plan.corrections:
        given, needed = "'feedback' of a plan without gains", 'policy.kind = "feedback"'
        allowed = f"must be 'open' or 'replan', or the plan made with {needed}"
        raise InputError(option("policy"), given, allowed)
    return plan.corrections


@dataclass(frozen=True, eq=False)
class Simulation:
    """A simulated flight that is checked and not flown yet."""

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
            *(self.solution, self.craft, self.seed),
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
    """Check the arguments of `plan_verbs.simulate`."""
    imported("simulate", "sim", "Basilisk")
    seed = whole_number(option("seed"), seed, 0, SEED_MAX)
    solution = solution_of(plan)
    if policy is not None:
        one_of(option("policy"), policy, get_args(PolicyKind))
    craft = load_vehicle(None if vehicle is None else path_of(option("vehicle"), vehicle))
    require_whole_flight(solution.scenario, option("plan"))
    check_miss(solution.scenario, miss)
    return Simulation(solution, seed, _policy(solution, policy), craft, miss)
