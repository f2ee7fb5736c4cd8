"""Design a pass: map both phases, descend from the map's minima, and refine the best pass.

Refining also changes the number of burns. If errors shrink with the burns, the primer shows where
another burn helps, and a useless burn vanishes. If errors do not shrink, there is no such
derivative. The design then tries one more burn between any two, and one burn less.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from formulations.arrays import Array, Booleans
from scp_recon.mission.mission import Mission
from scp_recon.passes.scan import phases, scan, starts
from scp_recon.passes.setting import BURNS_MAX, settled, spaces_of
from scp_recon.passes.space import Pass, Space, nearest_legal
from scp_recon.passes.timing import Effort, PassResult, Timing
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.method import SETTLE, FacetRounds
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import Planner
from scp_recon.planning.primer import WORTH as PRIMER_WORTH
from scp_recon.planning.primer import PrimerHistory, primer_history
from scp_recon.scenario.schema import Scenario

STARTS_MAX = 4
"""Number of the map's minima from which descents begin."""
FIRST = Effort(6, 1e-2, 15, 1e-3)
LAST = Effort(12, 1e-4, 40, 1e-4)
EXACT = Effort(6, 1e-3, 40)
"""Effort of descents for comparison, of the last descents, and of those with exact risk or gains."""
SURROGATE = {
    "risk": {"allocation": "uniform", "scope": "node"},
    "polytopes": {"ball": "tangent", "cone": 12},
}
"""Risk planned with in place of exact risk until the last descent: quicker, and near it."""

TRIED, HOPEFUL = Effort(1, 1e-3, 15, 1e-3), 1.02
"""Effort of a first descent with exact risk beside a rival, and cost over it up to which another
follows."""

NEAR = 1.1
"""Ratio of the costs of two windows' passes below which exact risk compares them."""

CORRECTED_MAX = 3
"""Largest number of passes planned with gains until one has a plan."""

AIMED_MAX, AIMED_WORTH = 3, 1e-3
"""Largest number of times that a plan with gains is continued, whose directions are then where its own
flights fail, and the relative gain that is worth it: Kingfisher's becomes 1 to 2 % cheaper."""

PLACES_MAX = 3
"""Peaks of the primer at which another burn is tried."""
VANISHED_M_S = 1e-6
"""Size in m/s below which a burn has vanished."""

Step = Literal[
    "map", "descent", "certain", "window", "refinement", "fewer", "number", "exact", "corrected"
]


@dataclass(frozen=True, eq=False)
class Trial:
    """A plan made during the design, and the number of its lighting window, from 0.

    The pass's own times count from `begin_s` past the scenario's epoch.

    Attributes:
        step: the step of the design that the plan belongs to.
        window: number of the lighting window, from 0.
        begin_s: where the pass's times begin.
        result: the pass and its plan.
        expected: number of plans of the step, of which only that of a map of several pairs of phases is
            known beforehand.
    """

    step: Step
    window: int
    begin_s: float
    result: PassResult
    expected: int | None = None


