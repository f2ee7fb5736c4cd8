"""Studies of what the planner leaves out: crude models, power, sources of uncertainty."""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.stats import chi2

from experiments.flown import erring
from experiments.harness import Record, Session, Study, Tables, default_mission, default_plan
from formulations.arrays import Array
from scp_recon.errors import needing
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import HARMONICS_DEGREE
from scp_recon.mission.schedule import Mode
from scp_recon.monte_carlo.estimates import CONFIDENCE, Estimate
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.physics.forces import SPEED_OF_LIGHT_M_S
from scp_recon.physics.frames import unit
from scp_recon.physics.harmonics import HarmonicField
from scp_recon.results.solution import Solution, ballistic_arc
from scp_recon.scenario.load import load_scenario
from scp_recon.simulation.guidance import FlightPlan, SolarArray, irradiance
from scp_recon.simulation.vehicle import Errors, Vehicle, load_vehicle

# --- force and burn models ------------------------------------------------------------------------

SRP, GRAVITY, BURNS = "solar radiation pressure", "gravity", "burns"
PLANNER = {SRP: "cannonball", GRAVITY: "J2", BURNS: "impulsive"}
"""The planner's own models."""
ATTITUDE_STEP_S = 60.0
"""Spacing at which the commanded attitude is turned into a force, linear in between."""
INTEGRATOR: Mapping[str, Any] = {"rtol": 1e-11, "atol": 1e-9, "method": "DOP853"}
"""The tolerances together cost less than 0.1 mm at the end of the flight."""

Acceleration = Callable[[float], Array]
"""Acceleration by sunlight, J2000, m/s^2, at a time in s."""
Models = Mapping[str, Mapping[str, Any]]
"""The models of each effect by name, in ascending fidelity; the last is the truth. A model is an
`Acceleration`; a field of gravity; the delay of a burn's impulse over the firing's length, or None for
a thrust that lasts."""


def flight_plan(solution: Solution, mission: Mission, vehicle: Vehicle) -> FlightPlan:
    """The flight of a solution; with a burn of zero the panels stay on the Sun."""
    plan = FlightPlan.of(solution, mission, vehicle)
    idle = {firing.end_s for firing in plan.firings if not firing.dv_m_s.any()}
    legs = (replace(leg, mode=Mode.SUN_POINTING) if leg.end_s in idle else leg for leg in plan.legs)
    return replace(plan, legs=tuple(legs))


def models_of(plan: FlightPlan) -> Models:
    """The models of each effect on a flight."""
    forces, gm = plan.mission.forces, plan.mission.scenario.body.gm_m3_s2
    fields = [HarmonicField.bennu(gm, n) for n in range(HARMONICS_DEGREE + 1)]
    named = {f"degree {n}": field for n, field in enumerate(fields)}
    crude = {"degree 0": fields[0], "degree 1": fields[1], "J2": _zonal(fields[2])}
    return {
        SRP: {
            "none": lambda _: np.zeros(3),
            "cannonball": lambda _: forces.srp,
            "N-plate": _plate_srp(plan),
        },
        GRAVITY: crude | named,
        BURNS: {"impulsive": 0.0, "impulsive, mid-firing": 0.5, "finite": None},
    }


def _zonal(field: HarmonicField) -> HarmonicField:
    """The planner's gravity: the field's oblateness alone."""
    c = np.zeros_like(field.c)
    c[0, 0], c[2, 0] = field.c[0, 0], field.c[2, 0]
    return HarmonicField(field.gm, field.radius, c, np.zeros_like(field.s))


def _plate_srp(plan: FlightPlan) -> Acceleration:
    """Acceleration of the vehicle's plates in its commanded attitude."""
    plates, vehicle, mission = plates_of(plan.vehicle), plan.vehicle, plan.mission
    scale = irradiance(mission.scenario) / SPEED_OF_LIGHT_M_S / vehicle.mass.mass_kg
    times, values = [], []
    for leg in plan.legs:
        count = max(2, int(np.ceil((leg.end_s - leg.start_s) / ATTITUDE_STEP_S)) + 1)
        inside = np.linspace(leg.start_s, np.nextafter(leg.end_s, leg.start_s), count)
        to_j2000 = plan.attitudes(inside).as_matrix()
        sun_body = np.einsum("nji,nj->ni", to_j2000, mission.sun_direction(inside))
        force = light_force(sun_body, *plates)
        times.append(inside)
        values.append(scale * np.einsum("nij,nj->ni", to_j2000, force))
    starts = np.array([leg.start_s for leg in plan.legs])

    def acceleration(time: float) -> Array:
        leg = max(0, int(np.searchsorted(starts, time, side="right")) - 1)
        return np.array([np.interp(time, times[leg], values[leg][:, i]) for i in range(3)])

    return acceleration


