"""A flight that is under way coasts before its first burn: the same mathematics with one leg more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from formulations.arrays import Array
from formulations.linearisation.linearisation import (
    Linearisation,
    condense,
)
from formulations.problem.flyby import Legs
from formulations.program.subproblem import MeritFunction, Subproblem
from formulations.registry import make_subproblem
from formulations.rows.uniform import DeterministicRows
from tests.helpers import constrain, random_flyby

generators = st.integers(0, 2**32 - 1).map(np.random.default_rng)
coasts = st.integers(1, 4)


def covariances(lin: Linearisation) -> Array:
    """By Sigma' = A Sigma A', and a burn's errors where it falls: no factor, no legs."""
    problem = lin.problem
    sigma = problem.initial_factor @ problem.initial_factor.T
    columns = problem.execution_errors.columns(lin.iterate.burns)
    found = []
    for node in range(problem.n_nodes):
        if node:
            stm = lin.arcs.stm[node - 1]
            sigma = stm @ sigma @ stm.T
        for burn in np.flatnonzero(problem.burn_nodes == node):
            sigma = sigma.copy()
            sigma[3:, 3:] += columns[burn] @ columns[burn].T
        found.append(sigma)
    return np.array(found)


@given(generators, coasts)
def test_the_factor_is_the_covariance_of_a_coast_and_the_burns_after_it(
    rng: np.random.Generator, coast: int
) -> None:
    flyby = random_flyby(rng, coast=coast)
    lin = flyby.perturbed(rng, 0.1, 0.0)
    assert lin.problem.coasts == 1
    assert lin.factor @ lin.factor.swapaxes(1, 2) == pytest.approx(covariances(lin), abs=1e-10)


@given(generators, coasts)
def test_condensing_is_the_derivative_of_a_flight_with_a_coast(
    rng: np.random.Generator, coast: int
) -> None:
    flyby = random_flyby(rng, coast=coast)
    problem, waves = flyby.problem, flyby.waves
    step = 1e-5 * rng.normal(size=flyby.burns.shape)
    s = condense(waves.linearise(problem, waves.rollout(problem, flyby.burns)))
    ahead, behind = (
        waves.linearise(problem, waves.rollout(problem, flyby.burns + move))
        for move in (step, -step)
    )
    mean = 0.5 * (ahead.iterate.mean - behind.iterate.mean)
    factor = 0.5 * (ahead.factor - behind.factor)
    assert s.mean_jacobian @ step.ravel() == pytest.approx(mean, rel=1e-6, abs=1e-12)
    assert s.factor_jacobian @ step.ravel() == pytest.approx(factor, rel=1e-6, abs=1e-12)
    assert not s.mean_jacobian[: coast + 1, :3].any()


@given(generators, coasts)
def test_closing_defects_of_a_coast_is_part_of_the_model(
    rng: np.random.Generator, coast: int
) -> None:
    """Of linear arcs it is exact: the model of a path with defects is the flight without them."""
    flyby = random_flyby(rng, coast=coast, curvature=0.0)
    lin = flyby.perturbed(rng, 0.1, 0.1)
    s = condense(lin)
    flown = flyby.waves.rollout(flyby.problem, flyby.burns)
    model = s.mean_constant + s.mean_jacobian @ flyby.burns.ravel()
    assert model == pytest.approx(flown.mean, abs=1e-9)


@pytest.mark.parametrize("seed", [0])
def test_both_forms_of_the_program_agree_with_a_coast(seed: int) -> None:
    rng = np.random.default_rng(seed)
    flyby = constrain(rng, random_flyby(rng, coast=2))
    lin, rows = flyby.perturbed(rng, 0.05, 0.01), DeterministicRows(flyby.problem)

    def answer(formulation: str) -> tuple[float, Array]:
        subproblem: Subproblem = make_subproblem(flyby.problem, rows, formulation)
        subproblem.update(lin)
        step = subproblem.solve(0.1, 10.0)
        return step.merit, step.burns

    (merit, burns), (other, others) = answer("condensed"), answer("lifted")
    assert other == pytest.approx(merit, rel=1e-5, abs=1e-6)
    assert others == pytest.approx(burns, abs=1e-3)


@given(generators, coasts)
def test_a_miss_that_need_not_be_met_is_a_cost_and_no_violation(
    rng: np.random.Generator, coast: int
) -> None:
    flyby = random_flyby(rng, coast=coast)
    problem = replace(flyby.problem, miss_weight=7.0)
    burns = flyby.burns + 0.1 * rng.normal(size=flyby.burns.shape)
    lin = flyby.waves.linearise(problem, flyby.waves.rollout(problem, burns))
    merit = MeritFunction(problem, DeterministicRows(problem))
    miss = np.abs(lin.iterate.mean[-1] - problem.final_state).sum()
    violations = merit.violations(lin)
    assert violations["dynamics"].max() < 1e-9
    limits = sum(amount.sum() for amount in violations.values())
    assert merit(lin, 10.0) == pytest.approx(
        lin.iterate.total_dv + 7.0 * miss + 10.0 * limits, abs=1e-6
    )


@given(generators)
def test_legs_begin_where_the_coast_does(rng: np.random.Generator) -> None:
    problem = random_flyby(rng, coast=3).problem
    legs = Legs(problem.n_nodes, problem.leg_starts)
    assert problem.leg_starts[0] == 0
    assert np.array_equal(problem.leg_starts[problem.coasts :], problem.burn_nodes)
    assert np.array_equal(legs.ends, problem.burn_nodes)
