"""The harmonic field is harmonic, and contains the planner's J2."""

from __future__ import annotations

from math import factorial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scp_recon.physics.forces import ForceModel, acceleration
from scp_recon.physics.harmonics import HarmonicField
from tests import reference

GM = reference.GM_M3_S2
directions = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda d: np.linalg.norm(d) > 0.1)


def at(direction: tuple[float, float, float], radius: float) -> np.ndarray:
    return radius * np.array(direction) / np.linalg.norm(direction)


def evaluate(field: HarmonicField, position: np.ndarray) -> np.ndarray:
    return np.array(field.acceleration(*np.asarray(position)[:, None]))[:, 0]


def gradient(field: HarmonicField, position: np.ndarray, step: float = 0.2) -> np.ndarray:
    columns = [
        (evaluate(field, position + step * e) - evaluate(field, position - step * e)) / (2 * step)
        for e in np.eye(3)
    ]
    return np.stack(columns, axis=1)


def test_degree_zero_is_a_point_mass() -> None:
    position = np.array([300.0, -500.0, 700.0])
    expected = -GM * position / np.linalg.norm(position) ** 3
    assert evaluate(HarmonicField.bennu(GM, 0), position) == pytest.approx(expected, rel=1e-14)


@given(directions, st.floats(350.0, 2000.0))
def test_zonal_degree_two_is_the_planners_j2(
    direction: tuple[float, float, float], radius: float
) -> None:
    field = HarmonicField.bennu(GM, 2)
    zonal = HarmonicField(GM, 290.0, np.diag([1.0, 0.0, 0.0]), np.zeros((3, 3)))
    zonal.c[2, 0] = field.c[2, 0]
    pole = np.array([0.0, 0.0, 1.0])
    planner = ForceModel(GM, 1.5 * GM * -field.c[2, 0] * 290.0**2, pole, np.zeros(3))
    position = at(direction, radius)
    expected = np.array(acceleration(*position, planner))
    np.testing.assert_allclose(evaluate(zonal, position), expected, rtol=1e-11, atol=1e-18)


@given(directions, st.floats(400.0, 1500.0), st.integers(0, 10))
def test_gradient_is_symmetric_and_trace_free(
    direction: tuple[float, float, float], radius: float, degree: int
) -> None:
    g = gradient(HarmonicField.bennu(GM, degree), at(direction, radius))
    size = np.abs(g).max()
    assert abs(np.trace(g)) < 1e-5 * size
    assert np.abs(g - g.T).max() < 1e-5 * size


@pytest.mark.parametrize("indices", reference.COEFFICIENTS)
def test_coefficients_are_those_of_the_source(indices: tuple[int, int]) -> None:
    n, m = indices
    # N_nm = sqrt((2 - delta_0m) (2n + 1) (n - m)! / (n + m)!)
    norm = np.sqrt((2 - (m == 0)) * (2 * n + 1) * factorial(n - m) / factorial(n + m))
    field = HarmonicField.bennu(GM, reference.GRAVITY_DEGREE)
    assert field.radius == reference.REFERENCE_RADIUS_M
    ours = (field.c[n, m], field.s[n, m])
    assert ours == pytest.approx(norm * np.array(reference.COEFFICIENTS[indices]), rel=1e-12)


def test_every_degree_and_order_of_the_source_is_there() -> None:
    field = HarmonicField.bennu(GM, reference.GRAVITY_DEGREE)
    there = (field.c != 0.0) | (field.s != 0.0)
    expected = np.tri(reference.GRAVITY_DEGREE + 1, dtype=bool)
    expected[1] = False  # the origin is the centre of mass
    np.testing.assert_array_equal(there, expected)
