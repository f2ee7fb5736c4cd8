"""Every way to eliminate mean and factor has the same shapes and the same mean; defects are closed."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings

from formulations.arrays import Array
from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import CONDENSATIONS, condense
from tests.helpers import Arcs, Waves, generators, random_flyby


@pytest.mark.parametrize("name", CONDENSATIONS)
@settings(max_examples=10)
@given(generators)
def test_unwanted_factor_is_none(name, rng):
    lin = random_flyby(rng).perturbed(rng, 0.2, 0.1)
    nodes, columns = np.array([1, 4, 8]), lin.problem.factor_columns
    z, full = lin.iterate.burns.size, condense(lin, nodes)
    for factor, c in ((True, columns), (False, 0)):
        s = CONDENSATIONS[name](lin, nodes, factor=factor)
        assert np.array_equal(s.mean_constant, full.mean_constant)
        assert np.array_equal(s.mean_jacobian, full.mean_jacobian)
        assert s.factor_constant.shape == (3, 6, c)
        assert s.factor_jacobian.shape == (3, 6, c, z)


@pytest.mark.parametrize("name", CONDENSATIONS)
@settings(max_examples=10)
@given(generators)
def test_every_model_is_exact_at_its_iterate(name, rng):
    lin = random_flyby(rng).perturbed(rng, 0.2, 0.0)
    nodes, z = np.array([0, 3, 8]), lin.iterate.burns.ravel()
    s = CONDENSATIONS[name](lin, nodes, factor=True)
    mean = s.mean_constant + s.mean_jacobian @ z
    factor = s.factor_constant + s.factor_jacobian @ z
    assert mean == pytest.approx(lin.iterate.mean[nodes], rel=1e-9, abs=1e-11)
    assert factor == pytest.approx(lin.factor[nodes], rel=1e-9, abs=1e-11)


@settings(max_examples=10)
@given(generators)
def test_frozen_forms_omit_curvature_or_derivative(rng):
    lin = random_flyby(rng).perturbed(rng, 0.2, 0.1)
    nodes = np.arange(lin.problem.n_nodes)
    stm, still = (
        CONDENSATIONS[f"frozen-{part}"](lin, nodes, factor=True) for part in ("stm", "covariance")
    )
    assert np.array_equal(stm.factor_jacobian, condense(lin, curvature=False).factor_jacobian)
    assert not np.allclose(stm.factor_jacobian, condense(lin).factor_jacobian)
    assert np.array_equal(still.factor_constant, lin.factor)
    assert not still.factor_jacobian.any()


@given(generators)
def test_defects_are_residuals_of_arcs_and_burns(rng):
    flyby = random_flyby(rng)
    burn_nodes = np.sort(rng.choice(flyby.problem.n_nodes, flyby.problem.n_burns, replace=False))
    flyby = replace(flyby, problem=replace(flyby.problem, burn_nodes=burn_nodes))
    left = rng.normal(size=(flyby.problem.n_nodes - 1, 6))
    iterate = flyby.waves.rollout(flyby.problem, flyby.burns, left)
    defects = flyby.waves.linearise(flyby.problem, iterate).defects
    np.testing.assert_allclose(defects[:-1], left, atol=1e-12)
    np.testing.assert_array_equal(defects[-1], iterate.mean[-1] - flyby.problem.final_state)


@dataclass(frozen=True)
class Motion:
    """Waves as a flow."""

    waves: Waves

    @property
    def arcs(self) -> int:
        return len(self.waves.linear)

    def propagate(self, state: Array, arc: int) -> Array:
        return self.waves.propagate(arc, state)

    def differentiate(self, state: Array) -> Arcs:
        return self.waves.derivatives(state)


def test_burns_are_flown_where_newton_fails():
    """Where a step meets another branch of strongly curved arcs."""
    rng = np.random.default_rng(0)
    flyby = random_flyby(rng, curvature=5.0)
    burns = flyby.burns + rng.normal(size=flyby.burns.shape)
    dynamics = Dynamics(Motion(flyby.waves), flyby.problem.burn_nodes)
    found = dynamics.close_defects(flyby.flown(flyby.burns), burns)
    np.testing.assert_array_equal(found.iterate.burns, burns)
    np.testing.assert_allclose(found.defects[:-1], 0.0, atol=1e-12)
