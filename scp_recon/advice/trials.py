"""Try other values of a failed plan's entries, as the user's next command would.

A relaxation is first planned roughly: from one start, with facets chosen once. If a rough plan exists,
the user's own command is carried out with the other values, on its grid, from its start, with its
options and its certificate. Only what ends verified is a remedy. Planning and flights end where the
time of the processor is used up.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from time import process_time
from typing import TypeVar

import numpy as np
from scipy.special import ndtr, ndtri

from formulations.problem.controls import Cost
from formulations.problem.flyby import Iterate
from formulations.registry import FULL
from scp_recon.api.inputs import PlanRequest
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import PlanObserver, PlanOutcome, Watch, carry_out, plan_mission
from scp_recon.certification.largest import Search, rounded_down
from scp_recon.errors import InputError
from scp_recon.mission.constraints import companion_distance_m, drift_radius_m, planned_misses
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import Estimate
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.method import SETTLE
from scp_recon.planning.plan import Plan
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.loop import Record
from scp_recon.scp.status import Status
from scp_recon.verification.causes import refined

CLOSE = 0.03
"""Standard deviations between the largest probability with a plan and the next without: a hint."""

BELOW, BELOW_CERTIFIED = (0.0, 0.02, 0.1, 0.25), (0.03, 0.06, 0.15, 0.3)
"""Standard deviations by which a proposed probability is below the largest with a rough plan: the
user's grid may require more than a rough plan does, and flights do."""

SEARCHING = 0.6
"""Share of the time for a lower probability in which the largest is looked for."""

LARGEST, CONE = "burns.dv_max_m_s", "battery.delta_v_cone_deg"
"""Entries of the largest burn, and of the cone that burns avoid."""

FREE = 100.0
"""Factor on the largest burn and on the final spread if they are relaxed."""

MORE = (1.0, 1.05, 1.25)
"""Factors on a value that suffices for a rough plan, tried one after the other."""

FREE_CONE_DEG, FREE_MISS = 1e-4, 1e-3
"""Half-angle of the cones that burns avoid if their directions are relaxed, and price of a miss if
the final state is relaxed."""

STEPS = 6
"""Bisections of the shares by which limits are relaxed."""

SIZE, DIRECTIONS = "the size of the burns", "the directions of the burns"
FINAL_STATE, LIMITS = "the final state", "the limits"
FINAL_SPREAD = "the limits on the final covariance"
SPLIT = "the polytopes and the split of the risk"
PROBABILITY, CORRECTED = "the probability", "feedback"
RETURN = "the observation: going home without it"
MORE_BURNS = "the number of burns"

T = TypeVar("T")
Changes = Mapping[str, object]


@dataclass(frozen=True)
class Remedy:
    """Other values of entries with which the user's command ended verified.

    Attributes:
        name: what is relaxed.
        changes: values by entry.
        cost_m_s: delta-v of the plan, as `counted` counts it.
        certify: option of certification that the command needs; None for its own.
    """

    name: str
    changes: Changes
    cost_m_s: float
    certify: bool | None = None
    counted: Cost = "nominal"

    @classmethod
    def of(cls, name: str, changes: Changes, plan: Plan, certify: bool | None = None) -> Remedy:
        """Make the remedy that a plan confirms."""
        return cls(name, changes, plan.cost_m_s, certify, counted=plan.counted)


def for_exact(options: PlanOptions) -> PlanOptions:
    """The options of a command, as far as exact risk and a given probability allow them."""
    return replace(
        options,
        method="scp",
        formulation=options.formulation if options.formulation in (*FULL, None) else FULL[0],
        facet_rounds=options.facet_rounds if options.facet_rounds in (0, SETTLE) else 0,
        objective="delta-v",
        dv_budget_m_s=None,
    )


class TimeIsUp(Exception):  # noqa: N818 -- no error
    """The time for a diagnosis is used up."""


