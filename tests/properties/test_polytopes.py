"""Polytopes about the ball: inclusion, tightness, turning."""

import itertools

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from scipy.spatial import HalfspaceIntersection

from formulations.arrays import Array
from formulations.problem.facets import ball, inner_pyramid_angle, paper_ball, rotations_between
from tests.helpers import generators, random_rotation, random_unit

EXACT = 1e-9
"""Qhull's vertices; the rest is rounding of order one."""

COUNTS = [4, 5, 6, 7, 8, 12, 13, 24, 32, 64, 128]


def vertices(normals: Array, distance: float) -> Array:
    """Vertices of {y : u_j'y <= distance}, each once."""
    halfspaces = np.column_stack([normals, np.full(len(normals), -distance)])
    found = HalfspaceIntersection(halfspaces, np.zeros(3)).intersections
    kept: list[Array] = []
    for vertex in found:
        if all(np.linalg.norm(vertex - other) > 1e-7 for other in kept):
            kept.append(vertex)
    return np.array(kept)


def norms(array: Array) -> Array:
    return np.linalg.norm(array, axis=-1)


@pytest.mark.parametrize("facets", ["paper", *COUNTS])
def test_polytope_bounds_unit_ball_from_both_sides(facets):
    polytope = ball(facets) if isinstance(facets, int) else paper_ball()
    normals, count = polytope.normals, 24 if facets == "paper" else facets
    assert normals.shape == (count, 3)
    assert norms(normals) == pytest.approx(1.0, abs=EXACT)  # all touch the ball from outside
    assert (normals @ normals.T - 2.0 * np.eye(count)).max() < 1.0 - 1e-3  # none is there twice
    inner = vertices(normals, 1.0 / polytope.reach)
    assert norms(inner).max() == pytest.approx(1.0, abs=EXACT)
    assert norms(vertices(normals, 1.0)).max() == pytest.approx(polytope.reach, abs=EXACT)
    assert norms(polytope.vertex) == pytest.approx(1.0, abs=EXACT)
    assert norms(inner - polytope.vertex).min() == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize("facets", [4, 5, 6, 12, 13, 30, 63])
def test_outer_polytopes_are_nested(facets):
    fewer, more = ball(facets), ball(facets + 1)
    assert np.array_equal(more.normals[:facets], fewer.normals)
    assert more.reach <= fewer.reach + EXACT


@pytest.mark.parametrize("facets", COUNTS)
def test_tightness_is_between_covering_and_packing_bounds(facets):
    # Caps of the angle alpha = acos(1 / reach) about the normals cover the sphere, each a fraction
    # (1 - cos alpha) / 2 of it; and as every normal was put where the covering was worst, caps of
    # half the angle are disjoint.
    tightness = 1.0 / ball(facets).reach
    assert tightness <= 1.0 - 2.0 / facets + EXACT
    assert tightness >= 1.0 - 8.0 / facets + 8.0 / facets**2 - EXACT


def test_paper_polytope_has_24_facets_and_14_vertices():
    polytope = paper_ball()
    found = vertices(polytope.normals, 1.0 / polytope.reach)
    axes = np.vstack([np.eye(3), -np.eye(3)])
    corners = np.array(list(itertools.product((1.0, -1.0), repeat=3))) / np.sqrt(3.0)
    expected = np.vstack([axes, corners])
    assert len(found) == 14
    for vertex in expected:
        assert norms(found - vertex).min() == pytest.approx(0.0, abs=EXACT)
    assert np.abs(polytope.vertex) == pytest.approx(np.full(3, 3**-0.5), abs=EXACT)  # a corner
    # Every facet is a triangle: exactly three of the vertices lie on its plane.
    height = expected @ polytope.normals.T
    assert np.all(np.sum(np.abs(height - 1.0 / polytope.reach) < EXACT, axis=0) == 3)


@pytest.mark.parametrize(("least", "make"), [(4, ball), (3, lambda n: inner_pyramid_angle(0.5, n))])
def test_too_few_facets_bound_nothing(least, make):
    for facets in (-1, 0, least - 1):
        with pytest.raises(ValueError, match=f"at least {least} facets, got {facets}"):
            make(facets)
    make(least)


def assert_smallest_rotations(rotation: Array, start: Array, end: Array) -> None:
    assert rotation @ start == pytest.approx(end, abs=EXACT)
    squared = rotation @ rotation.transpose(0, 2, 1)
    assert squared == pytest.approx(np.broadcast_to(np.eye(3), squared.shape), abs=EXACT)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=EXACT)
    # The trace is 1 + 2 cos of the angle turned by, and no rotation can turn by less than the
    # angle between the two vectors.
    assert np.trace(rotation, axis1=1, axis2=2) == pytest.approx(1.0 + 2.0 * end @ start, abs=EXACT)


@given(generators, st.integers(1, 6))
def test_turn_is_smallest_rotation_between_vectors(rng, count):
    start, end = random_unit(rng), random_unit(rng, count)
    assume(np.all(end @ start > -0.999))
    assert_smallest_rotations(rotations_between(start, end), start, end)


@given(st.sampled_from([*np.eye(3), -np.ones(3) / np.sqrt(3.0)]), generators)
def test_turn_reverses_antiparallel_vectors_and_leaves_parallel_ones(axis, rng):
    for start in (axis, random_unit(rng)):
        end = np.stack([-start, start])
        assert_smallest_rotations(rotations_between(start, end), start, end)


@given(st.floats(-15.0, -1.0), generators)
@example(-6.5, np.random.default_rng(0))
@example(-5.5, np.random.default_rng(0))
def test_turn_is_rotation_for_nearly_antiparallel_vectors(decade, rng):
    q = random_rotation(rng)
    start, aside = q[0], q[1]
    angle = 10.0**decade
    end = -np.cos(angle) * start[None] + np.sin(angle) * aside
    assert_smallest_rotations(rotations_between(start, end), start, end)
