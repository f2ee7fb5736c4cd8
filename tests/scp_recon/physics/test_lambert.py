"""Lambert's problem against flown two-body motion."""

from __future__ import annotations

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from scp_recon.physics.lambert import lambert
from tests.helpers import generators, random_unit

GM = 4.9


@given(rng=generators, speed=st.floats(0.2, 3.0), share=st.floats(0.02, 0.4))
def test_the_arc_between_two_points_of_a_flight_is_that_flight(
    rng: np.random.Generator, speed: float, share: float
) -> None:
    """Ellipses and hyperbolas, of less than half a revolution."""
    start = 1000.0 * random_unit(rng)
    across = np.cross(start, random_unit(rng))
    across /= np.linalg.norm(across)
    velocity = speed * np.sqrt(GM / 1000.0) * (across + 0.3 * start / 1000.0)
    time = share * 2.0 * np.pi * np.sqrt(1000.0**3 / GM)

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[3:], -GM * y[:3] / np.linalg.norm(y[:3]) ** 3])

    flown = solve_ivp(
        rate, (0.0, time), [*start, *velocity], "DOP853", np.linspace(0.0, time, 60), rtol=1e-11
    ).y
    normal = np.cross(start, velocity)
    turned = np.array([normal @ np.cross(start, r) for r in flown[:3].T[1:]])
    assume(np.all(turned > 0.0))  # less than half a revolution all the way
    assume(turned[-1] > 1e-3 * np.linalg.norm(normal) * 1000.0**2)
    found = lambert(start, flown[:3, -1], time, GM)
    assert found is not None
    np.testing.assert_allclose(found[0], velocity, atol=1e-6)
    np.testing.assert_allclose(found[1], flown[3:, -1], atol=1e-6)


def test_points_in_line_with_the_centre_have_no_plane() -> None:
    start = np.array([1000.0, 0.0, 0.0])
    assert lambert(start, -start, 1e4, GM) is None
    assert lambert(start, 2.0 * start, 1e4, GM) is None
