"""Facets of chance constraints: inside or around their region, turned to the guess, chosen well."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial import HalfspaceIntersection
from scipy.stats import norm

from formulations.arrays import Array
from formulations.problem.facets import (
    Facets,
    Polytopes,
    ball,
    choose_facets,
    inner_facets,
    outer_facets,
    paper_ball,
    touching_facets,
)
from formulations.problem.flyby import FlybyProblem, StateConstraint
from formulations.problem.regions import Ball, Cone, Ellipsoid, Halfspaces, Region
from tests.helpers import constrain, generators, random_flyby, random_unit

EXACT = 1e-9
"""Rounding, and Qhull's vertices, of numbers of order one."""

ball_shapes = st.sampled_from([paper_ball(), *map(ball, (4, 5, 8, 13, 24, 48))])
polytopes = st.builds(Polytopes, ball_shapes, st.integers(3, 32))
generous = st.builds(Polytopes, st.one_of(st.none(), ball_shapes), st.integers(3, 32))


@st.composite
def balls(draw: st.DrawFn) -> Ball:
    return Ball(draw(generators).normal(size=(1, 3)), draw(st.floats(0.01, 2.0)))


@st.composite
def cones(draw: st.DrawFn) -> Cone:
    rng = draw(generators)
    return Cone(rng.normal(size=(1, 3)), random_unit(rng, 1), draw(st.floats(0.02, 1.5)))


points = generators.map(lambda rng: 2.0 * rng.normal(size=(1, 3)))


def stacked(facets: list[Halfspaces]) -> tuple[Array, Array]:
    """Normals (m, 3) and offsets (m,) at a single node."""
    return np.vstack([f.normal for f in facets]), np.concatenate([f.offset for f in facets])


def vertices(facets: list[Halfspaces], interior: Array) -> Array:
    normal, offset = stacked(facets)
    return HalfspaceIntersection(np.column_stack([normal, -offset]), interior).intersections


def edges(facets: list[Halfspaces]) -> Array:
    """Unit vectors along the edges of a pyramid: all that two of its planes span and all allow."""
    normal, _ = stacked(facets)
    lines = np.array([np.cross(a, b) for a, b in itertools.combinations(normal, 2)])
    size = np.linalg.norm(lines, axis=1)
    rays = np.vstack([lines, -lines])[np.tile(size > 1e-9, 2)]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays[np.all(rays @ normal.T <= 1e-10, axis=1)]


def off_axis(cone: Cone, rays: Array) -> Array:
    across = np.linalg.norm(np.cross(rays, cone.axis[0]), axis=1)
    return np.arctan2(across, rays @ cone.axis[0])


def faced(region: Region, point: Array) -> tuple[Array, Array]:
    """The place on the surface that faces a point, and the outward normal there.

    On a ball where the line of sight from its centre leaves it; on a cone one unit from the apex.
    """
    if isinstance(region, Ball):
        sight = (point - region.center)[0]
        assume(np.linalg.norm(sight) > 1e-3)
        sight /= np.linalg.norm(sight)
        return region.center[0] + region.radius * sight, sight
    d, axis, angle = (point - region.apex)[0], region.axis[0], region.half_angle
    side = d - (d @ axis) * axis
    assume(np.linalg.norm(side) > 1e-3)
    side /= np.linalg.norm(side)
    ray = np.cos(angle) * axis + np.sin(angle) * side
    return region.apex[0] + ray, np.cos(angle) * side - np.sin(angle) * axis


@given(balls(), polytopes, points)
def test_inner_facets_of_ball_lie_inside(region, shapes, point):
    facets = inner_facets(region, shapes, point)
    corners = vertices(facets, region.center[0])
    assert np.linalg.norm(corners - region.center, axis=1).max() <= region.radius * (1.0 + EXACT)
    # A vertex of it on the sphere, where three facets meet, is turned to the line of sight.
    normal, offset = stacked(facets)
    slack = offset - normal @ faced(region, point)[0]
    assert slack.min() == pytest.approx(0.0, abs=EXACT)
    assert np.sum(slack < EXACT) >= 3


@given(cones(), polytopes, points)
def test_inner_facets_of_cone_lie_inside(region, shapes, point):
    facets = inner_facets(region, shapes, point)
    normal, offset = stacked(facets)
    assert offset == pytest.approx(normal @ region.apex[0], abs=EXACT)
    rays = edges(facets)
    assert len(rays) == shapes.cone_facets
    assert np.all(off_axis(region, rays) <= region.half_angle + EXACT)
    assert np.all(normal @ region.axis[0] < 0.0)  # the pyramid holds the axis: it is not empty
    # An edge of it on the cone, where two facets meet, is turned to the line of sight.
    slack = offset - normal @ faced(region, point)[0]
    assert slack.min() == pytest.approx(0.0, abs=EXACT)
    assert np.sum(slack < EXACT) == 2


