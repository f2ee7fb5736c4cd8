"""The loop around planning: a map over both phases, descents from its valleys, the best one refined."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Literal

from scp_recon.pass_design.local import ROUNDS_MAX, WORTH, descend
from scp_recon.pass_design.near import Found
from scp_recon.pass_design.number import Other, others, vanished
from scp_recon.pass_design.ring import TURN
from scp_recon.pass_design.scan import scan, starts
from scp_recon.pass_design.setting import BURNS_MAX, spaces_of
from scp_recon.pass_design.space import Pass, Space
from scp_recon.scenario.schema import Scenario

STARTS_MAX = 4
"""Valleys of the map from which descents begin."""
FIRST_ROUNDS, FIRST_WORTH = 2, 1e-2
"""Of the descents that are only to be compared."""
EXACT_ROUNDS, EXACT_WORTH = 3, 1e-3
"""Of the descent under exact risk, whose plans take ten times as long."""
SURROGATE = {
    "risk": {"allocation": "uniform", "scope": "node"},
    "polytopes": {"ball": "tangent", "cone": 12},
}
"""What stands for exact risk until the last descent: quicker, and near it."""

Step = Literal["map", "descent", "certain", "window", "refinement", "fewer", "number", "exact"]


@dataclass(frozen=True, eq=False)
class Tried:
    """A plan that was made on the way.

    Attributes:
        step: of the design.
        window: number of the lighting window, from 0.
        begin_s: past the scenario's epoch, where the pass's own times begin.
        found: the plan.
    """

    step: Step
    window: int
    begin_s: float
    found: Found


@dataclass(frozen=True, eq=False)
class Around:
    """A space, its number, when its times begin past the scenario's epoch, and legal times in it."""

    space: Space
    number: int
    begin_s: float
    times_s: tuple[float, ...]


