"""Which rows a direct subproblem takes into its program, and what it says of the time that takes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from formulations.direct import DirectSubproblem

from formulations import direct
from formulations.facets import Polytopes, choose_facets
from formulations.lifting import Linearisation
from formulations.penalty import Charge
from formulations.polytopes import ball
from formulations.program.subproblem import Step
from formulations.rows import P2Rows
from tests.helpers import Array, constrain, random_flyby

FAR, WITHIN, MISSED = 1.0, 0.5 * direct.NEAR, -10.0 * direct.MISSED


class Told(DirectSubproblem):
    """A subproblem that is told how far each of its rows is from binding."""

    def __init__(self, lin: Linearisation) -> None:
        facets = choose_facets(lin.problem, Polytopes(ball(8), 4), lin.iterate.mean, lin.factor)
        super().__init__(
            lin.problem, P2Rows(lin.problem, facets, np.ones(len(facets.node), dtype=np.bool_))
        )
        self.told: list[Array] = []
        self.attempts: list[list[int]] = []

    def _slack(self, burns: Array) -> Array:
        return self.told.pop(0) if self.told else super()._slack(burns)

    def _attempt(self, radius: float, charge: Charge) -> Step:
        self.attempts.append(self.taken)
        return replace(super()._attempt(radius, charge), solver_s=0.25)

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
    rng = np.random.default_rng(3)
    return constrain(rng, random_flyby(rng, nodes=8, burns=4)).perturbed(rng, 0.1, 0.05)


def test_rows_near_binding_are_taken_and_stay(lin: Linearisation) -> None:
    subproblem = Told(lin)
    assert subproblem.taken == []
    for within, taken in (([3, 5], [3, 5]), ([4], [3, 4, 5]), ([3], [3, 4, 5]), ([], [3, 4, 5])):
        subproblem.told = [subproblem.slack(within=within)]
        solver = subproblem._solver
        subproblem.update(lin)
        assert subproblem.taken == taken
        # Its data can be updated as long as the rows are the same.
        assert (subproblem._solver is solver) == (within in ([3], []))


def test_near_is_below_the_limit(lin: Linearisation) -> None:
    subproblem = Told(lin)
    room = subproblem.slack()
    room[:3] = 0.999 * direct.NEAR, direct.NEAR, -FAR
    subproblem.told = [room]
    subproblem.update(lin)
    assert subproblem.taken == [0, 2]


@pytest.mark.parametrize(("spare", "dropped"), [(0.0, False), (-0.5, True)])
def test_rows_are_dropped_where_many_are_no_longer_near(
    lin: Linearisation, spare: float, dropped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    subproblem = Told(lin)
    every = list(range(subproblem.rows.count))
    monkeypatch.setattr(direct, "FEW", len(every) - direct.SHRINK * 6 + spare)
    subproblem.told = [subproblem.slack(within=every), subproblem.slack(within=every[:6])]
    subproblem.update(lin)
    assert subproblem.taken == every
    subproblem.update(lin)
    assert subproblem.taken == (every[:6] if dropped else every)


def test_an_answer_that_misses_rows_takes_them_and_those_near_in(
    lin: Linearisation, monkeypatch: pytest.MonkeyPatch
) -> None:
    subproblem = Told(lin)
    clock = iter([100.0, 107.0])
    monkeypatch.setattr(direct, "perf_counter", lambda: next(clock))
    subproblem.told = [
        subproblem.slack(within=[1]),
        subproblem.slack(within=[2], missed=[1, 4]),
        subproblem.slack(within=[6], missed=[1, 2, 4]),
    ]
    subproblem.update(lin)
    step = subproblem.solve(0.5, 10.0)
    assert subproblem.attempts == [[1], [1, 2, 4]]
    assert subproblem.taken == [1, 2, 4]
    assert step.solver_s == 0.5  # of both
    assert step.canonicalise_s == 6.5


@pytest.mark.parametrize(("share", "again"), [(0.5, False), (1.5, True)])
def test_a_row_is_missed_by_more_than_the_solvers_tolerance(
    lin: Linearisation, share: float, again: bool
) -> None:
    subproblem = Told(lin)
    room = subproblem.slack(within=[0, 1])
    room[3] = -share * direct.MISSED
    subproblem.told = [subproblem.slack(), room, subproblem.slack()]
    subproblem.update(lin)
    subproblem.solve(0.5, 10.0)
    assert subproblem.attempts == ([[], [0, 1, 3]] if again else [[]])


def test_with_no_room_at_all_only_what_is_missed_comes_in(
    lin: Linearisation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(direct, "NEAR", -np.inf)
    subproblem = Told(lin)
    subproblem.told = [subproblem.slack(), subproblem.slack(within=[2], missed=[5])]
    subproblem.update(lin)
    subproblem.solve(0.5, 10.0)
    assert subproblem.attempts[:2] == [[], [5]]


def test_the_room_of_a_row_is_its_cones(lin: Linearisation) -> None:
    """Of each row, wherever it stands among the cones, at any burns."""
    subproblem = Told(lin)
    subproblem.update(lin)
    burns = lin.iterate.burns + 0.1
    expected = np.empty(subproblem.rows.count)
    for cones in subproblem._cones:
        for row, values, constants in zip(cones.rows, cones.values, cones.constants, strict=True):
            y = values @ burns.reshape(-1)[: values.shape[1]] + constants
            expected[row] = y[0] - np.sqrt((y[1:] ** 2).sum())
    assert subproblem._slack(burns) == pytest.approx(expected, rel=1e-9, abs=1e-12)
