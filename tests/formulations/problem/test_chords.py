"""Chords of lines in regions: against points along them, and where they graze or stand."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from formulations.arrays import Array
from formulations.problem.regions import (
    Ball,
    Cone,
    Ellipsoid,
    Halfspaces,
    Polytope,
    Region,
    perpendicular,
)
from tests.helpers import generators, random_rotation, random_unit

AT = np.concatenate([-np.geomspace(1e3, 1e-3, 400), [0.0], np.geomspace(1e-3, 1e3, 400)])
"""Where along a line membership is asked."""

SURFACE = 1e-9
"""Depth over distance at which a point counts as on the surface, where rounding may say either."""


def region_and_line(rng: np.random.Generator) -> tuple[Region, Array, Array]:
    """A region about the origin, and a line near it."""
    start, direction = rng.normal(size=3), rng.normal(size=3) * np.exp(rng.normal())
    center, radius = rng.normal(size=(1, 3)), float(rng.uniform(0.1, 2.0))
    stretch = random_rotation(rng) @ np.diag([1.0, 0.6, 0.2]) @ random_rotation(rng)
    faces = random_unit(rng, 6)
    kinds: tuple[Region, ...] = (
        Ball(center, radius),
        Cone(center, random_unit(rng, 1), float(rng.uniform(0.02, np.pi / 2 - 0.02))),
        Halfspaces(random_unit(rng, 1), rng.normal(size=1)),
        Ellipsoid(center, stretch, radius),
        Polytope(faces, faces @ center[0] + rng.uniform(0.1, 2.0, 6)),
    )
    return kinds[rng.integers(len(kinds))], start, direction


def chord(region: Region, start: Array, direction: Array) -> tuple[float, float]:
    low, high = region.chord(start[None, None], direction[None, None])
    assert low.shape == high.shape == (1, 1)
    return low.item(), high.item()


def inside(region: Region, start: Array, direction: Array) -> tuple[Array, Array]:
    """Depths of the points at `AT`, and how far each is from the region's anchor."""
    points = start + AT[:, None] * direction
    anchor = getattr(region, "center", getattr(region, "apex", np.zeros(3)))
    many = region.at(np.zeros(len(points), dtype=np.intp))
    return many.inside(points), np.linalg.norm(points - anchor, axis=1)


def assert_holds(region: Region, start: Array, direction: Array) -> None:
    low, high = chord(region, start, direction)
    assert low <= high
    assert low < high or (low, high) == (np.inf, np.inf) or abs(low) < np.inf
    depth, distance = inside(region, start, direction)
    clear = np.abs(depth) > SURFACE * (1.0 + distance)
    within = (low < AT) & (high > AT)
    np.testing.assert_array_equal(within[clear], depth[clear] > 0.0)


@given(generators)
def test_chord_is_inside_and_ends_on_surface(rng):
    region, start, direction = region_and_line(rng)
    assert_holds(region, start, direction)
    for end in filter(np.isfinite, chord(region, start, direction)):
        point = (start + end * direction)[None]
        scale = 1.0 + float(np.linalg.norm(point)) + float(np.linalg.norm(start))
        assert abs(region.inside(point).item()) < 1e-7 * scale


@given(generators, st.sampled_from([1e-12, 1e-6, 1e-3]), st.sampled_from([-1.0, 1.0]))
def test_a_line_that_grazes_a_ball(rng, gap, side):
    ball = Ball(rng.normal(size=(1, 3)), 1.0)
    out = random_unit(rng)
    along = perpendicular(out[None])[0]
    low, high = chord(ball, ball.center[0] + (1.0 - side * gap) * out - 3.0 * along, along)
    if side < 0.0:
        assert (low, high) == (np.inf, np.inf)
    else:
        half = np.sqrt(2.0 * gap - gap**2)
        assert [low, high] == pytest.approx([3.0 - half, 3.0 + half], abs=1e-14 / gap**0.5)


