"""Balls and cones: signed distances, supporting half-spaces, second-order cones."""

from __future__ import annotations

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


def surface(rng: np.random.Generator, cone: Cone, count: int = 200) -> Array:
    """Rays of a cone's surface, (count, 3)."""
    side = across(cone.axis, rng.uniform(0.0, 2.0 * np.pi, count))
    return np.cos(cone.half_angle) * cone.axis + np.sin(cone.half_angle) * side


def contains(halfspaces: Halfspaces, inner_points: Array) -> bool:
    slack = halfspaces.offset - inner_points @ halfspaces.normal[0]
    return bool(np.all(slack >= -EXACT * (1.0 + lengths(inner_points))))


def cone_slack(cone: SecondOrderCone, point: Array) -> Array:
    d = point - cone.origin
    left = lengths(np.einsum("nij,nj->ni", cone.matrix, d))
    return np.sum(cone.linear * d, axis=-1) + cone.constant - left


# --- signed distance ----------------------------------------------------------------------------


@given(balls, points)
def test_inside_of_a_ball_is_its_radius_less_the_distance_to_its_centre(
    ball: Ball, point: Array
) -> None:
    distance = lengths(point - ball.center)
    assert ball.inside(point) == pytest.approx(ball.radius - distance, abs=EXACT)


@given(cones, points)
def test_inside_of_a_cone_is_the_sine_of_the_angle_to_its_surface(cone: Cone, point: Array) -> None:
    angle = cone.half_angle - angle_off_axis(cone, point)
    distance = lengths(point - cone.apex) * np.sin(angle)
    assert cone.inside(point) == pytest.approx(distance, abs=EXACT)


@given(cones, points, generators)
def test_no_point_of_a_cones_surface_is_nearer_than_the_distance_inside(
    cone: Cone, point: Array, rng: np.random.Generator
) -> None:
    d, rays = point - cone.apex, surface(rng, cone)
    nearest = np.maximum(d @ rays.T, 0.0).T * rays
    assert np.all(lengths(d - nearest) >= np.abs(cone.inside(point)) - EXACT)


@given(cones, points)
def test_the_distance_inside_a_cone_is_reached_unless_the_apex_is_nearest(
    cone: Cone, point: Array
) -> None:
    assume(angle_off_axis(cone, point)[0] <= cone.half_angle + np.pi / 2)
    foot = point + cone.inside(point)[:, None] * cone.supporting(point).normal
    assume(lengths(foot - cone.apex)[0] > 1e-3)  # where its direction means something
    assert angle_off_axis(cone, foot) == pytest.approx(cone.half_angle, abs=1e-9)


@given(balls, directions())
def test_inside_vanishes_on_a_ball(ball: Ball, direction: Array) -> None:
    assert ball.inside(ball.center + ball.radius * direction) == pytest.approx(0.0, abs=EXACT)


@given(cones, generators)
def test_inside_vanishes_on_a_cone(cone: Cone, rng: np.random.Generator) -> None:
    for ray in surface(rng, cone, 20):
        assert cone.inside(cone.apex + 2.0 * ray) == pytest.approx(0.0, abs=EXACT)


# --- supporting half-spaces ---------------------------------------------------------------------


@given(st.one_of(balls, cones), points, generators)
def test_the_supporting_half_space_contains_its_region(
    region: Region, point: Array, rng: np.random.Generator
) -> None:
    assert contains(region.supporting(point), members(rng, region))


@given(st.one_of(balls, cones), points)
@example(Ball(np.zeros((1, 3)), 1.0), np.array([[0.0, 0.0, 3e-162]]))
def test_the_supporting_normal_is_a_unit_vector(region: Region, point: Array) -> None:
    assert lengths(region.supporting(point).normal) == pytest.approx(1.0, abs=EXACT)


@given(balls, points)
def test_the_supporting_half_space_touches_the_ball_where_the_line_of_sight_leaves_it(
    ball: Ball, point: Array
) -> None:
    sight = point - ball.center
    assume(lengths(sight)[0] > 1e-3)
    touched = ball.center + ball.radius * sight / lengths(sight)
    assert ball.supporting(point).slack(touched) == pytest.approx(0.0, abs=EXACT)


@given(cones, points)
def test_the_supporting_half_space_touches_the_cone_along_the_ray_nearest_to_the_point(
    cone: Cone, point: Array
) -> None:
    d = point - cone.apex
    side = d - np.sum(d * cone.axis) * cone.axis
    assume(lengths(side)[0] > 1e-3)
    side /= lengths(side)
    ray = np.cos(cone.half_angle) * cone.axis + np.sin(cone.half_angle) * side
    for t in (0.0, 1.0, 3.0):
        touched = cone.apex + t * ray
        assert cone.supporting(point).slack(touched) == pytest.approx(0.0, abs=EXACT)


@given(balls)
def test_the_half_space_at_a_balls_centre_contains_and_touches_it(ball: Ball) -> None:
    halfspaces = ball.supporting(ball.center)
    assert lengths(halfspaces.normal) == pytest.approx(1.0, abs=EXACT)
    highest = np.sum(halfspaces.normal * ball.center) + ball.radius
    assert halfspaces.offset[0] == pytest.approx(highest, abs=EXACT)


