"""Forces: derivatives, units, light, and spherical harmonics."""

from collections.abc import Callable
from math import factorial

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from formulations.arrays import Array
from scp_recon.mission.mission import Mission
from scp_recon.physics.forces import (
    ForceModel,
    acceleration,
    accelerations,
    gravity_curvature,
    gravity_gradient,
)
from scp_recon.physics.frames import Rotation
from scp_recon.physics.harmonics import HarmonicField, TurningField
from scp_recon.scenario.load import load_scenario
from tests import reference
from tests.helpers import unit_vectors
from tests.scp_recon.support import COMPANION, mission_of

Derivatives = Callable[[Array], list[Array]]


def positions(least_m: float = 200.0, most_m: float = 3000.0) -> st.SearchStrategy[Array]:
    """From inside the body to three times the orbit's radius, m."""
    return st.builds(np.multiply, st.floats(least_m, most_m), unit_vectors())


def at(position: Array, forces: ForceModel) -> Array:
    return np.array(acceleration(*position, forces))


TIME_S = 5000.0


@pytest.fixture(
    scope="module", params=[{}, {"body.planned_degree": 4}, {"body.companion": COMPANION}], ids=str
)
def forces(request, mission) -> ForceModel:
    return mission.changed(request.param).forces if request.param else mission.forces


@pytest.fixture(scope="module")
def differentiated(forces) -> Derivatives:
    """CasADi's acceleration, gradient and second derivative of the library's `acceleration`."""
    r = ca.SX.sym("r", 3)
    value = ca.vertcat(*acceleration(r[0], r[1], r[2], forces, forces.moment(TIME_S)))
    gradient = ca.jacobian(value, r)
    second = [ca.jacobian(gradient[i, :].T, r) for i in range(3)]
    function = ca.Function("f", [r], [value, gradient, *second])

    def evaluate(position: Array) -> list[Array]:
        value, gradient, *second = (np.array(x) for x in function(position))
        return [value[:, 0], gradient, np.stack(second)]

    return evaluate


@pytest.fixture(scope="module")
def gradient_of_potential(mission) -> Callable[[Array], Array]:
    """CasADi's gradient of the textbook potential, with none of the library's arithmetic.

    U = GM/r [1 - J2 (R/r)^2 (3 sin^2 latitude - 1) / 2] + a_srp . r
    """
    body = mission.scenario.body
    p = ca.SX.sym("p", 3)
    radius = ca.norm_2(p)
    sine = ca.dot(p, ca.DM(mission.rotation.pole)) / radius
    oblate = body.j2 * (body.reference_radius_m / radius) ** 2 * (3 * sine**2 - 1) / 2
    potential = body.gm_m3_s2 / radius * (1 - oblate) + ca.dot(p, ca.DM(mission.forces.srp))
    function = ca.Function("g", [p], [ca.gradient(potential, p)])
    return lambda position: np.array(function(position))[:, 0]


@given(position=positions())
def test_acceleration_is_the_gradient_of_the_potential(position, mission, gradient_of_potential):
    expected = gradient_of_potential(position)
    error = np.abs(at(position, mission.forces) - expected).max()
    assert error < 1e-12 * np.linalg.norm(expected)


@given(position=positions())
def test_closed_form_derivatives_are_those_of_the_acceleration(position, forces, differentiated):
    value, gradient, curvature = differentiated(position)
    moment = forces.moment(TIME_S)
    closed_forms = (
        (accelerations(position[:, None], forces, moment)[:, 0], value),
        (gravity_gradient(position[None], forces, moment)[0], gradient),
        (gravity_curvature(position[None], forces, moment)[0], curvature),
    )
    for closed_form, expected in closed_forms:
        assert np.abs(closed_form - expected).max() < 1e-12 * np.abs(expected).max()


@given(position=positions(), length=st.floats(1.0, 1e4), time=st.floats(1.0, 1e5))
def test_a_change_of_units_changes_only_the_numbers(position, length, time, mission):
    scaled = at(position / length, mission.forces.in_units(length, time))
    np.testing.assert_allclose(scaled * length / time**2, at(position, mission.forces), rtol=1e-12)


def test_gravity_constants_are_those_of_the_flight_field(mission):
    body, (zonal, _) = mission.scenario.body, reference.COEFFICIENTS[2, 0]
    assert body.gm_m3_s2 == pytest.approx(reference.GM_M3_S2, rel=1e-12)
    assert body.reference_radius_m == reference.REFERENCE_RADIUS_M
    assert body.j2 == pytest.approx(-np.sqrt(5.0) * zonal, rel=1e-12)


