"""Plan from several starts, the guess and random flights; list local optima, keep the best plan."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np

from formulations.linearisation.linearisation import final_state_map
from formulations.problem.flyby import Iterate
from scp_recon.jobs.job import Job, generator, here, in_order
from scp_recon.jobs.processes import Processes
from scp_recon.mission.mission import Mission
from scp_recon.planning.initial_guess import bent
from scp_recon.planning.plan import Plan, Stage, as_interrupted, is_converged, merit_of, rank
from scp_recon.planning.planner import cheapest_p3
from scp_recon.planning.records import Optimum, Starts
from scp_recon.planning.solver import Observer, unobserved
from scp_recon.planning.stages import same_optimum
from scp_recon.scp.status import Status

CHANCE, CHANCE_WITHOUT, STARTS_AUTO_MAX = 0.05, 0.01, 100
"""Chance that a further start finds a new optimum of P3 below which no more are planned, the same of a
new minimum of its violation where it has no optimum, and the limit of their number."""

KNOWN = 1e-4
"""Relative reduction of the merit at which a P3 stops that leads to P2: optima differ by more."""

BEND, BURN = 0.5, 0.75
"""1 sigma of a random flight's path and burns before it is made to fly, in the mission's units."""


def plan_from_several(
    first: Plan,
    make_plan: Callable[..., Plan],
    *,
    starts: int | Literal["auto"],
    seed: int = 0,
    workers: int = 1,
    observe: Observer | None = None,
) -> Plan:
    """Plan also from the other optima of P3 that random flights lead to; keep the best plan.

    Every random flight is planned as P3, each optimum of P3 once as P2, the cheapest first; an optimum
    of P3 that costs more than the best P2 so far is left out where P3 bounds P2 (`_bounds`). Neither
    the plan nor the list of optima depends on the number of processes. An interrupt ends with the best
    plan so far, marked as interrupted.

    Args:
        first: the plan from the first start, the guess.
        make_plan: like `planner.plan`; it must pickle, and with `once` plans from its start alone.
        starts: their number, the guess included; "auto" for as many as Boender and Rinnooy Kan's rule
            asks for, and more where P3 has no optimum: see `Starts.chance`.
        seed: of the random flights.
        workers: processes.
        observe: called with the iterations of plans from other optima, and with the last one of each
            stage of each start, whose number then precedes the name of the stage.
    """
    work = _Several(first, make_plan, seed, observe)
    interrupted = False
    try:
        work.note(first, [0])
        work.search(starts, workers)
        work.plan_others()
    except KeyboardInterrupt:
        interrupted = True
    whole = [plan for plan in work.plans if plan.status is not Status.INTERRUPTED]
    best = max(whole or work.plans, key=lambda plan: rank(plan.final))
    least = cheapest_p3(first.mission, [stage for stage, _ in work.optima])
    return replace(
        as_interrupted(best) if interrupted else best,
        starts=work.listed() if work.number > 1 else None,
        without_uncertainty=least or best.without_uncertainty,
    )


@dataclass
class _Several:
    """Planning from several starts, so far.

    Attributes:
        plans: from the guess, and of every further optimum of P3.
        optima: ends of P3 and final ones of P2 with the numbers of the starts that led there.
        number: of starts.
    """

    first: Plan
    make_plan: Callable[..., Plan]
    seed: int
    observe: Observer | None
    plans: list[Plan] = field(default_factory=list)
    optima: list[tuple[Stage, list[int]]] = field(default_factory=list)
    number: int = 1

    @property
    def mission(self) -> Mission:
        """The mission on the grid that planning may have refined."""
        return self.first.mission

    def search(self, starts: int | Literal["auto"], workers: int) -> None:
        """Plan P3 from random flights, until so many starts are planned or the rule is met."""
        most = STARTS_AUTO_MAX if starts == "auto" else starts
        jobs = (Job(number, number) for number in range(1, most))
        executor = here if workers == 1 else Processes(min(workers, most - 1 or 1))
        p3_of = partial(_p3_of, self.mission, self.make_plan, self.seed, self._leads)
        with closing(in_order(executor, p3_of, jobs)) as ended:
            for done in ended:
                plan: Plan = done.result(name="start")
                if plan.status is not Status.INTERRUPTED:
                    self.number += 1
                    self._add(_ends(plan), [int(done.key)])
                self._show(int(done.key), plan)
                listed = self.listed()
                enough = CHANCE if listed.converged else CHANCE_WITHOUT
                if starts == "auto" and listed.chance < enough:
                    break

    @property
    def _leads(self) -> bool:
        """Whether P3 leads to P2; else P3 was asked for."""
        return self.first.final.problem == "P2" or not is_converged(self.first.final)

    def plan_others(self) -> None:
        """Plan P2 from the optima of P3 to which only random flights led."""
        for stage, numbers in sorted(self.optima, key=lambda found: merit_of(found[0])):
            is_p3 = stage.problem == "P3" and is_converged(stage)
            if not (self._leads and is_p3) or 0 in numbers:
                continue
            best = max((plan.final for plan in self.plans), key=rank)
            if _bounds(self.mission) and is_converged(best) and merit_of(stage) >= merit_of(best):
                continue
            start = on_grid(self.mission, stage.result.lin.iterate)
            how = {"init": f"random flight {numbers[0]} of seed {self.seed}", "once": True}
            self.note(self.make_plan(self.mission, start, observe=self.observe, **how), numbers)

    def listed(self) -> Starts:
        """The list of distinct optima, P3's first, the cheapest first."""
        speed_m_s = self.mission.units.speed_m_s
        optima = []
        for stage, numbers in self.optima:
            iterate = stage.result.lin.iterate
            optima.append(
                Optimum(
                    problem=stage.problem,
                    status=stage.result.status.value.name,
                    total_dv_m_s=iterate.total_dv * speed_m_s,
                    burns_m_s=tuple((x, y, z) for x, y, z in (iterate.burns * speed_m_s).tolist()),
                    starts=tuple(numbers),
                )
            )
        optima.sort(key=lambda o: (o.problem == "P2", o.status != "converged", o.total_dv_m_s))
        return Starts(self.number, self.seed, tuple(optima))

    def note(self, plan: Plan, numbers: list[int]) -> None:
        """Keep a plan and the optima where its runs ended."""
        self.plans.append(plan)
        self._show(numbers[0], plan)
        self._add(_ends(plan), numbers)

    def _show(self, number: int, found: Plan) -> None:
        """Show the last iteration of each stage.

        Raises:
            KeyboardInterrupt: if the plan was interrupted.
        """
        observe = self.observe or unobserved
        for stage in found.stages:
            for record in stage.result.records[-1:]:
                observe(f"{number} {stage.name}", record)
        if found.status is Status.INTERRUPTED:
            raise KeyboardInterrupt

    def _add(self, ends: Iterable[Stage], numbers: list[int]) -> None:
        """Add ends of runs to the optima that they are."""
        for stage in ends:
            for known, own in self.optima:
                if known.problem == stage.problem and same_optimum(known, stage):
                    own.extend(number for number in numbers if number not in own)
                    break
            else:
                self.optima.append((stage, list(numbers)))


