"""Find the positions at which the panels cannot carry the load.

Random positions on a sphere about the asteroid, the bottom face to nadir, the best rotation about it.
Generation falls below a mode's load in two opposite cones about the Sun line; their half-angles, with
and without calibration, go to OUT/battery_cones.csv, the samples to battery_cones_samples.csv.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import brentq

from experiments.harness import (
    SEED,
    VEHICLE,
    Claim,
    Findings,
    Record,
    Session,
    Study,
    number,
    records,
)
from formulations.arrays import Array
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.results.table import Table
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from scp_recon.simulation.panels import SolarArray, irradiance
from scp_recon.simulation.vehicle import Vehicle, load_vehicle

SAMPLES, RADIUS_M = 10_000, 1000.0
TOLERANCE_DEG, ROUNDING_DEG = 0.2, 0.05
BOTTOM = np.array([0.0, 0.0, -1.0])
"""Body axis that points to nadir: the camera's, and along it the thruster pushes."""


def sample(panels: SolarArray, count: int, seed: int, shadow_radius_m: float) -> Array:
    """Uniform directions from the body, Sun-North frame, and the power there, W, shape (count, 4).

    The power is the most that any rotation about nadir gives, none in the shadow, a cylinder.
    """
    drawn = np.random.default_rng(seed).standard_normal((count, 3))
    direction = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    to_sun = direction[:, 0]
    off_axis_m = RADIUS_M * np.linalg.norm(direction[:, 1:], axis=1)
    dark = (to_sun < 0.0) & (off_axis_m < shadow_radius_m)
    power_w = panels.best_about(BOTTOM, np.arccos(-to_sun))
    return np.column_stack([direction, np.where(dark, 0.0, power_w)])


def find_cones(
    vehicle: Vehicle, scenario: Scenario, samples: int, seed: int
) -> tuple[list[Record], Array]:
    """Every mode's double cone of too little power, uncalibrated and calibrated: rows; the samples.

    Generation less housekeeping is below the load there. The half-angle is the wider cone's by the
    panels' closed form. It lies between the angles of the farthest sample below the load and of the
    nearest one above it.
    """
    panels, battery = SolarArray.of(vehicle, irradiance(scenario)), scenario.battery
    points = sample(panels, samples, seed, scenario.body.reference_radius_m)
    across = np.linalg.norm(points[:, 1:3], axis=1)
    off_deg = np.rad2deg(np.arctan2(across, np.abs(points[:, 0])))

    def surplus(angle: float, needed_w: float) -> float:
        ends = panels.best_about(BOTTOM, np.array([angle, np.pi - angle]))
        return float(ends.min()) - needed_w

    found = list[Record]()
    for housekeeping_w in (0.0, vehicle.loads.housekeeping_w):
        for mode, load_w, paper_deg in (
            ("delta-V, warm-up", vehicle.loads.warm_up_w, battery.delta_v_cone_deg),
            ("observation", vehicle.loads.observation_w, battery.observation_cone_deg),
        ):
            needed_w = load_w + housekeeping_w
            if surplus(0.0, needed_w) >= 0.0:
                half_angle = 0.0
            elif surplus(np.pi / 2, needed_w) < 0.0:
                half_angle = np.pi / 2
            else:
                half_angle = brentq(surplus, 0.0, np.pi / 2, (needed_w,), xtol=1e-12)
            half_angle_deg, short = float(np.rad2deg(half_angle)), points[:, 3] < needed_w
            share = proportion(int(short.sum()), samples)
            found.append(
                {
                    "mode": mode,
                    "load_w": load_w,
                    "calibrated": housekeeping_w > 0.0,
                    "half_angle_deg": half_angle_deg,
                    "sampled_below_up_to_deg": float(off_deg[short].max(initial=0.0)),
                    "sampled_met_from_deg": float(off_deg[~short].min(initial=90.0)),
                    "paper_deg": paper_deg,
                    "difference_deg": half_angle_deg - paper_deg,
                    "within_tolerance": abs(half_angle_deg - paper_deg) <= TOLERANCE_DEG,
                    "fraction_of_sphere": 1.0 - float(np.cos(half_angle)),
                    "sampled_fraction": share.value,
                    "sampled_fraction_low": share.low,
                    "sampled_fraction_high": share.high,
                }
            )
    return found, points


def claims(cones: Sequence[Record], extra_w: float) -> list[Claim]:
    """Claims that half-angles agree with the paper's, and that the planner's are wide enough."""
    found = []
    for calibrated, kind in (
        (False, "uncalibrated half-angles are the paper's"),
        (True, f"half-angles calibrated by {extra_w:g} W of housekeeping are the paper's"),
    ):
        chosen = [cone for cone in cones if cone["calibrated"] == calibrated]
        angles = " and ".join(f"{cone['half_angle_deg']:.2f}" for cone in chosen)
        agree = all(cone["within_tolerance"] for cone in chosen)
        found.append(Claim(kind, f"within {TOLERANCE_DEG:g} deg", f"{angles} deg", agree))
    short = max(cone["difference_deg"] for cone in cones)
    words = "the planner's cones are wide enough for both"
    threshold = f"at most {ROUNDING_DEG:g} deg too narrow"
    return [*found, Claim(words, threshold, f"{short:+.2f} deg", short <= ROUNDING_DEG)]


def run(session: Session) -> Findings:
    """Sample positions, and find every mode's cone."""
    options, vehicle = session.options, load_vehicle(session.options.vehicle)
    cones, points = find_cones(vehicle, load_scenario(), options.samples, options.seed)
    files = {
        "battery_cones.csv": records(cones),
        "battery_cones_samples.csv": Table.of("", ("x", "y", "z", "power_w"), points.tolist()),
    }
    return Findings(files, claims(cones, vehicle.loads.housekeeping_w))


STUDY = Study(
    __doc__,
    run,
    (number("--samples", SAMPLES, 100, 10_000_000, "positions"), SEED, VEHICLE),
)
