"""The cost of corrected burns: its gradient, its law where that is known, and what the program says."""

from collections.abc import Callable
from dataclasses import replace
from unittest.mock import Mock

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtri

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.controls import Cost
from formulations.problem.cost import (
    PROBABILITY,
    Valued,
    bends,
    cost,
    formula,
    roots_of,
    total_sizes,
)
from formulations.problem.flyby import FlybyProblem, Iterate
from formulations.program.model import Shape, cost_values, write_cost
from tests.helpers import Arcs, generators, random_flyby, share_of_examples


def case(kind: Cost, *, seed: int = 1) -> tuple[FlybyProblem, Array]:
    """A problem with two corrected burns, and controls of it."""
    rng = np.random.default_rng(seed)
    problem = random_flyby(rng, nodes=6).corrected(rng, kind).problem
    return problem, 0.3 * rng.normal(size=problem.controls_before[-1])


def iterate_of(problem: FlybyProblem, controls: Array) -> Iterate:
    burns = controls[problem.burn_controls]
    return Iterate(burns, np.zeros((problem.n_nodes, 6)), controls[problem.gain_controls])


def cost_at(problem: FlybyProblem, controls: Array) -> float:
    return cost(problem, iterate_of(problem, controls)).value


def model_of(problem: FlybyProblem, at: Array) -> Callable[[Array], float]:
    """The program's objective about some controls, without penalties."""
    arcs = Arcs(*np.zeros((3, 0)))  # of which cost knows nothing
    values, left = cost_values(Linearisation(problem, iterate_of(problem, at), arcs))
    controls, sizes = cp.Variable(len(at)), cp.Parameter(problem.n_burns)
    numbers = Mock(array=lambda name, *shape: np.reshape(values[name], shape))
    total, parameters = write_cost(Shape.of(problem, floor=False), controls, sizes, numbers)
    parameters["tilt"].value = values["tilt"]

    def model(there: Array) -> float:
        controls.value = there
        sizes.value = np.linalg.norm(there[problem.burn_controls], axis=1)
        return float(total.value) + left

    return model


@pytest.mark.slow
@pytest.mark.parametrize("value", ["cost", "formula"])
@pytest.mark.parametrize("kind", ["nominal", "expected", "dv99"])
def test_the_gradient_is_that_of_differences(kind, value):
    problem, controls = case(kind)
    roots = roots_of(problem, iterate_of(problem, controls))

    def at(shift: Array) -> Valued:
        there = problem, iterate_of(problem, controls + shift)
        return cost(*there) if value == "cost" else formula(*there, roots)

    steps = 1e-5 * np.eye(len(controls))
    slopes = [(at(step).value - at(-step).value) / 2e-5 for step in steps]
    np.testing.assert_allclose(at(0.0 * controls).gradient, slopes, atol=2e-6)


@pytest.mark.parametrize("sigma", [0.02, 0.2, 2.0])
def test_correction_across_burn_has_one_dimensional_law(sigma):
    """|v + sigma z| is monotonic in |z|. The law is skewed, which the smoothed cost tells less well."""
    problem, controls = case("dv99")
    iterate = iterate_of(problem, controls)
    across = np.linalg.qr(iterate.burns[1][:, None], mode="complete")[0].T[1]
    gains = np.zeros_like(iterate.gains)
    gains[:18:6] = sigma * across
    iterate = replace(iterate, gains=gains)
    sizes = np.linalg.norm(iterate.burns, axis=1)
    far = ndtri(0.5 + 0.5 * PROBABILITY) * sigma
    exact = sizes.sum() - sizes[1] + np.hypot(sizes[1], far)
    total = total_sizes(problem, iterate)
    assert abs(np.quantile(total, PROBABILITY) - exact) < 0.05 * total.std()
    assert abs(cost(problem, iterate).value - exact) < 0.35 * total.std()


