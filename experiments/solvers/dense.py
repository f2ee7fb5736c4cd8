"""Search the default scenario's flights densely for anything cheaper than its plans.

A flight is six numbers, positions at the two middle burns; or the first two burns, which lead there.
A flight cheaper than a plan spends less than the plan on its first two burns. All such pairs are the
search's box. Points are spread evenly in it (Sobol's sequence). Two legs are flown from each, the third
is a boundary-value problem, solved by Newton's method for all points at once with the planner's flow.
The best flights, by P3's cost and violations, none within a cell of another, are starts of P3, and P3's
ends of P2 with exact risk at nodes. OUT/dense.csv has a row for each density: what was covered, and the
local optima that were found, beside the plan from the straight line.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import beta, qmc

from experiments.harness import Findings, Record, Session, Study
from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from formulations.rows.exact import NodeRows
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Stage, StageSpec, is_converged, merit_of
from scp_recon.planning.planner import Planner
from scp_recon.planning.records import Problem
from scp_recon.planning.stages import Pipeline, same_optimum
from scp_recon.scenario.load import load_scenario

DENSITIES = ((2**13, 20), (2**17, 150))
"""Points, and flights from which local searches start."""
AT_ONCE = 2**13
"""Flights that are flown at once."""
NEWTON, STEP, CLOSE = 6, 1e-6, 1e-6
"""Iterations of the boundary-value problems, their step of differences and largest miss, in units."""
VOLUME = 16.0 * np.pi**2 * 4.0 / 720.0
"""Of the pairs of vectors whose sizes sum up to one at most."""
WEIGHT = 10.0
"""Charge for P3's violations, as in planning's first penalty."""


def first_burns(cost: float, points: int) -> Array:
    """Pairs of burns of less than a cost together, spread evenly in all six components, (n, 2, 3)."""
    u = qmc.Sobol(6, seed=0).random(points)
    total, share = cost * u[:, 0] ** (1 / 6), beta(3, 3).ppf(u[:, 1])
    up, turn = 2.0 * u[:, 2:4] - 1.0, 2.0 * np.pi * u[:, 4:]
    flat = np.sqrt(1.0 - up**2)
    ways = np.stack([flat * np.cos(turn), flat * np.sin(turn), up], axis=2)
    return np.stack([total * share, total * (1.0 - share)], axis=1)[:, :, None] * ways


def flown(mission: Mission, firsts: Array) -> tuple[Array, Array]:
    """Fly pairs of first burns, solve the third leg: burns (n, 4, 3) and merits (n,) of solved ones."""
    problem, flow = mission.problem, mission.dynamics.flow
    _, second, third, last = mission.dynamics.burn_nodes
    means = np.zeros((problem.n_nodes, len(firsts), 3))
    state = np.tile(problem.initial_state, (len(firsts), 1))
    state[:, 3:] += firsts[:, 0]
    for k in range(third + 1):
        if k > 0:
            state = flow.propagate(state, k - 1)
        if k == second:
            state[:, 3:] += firsts[:, 1]
        means[k] = state[:, :3]

    def leg(start: Array) -> Array:
        for k in range(third, last):
            start = flow.propagate(start, k)
            if start.ndim == 2:
                means[k + 1] = start[:, :3]
        return start

    start, goal = state.copy(), problem.final_state
    seconds = mission.times_s[last] - mission.times_s[third]
    start[:, 3:] = (goal[:3] - state[:, :3]) * (mission.units.time_s / seconds)
    for number in range(NEWTON):
        end = leg(start)
        if number < 2:  # from then on the derivatives hardly change
            turned = start[:, None].repeat(3, axis=1)
            turned[:, range(3), range(3, 6)] += STEP
            jacobian = (leg(turned) - end[:, None])[:, :, :3].swapaxes(1, 2) / STEP
            usable = np.isfinite(jacobian).all(axis=(1, 2))
            jacobian[~usable] = np.eye(3)
        start[:, 3:] -= np.linalg.solve(jacobian, (end[:, :3] - goal[:3])[:, :, None])[:, :, 0]
    end = leg(start)
    thirds, fourths = start[:, 3:] - state[:, 3:], goal[3:] - end[:, 3:]
    burns = np.concatenate([firsts, thirds[:, None], fourths[:, None]], axis=1)
    merit = np.linalg.norm(burns, axis=2).sum(axis=1)
    for one in problem.constraints:
        inside = one.region.inside(means[one.nodes])
        merit += WEIGHT * np.maximum(-inside if one.keep == "in" else inside, 0.0).max(axis=0)
    with np.errstate(invalid="ignore"):
        solved = np.isfinite(merit) & (np.abs(end[:, :3] - goal[:3]).max(axis=1) < CLOSE)
    return burns[solved], merit[solved]


def best_cells(every: Array, merit: Array, size: float, most: int) -> list[Array]:
    """Burns of the best flights, none of whose first two are within a size of a better one's."""
    taken: list[Array] = []
    for burns in every[np.argsort(merit)]:
        if all(np.linalg.norm(burns[:2] - other[:2]) > size for other in taken):
            taken.append(burns)
        if len(taken) == most:
            break
    return taken


