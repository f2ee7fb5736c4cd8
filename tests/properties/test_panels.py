"""Solar panels: the largest power over rotations, and the attitude that gives it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.left_out import light_force
from formulations.arrays import Array
from scp_recon.simulation.guidance import SolarArray, align
from tests.helpers import generators, random_unit


def random_panels(rng: np.random.Generator) -> SolarArray:
    count = int(rng.integers(1, 7))
    return SolarArray(random_unit(rng, count), rng.uniform(0.0, 200.0, count))


def turned(axis: Array, angle: Array) -> Array:
    """Rotations about an axis by Rodrigues' formula, shape (n, 3, 3)."""
    k = np.cross(np.eye(3), axis)
    angle = angle[:, None, None]
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * k @ k


@given(generators, st.floats(0.0, np.pi))
def test_no_rotation_generates_more_than_the_best(rng, angle):
    panels, axis = random_panels(rng), random_unit(rng, 1)[0]
    side = np.cross(axis, random_unit(rng, 1)[0])
    sun = np.cos(angle) * axis + np.sin(angle) * side / np.linalg.norm(side)
    tried = turned(axis, np.linspace(0.0, 2.0 * np.pi, 721)) @ sun
    power = panels.generation(tried).sum(axis=1).max()
    best = float(panels.best_about(axis, np.array(angle)))
    # Half a degree of rotation away from the best at most.
    assert power <= best * (1.0 + 1e-12) + 1e-9
    assert best <= power + panels.peak_w.sum() * np.deg2rad(0.25)


@given(generators)
def test_the_attitude_found_generates_the_most(rng):
    panels = random_panels(rng)
    axis_body, axis, sun = random_unit(rng, 3)
    angle = float(np.arccos(np.clip(axis @ sun, -1.0, 1.0)))
    to_inertial = align(axis_body, axis, panels.best_roll(axis_body, angle), sun)
    np.testing.assert_allclose(to_inertial @ axis_body, axis, atol=1e-12)
    np.testing.assert_allclose(to_inertial.T @ to_inertial, np.eye(3), atol=1e-12)
    power = panels.generation(to_inertial.T @ sun).sum()
    assert power == pytest.approx(float(panels.best_about(axis_body, np.array(angle))), abs=1e-7)


@given(generators)
def test_no_attitude_generates_more_than_the_best_direction(rng):
    panels = random_panels(rng)
    best = panels.best_direction()
    most = np.linalg.norm(best)
    suns = random_unit(rng, 2000)
    assert panels.generation(suns).sum(axis=1).max() <= most * (1.0 + 1e-12)
    assert panels.generation(best / most).sum() == pytest.approx(most)


def test_axis_along_sun_leaves_rotation_free():
    z = np.array([0.0, 0.0, 1.0])
    for side in (z, -z):
        matrix = align(z, z, np.array([1.0, 0.0, 0.0]), side)
        assert np.linalg.det(matrix) == pytest.approx(1.0)
        np.testing.assert_allclose(matrix @ z, z)
    upward = SolarArray(z[None], np.array([10.0]))
    assert upward.best_roll(z, 0.3) @ z == pytest.approx(0.0)


def sphere(count: int, specular: float, diffuse: float) -> tuple[Array, ...]:
    """Equal plates at the points of a Fibonacci lattice: a unit sphere."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    azimuth = np.pi * (1.0 + np.sqrt(5.0)) * k
    radius = np.sqrt(1.0 - z**2)
    normals = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)
    area = np.full(count, 4.0 * np.pi / count)
    return normals, area, np.full(count, specular), np.full(count, diffuse)


@given(st.floats(0.0, 0.5), st.floats(0.0, 0.5), generators)
def test_plates_of_a_sphere_are_the_cannonball(specular, diffuse, rng):
    """A sphere has C_R = 1 + 4/9 rho_d, and specular reflection adds nothing."""
    sun = random_unit(rng, 1)[0]
    force = light_force(sun, *sphere(20_000, specular, diffuse))
    expected = -np.pi * (1.0 + 4.0 / 9.0 * diffuse) * sun
    np.testing.assert_allclose(force, expected, atol=2e-3)


@given(generators, st.floats(0.0, 1.0))
def test_a_mirror_is_pushed_along_its_normal(rng, specular):
    normal = random_unit(rng, 1)
    sun = random_unit(rng, 1)[0]
    force = light_force(sun, normal, *np.array([[2.0], [specular], [0.0]]))
    cosine = max(0.0, float(normal[0] @ sun))
    expected = -2.0 * cosine * ((1.0 - specular) * sun + 2.0 * specular * cosine * normal[0])
    np.testing.assert_allclose(force, expected, atol=1e-14)
