"""Design a pass: map both phases, descend from the map's minima, and refine the best pass.

Refining also changes the number of burns. If errors shrink with the burns, the primer shows where
another burn helps, and a useless burn vanishes. If errors do not shrink, there is no such
derivative. The design then tries one more burn between any two, and one burn less.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np

from formulations.arrays import Array, Booleans
from scp_recon.mission.mission import Mission
from scp_recon.passes.scan import phases, scan, starts
from scp_recon.passes.space import BURNS_MAX, Pass, Space, has_given_times, settled, spaces_of
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
    """A plan made during the design.

    Attributes:
        step: the step of the design that the plan belongs to.
        result: the pass and its plan.
        expected: number of plans of the step, of which only that of a map of several pairs of phases is
            known beforehand.
    """

    step: Step
    result: PassResult
    expected: int | None = None


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pass to descend from, and burns to start from, J2000, m/s, shape (m, 3)."""

    space: Space
    at: Pass
    burns_m_s: Array


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
    exact: list[PassResult] = field(default_factory=list)
    corrected: Plan | None = None

    @property
    def _is_exact(self) -> bool:
        return self.scenario.risk.allocation == "exact"

    @property
    def effort(self) -> Effort:
        """Settings of the last descents before those with exact risk."""
        return FIRST if self._is_exact else LAST

    def run(self) -> PassResult:
        """Find the cheapest pass; if none converged, the one with the least violation.

        Raises:
            InputError: see `spaces_of`.
        """
        if self.scenario.policy.kind == "feedback":
            return self._with_corrections(spaces_of(self.scenario))
        spaces = spaces_of(self.scenario.replace(SURROGATE) if self._is_exact else self.scenario)
        begun: list[PassResult] = []
        for space in spaces:
            begun.append(self._map_and_descend(space))
            if begun[-1].converged:
                break
        else:
            best = min(begun, key=violation)
            # Exact risk requires less than what stands for it.
            return self._descend_exact(best) if self._is_exact else best
        first, others = begun[-1], spaces[len(begun) :]  # the earlier ones have no pass
        best = self._chosen([first, *self._other_windows(others, first)])
        if not self.exact:
            best = self._descend("refinement", best, self.effort)
        varied = self._vary_burns(best)
        if not self._is_exact:
            return varied
        cheaper = varied.dv_m_s <= (1.0 - self.effort.worth) * best.dv_m_s
        if not self.exact or cheaper or len(varied.at.times_s) != len(best.at.times_s):
            self._compare_exact([varied])
        return self._without_vanished(cheapest(self.exact))

    def _with_corrections(self, spaces: list[Space]) -> PassResult:
        """The first pass that has a plan with gains, of those that are cheapest without uncertainty.

        The cost of errors and limits without corrections says little about passes with corrections.
        Windows with more burns before them come first, because later burns correct earlier errors.
        """
        tries: list[PassResult] = []
        for space in sorted(spaces, key=lambda one: -one.before(one.times_s)):
            for one in self.certain(space)[:CORRECTED_MAX]:
                tries.append(self._correct(one) if one.converged else one)
                if tries[-1].converged:
                    return self._with_moved_cut_offs(tries[-1])
        return min(tries, key=violation)

    def _map(self, space: Space) -> list[PassResult]:
        cells = math.prod(len(phases(span)) for span in space.phase_spans)
        known = cells if cells > 1 else None  # one pair of phases has several plans
        return scan(space, partial(self._keep, "map", expected=known))

    def certain(self, space: Space) -> list[PassResult]:
        """Passes about a window without uncertainty, the cheapest first.

        Burns between departure and the last one before the window stay where they are: without errors
        some are zero, at any time, and how well they correct depends on their times.
        """
        mapped, spans = self._map(space), list(space.time_spans)
        for burn in range(1, space.before(space.times_s)):
            spans[burn] = (space.times_s[burn],) * 2
        still = replace(space, time_spans=tuple(spans))
        begun = [Candidate(still, one.at, one.burns_m_s) for one in starts(mapped, STARTS_MAX)]
        found = [self._search("certain", one, FIRST, certain=True) for one in begun]
        free = [replace(one, space=space) for one in found]
        return sorted(free, key=lambda one: one.dv_m_s) or [min(mapped, key=violation)]

    def _correct(self, one: PassResult) -> PassResult:
        """Plan a pass with gains, in its own scenario; landmarks are pictured along the given burns."""
        mission = Mission.from_scenario(settled(self.scenario, one.space, one.at))
        mission = mission.along(one.burns_m_s)
        planner = Planner(mission)
        plan = planner.plan(from_burns(mission, one.burns_m_s), once=True)
        result = self._keep("corrected", replace(one, mission=mission, stage=plan.final))
        for _ in range(AIMED_MAX if self._is_exact and result.converged else 0):
            again = planner.plan(plan, once=True)
            last = self._keep("corrected", replace(result, stage=again.final))
            if last.dv_m_s > (1.0 - AIMED_WORTH) * result.dv_m_s:
                break
            plan, result = again, last
        if result.converged:
            self.corrected = plan
        return result

    def _with_moved_cut_offs(self, planned: PassResult) -> PassResult:
        """The pass with the times at which it is cheapest with gains, or as it is planned.

        From a home orbit times stay: burns between departure and window are where they correct.
        """
        if planned.space.has_home:
            return planned
        space, first = planned.space.with_policy_of(self.scenario), self.corrected
        found = self._search("corrected", replace(planned, space=space), EXACT)
        if found.dv_m_s < planned.dv_m_s:
            again = self._correct(replace(found, space=planned.space))
            if again.dv_m_s < planned.dv_m_s:
                return again
        self.corrected = first
        return planned

    def _chosen(self, tries: list[PassResult]) -> PassResult:
        """The cheapest pass of all windows; of nearly equal ones, the cheapest by exact risk."""
        least = cheapest(tries)
        near = [one for one in tries if one.dv_m_s <= NEAR * least.dv_m_s]
        if not self._is_exact or len(near) == 1:
            return least
        near.sort(key=lambda one: one.dv_m_s)
        self._compare_exact(near)
        return near[self.exact.index(cheapest(self.exact))]

    def _compare_exact(self, passes: list[PassResult]) -> None:
        """Descend from passes under exact risk, each as long as it may beat all before it."""
        for one in passes:
            rival_m_s = min((other.dv_m_s for other in self.exact), default=np.inf)
            self.exact.append(self._descend_exact(one, rival_m_s))

    def _descend_exact(self, best: PassResult, rival_m_s: float = np.inf) -> PassResult:
        """Descend from a pass under the scenario's own, exact risk, as long as it may beat a rival."""
        space, given = best.space, self.scenario
        update = {"risk": given.risk, "polytopes": given.polytopes}
        own = space.mission.scenario.model_copy(update=update)
        best = replace(best, space=replace(space, mission=replace(space.mission, scenario=own)))
        if np.isfinite(rival_m_s):
            best = self._descend("exact", best, TRIED, rival_m_s)
            if best.dv_m_s > HOPEFUL * rival_m_s:
                return best
        return self._descend("exact", best, EXACT, rival_m_s)

    def _map_and_descend(self, space: Space, rival_m_s: float = np.inf) -> PassResult:
        """Map one window and descend from its minima: the best pass, or the one of least violation.

        Minima that cost more than a rival even without uncertainty are left.
        """
        mapped = self._map(space)
        tries: list[PassResult] = []
        for one in starts(mapped, STARTS_MAX):
            if one.dv_m_s > rival_m_s:
                break
            tries.append(self._descend("descent", one, FIRST))
            rival_m_s = min(rival_m_s, tries[-1].dv_m_s)
        if any(one.converged for one in tries):
            return cheapest(tries)
        return min(tries or mapped, key=violation)

    def _other_windows(self, others: list[Space], best: PassResult) -> Iterator[PassResult]:
        """Descend from a pass about the other windows, at their own legal times.

        A window in which that finds no pass is mapped: its passes may have other phases.
        """
        for other in others:
            begun = Candidate(other, Pass(best.at.phases, other.times_s), best.burns_m_s)
            found = self._descend("window", begun, FIRST)
            yield found if found.converged else self._map_and_descend(other, best.dv_m_s)

    def _vary_burns(self, best: PassResult) -> PassResult:
        """Leave out vanished burns and add others, as long as that helps."""
        if has_given_times(self.scenario):
            return best
        for _ in range(BURNS_MAX):
            best = self._without_vanished(best)
            tries = [
                self._search("number", other, self.effort, rival_m_s=best.dv_m_s)
                for other in other_counts(best)
            ]
            found = cheapest([best, *tries])
            if found.dv_m_s > (1.0 - self.effort.worth) * best.dv_m_s:
                break
            best = found
        return best

    def _without_vanished(self, best: PassResult) -> PassResult:
        """The pass without its vanished burns, unless it costs more or their times are given."""
        fewer = vanished(best)
        if fewer is None or has_given_times(self.scenario):
            return best
        found = self._search("fewer", fewer, self.effort, rival_m_s=best.dv_m_s)
        return found if found.dv_m_s <= (1.0 + self.effort.worth) * best.dv_m_s else best

    def _descend(
        self,
        step: Step,
        begun: Candidate | PassResult,
        effort: Effort,
        rival_m_s: float = np.inf,
    ) -> PassResult:
        """Descend from a pass; if that does not converge, without uncertainty first, and from there."""
        result = self._search(step, begun, effort, rival_m_s=rival_m_s)
        if result.converged:
            return result
        sure = self._search("certain", begun, effort, certain=True)
        return self._search(step, sure, effort) if sure.converged else result

    def _search(
        self,
        step: Step,
        begun: Candidate | PassResult,
        effort: Effort,
        *,
        certain: bool = False,
        rival_m_s: float = np.inf,
    ) -> PassResult:
        """Find the best pass from a given one."""
        timing, keep = Timing(begun.space, self.facet_rounds, certain), partial(self._keep, step)
        return timing.descend(begun.at, begun.burns_m_s, keep, effort, rival_m_s)

    def _keep(self, step: Step, result: PassResult, expected: int | None = None) -> PassResult:
        """Keep and report a plan."""
        self.trials.append(Trial(step, result, expected))
        self.observe(self.trials[-1])
        return result


