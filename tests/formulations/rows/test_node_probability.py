"""Probabilities at nodes: against known laws and nested quadrature, and their gradients."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr
from scipy.stats import ncx2

from formulations.arrays import Array
from formulations.problem.flyby import StateConstraint
from formulations.problem.regions import Ball, Cone, Ellipsoid, Halfspaces, Polytope, Region
from formulations.rows.node_probability import (
    SPREAD_MIN,
    Event,
    Quantiles,
    joint_events,
    node_quantiles,
)
from tests.helpers import generators, random_rotation, random_unit, share_of_examples
from tests.normal_law import ball_probability, cone_probability, round_ball_probability

few = settings(max_examples=share_of_examples(3))
QUADRATURE, SLENDER = 1e-7, 30.0
"""Error of a probability, for a spread up to half the radius and axes up to so many times as long."""

NEAR_APEX = 1e-6
"""The same with a cone's apex within six deviations."""

sigmas_away = st.floats(-4.0, 4.0)


def event(keep_in: tuple[Region, ...] = (), keep_out: tuple[Region, ...] = ()) -> Event:
    first = (keep_in + keep_out)[0]
    n = len(next(iter(vars(first).values())))  # centres, apices or normals
    return Event("event", np.arange(n), keep_in, keep_out)


def many(region: Region, count: int) -> Region:
    return region.at(np.zeros(count, dtype=np.intp))


def probability(found: Quantiles) -> Array:
    return np.asarray(ndtr(found.value))


def root(rng: np.random.Generator, spread: float, slenderness: float = 2.0) -> Array:
    """A factor (1, 3, 5) of a law whose total spread is given, one axis up to so much longer."""
    sigma = np.exp(rng.uniform(0.0, np.log(slenderness), 3))
    square = random_rotation(rng) @ np.diag(spread * sigma / np.linalg.norm(sigma))
    mixed, _ = np.linalg.qr(rng.normal(size=(5, 3)))
    return np.asarray(square @ mixed.T)[None]


def covariance(factor: Array) -> Array:
    """With what is added so that no flight is without a gradient."""
    return factor @ factor.swapaxes(-1, -2) + SPREAD_MIN**2 * np.eye(3)


def touched(rng: np.random.Generator, region: Region) -> tuple[Array, Array]:
    """A point of the surface and the normal there (1, 3); of a cone well away from its apex."""
    if isinstance(region, Ball):
        normal = random_unit(rng, 1)
        return region.center + region.radius * normal, normal
    if isinstance(region, Halfspaces):
        return region.offset[:, None] * region.normal, region.normal
    if isinstance(region, Ellipsoid):
        seen = random_unit(rng, 1)
        normal = seen @ region.matrix / np.linalg.norm(seen @ region.matrix)
        return region.center + region.radius * seen @ np.linalg.inv(region.matrix).T, normal
    off = region.across(rng.normal(size=(1, 3)))
    ray = np.cos(region.half_angle) * region.axis + np.sin(region.half_angle) * off
    point = region.apex + ray / np.tan(region.half_angle)  # where the radius of curvature is one
    return point, region.supporting(point).normal


def some_region(rng: np.random.Generator) -> Region:
    if rng.integers(2):
        return Ball(rng.normal(size=(1, 3)), 1.0)
    return Cone(rng.normal(size=(1, 3)), random_unit(rng, 1), float(rng.uniform(0.2, 0.9)))


def both_sides(region: Region, mean: Array, factor: Array) -> tuple[Array, Array]:
    """Probabilities to be in a region, and to be out of it."""
    inside, outside = event((region,)), event((), (region,))
    within, without = (node_quantiles(side, mean, factor) for side in (inside, outside))
    return probability(within), probability(without)


def oracle(region: Region, mean: Array, factor: Array) -> float:
    if isinstance(region, Ball):
        return ball_probability(region, mean[0], covariance(factor)[0])
    return cone_probability(region, mean[0], covariance(factor)[0])


def away(rng: np.random.Generator, region: Region, factor: Array, deviations: float) -> Array:
    """A mean (1, 3) so many standard deviations outside the region's nearest facet."""
    point, normal = touched(rng, region)
    sigma = np.sqrt(normal[0] @ covariance(factor)[0] @ normal[0])
    return np.asarray(point + deviations * sigma * normal)


