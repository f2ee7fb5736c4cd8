"""Balls and cones: signed distances, supporting half-spaces, second-order cones."""

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from formulations.arrays import Array
from formulations.problem.flyby import StateConstraint
from formulations.problem.regions import (
    Ball,
    Cone,
    Halfspaces,
    Region,
    SecondOrderCone,
    perpendicular,
    reject,
    unit,
)
from tests.helpers import generators, random_unit

EXACT = 1e-12
"""Rounding of a few operations on numbers of order one."""

coordinates = st.floats(-3.0, 3.0)
points = st.tuples(coordinates, coordinates, coordinates).map(lambda p: np.array([p]))
half_angles = st.floats(0.01, np.pi / 2 - 0.01)


@st.composite
def directions(draw: st.DrawFn) -> Array:
    vector = draw(points)
    size = np.linalg.norm(vector)
    assume(size > 1e-3)
    return vector / size


balls = st.builds(Ball, points, st.floats(0.01, 3.0))
cones = st.builds(Cone, points, directions(), half_angles)


def lengths(vectors: Array) -> Array:
    return np.linalg.norm(vectors, axis=-1)


def angle_off_axis(cone: Cone, point: Array) -> Array:
    """By the arc tangent, accurate at any angle."""
    d = point - cone.apex
    return np.arctan2(lengths(np.cross(cone.axis, d)), np.sum(cone.axis * d, axis=-1))


def across(axis: Array, azimuth: Array) -> Array:
    """Unit vectors perpendicular to one axis (1, 3), all around it."""
    first = perpendicular(axis)
    second = np.cross(axis, first)
    return np.cos(azimuth)[:, None] * first + np.sin(azimuth)[:, None] * second


def members(rng: np.random.Generator, region: Region, count: int = 200) -> Array:
    """Points of one region, its surface included."""
    fraction = np.append(rng.uniform(size=count - 20), np.ones(20))[:, None]
    if isinstance(region, Ball):
        return region.center + region.radius * fraction * random_unit(rng, count)
    angle = region.half_angle * fraction
    azimuth = rng.uniform(0.0, 2.0 * np.pi, count)
    ray = np.cos(angle) * region.axis + np.sin(angle) * across(region.axis, azimuth)
    return region.apex + rng.exponential(2.0, (count, 1)) * ray


def contains(halfspaces: Halfspaces, inner_points: Array) -> bool:
    slack = halfspaces.offset - inner_points @ halfspaces.normal[0]
    return bool(np.all(slack >= -EXACT * (1.0 + lengths(inner_points))))


def cone_slack(cone: SecondOrderCone, point: Array) -> Array:
    matrix, origin, offset = cone
    y = np.einsum("nij,nj->ni", matrix, point - origin) + offset
    return y[:, 0] - lengths(y[:, 1:])


@given(balls, points)
def test_inside_of_ball_is_radius_less_distance(ball, point):
    distance = lengths(point - ball.center)
    assert ball.inside(point) == pytest.approx(ball.radius - distance, abs=EXACT)


@given(cones, points)
def test_inside_of_cone_is_sine_to_surface(cone, point):
    angle = cone.half_angle - angle_off_axis(cone, point)
    distance = lengths(point - cone.apex) * np.sin(angle)
    assert cone.inside(point) == pytest.approx(distance, abs=EXACT)


@given(st.one_of(balls, cones), points, points, generators)
@example(Ball(np.zeros((1, 3)), 1.0), np.array([[0.0, 0.0, 3e-162]]), np.zeros((1, 3)), None)
def test_supporting_half_space_contains_only_its_region(region, point, other, rng):
    halfspaces = region.supporting(point)
    assert lengths(halfspaces.normal) == pytest.approx(1.0, abs=EXACT)
    assert contains(halfspaces, members(rng or np.random.default_rng(0), region))
    room = halfspaces.offset - np.sum(halfspaces.normal * other, axis=1)
    assert halfspaces.inside(other) == pytest.approx(room, abs=EXACT)
    assert halfspaces.complement().inside(other) == pytest.approx(-room, abs=EXACT)


@given(balls, points)
def test_half_space_touches_ball_along_the_radius(ball, point):
    sight = point - ball.center
    assume(lengths(sight)[0] > 1e-3)
    touched = ball.center + ball.radius * sight / lengths(sight)
    assert ball.supporting(point).inside(touched) == pytest.approx(0.0, abs=EXACT)
    # At the centre, where no line of sight is, it touches the top.
    centre = ball.supporting(ball.center)
    assert centre.normal.tolist() == [[0.0, 0.0, 1.0]]
    assert centre.offset == pytest.approx(ball.center[:, 2] + ball.radius, abs=EXACT)


