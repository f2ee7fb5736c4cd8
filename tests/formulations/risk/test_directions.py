"""Directions: even ones cover the sphere, aimed ones keep the estimate and sharpen it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from formulations.risk.directions import Directions, aimed_directions, sphere_directions
from formulations.risk.lines import TwoSidedChiLaw

LINES = 4096


@pytest.mark.parametrize("dimension", [3, 9, 15])
def test_even_directions_are_unit_vectors_spread_evenly(dimension: int) -> None:
    u, weight = sphere_directions(LINES, dimension)
    assert u.shape == (LINES, dimension)
    np.testing.assert_array_equal(weight, 1.0)
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(u.mean(axis=0), 0.0, atol=2e-3)
    np.testing.assert_allclose(u.T @ u / LINES, np.eye(dimension) / dimension, atol=5e-3)


def test_directions_are_the_same_for_everyone() -> None:
    for part in range(2):
        few, many = sphere_directions(64, 5)[part], sphere_directions(128, 5)[part]
        np.testing.assert_array_equal(few, sphere_directions(64, 5)[part])
        np.testing.assert_array_equal(few, many[:64])


def failing(directions: Directions, away: float) -> np.ndarray:
    """Probability of a half-space `away` standard deviations off, on each line."""
    along = np.maximum(np.abs(directions.unit[:, 0]), 1e-300)
    law = TwoSidedChiLaw(directions.unit.shape[1])
    return np.asarray(law.between(away / along, np.full(len(along), np.inf)))


@pytest.mark.parametrize("dimension", [6, 12])
@pytest.mark.parametrize("away", [2.3, 3.1, 4.3])
def test_aimed_directions_tell_a_half_spaces_probability(dimension: int, away: float) -> None:
    aimed = aimed_directions(LINES, dimension, lambda u: failing(u, away))
    assert aimed.weight.max() <= 2.0
    assert aimed.weight.mean() == pytest.approx(1.0, abs=0.02)
    np.testing.assert_allclose(np.linalg.norm(aimed.unit, axis=1), 1.0, rtol=1e-12)
    exact = norm.sf(away)
    found = float((aimed.weight * failing(aimed, away)).mean())
    assert found == pytest.approx(exact, rel=0.01 if dimension == 6 else 0.05)


def test_where_nothing_fails_directions_stay_even() -> None:
    aimed = aimed_directions(64, 4, lambda u: np.zeros(len(u.unit)))
    np.testing.assert_array_equal(aimed.unit, sphere_directions(64, 4).unit)