def plates_of(vehicle: Vehicle) -> tuple[Array, Array, Array, Array]:
    """Normals (n, 3), areas (n,), specular and diffuse fractions (n,) of faces and cells."""
    sizes = [(plate.area_m2, plate.specular, plate.diffuse) for plate in vehicle.plates]
    area, specular, diffuse = np.array(sizes).T
    return unit([plate.normal for plate in vehicle.plates]), area, specular, diffuse


def light_force(
    sun_body: Array, normals: Array, areas_m2: Array, specular: Array, diffuse: Array
) -> Array:
    """Force on a rigid body's plates over the pressure of sunlight, body frame, m^2, shape (..., 3).

    -sum_i A_i cos_i ((1 - rho_s) s + 2 (rho_s cos_i + rho_d / 3) n_i) over the plates with
    cos_i = n_i . s > 0: Montenbruck & Gill, Satellite Orbits, eq. 3.73, with Lambert's law. Plates do
    not shade each other.

    Args:
        sun_body: unit vectors to the Sun, body frame, shape (..., 3).
        normals: outward unit vectors, body frame, shape (n, 3).
        areas_m2: shape (n,).
        specular: fraction of the light that is reflected as by a mirror, shape (n,).
        diffuse: fraction reflected by Lambert's law, shape (n,).
    """
    cosine = np.maximum(0.0, sun_body @ normals.T)
    lit = areas_m2 * cosine
    along_sun = (lit * (1.0 - specular)).sum(axis=-1, keepdims=True) * sun_body
    return -along_sun - 2.0 * lit * (specular * cosine + diffuse / 3.0) @ normals


def fly(
    mission: Mission,
    burns_m_s: Array,
    model: Mapping[str, Any],
    end_s: float,
    *,
    thrust_m_s2: float,
    breaks_s: Sequence[float] = (),
) -> Array:
    """State at a time, before a burn then, J2000, m and m/s, shape (6,).

    Args:
        mission: initial state, rotation and firing times.
        burns_m_s: planned burns, shape (m, 3); they may be zero.
        model: of each effect; see `Models`.
        end_s: the time.
        thrust_m_s2: while firing; it is constant, the propellant being a ten-thousandth.
        breaks_s: times at which sunlight's acceleration may jump.
    """
    lengths = np.linalg.norm(burns_m_s, axis=1) / thrust_m_s2
    impulses, thrusts = dict[float, Array](), list[tuple[float, float, Array]]()
    for start, length, burn in zip(mission.scenario.burns.times_s, lengths, burns_m_s, strict=True):
        if model[BURNS] is None:
            thrusts.append((start, start + length, burn / length if length else burn))
        else:
            impulses[start + model[BURNS] * length] = burn
    edges = {0.0, end_s, *impulses, *breaks_s, *(edge for *ends, _ in thrusts for edge in ends)}
    state = mission.initial_state.copy()
    for before, after in itertools.pairwise(sorted(edge for edge in edges if edge <= end_s)):
        state[3:] += impulses.get(before, np.zeros(3))
        middle = 0.5 * (before + after)
        thrust = sum((a for start, stop, a in thrusts if start < middle < stop), np.zeros(3))
        # An arc belongs to what holds before its end.
        rate = partial(_rate, mission, model, thrust, float(np.nextafter(after, before)))
        state = solve_ivp(rate, (before, after), state, **INTEGRATOR).y[:, -1].copy()
    return state


def _rate(
    mission: Mission, model: Mapping[str, Any], thrust: Array, last_s: float, time: float, y: Array
) -> Array:
    """Rate of the state on an arc without jumps of forces, which ends after `last_s`."""
    turn = mission.rotation.body_to_j2000(time)
    pull = turn @ np.array(model[GRAVITY].acceleration(*(turn.T @ y[:3])))
    return np.r_[y[3:], pull + model[SRP](min(time, last_s)) + thrust]


def compare_models(name: str, solution: Solution) -> list[Record]:
    """Fly every model of every effect, then the planner's together: rows."""
    plan = flight_plan(solution, solution.mission, load_vehicle())
    mission, models = plan.mission, models_of(plan)
    burns, end_s = np.array([firing.dv_m_s for firing in plan.firings]), float(mission.times_s[-1])
    thrust = plan.vehicle.chemical_thruster.thrust_n / plan.vehicle.mass.mass_kg
    truth = {effect: list(names)[-1] for effect, names in models.items()}
    legs = [leg.start_s for leg in plan.legs]

    def end(names: Mapping[str, str]) -> Array:
        model = {effect: models[effect][name] for effect, name in names.items()}
        return fly(mission, burns, model, end_s, thrust_m_s2=thrust, breaks_s=legs)[:3]

    true = end(truth)
    flown = [
        (effect, model, truth | {effect: model})
        for effect, names in models.items()
        for model in [*names][:-1]
    ]
    return [
        {
            "flight": name,
            "effect": effect,
            "model": model,
            "terminal_m": float(np.linalg.norm(end(names) - true)),
        }
        for effect, model, names in (*flown, ("together", ", ".join(PLANNER.values()), PLANNER))
    ]


