"""Plan from several starts, the guess and random flights; list local optima, keep the best plan."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial

import numpy as np

from formulations.linearisation.linearisation import final_state_map
from formulations.problem.flyby import Iterate
from scp_recon.jobs.job import Job, here, in_order
from scp_recon.jobs.processes import Processes
from scp_recon.mission.mission import Mission
from scp_recon.planning.initial_guess import bent
from scp_recon.planning.plan import Optimum, Plan, Stage, Starts, as_interrupted
from scp_recon.planning.stages import rank, same_optimum
from scp_recon.scp.status import Status

BEND, BURN = 0.5, 0.75
"""Of a random flight's path and burns before it is made to fly, in the mission's units, 1 sigma."""


def plan_from_several(
    mission: Mission,
    guess: Iterate,
    make_plan: Callable[..., Plan],
    *,
    starts: int,
    seed: int = 0,
    workers: int = 1,
    init: str = "given",
    seen: Callable[[int, Plan], None] | None = None,
) -> Plan:
    """Plan from several starts, the guess and random flights, and keep the best plan.

    `make_plan` is like `planner.plan` and must pickle: with `once` it plans from the given start
    alone. Neither the plan nor the list of optima depends on the number of processes. An interrupt ends
    with the best plan so far, marked as interrupted. `starts` includes the guess; `seen` is called with
    each start's number and plan, in order.
    """
    plan_start = partial(_plan_start, mission, guess, init, make_plan, seed)
    found: list[Plan] = []
    interrupted = False
    executor = here if workers == 1 else Processes(min(workers, starts))
    jobs = (Job(number, number) for number in range(starts))
    try:
        with closing(in_order(executor, plan_start, jobs)) as ended:
            for done in ended:
                plan: Plan = done.result(name="start")
                found.append(plan)
                if seen:
                    seen(int(done.key), plan)
                if plan.status is Status.INTERRUPTED:
                    raise KeyboardInterrupt
    except KeyboardInterrupt:
        if not found:
            raise
        interrupted = True
    whole = [plan for plan in found if plan.status is not Status.INTERRUPTED]
    best = max(whole or found, key=lambda plan: rank(plan.final))
    listed = Starts(starts, seed, local_optima(found))
    return replace(as_interrupted(best) if interrupted else best, starts=listed)


def _plan_start(
    mission: Mission,
    guess: Iterate,
    init: str,
    make_plan: Callable[..., Plan],
    seed: int,
    number: int,
) -> Plan:
    """Make the plan of one start, in any process."""
    if number == 0:
        return make_plan(mission, guess, once=False, init=init)
    start = random_flight(mission, seed, number)
    return make_plan(mission, start, once=True, init=f"random flight {number} of seed {seed}")


def random_flight(mission: Mission, seed: int, number: int) -> Iterate:
    """A random flight from the initial to the final state, without regard to limits.

    A randomly bent straight line with random burns, its defects closed by the smallest change of the
    burns that still leads to the final state. Each number has draws of its own.
    """
    units, problem = mission.units, mission.problem
    rng = np.random.default_rng((seed, number))
    path = bent(mission, rng, BEND * units.length_m, BURN * units.speed_m_s)
    mean = path.mean.copy()
    mean[0, 3:] = problem.initial_state[3:] + path.burns[0]
    lin = mission.dynamics.linearise(problem, Iterate(path.burns, mean))
    constant, jacobian = final_state_map(lin)
    miss = problem.final_state - constant - jacobian @ path.burns.ravel()
    burns = path.burns + np.linalg.lstsq(jacobian, miss)[0].reshape(-1, 3)
    return mission.dynamics.close_defects(lin, burns).iterate


def local_optima(plans: list[Plan]) -> tuple[Optimum, ...]:
    """Local optima of several starts' plans, each once: P3's first, the cheapest first.

    A local optimum is an end that converged, or is stationary at the least violation. Every P3 of a
    start counts. Of P2 only the final one counts, because its facets depend on the end of P3.
    """
    groups: list[tuple[Stage, list[int]]] = []
    for number, plan in enumerate(plans):
        for stage in _ends(plan):
            for known, numbers in groups:
                if known.problem == stage.problem and same_optimum(known, stage):
                    if number not in numbers:
                        numbers.append(number)
                    break
            else:
                groups.append((stage, [number]))
    speed_m_s = plans[0].mission.units.speed_m_s
    optima = []
    for stage, numbers in groups:
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
    return tuple(optima)


def _ends(plan: Plan) -> list[Stage]:
    ends = [s for s in plan.stages if s.problem == "P3" and s.spec.role != "open"]
    if plan.final.problem == "P2":
        ends.append(plan.final)
    return [s for s in ends if s.result.status in (Status.CONVERGED, Status.INFEASIBLE)]