@dataclass
class Designer:
    """A design at work.

    Attributes:
        scenario: with a home orbit.
        observe: called with every plan.
        tried: every plan.
    """

    scenario: Scenario
    observe: Callable[[Tried], None]
    tried: list[Tried] = field(default_factory=list)

    def run(self) -> tuple[Space, Found]:
        """The cheapest pass found, with its space; where none has a plan, the furthest that one came.

        Raises:
            InputError: see `spaces_of`.
        """
        exact = self.scenario.risk.allocation == "exact"
        given = self.scenario.changed(SURROGATE) if exact else self.scenario
        around = [
            Around(space, number, times[0], tuple(time - times[0] for time in times))
            for number, (space, times) in enumerate(spaces_of(given))
        ]
        begun = []
        for first in around:
            begun.append(self._begun(first))
            if begun[-1][1].converged:
                break
        where, best = begun[-1]
        if not best.converged:
            where, best = min(begun, key=lambda one: violation(one[1]))
            if exact:  # which asks for less than what stands for it
                where, best = self._exactly(where, best)
            return where.space, best
        others = around[len(begun) :]  # about those before there is no pass
        where, best = cheapest([(where, best), *self._elsewhere(others, best)])
        best = self._descent(where, "refinement", best.at, best, ROUNDS_MAX, WORTH)
        where, best = self._numbered(where, best, ROUNDS_MAX, WORTH)
        if exact:
            where, best = self._exactly(where, best)
        return where.space, best

    def _exactly(self, where: Around, best: Found) -> tuple[Around, Found]:
        """From a pass, under the scenario's own risk."""
        where = replace(where, space=under_risk_of(where.space, self.scenario))
        return where, self._descent(where, "exact", best.at, best, EXACT_ROUNDS, EXACT_WORTH)

    def _begun(self, first: Around) -> tuple[Around, Found]:
        """The best of descents from the valleys of a map about one window; if none, the furthest."""
        mapped = scan(first.space, first.times_s, self._seen("map", first))
        tries = [
            self._descent(first, "descent", one.at, one, FIRST_ROUNDS, FIRST_WORTH)
            for one in starts(mapped, STARTS_MAX)
        ]
        best = min(tries, key=lambda one: one.dv_m_s, default=None)
        if best is not None and best.converged:
            return first, best
        return first, furthest(tries or mapped)

    def _elsewhere(self, others: Iterable[Around], best: Found) -> Iterable[tuple[Around, Found]]:
        """The best pass about the other windows, at their own legal times."""
        for other in others:
            at = Pass(best.at.phases, other.times_s)
            yield other, self._descent(other, "window", at, best, FIRST_ROUNDS, FIRST_WORTH)

    def _numbered(
        self, where: Around, best: Found, rounds: int, worth: float
    ) -> tuple[Around, Found]:
        """With burns left out that have vanished and others added, as long as that helps."""
        if self.scenario.design is not None and self.scenario.design.burn_times == "given":
            return where, best
        for _ in range(BURNS_MAX):
            fewer = vanished(where.space, best)
            if fewer is not None:
                there, found = self._try("fewer", where, fewer, rounds, worth)
                if found.dv_m_s <= (1.0 + WORTH) * best.dv_m_s:
                    where, best = there, found
            tries = [
                self._try("number", where, other, rounds, worth)
                for other in others(where.space, best)
            ]
            there, found = cheapest([(where, best), *tries])
            if found.dv_m_s > (1.0 - worth) * best.dv_m_s:
                break
            where, best = there, found
        return where, best

    def _try(
        self, step: Step, where: Around, other: Other, rounds: int, worth: float
    ) -> tuple[Around, Found]:
        """From a pass with another number of burns."""
        there = replace(where, space=about(other.space, other.at))
        seen = self._seen(step, there)
        return there, descend(there.space, other.at, other.burns_m_s, seen, rounds, worth)

    def _descent(
        self, where: Around, step: Step, at: Pass, known: Found, rounds: int, worth: float
    ) -> Found:
        """From a pass, begun at the burns of a known plan.

        Where there is no plan, from a pass near by that is cheaper without uncertainty, and errs less.
        """
        space, seen = about(where.space, at), self._seen(step, where)
        found = descend(space, at, known.burns_m_s, seen, rounds, worth)
        if found.converged:
            return found
        seen_first = self._seen("certain", where)
        sure = descend(space, at, known.burns_m_s, seen_first, rounds, worth, certain=True)
        if not sure.converged:
            return found
        return descend(space, sure.at, sure.burns_m_s, seen, rounds, worth)

    def _seen(self, step: Step, where: Around) -> Callable[[Found], None]:
        def seen(found: Found) -> None:
            self.tried.append(Tried(step, where.number, where.begin_s, found))
            self.observe(self.tried[-1])

        return seen


def cheapest(tries: Iterable[tuple[Around, Found]]) -> tuple[Around, Found]:
    """The cheapest of some passes that have a plan, or any."""
    return min(tries, key=lambda one: one[1].dv_m_s)


def furthest(tries: Iterable[Found]) -> Found:
    """The one that violates least."""
    return min(tries, key=violation)


def violation(found: Found) -> float:
    """The largest of a try."""
    return found.stage.merit.worst_violation(found.stage.result.lin)


def about(space: Space, one: Pass) -> Space:
    """The same space, a whole turn of phases laid about a pass."""
    spans = [
        (phase - 0.5 * TURN, phase + 0.5 * TURN) if high - low >= TURN - 1e-9 else (low, high)
        for phase, (low, high) in zip(one.phases, space.phase_spans, strict=True)
    ]
    return replace(space, phase_spans=(spans[0], spans[1]))


def under_risk_of(space: Space, scenario: Scenario) -> Space:
    """The same space under a scenario's own risk and polytopes."""
    own = space.mission.scenario
    update = {"risk": scenario.risk, "polytopes": scenario.polytopes}
    return replace(space, mission=replace(space.mission, scenario=own.model_copy(update=update)))