@given(generators, st.sampled_from([-1.0, 1.0]), st.floats(0.02, 1.4), st.floats(0.0, 0.98))
def test_steep_line_enters_its_cone_once(rng, up, half_angle, share):
    """Whatever nappe it comes from."""
    cone = Cone(rng.normal(size=(1, 3)), random_unit(rng, 1), half_angle)
    tilt = share * half_angle
    direction = up * (np.cos(tilt) * cone.axis + np.sin(tilt) * perpendicular(cone.axis))[0]
    start = rng.normal(size=3)
    low, high = chord(cone, start, direction)
    assert np.isfinite(low if up > 0.0 else high)
    assert np.isinf(high if up > 0.0 else low)
    assert_holds(cone, start, direction)


@given(generators, st.floats(0.05, 1.4), st.floats(0.05, 1.0))
def test_wrong_nappe_is_outside_the_cone(rng, half_angle, depth):
    cone = Cone(rng.normal(size=(1, 3)), random_unit(rng, 1), half_angle)
    behind = cone.apex[0] - depth * cone.axis[0]
    assert chord(cone, behind, perpendicular(cone.axis)[0]) == (np.inf, np.inf)
    ahead = cone.apex[0] + depth * cone.axis[0]
    reach = depth * np.tan(half_angle)
    assert chord(cone, ahead, perpendicular(cone.axis)[0]) == pytest.approx((-reach, reach))


@given(generators, st.floats(0.05, 1.4), st.floats(-3.0, 3.0), st.floats(0.0, 0.9))
def test_steep_line_enters_at_the_apex(rng, half_angle, back, share):
    cone = Cone(rng.normal(size=(1, 3)), random_unit(rng, 1), half_angle)
    tilt = share * half_angle
    direction = (np.cos(tilt) * cone.axis + np.sin(tilt) * perpendicular(cone.axis))[0]
    low, high = chord(cone, cone.apex[0] - back * direction, direction)
    assert high == np.inf
    # Both roots are the apex: rounding of the discriminant splits them by its square root.
    steepness = np.sin(half_angle) ** 2 - np.sin(tilt) ** 2
    split = 4.0 * (1.0 + abs(back)) * np.sqrt(np.finfo(float).eps / steepness)
    assert low == pytest.approx(back, abs=split)
    assert chord(cone, cone.apex[0], direction) == (0.0, np.inf)


@pytest.mark.parametrize("shift", [0.5, -0.5])
def test_surface_ray_is_inside_from_one_point(shift):
    """cos^2 |v|^2 = (u'v)^2 exactly: one of the roots is at infinity."""
    cone = Cone(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), float(np.arccos(0.6)))
    direction = np.array([0.8, 0.0, 0.6])
    assert np.cos(cone.half_angle) ** 2 * (direction @ direction) == pytest.approx(0.36)
    start = shift * np.array([0.0, 0.0, 1.0])
    for exact in (cone, Cone(cone.apex, cone.axis, np.pi / 4)):
        along = direction if exact is cone else np.array([1.0, 0.0, 1.0])
        for way in (1.0, -1.0):
            assert_holds(exact, start, way * along)


@given(generators)
def test_normals_of_a_45_degree_cone_leave_it(rng):
    """They are parallel to the rays of the far side, so that rounding alone says how steep they are."""
    cone = Cone(np.zeros((1, 3)), random_unit(rng, 1), np.pi / 4)
    point = cone.axis + rng.uniform(0.1, 0.9) * cone.across(rng.normal(size=(1, 3)))
    normal = cone.supporting(point).normal
    low, high = chord(cone, point[0], normal[0])
    assert high == pytest.approx(cone.inside(point)[0])
    assert low < -1e6


@given(generators)
def test_a_line_without_direction_is_where_it_starts(rng):
    region, start, _ = region_and_line(rng)
    depth = region.inside(start[None]).item()
    assume(abs(depth) > 1e-9)
    everywhere, nowhere = (-np.inf, np.inf), (np.inf, np.inf)
    assert chord(region, start, np.zeros(3)) == (everywhere if depth > 0.0 else nowhere)
