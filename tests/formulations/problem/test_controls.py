"""Controls of a problem: boundary states that move with their phases."""

import numpy as np
import pytest

from formulations.problem.controls import Boundary

TURN, SPREAD = np.linspace(-1.0, 1.0, 6), np.linspace(0.1, 2.4, 24).reshape(6, 4)


@pytest.mark.parametrize("phases", [(0.0, 0.0), (0.7, -2.1), (5.9, 3.3)])
def test_slopes_of_boundary_are_its_derivatives(phases):
    boundary = Boundary(
        first=lambda phase: (np.sin(phase + TURN), SPREAD * np.cos(phase)),
        last=lambda phase: np.exp(TURN) * np.sin(phase),
        phases=phases,
        free=(0, 1),
    )
    first, factor, last = boundary.slopes(np.array(phases))
    np.testing.assert_allclose(first, np.cos(phases[0] + TURN), atol=1e-7)
    np.testing.assert_allclose(factor, -SPREAD * np.sin(phases[0]), atol=1e-7)
    np.testing.assert_allclose(last, np.exp(TURN) * np.cos(phases[1]), atol=1e-7)