def test_radiation_pressure_falls_with_the_squared_distance(mission):
    srp = mission.forces.srp
    # 1361 W/m^2 at 1.0108 au on 0.85 m^2 x 1.127 of 178 kg (nasa/muscat, DARE).
    assert np.linalg.norm(srp) == pytest.approx(2.39e-8, rel=2e-3)
    np.testing.assert_allclose(srp / np.linalg.norm(srp), -mission.sun_direction(0.0), atol=1e-14)
    window = "observation.window_s=[13140.0, 16537.0]"  # the Sun stands elsewhere
    scenario = load_scenario(None, ["boundary.frame=j2000", window])
    sun = scenario.sun.model_copy(update={"body_position_km": (149_597_870.7, 0.0, 0.0)})
    moved = Mission.from_scenario(scenario.model_copy(update={"sun": sun}))
    ratio = np.linalg.norm(moved.forces.srp) / np.linalg.norm(srp)
    assert ratio == pytest.approx(reference.SUN_DISTANCE_AU**2, rel=1e-7)


def test_radiation_pressure_scales_as_the_cannonball_law(mission):
    for doubled, effect in (
        ("spacecraft.srp_area_m2=1.7", 2.0),
        ("spacecraft.mass_kg=356", 0.5),
        ("spacecraft.reflectivity_coefficient=2.254", 2.0),
        ("sun.solar_constant_w_m2=2722", 2.0),
    ):
        expected = effect * mission.forces.srp
        np.testing.assert_allclose(mission_of(doubled).forces.srp, expected, rtol=1e-9)


GM = reference.GM_M3_S2


def evaluate(field: HarmonicField, position: np.ndarray) -> np.ndarray:
    return np.array(field.acceleration(*np.asarray(position)[:, None]))[:, 0]


@given(positions(350.0, 2000.0))
def test_zonal_degree_two_is_the_planners_j2(position):
    field = HarmonicField.bennu(GM, 2)
    zonal = HarmonicField(GM, 290.0, np.diag([1.0, 0.0, 0.0]), np.zeros((3, 3)))
    zonal.c[2, 0] = field.c[2, 0]
    pole = np.array([0.0, 0.0, 1.0])
    planner = ForceModel(GM, 1.5 * GM * -field.c[2, 0] * 290.0**2, pole, np.zeros(3))
    expected = np.array(acceleration(*position, planner))
    np.testing.assert_allclose(evaluate(zonal, position), expected, rtol=1e-11, atol=1e-18)


@given(positions(400.0, 1500.0), st.integers(0, 10))
def test_gradient_is_symmetric_and_trace_free(position, degree):
    field = HarmonicField.bennu(GM, degree)
    for each in (field.derivatives(position[:, None], order)[..., 0] for order in (1, 2)):
        size = np.abs(each).max()
        assert np.abs(np.trace(each)).max() < 1e-12 * size
        assert np.abs(each - each.swapaxes(0, 1)).max() < 1e-12 * size


@given(positions(300.0, 1500.0), st.integers(2, 8), st.floats(-1e5, 1e5))
def test_turning_field_is_that_of_the_turned_body(position, degree, time):
    rotation = Rotation(1.5, -1.05, 0.7, 4.06e-4, 1e-12)
    field = TurningField(HarmonicField.bennu(GM, degree), rotation)
    matrix = rotation.body_to_j2000(time)
    expected = matrix @ evaluate(field.field, matrix.T @ position)
    found = field.derivatives(position[:, None], matrix.T, 0)[..., 0]
    assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()


def test_all_coefficients_are_those_of_the_source():
    field = HarmonicField.bennu(GM, reference.GRAVITY_DEGREE)
    assert field.radius == reference.REFERENCE_RADIUS_M
    for (n, m), expected in reference.COEFFICIENTS.items():
        # N_nm = sqrt((2 - delta_0m) (2n + 1) (n - m)! / (n + m)!)
        norm = np.sqrt((2 - (m == 0)) * (2 * n + 1) * factorial(n - m) / factorial(n + m))
        ours = (field.c[n, m], field.s[n, m])
        assert ours == pytest.approx(norm * np.array(expected), rel=1e-12)
    there = (field.c != 0.0) | (field.s != 0.0)
    expected = np.tri(reference.GRAVITY_DEGREE + 1, dtype=bool)
    expected[1] = False  # the origin is the centre of mass
    np.testing.assert_array_equal(there, expected)
