"""Heliocentric motion against Kepler's equation, and Lambert's problem against flown arcs."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from scp_recon.bodies.catalogue import GM_SUN_KM3_S2
from scp_recon.physics.two_body import Orbit, lambert, two_body
from tests.helpers import generators, random_rotation, random_unit

AU_KM = 149_597_870.7


@given(
    axis_au=st.floats(0.7, 4.0),
    eccentricity=st.floats(0.0, 0.6),
    anomaly=st.floats(0.0, 6.28),
    days=st.floats(-300.0, 300.0),
    seed=st.integers(0, 2**32 - 1),
)
def test_motion_is_keplers(axis_au, eccentricity, anomaly, days, seed):
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
    assert np.linalg.norm(motion(days * 86_400.0) - expected) < 5e-7 * a
    assert np.linalg.norm(motion(0.0) - position) < 1e-6
    assert motion(np.zeros((2, 5))).shape == (2, 5, 3)


def test_orbits_into_the_sun_are_refused():
    for position in ([1e5, 0.0, 0.0], [2e7, 0.0, 0.0]):
        with pytest.raises(ValueError, match="Sun's centre"):
            two_body(position, [0.0, 0.0, 0.0], (0.0, 1e7))


GM = 4.9


@given(rng=generators, speed=st.floats(0.2, 3.0), share=st.floats(0.02, 0.4))
def test_lambert_finds_the_flight_between_two_points(rng, speed, share):
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
    np.testing.assert_allclose(found[0], velocity, atol=1e-6)
    np.testing.assert_allclose(found[1], flown[3:, -1], atol=1e-6)


def test_lambert_refuses_points_in_line_with_the_centre():
    start = np.array([1000.0, 0.0, 0.0])
    assert lambert(start, -start, 1e4, GM) is None
    assert lambert(start, 2.0 * start, 1e4, GM) is None


@pytest.mark.parametrize(
    ("position", "velocity"),
    [
        ([1.0, 0.2, -0.3], [0.1, 0.9, 0.4]),
        ([1.0, 0.2, -0.3], [0.6, 1.9, 0.4]),  # a hyperbola
        ([-0.4, 1.1, 0.2], [-0.5, -0.3, -0.6]),
        ([1.0, 0.2, 0.0], [0.1, -0.9, 0.0]),  # backwards in the plane of x and y
        ([0.6, 0.8, 0.0], [-0.8, 0.6, 0.0]),  # a circle in that plane
    ],
)
def test_an_orbits_elements_lead_back_to_its_state(position, velocity):
    orbit = Orbit.of(position, velocity, 1.0)
    inclination, node, pericentre, anomaly = orbit.angles(np.array(position))
    e = np.linalg.norm(orbit.eccentricity)
    p = orbit.axis * (1.0 - e * e)
    c, s = np.cos(anomaly), np.sin(anomaly)
    flat = np.array([[p * c, p * s, 0.0], [-s, e + c, 0.0]])
    flat[0] /= 1.0 + e * c
    flat[1] /= np.sqrt(p)
    turn = Rotation.from_euler("ZXZ", [node, inclination, pericentre])
    np.testing.assert_allclose(turn.apply(flat), [position, velocity], atol=1e-13)