@dataclass(frozen=True, eq=False)
class Around:
    """A window's space and number, its time zero past the scenario's epoch, s, and legal times."""

    space: Space
    number: int
    begin_s: float
    times_s: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pass with another number of burns, and burns to start from, J2000, m/s, shape (m, 3)."""

    space: Space
    at: Pass
    burns_m_s: Array


Best = tuple[Around, PassResult]
"""A pass and its window."""


@dataclass
class Designer:
    """Designs a pass for a scenario; keeps every plan and reports it to `observe`.

    `facet_rounds` are those of plans between given states. `exact` are passes under exact risk, and
    `corrected` is the found pass's plan with gains, for a scenario with feedback.
    """

    scenario: Scenario
    observe: Callable[[Trial], None]
    facet_rounds: FacetRounds = SETTLE
    trials: list[Trial] = field(default_factory=list)
    exact: list[Best] = field(default_factory=list)
    corrected: Plan | None = None

    @property
    def effort(self) -> Effort:
        """Settings of the last descents before those with exact risk."""
        return FIRST if self.scenario.risk.allocation == "exact" else LAST

    @property
    def _rival_m_s(self) -> float:
        """Least cost under exact risk so far."""
        return min((one.dv_m_s for _, one in self.exact), default=np.inf)

    def run(self) -> tuple[Space, PassResult]:
        """Find the cheapest pass and its space; if none converged, the one with the least violation.

        Raises:
            InputError: see `spaces_of`.
        """
        exact = self.scenario.risk.allocation == "exact"
        given = self.scenario.changed(SURROGATE) if exact else self.scenario
        if self.scenario.policy.kind == "feedback":
            return self._with_corrections(windows_of(self.scenario))
        around = windows_of(given)
        begun = []
        for first in around:
            begun.append(self._map_and_descend(first))
            if begun[-1][1].converged:
                break
        where, best = begun[-1]
        if not best.converged:
            where, best = min(begun, key=lambda one: violation(one[1]))
            if exact:  # which requires less than what stands for it
                where, best = self._descend_exact(where, best)
            return where.space, best
        others = around[len(begun) :]  # the earlier ones have no pass
        where, best = self._chosen([(where, best), *self._other_windows(others, best)])
        if not self.exact:
            best = self._descent(where, "refinement", best.at, best, self.effort)
        chosen = best
        where, best = self._vary_burns(where, best)
        if exact:
            cheaper = best.dv_m_s <= (1.0 - self.effort.worth) * chosen.dv_m_s
            if not self.exact or cheaper or len(best.at.times_s) != len(chosen.at.times_s):
                self.exact.append(self._descend_exact(where, best, self._rival_m_s))
            where, best = self._without_vanished(*cheapest(self.exact))
        return where.space, best

    def _with_corrections(self, around: list[Around]) -> tuple[Space, PassResult]:
        """The first pass that has a plan with gains, of those that are cheapest without uncertainty.

        The cost of errors and limits without corrections says little about passes with corrections.
        Windows with more burns before them come first, because later burns correct earlier errors.
        """
        tries: list[Best] = []
        for where in sorted(around, key=lambda one: -one.space.before(one.times_s)):
            for one in self.certain(where)[:CORRECTED_MAX]:
                planned = self._correct(where, one) if one.converged else one
                tries.append((where, planned))
                if planned.converged:
                    return where.space, self._with_moved_cut_offs(where, planned)
        where, best = min(tries, key=lambda one: violation(one[1]))
        return where.space, best

    def _map(self, where: Around) -> list[PassResult]:
        cells = math.prod(len(phases(span)) for span in where.space.phase_spans)
        known = cells if cells > 1 else None  # one pair of phases has several plans
        return scan(where.space, where.times_s, self._seen("map", where, known))

    def certain(self, where: Around) -> list[PassResult]:
        """Passes about a window without uncertainty, the cheapest first.

        Burns between departure and the last one before the window stay where they are: without errors
        some are zero, at any time, and how well they correct depends on their times.
        """
        mapped = self._map(where)
        seen, spans = self._seen("certain", where), list(where.space.time_spans)
        for burn in range(1, where.space.before(where.times_s)):
            spans[burn] = (where.times_s[burn],) * 2
        space = replace(where.space, time_spans=tuple(spans))
        found = [
            self._search(space, one.at, one.burns_m_s, seen, FIRST, certain=True)
            for one in starts(mapped, STARTS_MAX)
        ]
        return sorted(found, key=lambda one: one.dv_m_s) or [min(mapped, key=violation)]

    def _correct(self, where: Around, one: PassResult) -> PassResult:
        """Plan a pass with gains, in its own scenario; landmarks are pictured along the given burns."""
        mission = Mission.from_scenario(settled(self.scenario, where.space, one.at))
        mission, seen = mission.along(one.burns_m_s), self._seen("corrected", where)
        planner = Planner(mission)
        plan = planner.plan(from_burns(mission, one.burns_m_s), once=True)
        seen(result := PassResult(one.at, mission, plan.final))
        for _ in range(AIMED_MAX if mission.risk.allocation == "exact" and result.converged else 0):
            again = planner.plan(plan, once=True)
            seen(last := PassResult(one.at, mission, again.final))
            if last.dv_m_s > (1.0 - AIMED_WORTH) * result.dv_m_s:
                break
            plan, result = again, last
        if result.converged:
            self.corrected = plan
        return result

    def _with_moved_cut_offs(self, where: Around, planned: PassResult) -> PassResult:
        """The pass with the times at which it is cheapest with gains, or as it is planned.

        From a home orbit times stay: burns between departure and window are where they correct.
        """
        if where.space.has_home:
            return planned
        space, first = where.space.with_policy_of(self.scenario), self.corrected
        seen = self._seen("corrected", where)
        found = self._search(space, planned.at, planned.burns_m_s, seen, EXACT)
        if found.dv_m_s < planned.dv_m_s:
            again = self._correct(where, found)
            if again.dv_m_s < planned.dv_m_s:
                return again
        self.corrected = first
        return planned

    def _chosen(self, tries: list[Best]) -> Best:
        """The cheapest pass of all windows; of nearly equal ones, the cheapest by exact risk."""
        least = cheapest(tries)
        near = [one for one in tries if one[1].dv_m_s <= NEAR * least[1].dv_m_s]
        if self.scenario.risk.allocation != "exact" or len(near) == 1:
            return least
        near.sort(key=lambda one: one[1].dv_m_s)
        for where, best in near:
            self.exact.append(self._descend_exact(where, best, self._rival_m_s))
        return near[self.exact.index(cheapest(self.exact))]

    def _descend_exact(self, where: Around, best: PassResult, rival_m_s: float = np.inf) -> Best:
        """Descend from a pass under the scenario's own, exact risk, as long as it may beat a rival."""
        space, given = where.space, self.scenario
        update = {"risk": given.risk, "polytopes": given.polytopes}
        own = space.mission.scenario.model_copy(update=update)
        where = replace(where, space=replace(space, mission=replace(space.mission, scenario=own)))
        if np.isfinite(rival_m_s):
            best = self._descent(where, "exact", best.at, best, TRIED, rival_m_s)
            if best.dv_m_s > HOPEFUL * rival_m_s:
                return where, best
        return where, self._descent(where, "exact", best.at, best, EXACT, rival_m_s)

    def _map_and_descend(self, first: Around, rival_m_s: float = np.inf) -> Best:
        """Map one window and descend from its minima: the best pass, or the one of least violation.

        Minima that cost more than a rival even without uncertainty are left.
        """
        mapped = self._map(first)
        tries: list[PassResult] = []
        for one in starts(mapped, STARTS_MAX):
            if one.dv_m_s > rival_m_s:
                break
            tries.append(self._descent(first, "descent", one.at, one, FIRST))
            rival_m_s = min(rival_m_s, tries[-1].dv_m_s)
        held = [one for one in tries if one.converged]
        if held:
            return first, min(held, key=lambda one: one.dv_m_s)
        return first, min(tries or mapped, key=violation)

    def _other_windows(self, others: Iterable[Around], best: PassResult) -> Iterable[Best]:
        """Descend from a pass about the other windows, at their own legal times.

        A window in which that finds no pass is mapped: its passes may have other phases.
        """
        for other in others:
            at = Pass(best.at.phases, other.times_s)
            found = self._descent(other, "window", at, best, FIRST)
            yield (other, found) if found.converged else self._map_and_descend(other, best.dv_m_s)

    def _vary_burns(self, where: Around, best: PassResult) -> Best:
        """Leave out vanished burns and add others, as long as that helps."""
        if self.scenario.design is not None and self.scenario.design.burn_times == "given":
            return where, best
        for _ in range(BURNS_MAX):
            where, best = self._without_vanished(where, best)
            tries = [
                self._descend_candidate("number", where, other, best.dv_m_s)
                for other in other_counts(where.space, best)
            ]
            there, result = cheapest([(where, best), *tries])
            if result.dv_m_s > (1.0 - self.effort.worth) * best.dv_m_s:
                break
            where, best = there, result
        return where, best

    def _without_vanished(self, where: Around, best: PassResult) -> Best:
        """The pass without its vanished burns, unless it costs more or their times are given."""
        design, fewer = self.scenario.design, vanished(where.space, best)
        if fewer is None or (design is not None and design.burn_times == "given"):
            return where, best
        there, result = self._descend_candidate("fewer", where, fewer, best.dv_m_s)
        if result.dv_m_s <= (1.0 + self.effort.worth) * best.dv_m_s:
            return there, result
        return where, best

    def _descend_candidate(
        self, step: Step, where: Around, other: Candidate, rival_m_s: float
    ) -> Best:
        """Descend from a pass with another number of burns, as long as it may be worth it."""
        there = replace(where, space=other.space)
        seen = self._seen(step, there)
        return there, self._search(
            there.space, other.at, other.burns_m_s, seen, self.effort, rival_m_s=rival_m_s
        )

    def _descent(
        self,
        where: Around,
        step: Step,
        at: Pass,
        known: PassResult,
        effort: Effort,
        rival_m_s: float = np.inf,
    ) -> PassResult:
        """Descend from a pass, started from the burns of a known plan.

        If that does not converge, descend without uncertainty first, and from there again.
        """
        space, seen = where.space, self._seen(step, where)
        result = self._search(space, at, known.burns_m_s, seen, effort, rival_m_s=rival_m_s)
        if result.converged:
            return result
        sure = self._search(
            space, at, known.burns_m_s, self._seen("certain", where), effort, certain=True
        )
        if not sure.converged:
            return result
        return self._search(space, sure.at, sure.burns_m_s, seen, effort)

    def _search(
        self,
        space: Space,
        at: Pass,
        burns_m_s: Array,
        seen: Callable[[PassResult], None],
        effort: Effort,
        *,
        certain: bool = False,
        rival_m_s: float = np.inf,
    ) -> PassResult:
        """Find the best pass from a given one."""
        timing = Timing(space, self.facet_rounds, certain)
        return timing.descend(at, burns_m_s, seen, effort, rival_m_s)

    def _seen(
        self, step: Step, where: Around, expected: int | None = None
    ) -> Callable[[PassResult], None]:
        def seen(result: PassResult) -> None:
            self.trials.append(Trial(step, where.number, where.begin_s, result, expected))
            self.observe(self.trials[-1])

        return seen