def on_grid(mission: Mission, found: Iterate) -> Iterate:
    """A flight on the mission's nodes, which may have been found on a finer grid."""
    if len(found.mean) == len(mission.times_s):
        return found
    path = mission.dynamics.rollout(mission.problem.initial_state, found.burns)
    return replace(found, mean=path)


def _p3_of(
    mission: Mission, make_plan: Callable[..., Plan], seed: int, leads: bool, number: int
) -> Plan:
    """Plan P3 from a random flight, in any process; where it leads to P2 only until it is known."""
    start = random_flight(mission, seed, number)
    called = f"random flight {number} of seed {seed}"
    how = {"p3_resolution": KNOWN} if leads else {}
    return make_plan(mission, start, problem="P3", once=True, init=called, **how)


def _bounds(mission: Mission) -> bool:
    """Whether no P2 costs less than the P3 in whose basin it lies.

    Means then keep what P3 asks of them: with a probability of one half or more, a mean is in a convex
    keep-in set, and outside a keep-out set that is larger than the spread. Not so with polytopes around
    keep-in sets, nor with feedback, which costs what is commanded in flight.
    """
    uniform = mission.risk.allocation == "uniform"
    return mission.problem.feedback is None and not (uniform and mission.polytopes.ball is None)


def random_flight(mission: Mission, seed: int, number: int) -> Iterate:
    """A random flight from the initial to the final state, without regard to limits.

    A randomly bent straight line with random burns, its defects closed by the smallest change of the
    burns that still leads to the final state. Each number has draws of its own.
    """
    units, problem = mission.units, mission.problem
    rng = generator(seed, number)
    path = bent(mission, rng, BEND * units.length_m, BURN * units.speed_m_s)
    mean = path.mean.copy()
    mean[0, 3:] = problem.initial_state[3:] + path.burns[0]
    lin = mission.dynamics.linearise(problem, Iterate(path.burns, mean))
    constant, jacobian = final_state_map(lin)
    miss = problem.final_state - constant - jacobian @ path.burns.ravel()
    burns = path.burns + np.linalg.lstsq(jacobian, miss)[0].reshape(-1, 3)
    return mission.dynamics.close_defects(lin, burns).iterate


def _ends(plan: Plan) -> list[Stage]:
    """Local optima of P3 among the stages of a plan, and its final one of P2; also least violations."""
    ends = [s for s in plan.stages if s.problem == "P3" and s.spec.role != "open"]
    ends += [plan.final] if plan.final.problem == "P2" else []
    return [s for s in ends if s.result.status in (Status.CONVERGED, Status.INFEASIBLE)]
