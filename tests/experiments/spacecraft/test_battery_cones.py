"""Generation about the asteroid: the panels' law, the two cones, and the command."""

import numpy as np
import pytest

from experiments.harness import Record
from experiments.model_fidelity import Plates
from experiments.spacecraft.battery_cones import (
    SAMPLES,
    TOLERANCE_DEG,
    find_cones,
    mode_loads,
    sample,
)
from scp_recon.physics.forces import SPEED_OF_LIGHT_M_S
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from scp_recon.simulation.panels import SolarArray, irradiance


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario()


@pytest.fixture(scope="module")
def panels(scenario, vehicle) -> SolarArray:
    return SolarArray.of(vehicle, irradiance(scenario))


@pytest.fixture(scope="module")
def cones(scenario, vehicle, panels) -> list[Record]:
    samples = sample(panels, SAMPLES, 0, scenario.body.reference_radius_m)
    return find_cones(panels, samples, mode_loads(vehicle, scenario), vehicle.loads.housekeeping_w)


def test_panel_powers(panels):
    """Peaks of SP1 to SP5 by areas of 0.0286, 0.0676 and 0.36 m^2, 30 % cells and 1332 W/m^2."""
    assert panels.peak_w == pytest.approx([11.4, 27.0, 27.0, 143.9, 143.9], abs=0.05)
    sun = -np.eye(3)[0]
    assert panels.generation(sun).sum() == pytest.approx(299.2, abs=0.2)
    assert np.linalg.norm(panels.best_direction()) == pytest.approx(300.4, abs=0.2)


def test_light_pushes_the_vehicle_as_its_areas_say(scenario, vehicle):
    plates = Plates.of(vehicle)
    pressure = irradiance(scenario) / SPEED_OF_LIGHT_M_S
    cells, structure = 0.7486, 0.0614 + 0.036
    to_panels = plates.force_per_pressure(-np.eye(3)[0])
    np.testing.assert_allclose(to_panels, [1.01 * cells + 1.6 * structure, 0.0, 0.0], atol=1e-12)
    assert pressure * to_panels[0] == pytest.approx(4.05e-6, rel=2e-3)


def test_calibrated_cones_are_the_papers_and_others_what_the_panels_give(cones, panels):
    found = {cone["mode"]: cone["half_angle_deg"] for cone in cones if cone["calibrated"]}
    assert found["delta-V, warm-up"] == pytest.approx(23.3, abs=TOLERANCE_DEG)
    assert found["observation"] == pytest.approx(18.2, abs=TOLERANCE_DEG)
    most = np.linalg.norm(panels.best_direction())
    plain = [cone for cone in cones if not cone["calibrated"]]
    assert [cone["load_w"] for cone in plain] == [115.0, 90.0]
    for cone in plain:
        assert np.sin(np.deg2rad(cone["half_angle_deg"])) * most == pytest.approx(cone["load_w"])


def test_samples_bracket_the_half_angles(cones):
    for cone in cones:
        inside, outside = (cone[f"sampled_{end}_deg"] for end in ("below_up_to", "met_from"))
        assert inside <= cone["half_angle_deg"] <= outside < inside + 0.2
        solid_angle = 1.0 - np.cos(np.deg2rad(cone["half_angle_deg"]))
        # Five standard deviations, as a wrong share would miss by more.
        spread = np.sqrt(solid_angle * (1.0 - solid_angle) / SAMPLES)
        assert cone["fraction_of_sphere"] == pytest.approx(solid_angle)
        value, low, high = (cone[f"sampled_fraction{end}"] for end in ("", "_low", "_high"))
        assert value == pytest.approx(solid_angle, abs=5.0 * spread)
        assert low < value < high