def windows_of(scenario: Scenario) -> list[Around]:
    """Every window's space, its times from its own first burn on."""
    return [
        Around(space, number, times[0], tuple(time - times[0] for time in times))
        for number, (space, times) in enumerate(spaces_of(scenario))
    ]


def cheapest(tries: Iterable[Best]) -> Best:
    """The cheapest of some passes; any of them if none converged."""
    return min(tries, key=lambda one: one[1].dv_m_s)


def violation(result: PassResult) -> float:
    """Largest violation of a pass's plan."""
    return result.stage.merit.worst_violation(result.stage.result.lin)


def vanished(space: Space, result: PassResult) -> Candidate | None:
    """The pass without its vanished inner burns; None if no burn has vanished."""
    there = np.linalg.norm(result.burns_m_s, axis=1) > VANISHED_M_S
    there[[0, -1]] = True
    return None if there.all() else _chosen(space, result, there)


def other_counts(space: Space, result: PassResult) -> list[Candidate]:
    """Passes with one burn more, and without a primer also with one less."""
    history = primer_history(result.mission, result.stage)
    times, every = result.at.times_s, np.arange(space.n_burns)
    if history is not None:
        places, fewer = peaks(history), []
    else:
        places = [0.5 * (first + second) for first, second in itertools.pairwise(times)]
        fewer = [_chosen(space, result, every != gone) for gone in every[1:-1]]
    room = space.n_burns < BURNS_MAX
    more = [_with_burn(space, result, place) for place in places if room]
    # At several places the rules may leave a burn the same time.
    apart = {tuple(np.round(one.at.times_s)): one for one in more if one is not None}
    return [*apart.values(), *fewer]