@given(st.floats(0.002, 0.5 / np.sqrt(3.0)), generators)
@few
def test_balls_follow_the_noncentral_chi_square_law(sigma, rng):
    n = 40
    normal = random_unit(rng, n)
    distance = np.r_[0.0, rng.uniform(0.0, 1.0, 9), 1.0 + sigma * rng.uniform(-5.0, 5.0, n - 10)]
    mean, ball = distance[:, None] * normal, many(Ball(np.zeros((1, 3)), 1.0), n)
    factor = np.broadcast_to(sigma * np.eye(3), (n, 3, 3))
    expected = round_ball_probability(1.0, np.abs(distance), np.hypot(sigma, SPREAD_MIN))
    within, without = both_sides(ball, mean, factor)
    np.testing.assert_allclose(within, expected, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(without, 1.0 - expected, rtol=0.0, atol=1e-8)


@given(st.floats(0.002, 0.5), st.floats(1.0, SLENDER), sigmas_away, generators)
@few
def test_balls_and_cones_agree_with_nested_quadrature(spread, slenderness, deviations, rng):
    """Wide and slender laws too."""
    region = some_region(rng)
    factor = root(rng, spread, slenderness)
    mean = away(rng, region, factor, deviations)
    expected = oracle(region, mean, factor)
    within, without = both_sides(region, mean, factor)
    accuracy = NEAR_APEX if isinstance(region, Cone) else QUADRATURE
    assert within.item() == pytest.approx(expected, abs=accuracy)
    assert without.item() == pytest.approx(1.0 - expected, abs=accuracy)


@given(st.floats(0.05, 0.5), st.floats(0.0, 1.0), generators)
@few
def test_long_law_deep_inside_reaches_out(spread, distance, rng):
    """Lying across the way to the nearest point of the limit, which it is far from."""
    normal, side, other = random_rotation(rng)
    axes = [normal / SLENDER, side, other / 10.0]
    factor = spread * np.stack(axes, axis=1)[None]
    mean, ball = distance * normal[None], Ball(np.zeros((1, 3)), 1.0)
    expected = ball_probability(ball, mean[0], covariance(factor)[0])
    found = probability(node_quantiles(event((ball,)), mean, factor))
    assert found.item() == pytest.approx(expected, abs=QUADRATURE)


@given(st.floats(0.1, 1.0), st.floats(1.0, SLENDER), generators)
@few
def test_about_its_apex_a_cone_has_one_nappe(away, slenderness, rng):
    """Whichever nappe of the double cone the mean is on or beside."""
    cone = Cone(rng.normal(size=(1, 3)), random_unit(rng, 1), float(rng.uniform(0.2, 1.3)))
    factor = root(rng, 1.0, slenderness)
    mean = cone.apex + away * (factor[0] @ rng.normal(size=5))
    expected = oracle(cone, mean, factor)
    within, without = both_sides(cone, mean, factor)
    assert within.item() == pytest.approx(expected, abs=NEAR_APEX)
    assert without.item() == pytest.approx(1.0 - expected, abs=NEAR_APEX)


@given(st.floats(0.01, 0.5), st.floats(1.0, SLENDER), generators)
@few
def test_between_two_limits(spread, slenderness, rng):
    inner: Region
    outer: Region
    if rng.integers(2):
        center = rng.normal(size=(1, 3))
        inner, outer = Ball(center, float(rng.uniform(0.5, 0.95))), Ball(center, 1.0)
    else:
        apex, axis = rng.normal(size=(1, 3)), random_unit(rng, 1)
        inner, outer = Cone(apex, axis, float(rng.uniform(0.2, 0.6))), Cone(apex, axis, 0.7)
    factor = root(rng, spread, slenderness)
    nearest = (inner, outer)[rng.integers(2)]
    mean = away(rng, nearest, factor, float(rng.uniform(-3.0, 3.0)))
    expected = oracle(outer, mean, factor) - oracle(inner, mean, factor)
    found = probability(node_quantiles(event((outer,), (inner,)), mean, factor))
    assert found.item() == pytest.approx(expected, abs=NEAR_APEX)


def test_limits_that_are_not_nested_are_refused():
    """Their probabilities of being missed would not add up."""
    mean, factor = np.array([[0.0, 0.0, 1.0]]), 0.1 * np.eye(3)[None]
    ball, apart = Ball(np.zeros((1, 3)), 1.0), Ball(np.array([[0.0, 0.0, 1.0]]), 0.5)
    cone = Cone(np.zeros((1, 3)), np.eye(3)[[2]], 0.5)
    turned = Cone(np.zeros((1, 3)), np.eye(3)[[0]], 0.2)
    for keep_in, keep_out in (
        *(((ball,), (apart,)), ((ball,), (cone,)), ((cone,), (turned,))),
        *(((ball, apart), ()), ((), (ball, apart))),
    ):
        with pytest.raises(ValueError, match=r"nested|two limits"):
            node_quantiles(event(keep_in, keep_out), mean, factor)


@given(st.floats(-6.5, 6.5) | st.floats(7.5, 9.0) | st.floats(-9.0, -7.5), generators)
def test_a_half_space_has_its_closed_form(deviations, rng):
    """A huge ball: g = (b - a'mu) / ||S'a||, and the gradients of that."""
    normal, factor, radius = random_unit(rng), root(rng, 1.0, 5.0), 1e6
    ball = Ball(-radius * normal[None], radius)
    along = factor[0].T @ normal
    sigma = np.linalg.norm(along)
    side = np.cross(normal, random_unit(rng))
    mean = (-deviations * sigma * normal + side)[None]
    found = node_quantiles(event((ball,)), mean, factor)
    # The ball falls away from the plane by half a millionth.
    assert found.value.item() == pytest.approx(deviations, abs=1e-4)
    np.testing.assert_allclose(found.by_mean[0], -normal / sigma, rtol=1e-4, atol=1e-4 / sigma)
    expected = -deviations / sigma**2 * np.outer(normal, along)
    scale = (1.0 + abs(deviations)) / sigma
    np.testing.assert_allclose(found.by_factor[0], expected, atol=1e-4 * scale)


@given(generators, st.booleans())
def test_without_any_spread_the_means_side_tells(rng, out):
    region, none = some_region(rng), np.zeros((1, 3, 4))
    point, normal = touched(rng, region)
    for side in (-0.01, 0.01):
        it = event((), (region,)) if out else event((region,))
        found = node_quantiles(it, point + side * normal, none)
        assert np.isfinite(found.by_mean).all()
        assert np.isfinite(found.by_factor).all()
        holds = (side > 0.0) == out
        assert found.value.item() > 6.0 if holds else found.value.item() < -6.0


@given(generators)
@few
def test_vanishing_probability_keeps_g_beyond_bound(rng):
    """A slender law beside a ball: its tangent plane is near, and the ball itself out of reach."""
    ball = Ball(np.zeros((1, 3)), 0.43)
    turn = random_rotation(rng)
    mean = np.array([[0.97, 0.0, 0.0]]) @ turn.T
    c, s = np.cos(0.9), np.sin(0.9)
    tilt = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    factor = (turn @ tilt @ np.diag([0.22, 0.04, 0.006]))[None]
    found = node_quantiles(event((), (ball,)), mean, factor)
    lost = ball_probability(ball, mean[0], covariance(factor)[0])
    plane = 0.54 / np.linalg.norm(mean[0] @ factor[0] / 0.97)
    assert plane < 4.0
    assert lost < 1e-13
    assert found.value.item() > 7.0


@pytest.mark.slow
@pytest.mark.parametrize("slenderness", [2.0, SLENDER])
@pytest.mark.parametrize("spread", [0.02, 0.1, 0.5])
@pytest.mark.parametrize("kind", ["ball", "cone", "shell", "half-space", "ellipsoid"])
def test_gradients_are_good_to_a_millionth(kind, spread, slenderness):
    rng = np.random.default_rng(11)
    ball, hole = Ball(np.zeros((1, 3)), 1.0), Ball(np.zeros((1, 3)), 1.0 / (1.0 + 3.0 * spread))
    cone = Cone(np.zeros((1, 3)), random_unit(rng, 1), 0.7)
    plane = Halfspaces(random_unit(rng, 1), np.ones(1))
    egg = Ellipsoid(np.zeros((1, 3)), random_rotation(rng) @ np.diag([1.0, 0.8, 0.6]))
    for _ in range(4):
        factor = root(rng, spread, slenderness)
        nearest: Region = {"cone": cone, "half-space": plane, "ellipsoid": egg}.get(kind, ball)
        mean = away(rng, nearest, factor, float(rng.uniform(-2.0, 2.0)))
        step = 2e-4 * spread / slenderness
        moves = np.concatenate([np.eye(18), -np.eye(18)]) * step

        def values(means: Array, factors: Array, nearest: Region = nearest) -> Quantiles:
            holes = (many(hole, len(means)),) if kind == "shell" else ()
            return node_quantiles(event((many(nearest, len(means)),), holes), means, factors)

        found = values(mean, factor)
        moved = values(mean + moves[:, :3], factor + moves[:, 3:].reshape(-1, 3, 5)).value
        forward, backward = np.split(moved, 2)
        slope = spread * (forward - backward) / (2.0 * step)
        by = spread * np.concatenate([found.by_mean.ravel(), found.by_factor.ravel()])
        np.testing.assert_allclose(by, slope, rtol=0.0, atol=1e-6 * (1.0 + np.abs(by).max()))


@few
@given(generators)
def test_flat_and_stretched_regions_match_draws(rng):
    """An ellipsoid exactly; many faces by the sum of what each loses, a bound, in and out."""
    factor, faces = root(rng, 0.5), random_unit(rng, 5)
    mean, room = rng.normal(scale=0.3, size=(1, 3)), rng.uniform(0.6, 1.5, 5)
    draws = mean + rng.standard_normal((100_000, 5)) @ factor[0].T
    egg = Ellipsoid(np.zeros((1, 3)), np.diag([1.0, 0.7, 0.5]) @ random_rotation(rng))
    held = np.mean(egg.inside(draws[None]) > 0.0)
    assert probability(node_quantiles(event((egg,)), mean, factor)) == pytest.approx(held, abs=0.01)
    halves = tuple(Halfspaces(a[None], b[None]) for a, b in zip(faces, room, strict=True))
    inside = np.all([half.inside(draws[None]) > 0.0 for half in halves], axis=0).mean()
    lost = sum(1.0 - (half.inside(draws[None]) > 0.0).mean() for half in halves)
    found = probability(node_quantiles(event(halves), mean, factor)).item()
    assert found == pytest.approx(max(1.0 - lost, 0.0), abs=0.01)
    assert found <= inside + 0.01
    out = Event("out", np.zeros(1, dtype=np.intp), (), (Polytope(faces, room),))
    kept_out = probability(node_quantiles(out, mean, factor)).item()
    assert kept_out <= 1.0 - inside + 0.01
    beyond = max(1.0 - (half.inside(draws[None]) > 0.0).mean() for half in halves)
    assert kept_out == pytest.approx(beyond, abs=0.01)


@given(generators)
@few
def test_nodes_do_not_know_of_each_other(rng):
    """Whatever their spread and wherever they are: together and one by one."""
    n = 6
    mean, anchor = rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    factor = np.concatenate([root(rng, spread) for spread in np.geomspace(1e-7, 1.0, n)])
    axis = random_unit(rng, n)
    it = Event("it", np.arange(n), (Cone(anchor, axis, 1.2),), (Cone(anchor, axis, 0.4),))
    together = node_quantiles(it, mean, factor)
    for i in range(n):
        alone = node_quantiles(it.at(np.array([i])), mean[[i]], factor[[i]])
        for part, whole in zip(alone, together, strict=True):
            np.testing.assert_allclose(part[0], whole[i], rtol=1e-9, atol=1e-12)


def test_joint_events_are_made_of_their_sides():
    nodes = np.array([2, 5])
    ball, hole = Ball(np.zeros((2, 3)), 2.0), Ball(np.zeros((2, 3)), 1.0)
    cone = Cone(np.zeros((2, 3)), np.tile([[0.0, 0.0, 1.0]], (2, 1)), 0.3)
    constraints = [
        StateConstraint("far", nodes, ball, "in", 0.9, "distance"),
        StateConstraint("alone", nodes, cone, "out", 0.9),
        StateConstraint("near", nodes, hole, "out", 0.9, "distance"),
    ]
    first, second = joint_events(constraints)
    assert (first.name, first.keep_in, first.keep_out) == ("distance", (ball,), (hole,))
    assert (second.name, second.keep_in, second.keep_out) == ("alone", (), (cone,))
    np.testing.assert_array_equal(first.nodes, nodes)
    assert first.limits == (ball, hole)


@pytest.mark.parametrize("left", [1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("spread", [0.01, 0.1])
def test_complement_near_one_keeps_its_digits(left, spread):
    """Down to the least that a scenario may leave, 1e-9: by the noncentral chi-square law."""
    mean = np.array([[1.0, 0.0, 0.0]])
    factor = spread * np.eye(3)[None]
    square = float(ncx2.isf(left, 3, 1.0 / spread**2))
    event = Event("ball", np.array([0]), (Ball(np.zeros((1, 3)), spread * np.sqrt(square)),), ())
    (g,) = node_quantiles(event, mean, factor).value
    assert ndtr(-g) == pytest.approx(left, rel=1e-5)
