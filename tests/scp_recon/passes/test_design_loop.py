"""The loop of a design, its plans made up: which windows are tried, and what counts in the end."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

import scp_recon as sr
from scp_recon.passes import design
from scp_recon.passes.design import Candidate, Designer, Trial
from scp_recon.passes.space import Pass, spaces_of
from scp_recon.scenario.load import load_scenario
from tests.helpers import nightly
from tests.scp_recon.passes.support import MEASURED, home_scenario

SPANS = {"departure_s": [-20_000.0, 30_000.0], "arrival_s": [10_000.0, 70_000.0]}
"""Of dates with three windows."""


@dataclass(frozen=True)
class Made:
    """What stands for a plan."""

    space: Any
    at: Pass
    converged: bool
    cost: float = 1.0
    short: float = 0.0
    certain: bool = False

    @property
    def dv_m_s(self) -> float:
        return self.cost if self.converged else float("inf")

    @property
    def burns_m_s(self) -> Any:
        return np.ones((len(self.at.times_s), 3))


@dataclass
class World:
    """Which windows have plans, with uncertainty or without, by their edges."""

    mapped: set[int]
    planned: set[int]
    only_after_certain: bool = False
    costs: tuple[float, ...] = (3.0, 2.0, 1.0)

    def install(self, patch, edges: list[tuple[float, float]]) -> None:
        def scan(space: Any, seen: Any) -> list[Made]:
            at, one = Pass((0.0, 0.0), space.times_s), edges.index(space.window_s)
            seen(made := Made(space, at, one in self.mapped, short=1.0 + one))
            return [made]

        def descend(space: Any, at: Pass, certain: bool) -> Made:
            one = edges.index(space.window_s)
            eased = at.phases[0] == 0.5 or not self.only_after_certain
            there = certain or (one in self.planned and eased)
            begun = Pass((0.5, 0.0), at.times_s) if certain else at
            return Made(space, begun, there, self.costs[one], 0.1 * (1.0 + one), certain)

        patch.setattr(design, "scan", scan)
        search_by(patch, descend)
        patch.setattr(design, "starts", lambda found, _: [one for one in found if one.converged])
        patch.setattr(design, "violation", lambda one: one.short)
        patch.setattr(design, "vanished", lambda *_: None)
        patch.setattr(design, "other_counts", lambda *_: [])


def search_by(patch, descend: Any) -> None:
    """Put a function of space, pass and certainty in the place of the descents."""

    def search(self: Designer, step: Any, begun: Any, *_: Any, certain: bool = False, **__: Any):
        return self._keep(step, descend(begun.space, begun.at, certain))

    patch.setattr(Designer, "_search", search)


def mapped_of(tried: list[Trial]) -> list[int]:
    """Numbers of the windows that were mapped."""
    return [one.result.space.number for one in tried if one.step == "map"]


def run(
    world: World, patch, changes: dict[str, Any] | None = None, **others: Any
) -> tuple[Any, Any, int, list[Trial]]:
    """What is found, in which space and window, and all that was tried; with other stand-ins."""
    scenario = home_scenario(changes, SPANS)
    edges = [space.window_s for space in spaces_of(scenario)]
    assert len(edges) >= 3
    world.install(patch, edges)
    for name, function in others.items():
        if name == "descend":
            search_by(patch, function)
        else:
            patch.setattr(design, name, function)
    designer = Designer(scenario, lambda _: None)
    found = designer.run()
    return found, found.space, edges.index(found.space.window_s), designer.trials


def test_next_window_is_mapped_without_a_first_pass(monkeypatch):
    costs = tuple(float(10 - k) for k in range(12))
    found, _, window, tried = run(World({1, 2}, {2}, costs=costs), monkeypatch)
    assert found.converged
    assert window == 2
    mapped = mapped_of(tried)
    assert mapped == list(range(len(mapped)))  # also the later ones, none of which has a plan
    assert len(mapped) > 3
    assert all(one.expected == (36 if one.step == "map" else None) for one in tried)  # 6 x 6 phases


def test_later_windows_are_tried_and_the_cheapest_counts(monkeypatch):
    costs = (3.0, 1.0, *([5.0] * 10))
    everywhere = set(range(12))
    found, _, window, tried = run(World(everywhere, everywhere, costs=costs), monkeypatch)
    assert (found.cost, window) == (1.0, 1)
    assert mapped_of(tried) == [0]


@pytest.mark.parametrize(("costs", "chosen"), [((1.0, 2.0, 3.0), 0), ((1.0, 0.5, 3.0), 1)])
def test_a_later_window_without_a_descent_is_mapped(monkeypatch, costs, chosen):
    """A window has passes at its own phases alone, where descents from another window's fail."""
    edges = [space.window_s for space in spaces_of(home_scenario(None, SPANS))]

    def scan(space: Any, seen: Any) -> list[Made]:
        at = Pass((float(edges.index(space.window_s)), 0.0), space.times_s)
        seen(made := Made(space, at, True, 0.4))
        return [made]

    def descend(space: Any, at: Pass, _: bool) -> Made:
        window = edges.index(space.window_s)
        return Made(space, at, at.phases[0] == window, costs[min(window, 2)])

    found, _, window, tried = run(World(set(), set()), monkeypatch, scan=scan, descend=descend)
    assert mapped_of(tried) == list(range(len(edges)))
    assert (found.dv_m_s, window) == (costs[chosen], chosen)


