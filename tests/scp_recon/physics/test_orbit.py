"""The body's heliocentric motion against Kepler's equation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from scp_recon.environment.catalogue import GM_SUN_KM3_S2
from scp_recon.physics.orbit import two_body
from tests.helpers import random_rotation

AU_KM = 149_597_870.7


@given(
    axis_au=st.floats(0.7, 4.0),
    eccentricity=st.floats(0.0, 0.6),
    anomaly=st.floats(0.0, 6.28),
    days=st.floats(-300.0, 300.0),
    seed=st.integers(0, 2**32 - 1),
)
def test_motion_is_keplers(
    axis_au: float, eccentricity: float, anomaly: float, days: float, seed: int
) -> None:
    turn = random_rotation(np.random.default_rng(seed))
    a, e = axis_au * AU_KM, eccentricity
    rate = np.sqrt(GM_SUN_KM3_S2 / a**3)

    def state(eccentric: float) -> tuple[np.ndarray, np.ndarray]:
        c, s, b = np.cos(eccentric), np.sin(eccentric), np.sqrt(1.0 - e * e)
        speed = a * rate / (1.0 - e * c)
        return turn @ [a * (c - e), a * b * s, 0.0], turn @ [-speed * s, speed * b * c, 0.0]

    mean = anomaly - e * np.sin(anomaly) + rate * days * 86_400.0
    then = brentq(lambda x: x - e * np.sin(x) - mean, mean - 1.0, mean + 1.0, xtol=1e-14)
    position, velocity = state(anomaly)
    motion = two_body(position, velocity, (min(0.0, days * 86_400.0), max(0.0, days * 86_400.0)))
    expected, _ = state(float(then))
    assert np.linalg.norm(motion(days * 86_400.0) - expected) < 5e-8 * a
    assert np.linalg.norm(motion(0.0) - position) < 1e-6


def test_shapes_follow_the_times() -> None:
    motion = two_body([AU_KM, 0.0, 0.0], [0.0, 29.8, 0.0], (-1e5, 1e5))
    assert motion(0.0).shape == (3,)
    assert motion(np.zeros((2, 5))).shape == (2, 5, 3)


def test_what_is_in_the_sun_or_falls_into_it_is_refused() -> None:
    for position in ([1e5, 0.0, 0.0], [2e7, 0.0, 0.0]):
        with pytest.raises(ValueError, match="Sun's centre"):
            two_body(position, [0.0, 0.0, 0.0], (0.0, 1e7))
