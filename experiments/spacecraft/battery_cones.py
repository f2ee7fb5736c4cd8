"""Find the positions at which the panels cannot carry the load, and how long a recharge takes.

Random positions on a sphere about the asteroid, the bottom face to nadir, the best rotation about it.
Generation falls below a mode's load in two opposite cones about the Sun line; their half-angles, with
and without calibration, go to OUT/battery_cones.csv, figures of the batteries to OUT/batteries.csv.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

from experiments.harness import Record, Session, Study, Tables
from scp_recon.scenario.load import load_scenario
from scp_recon.simulation.panels import SolarArray, irradiance
from scp_recon.simulation.vehicle import load_vehicle

SAMPLES, RADIUS_M = 10_000, 1000.0
BOTTOM = np.array([0.0, 0.0, -1.0])
"""Body axis that points to nadir: the camera's, and along it the thruster pushes."""


def find_cones(seed: int) -> list[Record]:
    """Every mode's double cone of too little power, uncalibrated and calibrated by housekeeping.

    Generation less housekeeping is below the load there, with the best rotation about nadir. The
    half-angle is the wider cone's by the panels' closed form; sampled positions are also in the body's
    shadow, a cylinder.
    """
    scenario, vehicle = load_scenario(), load_vehicle()
    panels, battery = SolarArray.of(vehicle, irradiance(scenario)), scenario.battery
    loads, turning_w = vehicle.loads, vehicle.loads.quiescent_w + vehicle.loads.attitude_control_w
    drawn = np.random.default_rng(seed).standard_normal((SAMPLES, 3))
    direction = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    to_sun, across = direction[:, 0], np.linalg.norm(direction[:, 1:], axis=1)
    dark = (to_sun < 0.0) & (RADIUS_M * across < scenario.body.reference_radius_m)
    power_w = np.where(dark, 0.0, panels.best_about(BOTTOM, np.arccos(-to_sun)))

    def surplus(angle: float, needed_w: float) -> float:
        ends = panels.best_about(BOTTOM, np.array([angle, np.pi - angle]))
        return float(ends.min()) - needed_w

    return [
        {
            "mode": mode,
            "load_w": load_w,
            "calibrated": own_w > 0.0,
            "half_angle_deg": float(np.rad2deg(brentq(surplus, 0.0, np.pi / 2, (load_w + own_w,)))),
            "paper_deg": paper_deg,
            "sampled_fraction": float((power_w < load_w + own_w).mean()),
        }
        for own_w in (0.0, loads.housekeeping_w)
        for mode, load_w, paper_deg in (
            ("delta-V, warm-up", turning_w + loads.heater_w, battery.delta_v_cone_deg),
            ("observation", turning_w + loads.payload_w, battery.observation_cone_deg),
        )
    ]


def batteries() -> list[Record]:
    """A recharge from empty, facing the Sun; and the share of charge left after a warm-up in the dark.

    The recharge is quiescent, or with the attitude control's reserve drawn as well.
    """
    vehicle = load_vehicle()
    battery, loads = vehicle.battery, vehicle.loads
    peak_w = np.linalg.norm(SolarArray.of(vehicle, irradiance(load_scenario())).best_direction())
    stored_wh = battery.count * battery.capacity_wh
    turning_w = loads.quiescent_w + loads.attitude_control_w
    warm_up_wh = (turning_w + loads.heater_w) * vehicle.chemical_thruster.heating_s / 3600.0

    def recharge_min(drawn_w: float) -> float:
        return float(60.0 * stored_wh / battery.efficiency / (peak_w - drawn_w))

    found = {
        "recharge from empty, quiescent, min": recharge_min(loads.quiescent_w),
        "the same with the attitude control, min": recharge_min(turning_w),
        "charge after a warm-up that no panel helps": 1.0
        - warm_up_wh / battery.efficiency / stored_wh,
        "floor of the charge": battery.floor_charge,
    }
    return [{"figure": figure, "value": value} for figure, value in found.items()]


def run(_: Session) -> Tables:
    """Sample positions, and find every mode's cone."""
    return {"battery_cones": find_cones(0), "batteries": batteries()}


STUDY = Study(__doc__, run)