def test_valley_without_a_plan_is_left_without_uncertainty(monkeypatch):
    world = World({0}, {0}, only_after_certain=True, costs=tuple(float(k) for k in range(12)))
    found, _, window, tried = run(world, monkeypatch)
    assert found.converged
    assert not found.certain
    assert window == 0
    first = [one.step for one in tried if one.step in ("descent", "certain")][:3]
    assert first == ["descent", "certain", "descent"]


@pytest.mark.slow
@pytest.mark.parametrize(("planned", "tried"), [({1}, [1]), ({0}, [1, 0]), (set(), [1, 0])])
def test_with_feedback_passes_must_have_gains(monkeypatch, planned, tried):
    """Windows with more burns before them come first."""
    scenario = load_scenario("kingfisher").replace(MEASURED)
    edges = [space.window_s for space in spaces_of(scenario)]
    World({0, 1}, set()).install(monkeypatch, edges)
    asked = []

    def correct(_: Designer, one: Made) -> Made:
        asked.append(number := one.space.number)
        return replace(one, converged=number in planned, short=0.1 * number)

    monkeypatch.setattr(Designer, "_correct", correct)
    found = Designer(scenario, lambda _: None).run()
    assert asked == tried
    assert found.converged == bool(planned)
    assert found.space.window_s == edges[next(iter(planned), 0)]


CIRCLE = {"radius_m": 700.0, "normal": [1.0, 0.0, 0.0]}
FIXED = {
    "boundary.home": CIRCLE | {"departure_deg": [161.7] * 2, "arrival_deg": [43.1] * 2},
    "burns.times_s": [0.0, 7000.0, 27000.0, 45000.0],
    "design": None,
}
"""One pass from Apophis' home orbit."""


@nightly
@pytest.mark.parametrize(
    ("name", "changes", "flown"),
    [
        ("kingfisher", MEASURED | {"risk.p_chance": 0.9}, {}),  # which has none open loop
        ("didymos", {}, {}),  # a companion
        ("apophis", FIXED, {}),  # a site that tumbles
        ("ryugu", {}, {"truth": "polyhedron"}),  # planned with J2, and with harmonics to degree 4
        ("itokawa", {}, {"truth": "polyhedron"}),
    ],
)
def test_packaged_scenarios_have_certified_passes(name, changes, flown):
    """Fresh flights bear it out, about the solid body too."""
    scenario = load_scenario(name).replace(changes)
    plan = sr.plan(scenario) if changes is FIXED else sr.design(scenario).plan
    assert plan.certificate.certifies(scenario.risk.p_chance)
    assert sr.verify(plan).ok
    whole = sr.fly(plan, samples=10_000, seed=7, **flown).whole_flight
    assert whole.high > scenario.risk.p_chance
    if name == "kingfisher":  # 0.530 to 0.536 where it is planned once
        assert plan.total_dv_m_s < plan.cost_m_s < 0.526


@pytest.mark.slow
@pytest.mark.parametrize(("mapped", "furthest"), [(set(), 0), ({1}, 1)])
def test_without_a_plan_the_furthest_pass_is_returned(monkeypatch, mapped, furthest):
    """Where the second is mapped it is short by 0.2, and the first one's map by 1."""
    found, _, window, _ = run(World(mapped, set(), costs=(1.0,) * 12), monkeypatch)
    assert (found.converged, window) == (False, furthest)


@pytest.mark.slow
@pytest.mark.parametrize(("cost", "burns"), [(9.0, 4), (0.5, 5)])
def test_another_burn_counts_only_where_cheaper(monkeypatch, cost, burns):
    """Whatever the descent with one more ends at: with it no pass is dearer than without."""

    def more(found: Made) -> list[Candidate]:
        space, times = found.space, found.at.times_s
        if len(times) > 4:
            return []
        at = Pass(found.at.phases, (*times[:3], 0.5 * (times[2] + times[3]), times[3]))
        wider = replace(space, time_spans=(*space.time_spans[:3], *space.time_spans[2:]))
        return [Candidate(wider, at, np.insert(found.burns_m_s, 3, 0.0, axis=0))]

    def descend(space: Any, at: Pass, _: bool) -> Made:
        return Made(space, at, True, cost if len(at.times_s) == 5 else 1.0)

    found, space, _, tried = run(World({0}, {0}), monkeypatch, other_counts=more, descend=descend)
    assert found.dv_m_s == min(cost, 1.0)
    assert len(space.time_spans) == len(found.at.times_s) == burns
    assert any(len(one.result.at.times_s) == 5 for one in tried)


@pytest.mark.parametrize(("cost", "burns"), [(2.0, 4), (1.0, 3)])
def test_vanished_burn_under_exact_risk_is_left_out(monkeypatch, cost, burns):
    last: list[Pass] = []

    def fewer(found: Made) -> Candidate | None:
        if found.at not in last:
            return None
        space = found.space
        spans = (*space.time_spans[:1], *space.time_spans[2:])
        at = Pass(found.at.phases, (*found.at.times_s[:1], *found.at.times_s[2:]))
        return Candidate(replace(space, time_spans=spans), at, found.burns_m_s[1:])

    def exact(_: Designer, best: Made, _rival: float = 0.0) -> Made:
        last.append(best.at)
        return best

    def descend(space: Any, at: Pass, _: bool) -> Made:
        return Made(space, at, True, cost if len(at.times_s) == 3 else 1.0)

    monkeypatch.setattr(Designer, "_descend_exact", exact)
    only = {"risk.allocation": "exact"}
    found, space, _, _ = run(World({0}, {0}), monkeypatch, only, vanished=fewer, descend=descend)
    assert len(space.time_spans) == len(found.at.times_s) == burns
