"""Find the cheapest pass near a given one, by rounds of SLSQP over phases and times.

The cost of a pass is the delta-v of its plan. `Near` plans with the grid, the facets and the compiled
program of the round's start, and starts from the nearest plan, so that the cost is smooth in phases and
times. `Near.slope` gives its derivative from the multipliers of the plan's constraints.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, minimize

from formulations.arrays import Array, Booleans
from formulations.linearisation.linearisation import Linearisation, step_mean
from formulations.problem.facets import choose_facets
from formulations.problem.flyby import Iterate
from formulations.program.multipliers import multipliers
from scp_recon.mission.mission import Mission
from scp_recon.passes.space import Pass, Space
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.plan import Stage, StageSpec, scales
from scp_recon.planning.planner import Planner
from scp_recon.planning.stages import Pipeline
from scp_recon.scp.status import Status

REACH = 0.3
"""Reach of a round, rad and units of time: facets and grid are those of its start."""
ROUNDS_MAX, STEPS_MAX = 12, 20
"""Rounds, and steps of SLSQP in each."""
WORTH = 1e-4
"""Relative gain of a round after which another one is made."""
FREE_SPAN = 1e-9
DIFFERENCE = 1e-6
"""Step of the derivatives by phase (rad) and time; the flown deviation has an error of its square."""

Observe = Callable[["PassResult"], None]


@dataclass(frozen=True, eq=False)
class PassResult:
    """A pass with its mission and its plan, the last stage of P3 or P2.

    Attributes:
        at: the pass.
        mission: of it.
        stage: of P3 or P2.
    """

    at: Pass
    mission: Mission
    stage: Stage

    @property
    def converged(self) -> bool:
        """Whether the plan converged."""
        return self.stage.result.status is Status.CONVERGED

    @property
    def dv_m_s(self) -> float:
        """Total delta-v of the plan, as it is minimised; infinite if it did not converge."""
        total = self.stage.result.lin.cost.value * self.mission.units.speed_m_s
        return total if self.converged else float("inf")

    @property
    def burns_m_s(self) -> Array:
        """Burns, J2000, shape (m, 3)."""
        return self.stage.result.lin.iterate.burns * self.mission.units.speed_m_s


class Near:
    """Plans P2 near a pass with the facets that `Planner.plan` would choose there.

    With exact risk there are no facets. If `certain`, P3 is planned instead, without uncertainty.
    `first` is the plan at the pass itself, started from the given burns, J2000, m/s, shape (m, 3).
    """

    def __init__(self, space: Space, at: Pass, burns_m_s: Array, *, certain: bool = False) -> None:
        self.space, self._mission = space, space.mission_of(at)
        self._planner = planner = Planner(self._mission)
        self._exact = self._mission.scenario.risk.allocation == "exact"
        pipeline = Pipeline(self._mission, planner)
        start = pipeline.start(from_burns(self._mission, burns_m_s))
        if not (self._exact or certain):
            start = pipeline.solve(planner.p3, start).result.lin
        self._spec = planner.p3 if certain else self._spec_at(start)
        self.first = self.plan(space.vector(at), start)

    def plan(self, x: Array, start: Linearisation | None = None) -> PassResult:
        """Plan P2 at x, started from the burns of another iterate, or from the first plan."""
        at = self.space.at(x)
        mission = self.space.moved(self._mission, at)
        pipeline, begun = Pipeline(mission, self._planner), start or self.first.stage.result.lin
        stage = pipeline.solve(self._spec, pipeline.start(begun.iterate))
        return PassResult(at, mission, stage)

    def slope(self, result: PassResult, free: Booleans) -> Array:
        """Derivative of the least delta-v by x, nondimensional, shape (2 + m,); zero where not free.

        By the envelope theorem it is the Lagrangian's, with burns and multipliers kept. Only defects
        and violations depend on x then; flying the same burns from other states and at other times
        gives them. Fiacco, Introduction to Sensitivity and Stability Analysis, 1983, section 3.4.
        """
        space, stage, x = self.space, result.stage, self.space.vector(result.at)
        lin, merit = stage.result.lin, stage.merit
        prices = multipliers(merit.problem, merit.rows, lin)
        base, by_x = float(prices @ merit.excess(lin)), np.zeros(len(x))
        for j in np.flatnonzero(free):
            step = DIFFERENCE * np.eye(len(x))[j]
            flown = reflown(space.moved(result.mission, space.at(x + step)), lin)
            by_x[j] = (float(prices @ merit.excess(flown)) - base) / DIFFERENCE
        return by_x

    def _spec_at(self, lin: Linearisation) -> StageSpec:
        if self._exact:
            *_, final = stages = self._planner.exact_stages()
            coarse = [stage for stage in stages if stage.role == "coarse"]
            return replace((*coarse, final)[0], role="final")
        problem, polytopes = self._mission.problem, self._mission.polytopes
        facets = choose_facets(problem, polytopes, lin.iterate.mean, lin.spread.factor)
        return self._planner.p2_stage(facets, lin, again=True)


def reflown(mission: Mission, lin: Linearisation) -> Linearisation:
    """Fly an iterate's burns in a nearly equal mission, with defects closed to first order.

    The problem is the iterate's with the mission's boundary; its constraints are kept.
    """
    units, dynamics, iterate = mission.units, mission.dynamics, lin.iterate
    problem = replace(
        lin.problem,
        initial_state=mission.initial_state / units.state,
        final_state=mission.final_state / units.state,
        initial_factor=mission.joint_factor,
    )
    mean = iterate.mean.copy()
    mean[0] = problem.initial_state
    mean[0, 3:] += iterate.burns[0]
    near = dynamics.linearise(problem, Iterate(iterate.burns, mean))
    return dynamics.linearise(problem, Iterate(iterate.burns, step_mean(near, iterate.burns)))


def descend(
    space: Space,
    at: Pass,
    burns_m_s: Array,
    observe: Observe,
    rounds_max: int = ROUNDS_MAX,
    worth: float = WORTH,
    precision: float = 0.1 * WORTH,
    *,
    certain: bool = False,
    rival_m_s: float = np.inf,
) -> PassResult:
    """Find the best pass by rounds of SLSQP from a given one; it is never worse than the start's P2.

    The first plan starts from the given burns, J2000, m/s, shape (m, 3), and is returned if it does
    not converge. A round is followed by another if its relative gain is at least `worth`, and if the
    pass is not dearer than a rival by more than that. A round ends with a step that gains no more than
    `precision`. If `certain`, uncertainty is left out: P3 in place of P2.
    """
    near = Near(space, at, burns_m_s, certain=certain)
    best = near.first
    observe(best)
    if not best.converged:
        return best
    for _ in range(rounds_max):
        x, burns = _round(space, near, observe, precision)
        near = Near(space, space.at(x), burns, certain=certain)
        gain = 1.0 - near.first.dv_m_s / best.dv_m_s
        observe(near.first)
        if gain > 0.0:
            best = near.first
        if gain < worth or best.dv_m_s > (1.0 + worth) * rival_m_s:
            break
    return best


def _round(space: Space, near: Near, observe: Observe, precision: float) -> tuple[Array, Array]:
    """One round: the cheapest x that SLSQP finds within reach, and the burns there.

    It ends where a step gains no more than `precision`. Slopes are those of steps that are taken: the
    line search asks for costs alone.
    """
    start, low, high = space.vector(near.first.at), *space.bounds.T
    free = high - low > FREE_SPAN
    matrix, least = space.rules(space.before(near.first.at.times_s))
    before = near.first
    unit, scale = before.mission.units.speed_m_s, before.dv_m_s
    best = before
    planned: dict[bytes, PassResult] = {}
    converged = [(start[free], before)]

    def plan(y: Array) -> PassResult:
        nonlocal best
        if y.tobytes() not in planned:
            x = start.copy()
            x[free] = y
            _, nearest = min(converged, key=lambda one: float(np.linalg.norm(one[0] - y)))
            planned[y.tobytes()] = result = near.plan(x, nearest.stage.result.lin)
            observe(result)
            if result.converged:
                converged.append((y.copy(), result))
            best = min(best, result, key=lambda one: one.dv_m_s)
        return planned[y.tobytes()]

    def cost(y: Array) -> float:
        result = plan(y)
        return result.dv_m_s / scale if result.converged else 10.0  # the line search turns back

    def slope(y: Array) -> Array:
        result = plan(y)
        if not result.converged:
            return np.zeros(len(y))
        return near.slope(result, free)[free] * (unit / scale)

    reach = Bounds(
        np.maximum(low, start - REACH)[free], np.minimum(high, start + REACH)[free], True
    )
    felt = np.any(matrix[:, free], axis=1)  # the others hold, for times that are given
    room = least - matrix[:, ~free] @ start[~free]
    rules = [LinearConstraint(matrix[felt][:, free], room[felt], np.inf)] if felt.any() else []
    minimize(
        cost,
        start[free],
        jac=slope,
        method="SLSQP",
        bounds=reach,
        constraints=rules,
        options={"maxiter": STEPS_MAX, "ftol": precision},
    )
    return space.vector(best.at), best.burns_m_s


def explain_failure(result: PassResult, plans: int) -> str:
    """Explain a design without a plan: its best pass, and the limit that this pass violates most."""
    stage, mission = result.stage, result.mission
    worst, most = "the final state", 0.0
    for name, margins in stage.margins.items():
        least = int(np.argmin(margins.margin))
        amount = -float(margins.margin[least])
        if amount > most:
            most, unit = amount, stage.unit(name)
            short = f"{amount * scales(mission.units)[unit]:.3g} {unit}"
            at = mission.times_s[margins.nodes[least]]
            worst = f"{name}, short by {short} {at:.0f} s into the pass"
    between = ""
    if mission.scenario.boundary.home is not None:
        departure, arrival = np.rad2deg(result.at.phases) % 360.0
        between = f" from {departure:.1f} to {arrival:.1f} deg"
    return (
        f"no pass found in {plans} plans; the one that came furthest, of {stage.problem}{between} "
        f"with burns at "
        f"{', '.join(f'{time:.0f}' for time in result.at.times_s)} s, was stopped by {worst}"
    )