@dataclass
class Clock(Watch):
    """Limit of processor time, checked after every iteration and every round of flights.

    Attributes:
        limit_s: of the diagnosis.
        began: processor time at its begin, s.
        tried: names of what was tried without success.
        left_out: names of what the time did not suffice for.
        until_s: processor time at which the present trial has to end.
        show: called with what is tried, and for how long.
    """

    limit_s: float
    began: float = field(default_factory=process_time)
    tried: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    until_s: float = math.inf
    show: Callable[[str], None] | None = None
    _trying: str = ""

    def __call__(self, stage: str, record: Record) -> None:
        """An iteration is done."""
        del stage, record
        self.check()

    def flights(
        self, step: str, plan: Plan, samples: int, flown: int = 0, reached: Estimate | None = None
    ) -> None:
        """Some flights are flown."""
        del step, plan, samples, flown, reached
        self.check()

    def planning(self, mission: Mission) -> AbstractContextManager[PlanObserver | None]:
        """Observe the plan of a command."""
        del mission
        return nullcontext(self)

    def check(self) -> None:
        """Stop once the time is used up.

        Raises:
            TimeIsUp: if it is.
        """
        now = process_time()
        if self.show is not None:
            self.show(
                f"trying {self._trying}: {now - self.began:.0f} of at most {self.limit_s:.0f} s"
            )
        if now > min(self.until_s, self.began + self.limit_s):
            raise TimeIsUp

    @contextmanager
    def part(self, share: float) -> Iterator[None]:
        """Context for a share of the time that the present trial has left."""
        until_s, now = self.until_s, process_time()
        self.until_s = now + share * (min(until_s, self.began + self.limit_s) - now)
        try:
            yield
        finally:
            self.until_s = until_s

    def attempt(self, name: str, work: Callable[[], T | None], share: float = 1.0) -> T | None:
        """What a trial finds; None, and the trial is noted, if it finds nothing or time is up.

        Args:
            name: of the trial.
            work: the trial.
            share: of all time that it may take.
        """
        self.until_s, self._trying = process_time() + share * self.limit_s, name
        try:
            self.check()
            found = work()
        except TimeIsUp:
            self.left_out.append(name)
            return None
        except InputError:  # the scenario does not allow such values
            found = None
        if found is None:
            self.tried.append(name)
        return found


