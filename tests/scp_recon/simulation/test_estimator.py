from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from scp_recon.simulation.estimator import (
    AttitudeFilter,
    SensorSigmas,
    from_rotation_vector,
    matrix,
    product,
)
from tests.helpers import generators, random_unit

BORESIGHTS = np.vstack([np.eye(3), -np.eye(3)])


@given(rng=generators)
def test_quaternions_are_scipys_rotations(rng: np.random.Generator) -> None:
    a, b = Rotation.random(2, rng=rng)
    p, q = (r.as_quat(scalar_first=True) for r in (a, b))
    np.testing.assert_allclose(matrix(product(p, q)), (a * b).as_matrix(), atol=1e-12)
    vector = rng.normal(size=3) * 10.0 ** rng.uniform(-9, 0.5)
    expected = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(matrix(from_rotation_vector(vector)), expected, atol=1e-12)
    estimate = AttitudeFilter(p, SensorSigmas(1e-4, 1e-4, 0.05), 1e-3)
    short = Rotation.from_mrp(estimate.mrp)
    assert np.linalg.norm(estimate.mrp) <= 1.0
    assert (short.inv() * a).magnitude() < 1e-10


@settings(max_examples=6)
@given(rng=generators, stars=st.booleans())
def test_errors_are_as_large_as_the_filter_says(rng: np.random.Generator, stars: bool) -> None:
    """Sixty filters on a tumble: the errors' normalised square averages to three."""
    sigmas = SensorSigmas(1e-4, 1e-4, 0.02)
    squares = []
    for _ in range(60):
        true = Rotation.random(rng=rng)
        first = 0.01 * rng.normal(size=3)
        estimate = AttitudeFilter(
            (true * Rotation.from_rotvec(first)).as_quat(scalar_first=True), sigmas, 0.01
        )
        sun = random_unit(rng)
        for _ in range(8):
            step = 0.05 * rng.normal(size=3)
            true = true * Rotation.from_rotvec(step)
            estimate.turn(step + sigmas.gyro * rng.normal(size=3))
            noise = Rotation.from_rotvec(sigmas.star_tracker * rng.normal(size=3))
            seen = (true * noise).as_quat(scalar_first=True) if stars else None
            lit = BORESIGHTS[BORESIGHTS @ true.inv().apply(sun) > 0.2]
            cosines = lit @ true.inv().apply(sun) + sigmas.sun_sensor * rng.normal(size=len(lit))
            estimate.see(seen, cosines, lit, sun)
        guess = Rotation.from_quat(estimate.quaternion, scalar_first=True)
        error = (guess.inv() * true).as_rotvec()
        squares.append(error @ np.linalg.solve(estimate.covariance, error))
    # Chi-squared of 180 degrees of freedom over 60: 3 with a deviation of 0.32.
    assert 1.6 < np.mean(squares) < 4.6


def test_a_sun_sensor_in_shadow_is_not_believed() -> None:
    sun = np.array([0.0, 0.0, 1.0])
    boresight = np.array([[0.0, 0.6, 0.8]])
    for reading, moves in ((0.0, False), (0.7, True)):
        estimate = AttitudeFilter(
            np.array([1.0, 0.0, 0.0, 0.0]), SensorSigmas(1e-4, 1e-4, 0.05), 0.01
        )
        estimate.see(None, np.array([reading]), boresight, sun)
        assert estimate.quaternion[1:].any() == moves
