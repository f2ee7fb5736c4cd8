"""Planes that keep burns out of the battery's cones, and the seconds of a step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from formulations.arrays import Array
from formulations.linearisation.linearisation import (
    Linearisation,
    condense,
)
from formulations.program.condensed import CondensedSubproblem
from formulations.program.convex_subproblem import SMALL_BURN
from formulations.program.subproblem import PenaltyParameters, Step
from formulations.registry import make_subproblem
from formulations.rows.uniform import DeterministicRows

from .support import linearised

LIMIT = 2.0 * SMALL_BURN


class Scripted(CondensedSubproblem):
    """A subproblem whose attempts are told, and that remembers the planes of each; flown or not."""

    def __init__(self, burns: Array, steps: list[Step], *, flown: bool = True) -> None:
        lin = linearised(np.random.default_rng(4))
        problem = replace(lin.problem, dv_max=2.0)
        super().__init__(problem, DeterministicRows(problem), "exact", "CLARABEL", condense)
        self.update(Linearisation(problem, replace(lin.iterate, burns=burns), lin.arcs))
        self._at = Linearisation(problem, self._at.iterate, lin.arcs)
        self._at.__dict__["defects"] = np.full((problem.n_nodes, 6), 0.0 if flown else 1.0)
        self.steps, self.planes = steps, list[Array]()

    def _attempt(self, radius: float, charge: PenaltyParameters, planes: Array) -> Step:
        del radius, charge
        self.planes.append(planes)
        return self.steps.pop(0)


def along(sizes: list[float]) -> Array:
    """Burns of given sizes in random directions."""
    burns = linearised(np.random.default_rng(4)).iterate.burns
    direction = burns / np.linalg.norm(burns, axis=1, keepdims=True)
    return direction * np.array(sizes)[:, None]


def across(subproblem: Scripted, size: float) -> Array:
    """Burns of one size at right angles to the Sun, far from the battery's cones."""
    sun = subproblem.problem.sun
    side = np.cross(sun, [0.3, 0.5, -0.7])
    return size * side / np.linalg.norm(side, axis=1, keepdims=True)


def step(burns: Array, merit: float, seconds: float = 1.0) -> Step:
    return Step(burns, merit, seconds, 10.0 * seconds)


def test_a_plane_touches_its_cone_nearest_to_the_burn() -> None:
    burns = along([1e-3, 0.5, 1.0, 3.0])
    subproblem = Scripted(burns, [])
    problem, planes = subproblem.problem, subproblem.burn_planes(burns)
    assert planes.shape == (2, 4, 3)
    for i, sense in enumerate((1.0, -1.0)):
        for burn, sun, normal in zip(burns, problem.sun, planes[i], strict=True):
            assert normal @ normal == pytest.approx(1.0)
            assert normal @ (sense * sun) == pytest.approx(-np.sin(problem.dv_cone))
            assert np.linalg.det([normal, sun, burn]) == pytest.approx(0.0, abs=1e-12)
            assert normal @ burn == pytest.approx(
                np.sin(np.arccos(sense * burn @ sun / np.linalg.norm(burn)) - problem.dv_cone)
                * np.linalg.norm(burn)
            )


@pytest.mark.parametrize("radius", [1.0, 0.5 * SMALL_BURN])
def test_a_small_burn_that_may_turn_is_first_kept_out_of_no_cone(radius: float) -> None:
    """Small is a hundredth of the largest burn, or no more than the trust region lets it turn."""
    limit = min(radius, LIMIT)
    burns = along([0.0, 0.999 * limit, 1.001 * limit, 50.0 * limit])
    subproblem = Scripted(burns, [])
    answer = step(across(subproblem, 0.1), 1.0)
    subproblem.steps = [answer]
    assert subproblem.solve(radius, 10.0) is answer
    (planes,) = subproblem.planes
    assert not planes[:, :2].any()
    assert np.array_equal(planes[:, 2:], subproblem.burn_planes(burns)[:, 2:])


