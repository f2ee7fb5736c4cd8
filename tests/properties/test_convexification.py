"""Every subproblem is convex, exact at its iterate, and wrong by the square of the step."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formulations.arrays import Array
from formulations.linearisation.condensation import condense
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.execution_errors import ComponentwiseErrors
from formulations.problem.facets import Polytopes, choose_facets
from formulations.problem.flyby import FlybyProblem
from formulations.problem.polytopes import ball
from formulations.program import condensed, lifted
from formulations.program.model import CompiledProgram, Model
from formulations.program.subproblem import Penalty, PenaltyParameters
from formulations.registry import FORMULATIONS, make_subproblem
from formulations.rows.cones import Rows
from formulations.rows.uniform import ChanceRows, DeterministicRows
from tests.helpers import Flyby, Waves, constrain, generators, random_flyby, share_of_examples

WEIGHT = 10.0
few = settings(max_examples=share_of_examples(6))


def rows_of(lin: Linearisation, name: str, facets: int) -> Rows:
    if name == "P3":
        return DeterministicRows(lin.problem)
    polytopes = Polytopes(ball(facets), facets)
    chosen = choose_facets(lin.problem, polytopes, lin.iterate.mean, lin.factor)
    return ChanceRows(lin.problem, chosen, np.ones(len(chosen.node), dtype=np.bool_))


def some_flyby(rng: np.random.Generator) -> Flyby:
    keeps = [("in",), ("out",), ("in", "out")][int(rng.integers(3))]
    return constrain(rng, random_flyby(rng, nodes=7, burns=3), keeps)


@pytest.mark.parametrize("name", ["P3", "P2"])
@pytest.mark.parametrize("formulation", FORMULATIONS)
@settings(max_examples=share_of_examples(30))
@given(generators, st.sampled_from(get_args(Penalty)), st.integers(4, 8))
def test_every_subproblem_is_disciplined_convex_and_parametrised(
    formulation: str, name: str, rng: np.random.Generator, penalty: Penalty, facets: int
) -> None:
    lin = some_flyby(rng).perturbed(rng, 0.1, 0.05)
    rows = rows_of(lin, name, facets)
    compiled: list[Model] = []

    def watch(model: Model) -> CompiledProgram:
        compiled.append(model)
        return CompiledProgram(model)

    with pytest.MonkeyPatch.context() as patch:
        for module in (condensed, lifted):
            patch.setattr(module, "CompiledProgram", watch)
        condensed.compile_condensed.cache_clear()
        subproblem = make_subproblem(lin.problem, rows, formulation, penalty=penalty)
        subproblem.update(lin)
        multipliers = np.zeros(6 + 3 * lin.problem.n_burns + rows.count)
        augmented = penalty == "augmented"
        subproblem.solve(
            0.5, PenaltyParameters(WEIGHT, multipliers=multipliers if augmented else None)
        )
    assert compiled
    assert all(model.program.is_dcp(dpp=True) for model in compiled)


@pytest.mark.parametrize("name", ["P3", "P2"])
@few
@given(generators, st.integers(4, 8))
def test_the_linearisation_is_exact_at_the_iterate(
    name: str, rng: np.random.Generator, facets: int
) -> None:
    flyby = some_flyby(rng)
    lin = flyby.perturbed(rng, 0.1, 0.0)
    subproblem = make_subproblem(lin.problem, rows_of(lin, name, facets))
    subproblem.update(lin)
    merit = subproblem.merit(lin, WEIGHT)
    # A step of next to nothing changes next to nothing.
    assert subproblem.solve(1e-10, PenaltyParameters(WEIGHT)).merit == pytest.approx(
        merit, rel=1e-6, abs=1e-6
    )


@pytest.mark.parametrize("name", ["P3", "P2"])
@few
@given(generators, st.integers(4, 8))
def test_the_model_error_falls_with_the_square_of_the_step(
    name: str, rng: np.random.Generator, facets: int
) -> None:
    flyby = some_flyby(rng)
    # A spread that counts, or its linearisation would not.
    wide = replace(flyby.problem, initial_factor=20.0 * flyby.problem.initial_factor)
    flyby = replace(flyby, problem=wide)
    lin = flyby.perturbed(rng, 0.1, 0.0)
    subproblem = make_subproblem(lin.problem, rows_of(lin, name, facets))
    subproblem.update(lin)

    def error(radius: float) -> float:
        step = subproblem.solve(radius, PenaltyParameters(WEIGHT))
        flown = flyby.waves.linearise(flyby.problem, flyby.waves.rollout(flyby.problem, step.burns))
        return abs(subproblem.merit(flown, WEIGHT) - step.merit)

    coarse, fine = error(1e-2), error(1e-4)
    # A ten-thousandth, but that the step may turn, and for the solver's tolerance; a model that
    # leaves out a derivative errs by a hundredth.
    assert fine < 2e-3 * coarse + 1e-7 * subproblem.merit(lin, WEIGHT)


# --- the derivative by automatic differentiation ------------------------------------------------


def differentiated(problem: FlybyProblem, waves: Waves, burns: Array) -> tuple[Array, Array]:
    """Derivatives of all node means and factors by the burns, by CasADi, from the definitions."""
    z = ca.SX.sym("z", 3 * problem.n_burns)
    x = ca.SX.sym("x", 6)
    mean, columns = ca.DM(problem.initial_state), problem.factor_columns
    assert isinstance(problem.execution_errors, ComponentwiseErrors)
    beta = problem.execution_errors.fraction
    factor = ca.SX.zeros(6, columns)
    factor[:, : problem.initial_factor.shape[1]] = problem.initial_factor
    means, factors = [], []
    for k in range(problem.n_nodes):
        if k > 0:
            turned = ca.mtimes(ca.DM(waves.frequency[k - 1]), x)
            end = ca.mtimes(ca.DM(waves.linear[k - 1]), x)
            end += ca.mtimes(ca.DM(waves.amplitude[k - 1]), ca.sin(turned))
            arc = ca.Function("arc", [x], [end, ca.jacobian(end, x)])
            mean, stm = arc(mean)
            factor = ca.mtimes(stm, factor)
        for i in np.flatnonzero(problem.burn_nodes == k):
            burn = z[3 * i : 3 * i + 3]
            mean = mean + ca.vertcat(ca.SX.zeros(3), burn)
            first = problem.columns_of_burn(int(i)).start
            factor[3:, first : first + 3] = beta * ca.diag(burn)
        means.append(mean)
        factors.append(ca.vec(factor.T))
    by_mean, by_factor = (ca.jacobian(ca.vertcat(*part), z) for part in (means, factors))
    values = ca.Function("d", [z], [by_mean, by_factor])(burns.ravel())
    nodes = problem.n_nodes
    return (
        np.array(values[0]).reshape(nodes, 6, -1),
        np.array(values[1]).reshape(nodes, 6, columns, -1),
    )


@few
@given(generators)
def test_full_linearisation_is_the_derivative_by_automatic_differentiation(
    rng: np.random.Generator,
) -> None:
    flyby = random_flyby(rng, nodes=6, burns=3)
    burns = flyby.burns + 0.3 * rng.normal(size=flyby.burns.shape)
    lin = flyby.waves.linearise(flyby.problem, flyby.waves.rollout(flyby.problem, burns))
    ours = condense(lin)
    by_mean, by_factor = differentiated(flyby.problem, flyby.waves, burns)
    np.testing.assert_allclose(ours.mean_jacobian, by_mean, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(ours.factor_jacobian, by_factor, rtol=1e-9, atol=1e-10)
