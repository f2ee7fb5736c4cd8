"""Rows and slots of a condensed subproblem; neither changes its answer."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings

from formulations.arrays import Array
from formulations.linearisation.linearisation import CONDENSATIONS, Linearisation, condense
from formulations.program import condensed
from formulations.program.condensed import CondensedSubproblem, compile_condensed
from formulations.program.subproblem import Penalty, Step
from formulations.rows.cones import NEAR_LENGTH, Rows
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import plan
from scp_recon.scenario.load import load_scenario
from tests.helpers import generators, near_from, share_of_examples, usually

from .support import (
    PENALTIES,
    charge_for,
    every_row,
    linearised,
    minimum,
    small,
    tighten,
)

FAR, WITHIN, MISSED = 1.0, 0.5 * NEAR_LENGTH, -10.0 * condensed.MISSED
MANY = 64
"""Slots: more than any of the cones here has rows."""


def make(
    lin: Linearisation, rows: Rows, penalty: Penalty = "exact", solver: str = "CLARABEL"
) -> CondensedSubproblem:
    subproblem = CondensedSubproblem(lin.problem, rows, penalty, solver, condense)
    subproblem.update(lin)
    return subproblem


class Told(CondensedSubproblem):
    """A subproblem that is told how far each of its rows is from binding."""

    def __init__(self, lin: Linearisation) -> None:
        rows = every_row(lin, "P2")
        super().__init__(lin.problem, rows, "exact", "CLARABEL", CONDENSATIONS["condensed"])
        self.told: list[Array] = []
        self.attempts: list[list[int]] = []

    def _slack(self, controls: Array) -> Array:
        return self.told.pop(0) if self.told else super()._slack(controls)

    def _solve(self, *arguments: Any) -> Step:
        self.attempts.append(self.taken)
        return replace(super()._solve(*arguments), solver_s=0.25)

    @property
    def taken(self) -> list[int]:
        return np.flatnonzero(self._active).tolist()

    def slack(self, **rows: list[int]) -> Array:
        """Far from binding but for some rows."""
        room = np.full(self.rows.count, FAR)
        for name, which in rows.items():
            room[which] = {"within": WITHIN, "missed": MISSED}[name]
        return room


@pytest.fixture
def lin() -> Linearisation:
    return small(nodes=8, burns=4)


def test_rows_near_binding_are_chosen_each_iterate(lin):
    subproblem = Told(lin)
    solver = subproblem._solver
    assert subproblem.taken == []
    for within in ([3, 5], [4], [3], []):
        room = subproblem.slack(within=within)
        room[:3] = 0.999 * NEAR_LENGTH, NEAR_LENGTH, -FAR
        within += [0, 2]
        subproblem.told = [room]
        subproblem.update(lin)
        assert subproblem.taken == sorted(within)
        # Its data can be updated whichever rows are in the slots.
        assert subproblem._solver is solver


def test_missed_rows_alone_are_added(lin, monkeypatch):
    subproblem = Told(lin)
    clock = iter([100.0, 107.0])
    monkeypatch.setattr(condensed, "perf_counter", lambda: next(clock))
    subproblem.told = [
        subproblem.slack(within=[1]),
        subproblem.slack(within=[2], missed=[1, 4]),
        subproblem.slack(within=[6], missed=[1, 4]),
    ]
    subproblem.update(lin)
    step = subproblem.solve(0.5, 10.0)
    assert subproblem.attempts == [[1], [1, 4]]
    assert subproblem.taken == [1, 4]
    assert step.solver_s == 0.5  # of both
    assert step.canonicalise_s == 6.5


def test_half_the_slots_hold_the_tightest_rows(lin, monkeypatch):
    """The other half stays free for what the answer misses."""
    monkeypatch.setattr(condensed, "SLOTS", 4)
    subproblem = Told(lin)
    subproblem.told = [subproblem.slack()]
    subproblem.update(lin)
    assert len(subproblem._cones) > 1
    blocks = [cones.rows[:4] for cones in subproblem._cones]
    room = subproblem.slack()
    for rows in blocks:
        room[rows] = WITHIN * np.array([0.9, 0.1, 0.5, 0.3])[: len(rows)]
    subproblem.told = [room]
    subproblem.update(lin)
    # Every block has slots of its own.
    assert all(len(rows) == 4 for rows in blocks)
    assert subproblem.taken == sorted(int(row) for rows in blocks for row in rows[[1, 3]])
    assert subproblem._slots == [4] * len(blocks)


def test_slots_double_only_where_exhausted(lin, monkeypatch):
    monkeypatch.setattr(condensed, "SLOTS", 2)
    subproblem = Told(lin)
    subproblem.told = [subproblem.slack()]
    subproblem.update(lin)
    which = int(np.argmax([len(cones.rows) for cones in subproblem._cones]))
    a, b, c, d = subproblem._cones[which].rows[:4].tolist()
    taken = [a], sorted([a, b]), sorted([a, b, c, d])
    assert condensed.SLOTS // 2 == 1
    subproblem.told = [
        subproblem.slack(within=[a]),
        subproblem.slack(missed=[b]),
        subproblem.slack(missed=[c, d]),
        subproblem.slack(),
    ]
    built = subproblem._solver
    subproblem.update(lin)
    subproblem.solve(0.5, 10.0)
    assert subproblem.attempts == list(taken)
    expected = [2] * len(subproblem._cones)
    expected[which] = 4
    assert subproblem._slots == expected
    assert subproblem._solver is not built  # of another size
    # They stay, so that the next iterate needs no new solver.
    built = subproblem._solver
    subproblem.told = [subproblem.slack(within=[c])]
    subproblem.update(lin)
    assert subproblem._slots == expected
    assert subproblem._solver is built


@pytest.mark.slow
@pytest.mark.parametrize("slots", usually([2, 1], 1))
@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("name", ["P3", "P2"])
@settings(max_examples=share_of_examples(250, usual=1))
@given(generators)
def test_few_slots_reach_the_full_program_solution(name, penalty, slots, rng):
    lin = linearised(rng)
    rows = every_row(lin, name)
    charge, found = charge_for(penalty, rows, lin), []
    with pytest.MonkeyPatch.context() as patch:
        tighten(patch)
        for few, near in ((slots, -np.inf), (MANY, np.inf)):
            patch.setattr(condensed, "SLOTS", few)
            near_from(patch, near)
            subproblem = make(lin, rows, penalty)
            found.append(subproblem.solve(0.5, charge))
    assert subproblem._active.all()  # nothing but unused slots sets the second apart
    rel = 1e-7 if penalty == "exact" else 1e-6
    few_slots, every = (minimum(step, lin, charge) for step in found)
    assert few_slots == pytest.approx(every, rel=rel, abs=1e-9)
    if penalty != "least":  # whose optimum is a set
        assert found[0].burns == pytest.approx(found[1].burns, abs=1e-3)


@pytest.mark.slow
def test_default_plan_needs_at_most_three_programs(monkeypatch):
    """One a stage, and one more where its slots run out; a second plan needs none."""
    sizes: set[Any] = set()

    def watch(*arguments: Any) -> Any:
        sizes.add(arguments)
        return compile_condensed(*arguments)

    monkeypatch.setattr(condensed, "compile_condensed", watch)
    compile_condensed.cache_clear()
    mission = Mission.from_scenario(load_scenario())
    plan(mission, initial_guess.cold(mission))
    compiled = compile_condensed.cache_info().misses
    assert 2 <= len(sizes) <= 3
    assert compiled == len(sizes)
    plan(mission, initial_guess.cold(mission))
    assert compile_condensed.cache_info().misses == compiled