def ends_of(mission: Mission, starts: list[Array]) -> dict[Problem, list[Stage]]:
    """Local optima of P3, and of P2 with exact risk at nodes from there, the cheapest first."""
    planner = Planner(mission)
    runs = Pipeline(mission, planner)
    nodes = StageSpec("P2", NodeRows(mission.problem.open_loop, mission.risk.p_chance))
    ends: dict[Problem, list[Stage]] = {"P3": [], "P2": []}
    for burns in starts:
        mean = mission.dynamics.rollout(mission.problem.initial_state, burns)
        stage = runs.solve(planner.p3, runs.start(Iterate(burns, mean)))
        for one in (stage, runs.solve(nodes, stage.result.lin)):
            known = ends[one.problem]
            if is_converged(one) and not any(same_optimum(one, other) for other in known):
                known.append(one)
    return {problem: sorted(found, key=merit_of) for problem, found in ends.items()}


def measure(density: tuple[int, int]) -> Record:
    """Search the default scenario with a number of points and of local searches: a row."""
    points, cells = density
    mission = Mission.from_scenario(load_scenario().replace({"risk.allocation": "exact"}))
    unit = mission.units.speed_m_s
    plan = Planner(mission).plan(initial_guess.cold(mission))
    p3 = plan.without_uncertainty
    assert p3 is not None
    cost = plan.total_dv_m_s / unit
    with np.errstate(all="ignore"):  # flights through the body
        parts = np.array_split(first_burns(cost, points), max(points // AT_ONCE, 1))
        every = [flown(mission, part) for part in parts]
    burns, merit = (np.concatenate(part) for part in zip(*every, strict=True))
    size = cost * (VOLUME / points) ** (1 / 6)
    starts = best_cells(burns, merit, size, cells)
    ends = ends_of(mission, starts)
    row: Record = {
        "points": points,
        "box_m_s": plan.total_dv_m_s,
        "flights": len(merit),
        "spacing_m_s": size * unit,
        "searches": len(starts),
    }
    for found, own in zip(ends.values(), (p3.total_dv_m_s, plan.total_dv_m_s), strict=True):
        costs = [unit * stage.result.lin.iterate.total_dv for stage in found]
        name = found[0].problem.lower()
        row |= {f"{name}_m_s": own, f"{name}_optima": len(costs), f"{name}_least_m_s": costs[0]}
        row[f"{name}_next_m_s"] = costs[1] if len(costs) > 1 else float("nan")
    return row


def run(session: Session) -> Findings:
    """Search with every density."""
    rows = session.rows("densities", measure, DENSITIES, session.store())
    return Findings({"dense": rows})


STUDY = Study(__doc__, run)