def model_fidelity(_: Session) -> Tables:
    """Measure how far a flight ends from the truth by cruder models of each effect.

    The truth is a flight under the degree-8 field, light pressure on the vehicle's plates in their
    commanded attitude, and finite burns. Each effect is replaced by its cruder models in turn, then
    all by the planner's together. OUT/model_fidelity.csv has the distances.
    """
    arc = compare_models("ballistic arc", ballistic_arc(default_mission()))
    return {"model_fidelity": arc + compare_models("plan", default_plan())}


# --- battery cones --------------------------------------------------------------------------------

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


def battery_cones(_: Session) -> Tables:
    """Find the positions at which the panels cannot carry the load, and how long a recharge takes.

    Random positions on a sphere about the asteroid, the bottom face to nadir, the best rotation
    about it. Generation falls below a mode's load in two opposite cones about the Sun line; their
    half-angles, with and without calibration, go to OUT/battery_cones.csv, figures of the batteries
    to OUT/batteries.csv.
    """
    return {"battery_cones": find_cones(0), "batteries": batteries()}


# --- sources of uncertainty -----------------------------------------------------------------------

PATHS, FLIGHTS = 10_000, 4
INITIAL, CHEMICAL, NO_ERRORS = "initial_state", "chemical_thruster", "none"
ATTITUDE = ("sun_sensor", "star_tracker", "imu", "micro_thruster")
"""Sources that act on the path by way of the attitude; names are those of the vehicle's errors."""
SETS: dict[str, tuple[str, tuple[str, ...], Callable[[Errors], str]]] = {
    NO_ERRORS: ("no errors", (), lambda _: ""),
    "sun_sensor": ("sun sensor", ATTITUDE[:1], lambda e: f"{e.sun_sensor_rad:g} rad"),
    "star_tracker": ("star tracker", ATTITUDE[1:2], lambda e: f"{e.star_tracker_arcsec:g} arcsec"),
    "imu": ("IMU", ATTITUDE[2:3], lambda e: f"{e.imu_rad_s:g} rad/s"),
    "micro_thruster": ("micro-thrusters", ATTITUDE[3:], lambda e: f"{e.micro_thruster_n:g} N"),
    "attitude": ("attitude sources together", ATTITUDE, lambda _: "the four above"),
    INITIAL: ("initial state", (INITIAL,), lambda e: f"{100 * e.initial_state:g} % of each component"),
    CHEMICAL: ("chemical thruster", (CHEMICAL,),
        lambda e: f"{100 * e.chemical_thruster:g} % of the thrust"),
    "path": ("path sources together", (INITIAL, CHEMICAL), lambda _: "the two above"),
    "all": ("all together", (*ATTITUDE, INITIAL, CHEMICAL), lambda _: "all six"),
}  # fmt: skip
"""Sources that err together, in the order of the table: label, members, their 1 sigma in words."""
PATH_SETS = (INITIAL, CHEMICAL, "path")
"""Sources that are flown in the planner's dynamics; the others are flown by the whole spacecraft."""
POSITION = ("x_m", "y_m", "z_m")


def fly_spacecraft(solution: Solution, vehicle: Vehicle, case: tuple[str, int]) -> Record:
    """Simulate one flight, (key of `SETS`, seed): a source_row of the flights' CSV.

    It has the position at the planned end, J2000, and the angle between attitude and command when the
    last burn begins.
    """
    from scp_recon.simulation.basilisk import simulation  # takes seconds

    name, seed = case
    sources = [simulation.Source(source) for source in SETS[name][1]]
    entries = erring(initial=vehicle.errors.initial_state)
    solution = replace(solution, scenario=solution.scenario.replace(entries))
    flight = simulation.simulate(solution, vehicle, seed, sources=sources)
    at = int(np.searchsorted(flight.times_s, flight.plan.firings[-1].start_s))
    off = (flight.commands[at].inv() * flight.attitudes[at]).magnitude()
    ends = dict(zip(POSITION, flight.terminal_state[:3].tolist(), strict=True))
    return {"error_sources": name, "seed": seed, **ends, "attitude_error_rad": float(off)}


