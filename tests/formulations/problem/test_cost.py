"""The cost of corrected burns: its gradient, its law where that is known, and what the program says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtri

from formulations.arrays import Array
from formulations.problem.cost import PROBABILITY, Valued, bend, cost, formula, total_sizes
from formulations.problem.feedback import Cost
from formulations.problem.flyby import FlybyProblem, Iterate
from tests.helpers import random_flyby


def case(kind: Cost, *, seed: int = 1) -> tuple[FlybyProblem, Array]:
    """A problem with two corrected burns, and controls of it."""
    rng = np.random.default_rng(seed)
    problem = random_flyby(rng, nodes=6).corrected(rng, kind).problem
    return problem, 0.3 * rng.normal(size=problem.controls_before[-1])


def iterate_of(problem: FlybyProblem, controls: Array) -> Iterate:
    burns = controls[problem.burn_controls]
    return Iterate(burns, np.zeros((problem.n_nodes, 6)), controls[problem.gain_controls])


@pytest.mark.parametrize("value", [cost, formula])
@pytest.mark.parametrize("kind", ["nominal", "expected", "dv99"])
def test_the_gradient_is_that_of_differences(kind: Cost, value: object) -> None:
    problem, controls = case(kind)

    def at(shift: Array) -> Valued:
        found = value(problem, iterate_of(problem, controls + shift))  # type: ignore[operator]
        assert isinstance(found, Valued)
        return found

    steps = 1e-5 * np.eye(len(controls))
    slopes = [(at(step).value - at(-step).value) / 2e-5 for step in steps]
    np.testing.assert_allclose(at(0.0 * controls).gradient, slopes, atol=2e-6)


@pytest.mark.parametrize("sigma", [0.02, 0.2, 2.0])
def test_corrections_across_a_burn_have_the_law_of_one_normal_number(sigma: float) -> None:
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
def test_the_program_curves_as_the_cost_does(across: float, along: float) -> None:
    """In its direction of most curvature, which little correction along burns makes large."""
    problem, z = case("dv99")
    assert problem.feedback is not None
    for burn in problem.feedback.burns:
        first, stop = problem.controls_before[burn : burn + 2]
        v, gains = z[first : first + 3], z[first + 3 : stop].reshape(3, -1)
        part = np.outer(v, v @ gains) / (v @ v)
        z[first + 3 : stop] = (across * (gains - part) + along * part).ravel()
    bent = bend(problem, iterate_of(problem, z))
    direction = np.linalg.svd(bent.root)[2][0]

    def slope(step: float) -> float:
        at = iterate_of(problem, z + step * direction)
        both = cost(problem, at).gradient - formula(problem, at).gradient
        return float(both @ direction)

    step = 1e-3 * bent.over
    curvature = (slope(step) - slope(-step)) / (2.0 * step)
    said = float(np.sum((bent.root @ direction) ** 2)) / bent.over
    assert said == pytest.approx(curvature, rel=0.5)
