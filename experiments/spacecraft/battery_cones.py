"""Find the positions at which the panels cannot carry the load.

Random positions on a sphere about the asteroid, the bottom face to nadir, the best rotation about it.
Generation falls below a mode's load in two opposite cones about the Sun line; their half-angles, with
and without calibration, go to OUT/battery_cones.csv, the samples to battery_cones_samples.csv.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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


@dataclass(frozen=True)
class Load:
    """Power drawn by a mode, and the paper's half-angle for it."""

    mode: str
    power_w: float
    paper_deg: float


@dataclass(frozen=True)
class Samples:
    """Positions and the panels' power there.

    Attributes:
        direction: unit vectors from the body's centre, Sun-North frame, shape (n, 3).
        power_w: most that any rotation about nadir gives, 0 in the asteroid's shadow, shape (n,).
    """

    direction: Array
    power_w: Array

    @property
    def off_sun_line(self) -> Array:
        """Angle between the position and the nearer end of the Sun line, rad."""
        across = np.linalg.norm(self.direction[:, 1:], axis=1)
        return np.arctan2(across, np.abs(self.direction[:, 0]))


def sample(panels: SolarArray, count: int, seed: int, shadow_radius_m: float) -> Samples:
    """Uniform positions on the sphere; the shadow is a cylinder."""
    drawn = np.random.default_rng(seed).standard_normal((count, 3))
    direction = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    to_sun = direction[:, 0]
    power = panels.best_about(BOTTOM, np.arccos(-to_sun))
    off_axis_m = RADIUS_M * np.linalg.norm(direction[:, 1:], axis=1)
    dark = (to_sun < 0.0) & (off_axis_m < shadow_radius_m)
    return Samples(direction, np.where(dark, 0.0, power))


def find_cone(panels: SolarArray, samples: Samples, load: Load, housekeeping_w: float) -> Record:
    """Find the double cone in which generation less housekeeping is below a load, as a row.

    The half-angle is the wider cone's by the panels' closed form. It lies between the angles of the
    farthest sample below the load and of the nearest one above it.
    """
    needed = load.power_w + housekeeping_w

    def surplus(angle: float) -> float:
        ends = panels.best_about(BOTTOM, np.array([angle, np.pi - angle]))
        return float(ends.min()) - needed

    if surplus(0.0) >= 0.0:
        half_angle = 0.0
    elif surplus(np.pi / 2) < 0.0:
        half_angle = np.pi / 2
    else:
        half_angle = float(brentq(surplus, 0.0, np.pi / 2, xtol=1e-12))
    short = samples.power_w < needed
    off = np.rad2deg(samples.off_sun_line)
    fraction = proportion(int(short.sum()), len(short))
    error_deg = float(np.rad2deg(half_angle)) - load.paper_deg
    return {
        "mode": load.mode,
        "load_w": load.power_w,
        "calibrated": housekeeping_w > 0.0,
        "half_angle_deg": float(np.rad2deg(half_angle)),
        "sampled_below_up_to_deg": float(off[short].max(initial=0.0)),
        "sampled_met_from_deg": float(off[~short].min(initial=90.0)),
        "paper_deg": load.paper_deg,
        "difference_deg": error_deg,
        "within_tolerance": abs(error_deg) <= TOLERANCE_DEG,
        "fraction_of_sphere": 1.0 - float(np.cos(half_angle)),
        "sampled_fraction": fraction.value,
        "sampled_fraction_low": fraction.low,
        "sampled_fraction_high": fraction.high,
    }


def find_cones(
    panels: SolarArray, samples: Samples, loads: Sequence[Load], extra_w: float
) -> list[Record]:
    """Every mode's cone, uncalibrated and calibrated by `extra_w`."""
    return [find_cone(panels, samples, load, w) for w in (0.0, extra_w) for load in loads]


def mode_loads(vehicle: Vehicle, scenario: Scenario) -> tuple[Load, Load]:
    """Loads of the vehicle's modes, beside the half-angles that the planner uses."""
    return (
        Load("delta-V, warm-up", vehicle.loads.warm_up_w, scenario.battery.delta_v_cone_deg),
        Load("observation", vehicle.loads.observation_w, scenario.battery.observation_cone_deg),
    )


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
    options, scenario = session.options, load_scenario()
    vehicle = load_vehicle(options.vehicle)
    panels = SolarArray.of(vehicle, irradiance(scenario))
    samples = sample(panels, options.samples, options.seed, scenario.body.reference_radius_m)
    extra_w = vehicle.loads.housekeeping_w
    cones = find_cones(panels, samples, mode_loads(vehicle, scenario), extra_w)
    points = np.column_stack([samples.direction, samples.power_w]).tolist()
    files = {
        "battery_cones.csv": records(cones),
        "battery_cones_samples.csv": Table.of("", ("x", "y", "z", "power_w"), points),
    }
    return Findings(files, claims(cones, extra_w))


STUDY = Study(
    __doc__,
    run,
    (number("--samples", SAMPLES, 100, 10_000_000, "positions"), SEED, VEHICLE),
)
