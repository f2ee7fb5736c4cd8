from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiments.model_fidelity.models import Plates
from scp_recon.errors import InputError
from scp_recon.simulation import vehicle as module
from scp_recon.simulation.vehicle import Vehicle, load_vehicle

DARE = Path(module.__file__).parent / "data" / "dare.toml"


def test_the_packaged_vehicle_is_the_papers(vehicle: Vehicle) -> None:
    assert vehicle.mass.mass_kg < 180.0
    assert vehicle.battery.count * vehicle.battery.capacity_wh == 80.0
    assert len(vehicle.panels.panel) == 5
    assert len(vehicle.wheels.axes) == 4
    assert len(vehicle.micro_thrusters.directions) == 8
    assert (vehicle.loads.warm_up_w, vehicle.loads.observation_w) == (115.0, 90.0)
    assert np.linalg.eigvalsh(vehicle.inertia).min() > 0.0


def test_the_plates_are_closed_but_for_what_shades_itself(vehicle: Vehicle) -> None:
    """As much area looks along an axis as against it, where neither stage hides the other."""
    plates = Plates.of(vehicle)
    areas = plates.areas_m2[:, None] * np.maximum(
        0.0, plates.normals @ np.vstack([np.eye(3), -np.eye(3)]).T
    )
    front, left, top, back, right, bottom = areas.sum(axis=0)
    assert front == pytest.approx(back)
    assert left == pytest.approx(right)
    assert top == pytest.approx(bottom)
    # The wings with both stages and no shading: 0.3 x 0.3 + 0.3 x 0.12 + 2 x 0.3 x 1.2 m.
    assert back == pytest.approx(0.846)


def test_micro_thrusters_make_every_torque_without_a_force(vehicle: Vehicle) -> None:
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
def test_a_bad_entry_is_named(tmp_path: Path, old: str, new: str, entry: str) -> None:
    text = DARE.read_text("utf-8")
    assert old in text
    file = tmp_path / "mine.toml"
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=entry):
        load_vehicle(file)


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no\.toml"):
        load_vehicle(tmp_path / "no.toml")
    with pytest.raises(InputError, match="more than 100 megabytes"):
        load_vehicle(Path("/dev/zero"))