@given(balls(), polytopes, points)
def test_outer_facets_of_ball_lie_around(region, shapes, point):
    facets = outer_facets(region, shapes, point)
    normal, offset = stacked(facets)
    # The farthest point of a ball along a unit normal is a radius from its centre.
    assert np.linalg.norm(normal, axis=1) == pytest.approx(1.0, abs=EXACT)
    assert offset == pytest.approx(normal @ region.center[0] + region.radius, abs=EXACT)
    vertices(facets, region.center[0])  # bounded, or Qhull fails


@given(cones(), polytopes, points)
def test_outer_facets_of_cone_lie_around(region, shapes, point):
    facets = outer_facets(region, shapes, point)
    normal, offset = stacked(facets)
    assert offset == pytest.approx(normal @ region.apex[0], abs=EXACT)
    # The ray of a cone that is highest along a normal lies in the plane of axis and normal.
    along = normal @ region.axis[0]
    across = np.linalg.norm(np.cross(normal, region.axis[0]), axis=1)
    highest = along * np.cos(region.half_angle) + across * np.sin(region.half_angle)
    assert np.all(highest <= EXACT)
    assert np.all(off_axis(region, edges(facets)) >= region.half_angle - EXACT)


@given(st.one_of(balls(), cones()), generous, points)
def test_nearest_outer_facet_touches_the_region(region, shapes, point):
    place, outward = faced(region, point)
    normal, offset = stacked(outer_facets(region, shapes, point))
    best = np.argmax(normal @ outward)
    assert normal[best] == pytest.approx(outward, abs=EXACT)
    assert offset[best] == pytest.approx(outward @ place, abs=EXACT)
    if shapes.ball is None and isinstance(region, Ball):  # the tangent facet stands alone
        (inner,) = inner_facets(region, shapes, point)
        assert len(normal) == 1
        assert np.array_equal(inner.normal, normal)
        assert np.array_equal(inner.offset, offset)


def problem_with(*constraints: StateConstraint) -> FlybyProblem:
    problem = random_flyby(np.random.default_rng(0)).problem
    return replace(problem, constraints=constraints)


@st.composite
def beliefs(draw: st.DrawFn) -> tuple[Array, Array]:
    """Means (9, 6) and factors (9, 6, c), of any rank."""
    rng = draw(generators)
    columns = draw(st.integers(1, 9))
    spread = 10.0 ** draw(st.floats(-3.0, 0.0))
    return 2.0 * rng.normal(size=(9, 6)), spread * rng.normal(size=(9, 6, columns))


def spread_over(region: Region, nodes: Array) -> Region:
    """The same region at several nodes."""
    n = len(nodes)
    if isinstance(region, Ball):
        return Ball(np.repeat(region.center, n, axis=0), region.radius)
    return Cone(
        np.repeat(region.apex, n, axis=0), np.repeat(region.axis, n, axis=0), region.half_angle
    )


@given(st.one_of(balls(), cones()), generous, beliefs())
def test_most_probable_keep_out_facet_is_chosen(region, shapes, belief):
    mean, factor = belief
    nodes = np.array([1, 4, 7])
    constraint = StateConstraint("out", nodes, spread_over(region, nodes), "out", 0.8)
    chosen = choose_facets(problem_with(constraint), shapes, mean, factor)
    assert np.array_equal(chosen.node, nodes)
    for row, k in enumerate(nodes):
        # log of the probability to be on the inner side: exact even where it is next to nothing.
        normal, offset = stacked(outer_facets(region, shapes, mean[[k], :3]))
        sigma = np.linalg.norm(normal @ factor[k, :3], axis=1)
        failing = norm.logcdf(offset, loc=normal @ mean[k, :3], scale=sigma)
        a = -chosen.normal[row]
        centre, spread = a @ mean[k, :3], np.linalg.norm(a @ factor[k, :3])
        found = norm.logcdf(-chosen.offset[row], loc=centre, scale=spread)
        assert found <= failing.min() + 1e-6 * abs(failing.min())
        # It is a facet of the polytope, seen from the other side.
        assert np.min(np.abs(np.column_stack([normal - a, offset + chosen.offset[row]])).max(1)) < (
            EXACT
        )


@given(st.one_of(balls(), cones()), generous, generators, st.floats(-2.0, 3.0))
def test_without_spread_roomiest_facet_is_chosen(region, shapes, rng, decade):
    mean = 10.0**decade * rng.normal(size=(9, 6))
    nodes = np.array([2])
    constraint = StateConstraint("out", nodes, region, "out", 0.8)
    chosen = choose_facets(problem_with(constraint), shapes, mean, np.zeros((9, 6, 6)))
    normal, offset = stacked(outer_facets(region, shapes, mean[nodes, :3]))
    room = (normal @ mean[2, :3] - offset).max()
    found = chosen.offset - chosen.normal @ mean[2, :3]
    assert found == pytest.approx(room, rel=EXACT, abs=EXACT)


