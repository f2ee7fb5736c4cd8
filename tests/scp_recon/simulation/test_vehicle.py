"""What flies: the packaged vehicle, its guidance and its estimator."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from scp_recon.errors import InputError
from scp_recon.mission.schedule import Mode
from scp_recon.physics import geometry
from scp_recon.simulation import vehicle as module
from scp_recon.simulation.estimator import (
    AttitudeFilter,
    SensorSigmas,
    from_rotation_vector,
    matrix,
    product,
)
from scp_recon.simulation.guidance import FlightPlan
from scp_recon.simulation.vehicle import load_vehicle
from tests.helpers import generators, random_unit
from tests.scp_recon.support import fly

DARE = Path(module.__file__).parent / "data" / "dare.toml"


def test_the_packaged_vehicle_is_the_papers(vehicle):
    assert vehicle.mass.mass_kg < 180.0
    assert vehicle.battery.count * vehicle.battery.capacity_wh == 80.0
    assert len(vehicle.panels.panel) == 5
    assert len(vehicle.wheels.axes) == 4
    assert len(vehicle.micro_thrusters.directions) == 8
    assert np.linalg.eigvalsh(vehicle.inertia).min() > 0.0


def test_micro_thrusters_make_every_torque_without_a_force(vehicle):
    micro = vehicle.micro_thrusters
    force = np.array(micro.directions) / np.sqrt(2.0)
    torque = np.cross(micro.offsets_m, force)
    # The forces that thrusters of equal share make cancel, and torques of both signs span space.
    assert np.allclose(force.sum(axis=0), 0.0)
    assert np.linalg.matrix_rank(torque) == 3
    for axis in np.vstack([np.eye(3), -np.eye(3)]):
        share = np.linalg.pinv(np.vstack([torque.T, force.T])) @ np.concatenate([axis, np.zeros(3)])
        share -= share.min()
        np.testing.assert_allclose(torque.T @ share, axis, atol=1e-12)
        np.testing.assert_allclose(force.T @ share, 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "entry"),
    [
        ("mass_kg = 178.0", "mass_kg = -1.0", "mass.mass_kg"),
        ("efficiency = 0.30", "efficiency = 1.3", "panels.efficiency"),
        ("pulse_min_s = 0.1", "", "micro_thrusters.pulse_min_s"),
        ("camera = ", "kamera = ", "sensors"),
        ("[0.17, 0.0, 0.15], [0.17", "[0.17", "micro_thrusters"),
        ('name = "DARE"', "name = ", "vehicle"),
        ("[62.7, 4.1, 60.0]", "[64.2, 4.1, 60.0]", "sum of the others"),
        (
            "[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [-1.0, 0.0, 1.0]]",
            "[0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]",
            "span",
        ),
        ("[26.2, 0.6], [251.0, 6.0]", "[251.0, 6.0], [26.2, 0.6]", "ascending"),
    ],
)
def test_a_bad_entry_is_named(tmp_path, old, new, entry):
    text = DARE.read_text("utf-8")
    assert old in text
    file = tmp_path / "mine.toml"
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=entry):
        load_vehicle(file)


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(InputError, match=r"no\.toml"):
        load_vehicle(tmp_path / "no.toml")
    with pytest.raises(InputError, match="more than 100 megabytes"):
        load_vehicle(Path("/dev/zero"))


@pytest.fixture(scope="module")
def plan(solution, mission, vehicle) -> FlightPlan:
    return FlightPlan.of(solution, mission, vehicle)


def test_burns_keep_their_attitude_to_the_end(plan):
    thrust, mass = plan.vehicle.chemical_thruster.thrust_n, plan.vehicle.mass.mass_kg
    for firing in plan.firings:
        least = mass * np.linalg.norm(firing.dv_m_s) / thrust
        assert least <= firing.duration_s < least + 1.0
        (leg,) = [leg for leg in plan.legs if leg.end_s == firing.end_s]
        assert leg.mode is Mode.DELTA_V
    assert plan.legs[0].start_s == 0.0
    assert all(a.end_s == b.start_s for a, b in zip(plan.legs, plan.legs[1:], strict=False))


def test_nominal_path_is_planned_mean_between_nodes(plan, solution, mission):
    times = np.union1d(np.arange(0.0, 34842.0, 971.0), mission.scenario.burns.times_s)
    truth = fly(mission, solution.burns_m_s, times)[:, :3]
    assert np.abs(plan.position(times) - truth).max() < 0.01


def test_every_mode_points_and_rolls_for_power(plan, mission):
    times = np.arange(0.0, plan.end_s, 61.0)
    attitudes = plan.attitudes(times)
    sun = mission.sun_direction(times)
    power = plan.panels.generation(attitudes.inv().apply(sun)).sum(axis=1)
    position = plan.position(times)
    bottom = attitudes.apply([0.0, 0.0, -1.0])
    site = geometry.track(mission.site, mission.rotation, times).position
    best = np.linalg.norm(plan.panels.best_direction())
    for leg in plan.legs:
        k = (times >= leg.start_s) & (times < leg.end_s)
        if leg.mode is Mode.SUN_POINTING:
            np.testing.assert_allclose(power[k], best, rtol=1e-9)
            # The bottom looks down as far as it can, across the Sun line.
            down = np.einsum("ni,ni->n", bottom[k], -position[k])
            across = np.linalg.norm(np.cross(position[k], sun[k]), axis=1)
            np.testing.assert_allclose(down, across, rtol=1e-9)
            continue
        target = site[k] - position[k]
        if leg.mode is Mode.DELTA_V:
            firing = next(f for f in plan.firings if f.end_s == leg.end_s)
            target = np.broadcast_to(firing.dv_m_s, target.shape)
        assert geometry.angle(target, bottom[k]).max() < 1e-9
        most = plan.panels.best_about(np.array([0.0, 0.0, -1.0]), geometry.angle(target, sun[k]))
        np.testing.assert_allclose(power[k], most, rtol=1e-9)


def test_zero_burn_keeps_panels_on_sun(plan):
    """Whatever the others are: turned away for an hour or more, they would not charge."""
    burns = np.array([firing.dv_m_s for firing in plan.firings])
    burns[1] = 0.0
    idle = plan.with_burns(burns)
    assert idle.firings[1].duration_s == 0.0
    before = next(leg for leg in idle.legs if leg.end_s == idle.firings[1].end_s)
    times = np.arange(before.start_s, before.end_s)
    sun = idle.mission.sun_direction(times)
    facing = idle.attitudes(times).apply(idle.panels.best_direction())
    assert geometry.angle(facing, sun).max() < 1e-6
    turned = plan.attitudes(times).apply(plan.panels.best_direction())
    assert geometry.angle(turned, sun).min() > 0.1


def test_a_burn_longer_than_its_mode_is_refused(solution, mission, vehicle):
    weak = vehicle.chemical_thruster.model_copy(update={"thrust_n": 1e-3})
    with pytest.raises(InputError, match="chemical_thruster"):
        FlightPlan.of(solution, mission, vehicle.model_copy(update={"chemical_thruster": weak}))


BORESIGHTS = np.vstack([np.eye(3), -np.eye(3)])


@given(rng=generators)
def test_quaternions_are_scipys_rotations(rng):
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


@pytest.mark.slow
@settings(max_examples=6)
@given(rng=generators, stars=st.booleans())
def test_errors_are_as_large_as_the_filter_says(rng, stars):
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


def test_a_sun_sensor_in_shadow_is_not_believed():
    sun = np.array([0.0, 0.0, 1.0])
    boresight = np.array([[0.0, 0.6, 0.8]])
    for reading, moves in ((0.0, False), (0.7, True)):
        estimate = AttitudeFilter(
            np.array([1.0, 0.0, 0.0, 0.0]), SensorSigmas(1e-4, 1e-4, 0.05), 0.01
        )
        estimate.see(None, np.array([reading]), boresight, sun)
        assert estimate.quaternion[1:].any() == moves