@dataclass
class Case:
    """A failed plan, the request of its command, and the trials that the time allows.

    Attributes:
        remedies: found so far.
        miss: see `Diagnosis`.
        largest: see `Diagnosis`.
    """

    failed: Plan
    request: PlanRequest
    clock: Clock
    remedies: list[Remedy] = field(default_factory=list)
    miss: tuple[float, float] | None = None
    largest: float | None = None

    @property
    def scenario(self) -> Scenario:
        """The failed plan's scenario."""
        return self.failed.mission.scenario

    def rough(self, changes: Changes) -> Plan | None:
        """A plan with other values, from one start and without flights; None if there is none."""
        mission = self.failed.mission.changed(changes)
        return self._roughly(mission, self.failed.final.result.lin.iterate)

    def _roughly(self, mission: Mission, start: Iterate) -> Plan | None:
        if len(start.mean) != len(mission.times_s):
            start = from_burns(mission, self.failed.burns_m_s)
        problem = self.request.options.problem
        exact = problem == "P2" and mission.scenario.risk.allocation == "exact"
        options = PlanOptions(problem, certify=False if exact else None, facet_rounds=0, starts=1)
        plan = plan_mission(mission, start, options, self.clock, once=True, others=False)
        return plan if _converged(plan) else None

    def command(self, changes: Changes, *, certify: bool | None = None) -> PlanOutcome | None:
        """The user's command with other values; None unless it ends verified."""
        exact = changes.get("risk.allocation", self.scenario.risk.allocation) == "exact"
        options = self.request.options
        if exact and ("risk.allocation" in changes or "risk.p_chance" in changes):
            options = for_exact(options)
        if certify is not None:
            options = replace(options, certify=certify)
        request = replace(self.request.again(overrides_of(changes)), options=options)
        outcome = carry_out(request, self.clock)
        if not _converged(outcome.plan) or outcome.verification is None:
            return None
        return outcome if outcome.verification.ok else None

    def confirmed(
        self, changes: Changes, name: str, *, certified: bool | None = None
    ) -> Remedy | None:
        """The remedy, if the user's command ends verified with these values.

        A command that turns to exact risk is tried without flights, then with them.
        """
        own = self.scenario.risk.allocation
        turns = changes.get("risk.allocation", own) != own
        for certify in (False, True) if turns else (certified,):
            try:
                outcome = self.command(changes, certify=certify)
            except InputError:  # no flights certify so much
                continue
            if outcome is not None:
                return Remedy.of(name, changes, outcome.plan, certify)
        return None

    def first(self, several: Sequence[Changes], name: str) -> Remedy | None:
        """The remedy of the first values that suffice."""
        return next((one for values in several if (one := self.confirmed(values, name))), None)

    def relaxed(
        self, entries: Mapping[str, tuple[float, float]], name: str, *, sized: bool = False
    ) -> Remedy | None:
        """The remedy with values the least of the way from the given ones to the widest.

        All entries go by the same share of their way. If `sized`, the largest burn goes with them, to
        what the widest values need: with corrections, or a limit that risk makes smaller, that is more
        than the mean burn.
        """
        if sized:
            given, widest = (
                self.scenario.burns.dv_max_m_s,
                {e: last for e, (_, last) in entries.items()},
            )
            free = self.rough({**widest, LARGEST: FREE * given})
            if free is None:
                return None
            needed = MORE[-1] * float(np.linalg.norm(free.burns_m_s, axis=1).max())
            entries = {**entries, LARGEST: (given, max(given, needed))}

        def at(share: float) -> dict[str, object]:
            return {
                entry: rounded(given + share * (widest - given), up=widest > given)
                for entry, (given, widest) in entries.items()
            }

        if self.rough(at(1.0)) is None:
            return None
        low, high = 0.0, 1.0
        for _ in range(STEPS):
            middle = 0.25 * high if low == 0.0 else math.sqrt(low * high)
            low, high = (low, middle) if self.rough(at(middle)) else (middle, high)
        shares = dict.fromkeys(min(1.0, factor * high) for factor in (*MORE, 2.0))
        return self.first([at(share) for share in shares], name)

    def likeliest(self, name: str) -> Remedy | None:
        """The largest probability with exact risk, of which the command ends verified."""
        required, allocation = self.scenario.risk.p_chance, self.scenario.risk.allocation
        split: Changes = {} if allocation == "exact" else {"risk.allocation": "exact"}
        search = Search(self._for_target, close=CLOSE, most=self.failed.target or required)
        try:
            with self.clock.part(SEARCHING):
                search.run(self.failed.mission.changed(split), self.failed.final.result.lin.iterate)
        except TimeIsUp:
            if self.largest is None:
                raise
        if self.largest is None:
            return None
        tries: list[Changes] = []
        certified = self.request.options.is_certified(self.scenario)
        for less in BELOW_CERTIFIED if certified else BELOW:
            p = rounded_down(float(ndtr(ndtri(self.largest) - less)))
            if 0.5 < p < required:
                tries.append({**split, "risk.p_chance": p})
        return self.first(tries, name)

    def _for_target(
        self, mission: Mission, start: Iterate | Plan, target: float, *, once: bool
    ) -> Plan:
        """A plan with exact risk by the normal law, for the search for the largest probability."""
        options = PlanOptions(certify=False, facet_rounds=0, starts=1)
        plan = plan_mission(mission, start, options, self.clock, target=target, once=once)
        if _converged(plan):
            self.largest = max(self.largest or 0.0, target)
        return plan

    def final_miss(self) -> tuple[float, float] | None:
        """Miss in m and m/s of a plan that may miss the final state, on a grid that is fine enough.

        No entry has a command miss the final state, so this is no remedy.
        """
        plan = self._missing(self.failed.mission)
        if plan is not None and (finer := refined(plan)) is not None:
            plan = self._missing(finer)
        if plan is None:
            return None
        missed = np.linalg.norm((plan.states[-1] - plan.mission.final_state).reshape(2, 3), axis=1)
        return float(missed[0]), float(missed[1])

    def _missing(self, mission: Mission) -> Plan | None:
        """A rough plan that may miss the final state, if there is one."""
        free = replace(mission)
        # No scenario asks for such a problem: it takes the place of the one that this copy caches.
        vars(free)["problem"] = replace(mission.problem, miss_weight=FREE_MISS)
        return self._roughly(free, from_burns(free, self.failed.burns_m_s))


