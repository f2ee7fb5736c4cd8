"""Move the burns of a pass between fixed states, by rounds of plans and of programs with free times.

A plan with given times has facets and a grid of its own. The program with these facets and free times
starts from the plan. Both alternate until a round gains little.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from formulations.arrays import Array
from formulations.program.multipliers import multipliers
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import ROOM_S
from scp_recon.passes.descent import PassResult
from scp_recon.passes.space import Pass, Space, nearest_legal
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.method import FacetRounds
from scp_recon.planning.plan import StageSpec, rank
from scp_recon.planning.planner import Planner
from scp_recon.planning.stages import Pipeline


@dataclass(frozen=True)
class RulePrice:
    """What a rule of the firing times costs.

    Attributes:
        rule: in words.
        saving_m_s2: delta-v that each second less of the rule would save, at first order.
    """

    rule: str
    saving_m_s2: float

    def __str__(self) -> str:
        """In words, for five minutes."""
        return f"{self.rule}: 300 s less would save {300e3 * self.saving_m_s2:.2g} mm/s"


@dataclass(frozen=True)
class Timing:
    """Rounds about one space; `certain` leaves uncertainty out: P3 in place of P2."""

    space: Space
    facet_rounds: FacetRounds
    certain: bool = False

    def descend(
        self,
        at: Pass,
        burns_m_s: Array,
        observe: Callable[[PassResult], None],
        rounds_max: int,
        worth: float,
        rival_m_s: float = np.inf,
    ) -> PassResult:
        """Find the best times from those of a pass; they are never worse than the start's.

        The first plan starts from the given burns, J2000, m/s, shape (m, 3). A round is followed by
        another if its relative gain is at least `worth`, and if the pass is not dearer than a rival by
        more than that.
        """
        best = self.plan(self._with_room(at), burns_m_s)
        observe(best)
        for _ in range(rounds_max):
            freed = self.freed(best)
            if freed is None:
                break
            again = self.plan(freed.at, freed.burns_m_s)
            observe(again)
            better = rank(again.stage) > rank(best.stage)
            gain = 1.0 - again.dv_m_s / best.dv_m_s if best.converged else float(again.converged)
            best = again if better else best
            if not better or gain < worth or best.dv_m_s > (1.0 + worth) * rival_m_s:
                break
        return best

    def _with_room(self, at: Pass) -> Pass:
        """The nearest times that may be rounded, if there are any."""
        space, times = self.space, at.times_s
        rules, before = space.mission.scenario.schedule, space.before(times)
        legal = nearest_legal(times, space.time_spans, space.window_s, before, rules, ROOM_S)
        return at if legal is None else Pass(at.phases, legal)

    def plan(self, at: Pass, burns_m_s: Array) -> PassResult:
        """The plan at given times, started from burns."""
        mission = self.space.mission_of(at)
        plan = Planner(mission).plan(
            from_burns(mission, burns_m_s),
            problem="P3" if self.certain else "P2",
            facet_rounds=self.facet_rounds,
            once=True,
        )
        return PassResult(at, mission, plan.final)

    def freed(self, result: PassResult) -> PassResult | None:
        """The program with a plan's facets and free times, started from it; None if all are given."""
        mission = replace(result.mission, firing_spans_s=self.space.time_spans)
        if mission.firing is None:
            return None
        planner, lin = Planner(mission), result.stage.result.lin
        pipeline = Pipeline(mission, planner)
        stage = pipeline.solve(self._spec(planner, result), pipeline.start(lin.iterate))
        iterate, problem = stage.result.lin.iterate, stage.result.lin.problem
        times = np.array(result.at.times_s)
        assert problem.firing is not None
        times[problem.firing.burns] = mission.units.time_s * problem.firing_times(iterate.times)
        at = Pass(result.at.phases, tuple(map(float, times)))
        return PassResult(at, mission, stage)

    def _spec(self, planner: Planner[Mission], result: PassResult) -> StageSpec:
        if self.certain:
            return planner.p3
        facets, lin = result.stage.facets, result.stage.result.lin
        return planner.exact_stages()[-1] if facets is None else planner.p2_stage(facets, lin)

    def prices(self, result: PassResult) -> tuple[RulePrice, ...]:
        """What each rule costs that binds at the times of a converged pass, the dearest first."""
        freed = self.freed(result)
        if freed is None or not freed.converged:
            return ()
        lin, merit, units = freed.stage.result.lin, freed.stage.merit, freed.mission.units
        firing = lin.problem.firing
        assert firing is not None
        own = multipliers(merit.problem, merit.rows, lin)[-len(firing.names) :]
        rate = units.speed_m_s / units.time_s
        found = [
            RulePrice(name, float(price) * rate)
            for name, price in zip(firing.names, own, strict=True)
            if price > PRICELESS
        ]
        return tuple(sorted(found, key=lambda one: -one.saving_m_s2))


PRICELESS = 1e-6
"""Multiplier up to which a rule costs nothing: its unit is the speed's over the time's."""