def peaks(history: PrimerHistory) -> list[float]:
    """Times at which the allowed part of the primer exceeds one and is largest near by, s.

    Other burns are moved if they leave no room for one at such a time.
    """
    allowed = np.array(history.allowed)
    size = np.r_[-np.inf, allowed, -np.inf]
    peak = (size[1:-1] >= size[:-2]) & (size[1:-1] > size[2:]) & (size[1:-1] > 1.0 + PRIMER_WORTH)
    places = np.flatnonzero(peak)
    best = places[np.argsort(-allowed[places], kind="stable")][:PLACES_MAX]
    return [history.t_s[at] for at in best.tolist()]


def _with_burn(space: Space, result: PassResult, time_s: float) -> Candidate | None:
    """The pass with another burn at a time, the others moved as little as the rules require."""
    times, spans = result.at.times_s, space.time_spans
    place = int(np.clip(np.searchsorted(times, time_s), 1, len(times) - 1))
    inner = spans[1] if len(spans) > 2 else (spans[0][0], spans[-1][1])
    wanted = (*times[:place], time_s, *times[place:])
    wider = replace(space, time_spans=(*spans[:place], inner, *spans[place:]))
    rules = space.mission.scenario.schedule
    before = space.before(wanted)
    legal = nearest_legal(wanted, wider.time_spans, space.kept_window_s, before, rules)
    if legal is None:
        return None
    burns = np.insert(result.burns_m_s, place, 0.0, axis=0)
    return Candidate(wider, Pass(result.at.phases, legal), burns)


def _chosen(space: Space, result: PassResult, there: Booleans) -> Candidate:
    spans = tuple(itertools.compress(space.time_spans, there))
    times = tuple(itertools.compress(result.at.times_s, there))
    return Candidate(
        replace(space, time_spans=spans), Pass(result.at.phases, times), result.burns_m_s[there]
    )