@pytest.mark.parametrize(("across", "along"), [(0.1, 0.1), (0.05, 0.0), (0.1, 0.01)])
def test_the_program_curves_as_the_cost_does(across, along):
    """In its direction of most curvature, which little correction along burns makes large."""
    problem, z = case("dv99")
    for burn in problem.feedback.burns:
        first, stop = problem.controls_before[burn : burn + 2]
        v, gains = z[first : first + 3], z[first + 3 : stop].reshape(3, -1)
        part = np.outer(v, v @ gains) / (v @ v)
        z[first + 3 : stop] = (across * (gains - part) + along * part).ravel()
    direction = np.linalg.svd(bends(problem, iterate_of(problem, z))[0].root)[2][0]
    step = 0.1 * min(across, along or across) * direction
    ahead, behind = (
        function(z + step) - 2.0 * function(z) + function(z - step)
        for function in (model_of(problem, z), lambda there: cost_at(problem, there))
    )
    assert ahead == pytest.approx(behind, rel=0.5)


def test_gains_of_rounding_size_have_no_direction():
    """Beside a burn that is nearly none; steps of gains longer than rounding and shorter than it."""
    problem, z = case("dv99")
    rng = np.random.default_rng(2)
    first, _ = problem.controls_before[1:3]
    z[first : first + 3] *= 1e-3
    z[problem.gain_controls] *= 1e-9
    model = model_of(problem, z)
    for _ in range(20):
        step = np.zeros_like(z)
        step[problem.gain_controls] = rng.normal(size=len(problem.gain_controls))
        step *= 1e-5 / np.linalg.norm(step)
        said, real = model(z + step) - model(z), cost_at(problem, z + step) - cost_at(problem, z)
        assert said == pytest.approx(real, rel=0.2)


def test_program_has_kink_where_corrections_cancel():
    """Across burns nothing adds up, so that past it the cost rises as it fell."""
    problem, z = case("dv99")
    assert problem.feedback is not None
    z[problem.gain_controls] *= 1e-3
    back = np.zeros_like(z)
    for burn in problem.feedback.burns:
        first, stop = problem.controls_before[burn : burn + 2]
        v, gains = z[first : first + 3], z[first + 3 : stop].reshape(3, -1)
        back[first + 3 : stop] = -(np.outer(v, v @ gains) / (v @ v)).ravel()
    model = model_of(problem, z)
    start, least = cost_at(problem, z), cost_at(problem, z + back)
    for share in (0.5, 1.0, 2.0, 4.0):
        there = z + share * back
        said, real = model(there) - model(z), cost_at(problem, there) - start
        assert said == pytest.approx(real, abs=0.2 * (start - least))


@settings(max_examples=share_of_examples(2))
@given(
    generators,
    st.sampled_from(["expected", "dv99"]),
    st.sampled_from([(), (1,), (2,), (1, 2)]),
    st.floats(0.0, 1.0),
)
def test_program_touches_cost_at_local_minimum(rng, kind, gone, share):
    """To first order, with burns and their gains that have vanished, where the cost has kinks, or none.

    Where nothing is corrected yet the program knows no draws near a quantile: gains alone count there.
    """
    problem, z = case(kind, seed=int(rng.integers(2**32)))
    step = rng.normal(size=len(z))
    for burn in gone:
        own = slice(*problem.controls_before[burn : burn + 2])
        z[own], step[own] = 0.0, step[own] * rng.choice([1e-3, 1.0, 1e3])
        step[own][:3] *= share * (len(gone) == 1)
    step *= 1e-7 / np.linalg.norm(step)
    model = model_of(problem, z)
    assert model(z) == pytest.approx(cost_at(problem, z), rel=1e-12)
    said, real = model(z + step) - model(z), cost_at(problem, z + step) - cost_at(problem, z)
    assert said >= real - 1e-4 * np.linalg.norm(step)
    if not gone:
        assert said <= real + 1e-4 * np.linalg.norm(step)
