"""Find the cheapest pass near a given one, by plans and by programs with free times and phases.

A plan at given times and phases has facets and a grid of its own. The program with these facets, in
which times and phases are controls too, starts from the plan. Both alternate until a round gains
little.
Within a program a companion stays where it was at each node, and the Sun at each burn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import Facets
from formulations.program.multipliers import multipliers
from formulations.rows.exact_flight import FlightRows
from scp_recon.display import digits
from scp_recon.mission.firing import BEFORE_END, FREE_SPAN_S, HomePhases
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import ROOM_S
from scp_recon.passes.space import Pass, Space
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.method import FacetRounds
from scp_recon.planning.plan import Stage, StageSpec, rank, scales
from scp_recon.planning.planner import Planner
from scp_recon.planning.records import Problem
from scp_recon.planning.solver import FEW_LINES, FINE, facets_at
from scp_recon.planning.stages import Pipeline
from scp_recon.scp.status import Status

PRICELESS = 1e-6
"""Multiplier up to which a rule costs nothing: its unit is the speed's over the time's."""

Observe = Callable[["PassResult"], object]


@dataclass(frozen=True, eq=False)
class PassResult:
    """A pass with its mission and its plan, the last stage of P3 or P2.

    Attributes:
        space: of the pass.
        at: the pass.
        mission: of it.
        stage: of P3 or P2.
    """

    space: Space
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


class Effort(NamedTuple):
    """How long a descent goes on.

    Attributes:
        rounds: at most.
        worth: relative gain of a round after which another one is made.
        iterations: of each program with free times, at most: the next round's has a grid of its own.
        resolution: relative reduction of the merit at which programs stop.
    """

    rounds: int
    worth: float
    iterations: int
    resolution: float = 0.0


PATIENCE = 1
"""Rounds in turn that may gain too little: facets chosen anew may cost more at first."""
PRICING = 40
"""Iterations of the program that prices rules, from its solution."""


@dataclass(frozen=True)
class RulePrice:
    """What a rule of the firing times costs.

    Attributes:
        rule: in words.
        saving_m_s2: delta-v that each second less of the rule, or more of a span, would save, at
            first order.
    """

    rule: str
    saving_m_s2: float

    def __str__(self) -> str:
        """In words, for five minutes."""
        change = "more" if self.rule.endswith(BEFORE_END) else "less"
        return f"{self.rule}: 300 s {change} would save {300e3 * self.saving_m_s2:.2g} mm/s"


@dataclass(frozen=True)
class Timing:
    """Rounds about one space; `certain` leaves uncertainty out: P3 in place of P2.

    From a home orbit a plan has the facets along the flight from which it starts, and exact risk is
    computed by few directions: the pass found is planned as any other after that.
    """

    space: Space
    facet_rounds: FacetRounds
    certain: bool = False

    def descend(
        self,
        at: Pass,
        burns_m_s: Array,
        observe: Observe,
        effort: Effort,
        rival_m_s: float = np.inf,
    ) -> PassResult:
        """Find the best pass from a given one; it is never worse than the start.

        The first plan starts from the given burns, J2000, m/s, shape (m, 3). A round is followed by
        another if its relative gain is worth it, or that of the round before was, and if the pass is
        not dearer than a rival by more than that.
        """
        failed, rough = 0, effort.resolution
        legal = self.space.nearest_legal(at.times_s, ROOM_S)  # which may be rounded
        at = at if legal is None else Pass(at.phases, legal)
        best = last = self.plan(at, burns_m_s, resolution=rough)
        observe(best)
        for _ in range(effort.rounds):
            freed = self.freed(last, effort.iterations, rough)
            if freed is None:
                break
            last = self.plan(freed.at, freed.burns_m_s, again=True, resolution=rough)
            observe(last)
            goal = (1.0 - effort.worth) * best.dv_m_s if best.converged else np.inf
            failed = 0 if last.dv_m_s < goal else failed + 1
            best = max(best, last, key=lambda one: rank(one.stage))
            if failed > PATIENCE or best.dv_m_s > (1.0 + effort.worth) * rival_m_s:
                break
        return best

    def plan(
        self, at: Pass, burns_m_s: Array, *, again: bool = False, resolution: float = 0.0
    ) -> PassResult:
        """The plan at given times and phases, started from burns; `again` from those of P2."""
        mission = self.space.mission_of(at).along(burns_m_s)
        planner, guess = Planner(mission), from_burns(mission, burns_m_s)
        if not self.space.has_home:
            problem: Problem = "P3" if self.certain else "P2"
            rounds = self.facet_rounds
            plan = planner.plan(guess, problem=problem, facet_rounds=rounds, once=True)
            return PassResult(self.space, at, mission, plan.final)
        pipeline, facets = Pipeline(mission, planner), None
        start = pipeline.start(guess)
        if not self.certain and mission.risk.allocation == "uniform":
            if not again:
                p3 = replace(planner.p3, resolution=resolution)
                start = pipeline.solve(p3, start).result.lin
            facets = facets_at(mission, start)
        spec = self._spec(planner, facets, start, again=again)
        stage = pipeline.solve(replace(spec, resolution=resolution), start)
        return PassResult(self.space, at, mission, stage)

    def _spec(
        self,
        planner: Planner[Mission],
        facets: Facets | None,
        lin: Linearisation,
        *,
        again: bool = False,
    ) -> StageSpec:
        """P3, P2 with facets, or exact risk, of whole flights from a home orbit by few directions."""
        if self.certain:
            return planner.p3
        if facets is not None:
            return planner.p2_stage(facets, lin, again=again)
        final = planner.exact_stages()[-1]
        if self.space.has_home and isinstance(final.rows, FlightRows):
            rows = FlightRows(final.rows.problem, planner.target, FEW_LINES, FINE).bundled()
            return replace(final, rows=rows)
        return final

    def freed(
        self, result: PassResult, iterations: int = PRICING, resolution: float = 0.0
    ) -> PassResult | None:
        """The program with a plan's facets and free times and phases; None if all are given."""
        space, home = self.space, None
        if space.has_home:
            home = HomePhases(space.ring, result.at.phases, space.phase_spans)
        flown = result.mission.scenario.burns_flown
        mission = replace(result.mission, firing_spans_s=space.time_spans[flown:], home=home)
        if mission.firing is None:
            return None
        planner, lin = Planner(mission), result.stage.result.lin
        pipeline = Pipeline(mission, planner)
        spec = self._spec(planner, result.stage.facets, lin)
        spec = replace(spec, max_iterations=iterations, resolution=resolution)
        start = pipeline.start(lin.iterate)
        if lin.iterate.gains.any():
            start = mission.dynamics.linearise(spec.rows.problem, lin.iterate)
        stage = pipeline.solve(spec, start)
        iterate, problem = stage.result.lin.iterate, stage.result.lin.problem
        assert problem.firing is not None
        moved, burns = problem.firing_times(iterate.times), problem.firing.burns
        times, phases = np.array(result.at.times_s), result.at.phases
        times[flown + burns] = mission.units.time_s * moved[: len(burns)]
        if problem.firing.boundary is not None:
            first, last = problem.firing.phases(moved).tolist()
            phases = first, last
        return PassResult(space, Pass(phases, tuple(map(float, times))), mission, stage)

    def prices(self, result: PassResult) -> tuple[RulePrice, ...]:
        """What each rule costs that binds at the times of a converged pass, the dearest first.

        None with drifts: their rows have kinks at an optimum, where a multiplier holds for one
        direction only. In the default scenario 60 s more of a rule cost what it says, and 60 s less
        saved a hundredth of that. None with gains and exact risk: the merit is flat in the gains, and
        with what is left of its slope multipliers were wrong by up to four times. With gains and
        uniform risk they are right to 6 % for 60 s.
        """
        problem = result.mission.problem
        exact = result.mission.risk.allocation == "exact"
        given = all(high - low <= FREE_SPAN_S for low, high in self.space.time_spans)
        if given or problem.drifts or (problem.feedback is not None and exact):
            return ()
        freed = self.freed(result)
        if freed is None or not freed.converged:
            return ()
        lin, merit, units = freed.stage.result.lin, freed.stage.merit, freed.mission.units
        firing = lin.problem.firing
        if firing is None or not firing.names:
            return ()
        own = multipliers(merit.problem, merit.rows, lin)[-len(firing.names) :]
        rate = units.speed_m_s / units.time_s
        in_time = np.any(firing.matrix[:, : len(firing.burns)], axis=1)  # a phase has no seconds
        found = [
            RulePrice(name, float(price) * rate)
            for name, price, timed in zip(firing.names, own, in_time, strict=True)
            if timed and price > PRICELESS
        ]
        return tuple(sorted(found, key=lambda one: -one.saving_m_s2))


def explain_failure(result: PassResult, plans: int) -> str:
    """Explain a design without a plan: its best pass, and the limit that this pass violates most."""
    stage, mission = result.stage, result.mission
    worst, most = "the final state", 0.0
    for name, margins in stage.margins.items():
        least = int(np.argmin(margins.margin))
        amount = -float(margins.margin[least])
        if amount > most:
            most, unit = amount, stage.unit(name)
            short = f"{digits(amount * scales(mission.units)[unit], 3)} {unit}"
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