@given(st.floats(0.5, 0.99), st.one_of(balls(), cones()), generous, beliefs())
def test_keep_in_shares_risk_keep_out_whole(probability, region, shapes, belief):
    nodes = np.array([3, 5])
    regions = spread_over(region, nodes)
    constraints = [
        StateConstraint(keep, nodes, regions, keep, probability) for keep in ("in", "out")
    ]
    facets = choose_facets(problem_with(*constraints), shapes, *belief)
    risk = norm.sf(facets.quantile)
    for index, keep in enumerate(("in", "out")):
        for k in nodes:
            of_one = (facets.constraint == index) & (facets.node == k)
            assert risk[of_one].sum() == pytest.approx(1.0 - probability, abs=1e-12)
            assert risk[of_one] == pytest.approx(risk[of_one].mean())  # uniformly
            if keep == "out":
                assert of_one.sum() == 1
            elif isinstance(region, Cone):
                assert of_one.sum() == shapes.cone_facets
            else:
                assert of_one.sum() == (1 if shapes.ball is None else len(shapes.ball.normals))


@given(st.floats(0.5, 0.99), st.one_of(balls(), cones()), beliefs())
def test_touching_facets_bear_whole_risk_at_surface(probability, region, belief):
    mean, _ = belief
    nodes = np.array([3, 5])
    regions = spread_over(region, nodes)
    constraints = [
        StateConstraint(keep, nodes, regions, keep, probability) for keep in ("in", "out")
    ]
    facets = touching_facets(problem_with(*constraints), mean)
    assert norm.cdf(facets.quantile) == pytest.approx(probability)
    room = facets.offset - np.einsum("mi,mi->m", facets.normal, mean[facets.node, :3])
    depth = regions.inside(mean[nodes, :3])
    assert room == pytest.approx(np.concatenate([depth, -depth]), abs=1e-9)


@given(generators, polytopes)
def test_facets_are_those_of_their_constraint_and_node(rng, shapes):
    flyby = constrain(rng, random_flyby(rng))
    lin = flyby.perturbed(rng, 0.1, 0.0)
    facets = choose_facets(flyby.problem, shapes, lin.iterate.mean, lin.factor)
    for index, constraint in enumerate(flyby.problem.constraints):
        own = facets.constraint == index
        assert set(facets.node[own]) == set(constraint.nodes)
        alone = choose_facets(
            replace(flyby.problem, constraints=(constraint,)), shapes, lin.iterate.mean, lin.factor
        )
        for field in ("node", "normal", "offset", "quantile"):
            assert np.array_equal(getattr(facets, field)[own], getattr(alone, field))


@given(generators, beliefs())
def test_facets_deviation_is_covariances_along_it(rng, belief):
    mean, factor = belief
    node, normal = rng.integers(0, 9, 20), random_unit(rng, 20)
    facets = Facets(
        np.zeros(20, dtype=int), node, normal, rng.normal(size=20), rng.uniform(0, 3, 20)
    )
    covariance = (factor @ factor.transpose(0, 2, 1))[node, :3, :3]
    variance = np.einsum("mi,mij,mj->m", normal, covariance, normal)
    assert facets.deviation(mean, factor) ** 2 == pytest.approx(variance, rel=1e-9, abs=1e-13)
    distance = facets.offset - np.sum(normal * mean[node, :3], axis=1)
    expected = distance - facets.quantile * facets.deviation(mean, factor)
    assert facets.margin(mean, factor) == pytest.approx(expected, abs=EXACT)


@given(generators, generous, points)
def test_ellipsoids_facets_touch_unconstrained_has_none(rng, shapes, point):
    matrix = rng.normal(size=(3, 3)) + 3.0 * np.eye(3)
    egg = Ellipsoid(rng.normal(size=(1, 3)), matrix, 0.7)
    normal, offset = stacked(outer_facets(egg, shapes, point))
    reach = egg.radius * np.linalg.norm(np.linalg.solve(matrix.T, normal.T), axis=0)
    assert offset == pytest.approx(normal @ egg.center[0] + reach, abs=EXACT)
    none = choose_facets(problem_with(), shapes, np.zeros((9, 6)), np.zeros((9, 6, 6)))
    assert len(none.node) == len(none.normal) == 0


@given(generators, polytopes)
def test_holding_choice_keeps_what_holds(rng, shapes):
    """At each node of each constraint the least room is no less than before, or not negative."""
    problem = constrain(rng, random_flyby(rng)).problem
    n = problem.n_nodes
    mean, factor = rng.normal(size=(n, 6)), 0.1 * rng.normal(size=(n, 6, 6))
    old = choose_facets(problem, shapes, rng.normal(size=(n, 6)), factor)
    new = choose_facets(problem, shapes, mean, factor)
    mixed = old.where_they_hold(new, mean, factor)
    rooms = [facets.margin(mean, factor) for facets in (old, new, mixed)]
    for group in {*zip(old.constraint.tolist(), old.node.tolist(), strict=True)}:
        own = (old.constraint == group[0]) & (old.node == group[1])
        before, fresh, after = (room[own].min() for room in rooms)
        assert after >= min(before, 0.0) - EXACT
        assert after in (before, fresh)