@given(cones, points)
def test_half_space_touches_cone_along_nearest_ray(cone, point):
    d = point - cone.apex
    side = d - np.sum(d * cone.axis) * cone.axis
    assume(lengths(side)[0] > 1e-3)
    side /= lengths(side)
    ray = np.cos(cone.half_angle) * cone.axis + np.sin(cone.half_angle) * side
    for t in (0.0, 1.0, 3.0):
        touched = cone.apex + t * ray
        assert cone.supporting(point).inside(touched) == pytest.approx(0.0, abs=EXACT)


@given(directions(), half_angles, st.floats(-16.0, -2.0))
@example(np.array([[0.6, 0.0, 0.8]]), 1.0, -14.0)
@example(np.array([[0.6, 0.0, 0.8]]), 1.0, -11.0)
def test_half_space_near_axis_touches_its_cone(axis, half_angle, decade):
    cone = Cone(np.zeros((1, 3)), axis, half_angle)
    side = perpendicular(axis)
    assert np.sum(side * axis) == pytest.approx(0.0, abs=EXACT)
    assert lengths(side) == pytest.approx(1.0, abs=EXACT)
    for aside in (0.0, 10.0**decade):
        for along in (1.0, -1.0):
            assert_supports(cone, cone.supporting(along * axis + aside * side))


@given(st.floats(-14.0, 0.0), generators)
def test_part_across_axis_is_remainder_or_zero(decade, rng):
    axis = random_unit(rng, 4)
    side = perpendicular(axis)
    vector = 3.0 * axis + 10.0**decade * side
    left = reject(vector, axis)
    assert np.abs(np.sum(left * axis, axis=1)).max() <= 1e-15 * 10.0**decade + 1e-30
    np.testing.assert_allclose(left, 10.0**decade * side, atol=5e-15)
    assert not reject(np.outer(rng.normal(size=4), np.ones(3)) * axis, axis).any()
    assert unit(2.0 * left, side) == pytest.approx(left / lengths(left)[:, None], abs=EXACT)
    assert unit(0.0 * left, side) is not side
    assert np.array_equal(unit(0.0 * left, side), side)


def assert_supports(cone: Cone, halfspaces: Halfspaces) -> None:
    """Of all rays of the cone the one that rises most along the normal does not rise at all."""
    normal, offset = halfspaces.normal, halfspaces.offset
    assert lengths(normal) == pytest.approx(1.0, abs=1e-9)
    along, aside = np.sum(normal * cone.axis), lengths(np.cross(normal, cone.axis))
    rise = along * np.cos(cone.half_angle) + aside * np.sin(cone.half_angle)
    assert rise == pytest.approx(0.0, abs=1e-9)
    assert offset[0] == pytest.approx(np.sum(normal * cone.apex), abs=EXACT)


@given(st.one_of(balls, cones), points)
def test_cone_constraint_and_margins_equal_inside(region, point):
    inside, slack = region.inside(point), cone_slack(region.second_order_cone, point)
    assert slack == pytest.approx(inside, abs=EXACT)
    mean = np.concatenate([point, np.full((1, 3), np.nan)], axis=1)  # velocities do not matter
    for keep, sense in (("in", 1.0), ("out", -1.0)):
        constraint = StateConstraint(keep, np.array([0]), region, keep, 0.9)
        assert constraint.margin(mean) == pytest.approx(sense * inside, abs=EXACT)


@given(generators, st.booleans())
def test_each_nodes_region_is_its_own(rng, alike):
    """Together and one by one, with points at distances of 1e-150 to 1e150 from their regions."""
    n = 5
    sizes = np.ones(n) if alike else np.array([1e-150, 1e-8, 1.0, 1e8, 1e150])
    anchor = rng.normal(size=(n, 3)) if alike else np.zeros((n, 3))
    point = anchor + sizes[:, None] * random_unit(rng, n)
    for together in (Ball(anchor, 0.7), Cone(anchor, random_unit(rng, n), 0.4)):
        halfspaces, inside = together.supporting(point), together.inside(point)
        for i in range(n):
            alone = together.at(np.array([i]))
            one = alone.supporting(point[[i]])
            assert one.normal[0] == pytest.approx(halfspaces.normal[i], abs=EXACT)
            assert one.offset[0] == pytest.approx(halfspaces.offset[i], abs=EXACT)
            assert alone.inside(point[[i]])[0] == pytest.approx(inside[i], rel=EXACT, abs=EXACT)