def overrides_of(changes: Changes) -> list[str]:
    """Changes as overrides of a command."""
    return [f"{entry}={json.dumps(value)}" for entry, value in changes.items()]


def _converged(plan: Plan) -> bool:
    """Whether a plan has converged.

    Raises:
        KeyboardInterrupt: if it was interrupted.
    """
    if plan.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    return plan.status is Status.CONVERGED


def violated_by(plan: Plan) -> tuple[str, ...]:
    """Names of the constraints that the end of a plan violates."""
    merit, tolerance = plan.final.merit, plan.final.tolerance
    violations = merit.violations(plan.final.result.lin)
    return tuple(
        FINAL_STATE if name == "dynamics" else name
        for name, amount in violations.items()
        if amount.max(initial=0.0) > tolerance
    )


def spreads_of(scenario: Scenario) -> dict[str, tuple[float, float]]:
    """Entries of the limits on the final covariance: their values, and far wider ones."""
    names = ("final_sigma_position_m", "final_sigma_velocity_m_s")
    given = {f"boundary.{name}": getattr(scenario.boundary, name) for name in names}
    return {entry: (value, FREE * value) for entry, value in given.items() if value is not None}


def limits_violated(scenario: Scenario, violated: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Entries of the limits that are violated: their values, and the widest that make sense."""
    o, safety, battery = scenario.observation, scenario.safety, scenario.battery
    radius = scenario.body.reference_radius_m
    companion = 0.0 if scenario.body.companion is None else scenario.body.companion.radius_m
    far, narrow, wide = 4.0 * o.site_distance_max_m, FREE_CONE_DEG, 89.0
    every: dict[str, tuple[str, float | None, float]] = {
        "site_distance_min": ("observation.site_distance_min_m", o.site_distance_min_m, 1.0),
        "site_distance_max": ("observation.site_distance_max_m", o.site_distance_max_m, far),
        "emission_min": ("observation.emission_min_deg", o.emission_min_deg, narrow),
        "emission_max": ("observation.emission_max_deg", o.emission_max_deg, wide),
        "phase_min": ("observation.phase_min_deg", o.phase_min_deg, narrow),
        "phase_max": ("observation.phase_max_deg", o.phase_max_deg, wide),
        "battery_observation": (
            "battery.observation_cone_deg",
            battery.observation_cone_deg,
            narrow,
        ),
        "safety_radius": ("safety.radius_min_m", safety.radius_min_m, radius),
        "companion_distance": (
            "safety.companion_distance_min_m",
            companion_distance_m(scenario) or None,
            companion,
        ),
    }
    found = {}
    drifts = {miss.name for miss in planned_misses(scenario)}
    for name in violated:
        if name in drifts and (kept := drift_radius_m(scenario)) > radius:
            found["safety.drift_radius_m"] = (kept, radius)
        # Sets with both limits count as one constraint where risk is exact.
        for constraint, (entry, given, widest) in every.items():
            is_named = constraint == name or constraint.startswith(f"{name}_")
            if is_named and given is not None and given != widest:
                found[entry] = (float(given), widest)
    return found


def rounded(value: float, *, up: bool = True, digits: int = 4) -> float:
    """A positive number rounded up or down to some significant digits."""
    place = digits - 1 - math.floor(math.log10(value))
    scaled = value * 10.0**place
    whole = math.ceil(scaled - 1e-9) if up else math.floor(scaled + 1e-9)
    return float(round(whole * 10.0**-place, max(place, 0)))