def cheapest(tries: Iterable[PassResult]) -> PassResult:
    """The cheapest of some passes; any of them if none converged."""
    return min(tries, key=lambda one: one.dv_m_s)


def violation(result: PassResult) -> float:
    """Largest violation of a pass's plan."""
    return result.stage.violation


def vanished(result: PassResult) -> Candidate | None:
    """The pass without its vanished inner burns; None if no burn has vanished."""
    there = np.linalg.norm(result.burns_m_s, axis=1) > VANISHED_M_S
    there[[0, -1]] = True
    return None if there.all() else _only(result, there)


def other_counts(result: PassResult) -> list[Candidate]:
    """Passes with one burn more, and without a primer also with one less."""
    history = primer_history(result.mission, result.stage)
    times, every = result.at.times_s, np.arange(len(result.at.times_s))
    if history is not None:
        places, fewer = peaks(history), []
    else:
        places = [0.5 * (first + second) for first, second in itertools.pairwise(times)]
        fewer = [_only(result, every != gone) for gone in every[1:-1]]
    room = len(times) < BURNS_MAX
    more = [_with_burn(result, place) for place in places if room]
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


def _with_burn(result: PassResult, time_s: float) -> Candidate | None:
    """The pass with another burn at a time, the others moved as little as the rules require."""
    space, times = result.space, result.at.times_s
    spans = space.time_spans
    place = int(np.clip(np.searchsorted(times, time_s), 1, len(times) - 1))
    inner = spans[1] if len(spans) > 2 else (spans[0][0], spans[-1][1])
    wanted = (*times[:place], time_s, *times[place:])
    wider = replace(space, time_spans=(*spans[:place], inner, *spans[place:]))
    legal = wider.nearest_legal(wanted)
    if legal is None:
        return None
    burns = np.insert(result.burns_m_s, place, 0.0, axis=0)
    return Candidate(wider, Pass(result.at.phases, legal), burns)


def _only(result: PassResult, there: Booleans) -> Candidate:
    """The pass with some of its burns."""
    spans = tuple(itertools.compress(result.space.time_spans, there))
    times = tuple(itertools.compress(result.at.times_s, there))
    space, at = replace(result.space, time_spans=spans), Pass(result.at.phases, times)
    return Candidate(space, at, result.burns_m_s[there])