def dispersion(deviation: Array) -> Estimate:
    """Root mean square length of deviations that should be zero on average, m.

    Its square, the trace of their second moments S, is taken as chi-squared with Satterthwaite's
    degrees of freedom, n (tr S)^2 / tr S^2. For normal deviations that is exact along one axis; in
    three, the few degrees of freedom that a small sample shows make the interval somewhat too wide.

    Args:
        deviation: shape (n, 3).
    """
    moments = deviation.T @ deviation / len(deviation)
    trace = float(np.trace(moments))
    if trace == 0.0:
        return Estimate(0.0, 0.0, 0.0)
    freedom = len(deviation) * trace**2 / float(np.sum(moments**2))
    tail = 0.5 * (1.0 - CONFIDENCE)
    high, low = (freedom / float(chi2.ppf(p, freedom)) for p in (tail, 1.0 - tail))
    return Estimate(np.sqrt(trace), np.sqrt(trace * low), np.sqrt(trace * high))


def measure_paths(solution: Solution, vehicle: Vehicle) -> list[Record]:
    """Rows of the sources that act on the path, alone and together, in the planner's dynamics."""
    mission, errors, rows = solution.mission, vehicle.errors, list[Record]()
    planned = np.array(solution.nodes.state[-1])[:3]
    for seed, name in enumerate(PATH_SETS):
        sources, initial, thruster = SETS[name][1], errors.initial_state, errors.chemical_thruster
        entries = erring(thruster * (CHEMICAL in sources), initial * (INITIAL in sources))
        own, ends_s = mission.changed(entries), mission.times_s[-1:]
        (ends,) = Flyer(own, solution.burns_m_s, seed=seed).first_positions(ends_s, PATHS)
        rows.append(source_row(name, ends, planned, errors))
    return rows


def measure_flights(flown: Sequence[Record], errors: Errors) -> list[Record]:
    """Rows of the sets that the whole spacecraft was flown with, among them the one without errors."""
    rows = list[Record]()
    sets: dict[str, list[Record]] = {}
    for one in flown:
        sets.setdefault(one["error_sources"], []).append(one)
    ends = {key: np.array([[one[x] for x in POSITION] for one in own]) for key, own in sets.items()}
    for name, own in sets.items():
        found = source_row(name, ends[name], ends[NO_ERRORS][0], errors)
        off = max(one["attitude_error_rad"] for one in own)
        rows.append(found | {"attitude_error_deg": float(np.rad2deg(off))})
    return rows


def source_row(name: str, ends: Array, perfect: Array, errors: Errors) -> Record:
    """A source_row of the CSV: a set of sources, from where its flights end, J2000, m, shape (n, 3).

    `perfect` is the end of the flight without errors.
    """
    spread, (label, _, sigma) = dispersion(ends - perfect), SETS[name]
    return {
        "source": name,
        "label": label,
        "sigma": sigma(errors),
        "flights": len(ends),
        "rms_m": spread.value,
        "rms_m_low": spread.low,
        "rms_m_high": spread.high,
        "attitude_error_deg": "",
    }


def uncertainty_sources(session: Session) -> Tables:
    """Measure the dispersion that each source of uncertainty causes.

    Each source of the vehicle's errors is flown alone, and all together. Sources that act on the
    path directly are flown many times in the planner's dynamics. Sources that act through the
    attitude, and all sources together, are flown a few times each in the simulation of the whole
    spacecraft (extra [sim]). How far flights end from the one without errors goes to
    OUT/uncertainty_sources.csv. A run that was stopped continues with the missing flights.
    """
    vehicle, solution = load_vehicle(), default_plan()
    with needing("uncertainty_sources", "sim", "Basilisk"):
        importlib.import_module("scp_recon.simulation.basilisk.simulation")
    # Seed by seed, so that an interrupted study has as many flights of every set.
    cases = [
        (name, seed)
        for seed in range(FLIGHTS)
        for name in SETS
        if name not in PATH_SETS and (name != NO_ERRORS or not seed)
    ]
    flown = session.rows("flights", partial(fly_spacecraft, solution, vehicle), cases)
    rows = measure_paths(solution, vehicle) + measure_flights(flown, vehicle.errors)
    rows.sort(key=lambda one: [*SETS].index(one["source"]))
    return {"uncertainty_sources": rows, "uncertainty_flights": flown}


STUDIES = {
    "model_fidelity": Study(model_fidelity.__doc__, model_fidelity),
    "battery_cones": Study(battery_cones.__doc__, battery_cones),
    "uncertainty_sources": Study(uncertainty_sources.__doc__, uncertainty_sources),
}