def test_a_burn_of_the_limit_itself_counts_as_small() -> None:
    burns = np.zeros((4, 3))
    burns[:, 0] = LIMIT
    for radius, small in ((1.0, True), (0.9 * LIMIT, False)):
        subproblem = Scripted(burns, [])
        subproblem.steps = [step(across(subproblem, 0.1), 1.0)]
        subproblem.solve(radius, 10.0)
        (planes,) = subproblem.planes
        assert planes.any() is np.bool_(not small)


def test_where_no_burn_is_small_one_answer_is_enough() -> None:
    burns = along([0.5, 1.0, 1.5, 2.0])
    subproblem = Scripted(burns, [])
    answer = step(5.0 * subproblem.problem.sun, 1.0)  # whatever cone it is in
    subproblem.steps = [answer]
    assert subproblem.solve(0.5, 10.0) is answer
    assert np.array_equal(subproblem.planes[0], subproblem.burn_planes(burns))


def test_from_a_guess_the_first_answer_is_taken_wherever_it_points() -> None:
    """There is no step to compare it with, and the next one is made at its burns."""
    subproblem = Scripted(along([0.5 * LIMIT, 1.0, 1.5, 2.0]), [], flown=False)
    inside = across(subproblem, 0.1)
    inside[0] = 0.1 * subproblem.problem.sun[0]
    subproblem.steps = [step(inside, 1.0)]
    assert subproblem.solve(1.0, 10.0).burns is inside


@pytest.mark.parametrize("better", [1, 2])
def test_a_small_burn_that_turns_into_a_cone_is_asked_again_both_ways(better: int) -> None:
    """With planes where the first answer points, and where the burn did; the lower merit counts."""
    burns = along([0.5 * LIMIT, 1.0, 1.5, 2.0])
    subproblem = Scripted(burns, [])
    first = across(subproblem, 0.1)
    first[0] = 0.1 * subproblem.problem.sun[0] + 1e-3 * first[0]
    merits = [1.0, 3.0, 3.0]
    merits[better] = 2.0
    steps = [step(first, merits[0]), step(burns, merits[1], 2.0), step(burns, merits[2], 4.0)]
    subproblem.steps = list(steps)
    found = subproblem.solve(1.0, 10.0)
    assert found.merit == 2.0
    assert found.burns is steps[better].burns
    assert (found.solver_s, found.canonicalise_s) == (7.0, 70.0)  # of all three
    turned = burns.copy()
    turned[0] = first[0]
    free, toward, back = subproblem.planes
    assert not free[:, 0].any()
    assert np.array_equal(toward, subproblem.burn_planes(turned))
    assert np.array_equal(back, subproblem.burn_planes(burns))


@pytest.mark.parametrize("formulation", ["condensed", "lifted"])
def test_held_burns_stay_and_raised_ones_are_no_smaller(formulation: str) -> None:
    """At a weight that makes every burn shrink; before and after the kept program is as it was."""
    lin = linearised(np.random.default_rng(4))
    burns, problem = lin.iterate.burns, replace(lin.problem, dv_max=9.0)
    sizes = np.linalg.norm(burns, axis=1)
    fixed = replace(problem, held=(1,), raised=(2,), dv_min=float(sizes[2]))
    rows = DeterministicRows(problem)
    subproblem = make_subproblem(problem, rows, formulation, "CLARABEL", "exact")
    steps = []
    for one in (problem, fixed, problem):
        subproblem.update(Linearisation(one, lin.iterate, lin.arcs))
        steps.append(subproblem.solve(0.5 * float(sizes.min()), 1e-3).burns)
    shrunk, step, again = steps
    assert np.allclose(shrunk, again, atol=1e-6)
    assert (np.linalg.norm(shrunk, axis=1) < 0.99 * sizes).all()
    assert np.array_equal(step[1], burns[1])
    assert step[2] @ burns[2] / sizes[2] == pytest.approx(sizes[2], abs=1e-6)
    assert (np.linalg.norm(step, axis=1) < 0.99 * sizes)[[0, 3]].all()