@given(cones, st.floats(-3.0, 3.0))
def test_the_half_space_at_a_cones_axis_contains_and_touches_it(cone: Cone, along: float) -> None:
    assert_supports(cone, cone.supporting(cone.apex + along * cone.axis))


@given(directions(), half_angles, st.floats(-16.0, -2.0))
@example(np.array([[0.6, 0.0, 0.8]]), 1.0, -14.0)
@example(np.array([[0.6, 0.0, 0.8]]), 1.0, -11.0)
def test_the_half_space_however_near_a_cones_axis_contains_and_touches_it(
    axis: Array, half_angle: float, decade: float
) -> None:
    cone = Cone(np.zeros((1, 3)), axis, half_angle)
    assert_supports(cone, cone.supporting(axis + 10.0**decade * perpendicular(axis)))


def assert_supports(cone: Cone, halfspaces: Halfspaces) -> None:
    """Of all rays of the cone the one that rises most along the normal does not rise at all."""
    normal, offset = halfspaces.normal, halfspaces.offset
    assert lengths(normal) == pytest.approx(1.0, abs=1e-9)
    along, aside = np.sum(normal * cone.axis), lengths(np.cross(normal, cone.axis))
    rise = along * np.cos(cone.half_angle) + aside * np.sin(cone.half_angle)
    assert rise == pytest.approx(0.0, abs=1e-9)
    assert offset[0] == pytest.approx(np.sum(normal * cone.apex), abs=EXACT)


@given(st.one_of(balls, cones), points, points)
def test_the_complement_is_the_other_side_of_the_same_plane(
    region: Region, point: Array, other: Array
) -> None:
    halfspaces = region.supporting(point)
    assert halfspaces.complement().slack(other) == pytest.approx(-halfspaces.slack(other))


# --- second-order cones and margins -------------------------------------------------------------


@given(st.one_of(balls, cones), points)
def test_the_second_order_cone_holds_exactly_inside_and_by_the_same_amount(
    region: Region, point: Array
) -> None:
    inside, slack = region.inside(point), cone_slack(region.second_order_cone, point)
    assert slack == pytest.approx(inside, abs=EXACT)


@given(st.one_of(balls, cones), generators)
def test_the_second_order_cone_holds_all_members(region: Region, rng: np.random.Generator) -> None:
    for point in members(rng, region, 40):
        assert cone_slack(region.second_order_cone, point[None]) >= -EXACT * (1.0 + lengths(point))


@given(st.one_of(balls, cones), points)
def test_margins_are_positive_on_the_allowed_side_only(region: Region, point: Array) -> None:
    if isinstance(region, Ball):
        depth = region.radius - lengths(point - region.center)[0]
    else:
        depth = region.half_angle - angle_off_axis(region, point)[0]
        assume(lengths(point - region.apex)[0] > 1e-3)
    assume(abs(depth) > 1e-9)
    mean = np.concatenate([point, np.full((1, 3), np.nan)], axis=1)  # velocities do not matter
    keep_in = StateConstraint("in", np.array([0]), region, "in", 0.9)
    keep_out = StateConstraint("out", np.array([0]), region, "out", 0.9)
    assert (keep_in.margin(mean)[0] > 0.0) == (depth > 0.0)
    assert (keep_out.margin(mean)[0] > 0.0) == (depth < 0.0)


@given(generators)
def test_no_node_knows_the_size_of_anothers_distance(rng: np.random.Generator) -> None:
    """Points at distances of 1e-150 to 1e150 from their regions, in one call and one by one."""
    sizes = np.array([1e-150, 1e-8, 1.0, 1e8, 1e150])[:, None]
    anchor, axis = np.zeros((5, 3)), random_unit(rng, 5)
    point = sizes * random_unit(rng, 5)
    for together, each in (
        (Ball(anchor, 0.7), [Ball(anchor[[i]], 0.7) for i in range(5)]),
        (Cone(anchor, axis, 0.4), [Cone(anchor[[i]], axis[[i]], 0.4) for i in range(5)]),
    ):
        normals = together.supporting(point).normal
        for i, alone in enumerate(each):
            assert alone.supporting(point[[i]]).normal[0] == pytest.approx(normals[i], abs=EXACT)


@given(generators)
def test_each_nodes_region_is_its_own(rng: np.random.Generator) -> None:
    n = 5
    anchor, axis, point = rng.normal(size=(n, 3)), random_unit(rng, n), rng.normal(size=(n, 3))
    balls_and_cones = (
        (Ball(anchor, 0.7), [Ball(anchor[[i]], 0.7) for i in range(n)]),
        (
            Cone(anchor, axis, 0.4),
            [Cone(anchor[[i]], axis[[i]], 0.4) for i in range(n)],
        ),
    )
    for together, each in balls_and_cones:
        halfspaces = together.supporting(point)
        for i, alone in enumerate(each):
            one = alone.supporting(point[[i]])
            assert one.normal[0] == pytest.approx(halfspaces.normal[i], abs=EXACT)
            assert one.offset[0] == pytest.approx(halfspaces.offset[i], abs=EXACT)
            assert alone.inside(point[[i]])[0] == pytest.approx(together.inside(point)[i])
