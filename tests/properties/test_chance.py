"""Chance constraints: a facet's condition is its probability, and facets imply their region."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal, norm, qmc

from formulations.arrays import Array
from formulations.problem.facets import (
    Facets,
    Polytopes,
    ball,
    choose_facets,
    inner_pyramid_angle,
    paper_ball,
    quantile,
    split_risk,
)
from formulations.problem.flyby import FlybyProblem, StateConstraint
from formulations.problem.regions import Ball, Cone, Region
from tests.helpers import generators, random_flyby, random_unit, share_of_examples

probabilities = st.floats(0.5, 0.9999)
polytopes = st.builds(
    Polytopes, st.sampled_from([paper_ball(), *map(ball, (4, 6, 13, 24, 40))]), st.integers(3, 24)
)

NORMAL = qmc.MultivariateNormalQMC(
    np.zeros(3), engine=qmc.Sobol(3, rng=np.random.default_rng(1)), rng=np.random.default_rng(2)
).random(2**14)
QMC_ERROR = 2e-3
"""Of a probability from `NORMAL`; see the test of it."""


def one_facet(normal: Array, offset: float, q: float) -> Facets:
    zero = np.array([0])
    return Facets(zero, zero, normal[None], np.array([offset]), np.array([q]))


def gaussian(rng: np.random.Generator) -> tuple[Array, Array]:
    """Mean (1, 6) of a state and its factor (1, 6, c)."""
    columns = int(rng.integers(1, 15))
    return rng.normal(size=(1, 6)), rng.normal(size=(1, 6, columns)) / np.sqrt(columns)


def position_covariance(factor: Array) -> Array:
    return (factor @ factor.transpose(0, 2, 1))[0, :3, :3]


def problem_with(constraint: StateConstraint) -> FlybyProblem:
    problem = random_flyby(np.random.default_rng(0)).problem
    return replace(problem, constraints=(constraint,))


@given(probabilities, probabilities, generators)
def test_zero_margin_facet_has_required_probability(probability, more, rng):
    """So that it has none, or some, at another."""
    mean, factor = gaussian(rng)
    normal = random_unit(rng)
    offset = -one_facet(normal, 0.0, quantile(probability)).margin(mean, factor)[0]
    sigma = np.linalg.norm(normal @ factor[0, :3])
    reached = norm.cdf(offset, loc=normal @ mean[0, :3], scale=sigma)
    assert reached == pytest.approx(probability, abs=1e-12)
    assume(abs(more - probability) > 1e-12)  # nearer ones have the same quantile
    margin = one_facet(normal, offset, quantile(more)).margin(mean, factor)[0]
    assert (margin > 0.0) == (more < probability)


def facets_of(
    region: Region, keep: str, p: float, shapes: Polytopes, mean: Array, factor: Array
) -> Facets:
    constraint = StateConstraint("region", np.array([0]), region, keep, p)
    return choose_facets(problem_with(constraint), shapes, mean, factor)


@given(probabilities)
def test_quantiles_invert_the_normal_distribution(probability):
    assert norm.cdf(quantile(probability)) == pytest.approx(probability, abs=1e-14)
    assert quantile(probability) >= 0.0  # so that the condition is convex


@pytest.mark.parametrize("probability", [-0.1, 0.0, 0.4999, 1.0, 1.1, float("nan")])
def test_no_quantile_for_nonconvex_or_impossible_condition(probability):
    with pytest.raises(ValueError, match=r"outside \[0.5, 1\)"):
        quantile(probability)


@given(probabilities, st.integers(1, 100))
def test_booles_shares_sum_to_the_risk(probability, parts):
    share = split_risk(probability, parts)
    assert parts * (1.0 - share) == pytest.approx(1.0 - probability, abs=1e-12)
    assert probability <= share < 1.0


def joint_probability(facets: Facets, mean: Array, factor: Array) -> float:
    """That all facets hold together, by multivariate normal integration over what they measure."""
    normal, offset = facets.normal, facets.offset
    distance = offset - normal @ mean[0, :3]
    law = multivariate_normal(
        np.zeros(len(offset)),
        normal @ position_covariance(factor) @ normal.T,
        allow_singular=True,
        abseps=INTEGRATION_ERROR,
        releps=0.0,
        maxpts=10**6,
        seed=1,
    )
    return float(law.cdf(distance))


INTEGRATION_ERROR = 5e-4
few_facets = st.builds(
    Polytopes, st.sampled_from([paper_ball(), *map(ball, (4, 5, 8, 13, 24))]), st.integers(3, 24)
)


@settings(max_examples=share_of_examples(6, usual=3))
@given(st.sampled_from([0.55, 0.7, 0.9, 0.99]), few_facets, generators)
def test_facets_with_booles_shares_jointly_hold(probability, shapes, rng):
    """Three to twenty-four facets of balls and cones, the first of them without margin."""
    mean, factor = gaussian(rng)
    region = random_region(rng, "in", mean[:, :3])
    facets = facets_of(region, "in", probability, shapes, mean, factor)
    worst = largest_scale(facets, mean, factor) * factor
    joint = joint_probability(facets, mean, worst)
    assert joint >= probability - 2.0 * INTEGRATION_ERROR
    assert joint == pytest.approx(sampled_probability(facets, mean, worst), abs=QMC_ERROR)


@pytest.mark.parametrize("probability", [0.9, 0.99])
@pytest.mark.parametrize("facets", [4, 5, 6])
def test_booles_shares_nearly_used_where_all_bind(probability, facets):
    """From the centre of a ball what little is left is that two facets fail at once."""
    mean, factor = np.zeros((1, 6)), np.eye(6)[None]
    found = facets_of(
        Ball(np.zeros((1, 3)), 1.0), "in", probability, Polytopes(ball(facets), 4), mean, factor
    )
    worst = largest_scale(found, mean, factor) * factor
    joint = joint_probability(found, mean, worst)
    assert probability - 2.0 * INTEGRATION_ERROR <= joint < probability + 0.2 * (1.0 - probability)


def largest_scale(facets: Facets, mean: Array, factor: Array) -> float:
    """The number by which the factor can grow until the first facet has no margin left."""
    distance = facets.margin(mean, 0.0 * factor)
    return float(np.min(distance / (distance - facets.margin(mean, factor))))


def test_quasi_random_sample_is_as_accurate_as_claimed():
    rng = np.random.default_rng(3)
    for normal in random_unit(rng, 200):
        offset = rng.normal()
        assert np.mean(NORMAL @ normal <= offset) == pytest.approx(norm.cdf(offset), abs=QMC_ERROR)


def random_region(rng: np.random.Generator, keep: str, point: Array) -> Region:
    """A region that leaves the point on the allowed side, at least a little."""
    away = random_unit(rng, 1)
    if rng.uniform() < 0.5:
        radius = rng.uniform(0.1, 2.0)
        # The 4-facet inner polytope of the unit ball holds the ball of a third.
        distance = radius * (rng.uniform(0.0, 0.3) if keep == "in" else rng.uniform(1.01, 3.0))
        return Ball(point + distance * away, radius)
    half_angle = rng.uniform(0.05, 1.4)
    side = np.cross(away, random_unit(rng, 1))
    side /= np.linalg.norm(side)
    off = (
        rng.uniform(0.0, 0.9) * inner_pyramid_angle(half_angle, 3)
        if keep == "in"
        else rng.uniform(half_angle + 0.01, np.pi)
    )
    ray = np.cos(off) * away + np.sin(off) * side
    return Cone(point - rng.uniform(0.1, 2.0) * ray, away, half_angle)


def sample_of(mean: Array, factor: Array) -> Array:
    """Quasi-random positions, shape (n, 3)."""
    variance, axes = np.linalg.eigh(position_covariance(factor))
    return mean[0, :3] + NORMAL * np.sqrt(np.maximum(variance, 0.0)) @ axes.T


def sampled_probability(facets: Facets, mean: Array, factor: Array) -> float:
    """That all facets hold together, by a quasi-random sample."""
    held = sample_of(mean, factor) @ facets.normal.T <= facets.offset
    return float(np.mean(held.all(axis=1)))


def probability_of(keep: str, region: Region, mean: Array, factor: Array) -> float:
    """That the position is in the region, or out of it, by a quasi-random sample."""
    d = sample_of(mean, factor)
    if isinstance(region, Ball):
        inside = np.linalg.norm(d - region.center, axis=1) <= region.radius
    else:
        d = d - region.apex
        inside = d @ region.axis[0] >= np.cos(region.half_angle) * np.linalg.norm(d, axis=1)
    return float(np.mean(inside if keep == "in" else ~inside))


@pytest.mark.parametrize("keep", ["in", "out"])
@given(st.floats(0.55, 0.99), polytopes, generators)
def test_zero_margin_facets_keep_position_with_probability(keep, probability, shapes, rng):
    mean, factor = gaussian(rng)
    region = random_region(rng, keep, mean[:, :3])
    if keep == "out" and rng.integers(3) == 0:  # a tangent facet is exact there
        shapes = Polytopes(None, shapes.cone_facets)
    facets = facets_of(region, keep, probability, shapes, mean, factor)
    worst = largest_scale(facets, mean, factor) * factor
    assert facets.margin(mean, worst).min() == pytest.approx(0.0, abs=1e-9)
    assert probability_of(keep, region, mean, worst) >= probability - QMC_ERROR
