"""Measure how far a flight ends from the truth by cruder models of each effect.

The truth is a flight under the degree-8 field, light pressure on the vehicle's plates in their
commanded attitude, and finite burns. Each effect is replaced by its cruder models in turn, then all by
the planner's together. OUT/model_fidelity.csv has the distances.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from experiments.harness import Record, Session, Study, Tables, default_mission, default_plan
from formulations.arrays import Array
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import HARMONICS_DEGREE
from scp_recon.mission.schedule import Mode
from scp_recon.physics.forces import SPEED_OF_LIGHT_M_S
from scp_recon.physics.frames import unit
from scp_recon.physics.harmonics import HarmonicField
from scp_recon.results.solution import Solution, ballistic_arc
from scp_recon.simulation.guidance import FlightPlan
from scp_recon.simulation.panels import irradiance
from scp_recon.simulation.vehicle import Vehicle, load_vehicle

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


def compare(name: str, solution: Solution) -> list[Record]:
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


def run(_: Session) -> Tables:
    """Fly every model on the plan, and on the departure burn alone, as the paper does."""
    arc = compare("ballistic arc", ballistic_arc(default_mission()))
    return {"model_fidelity": arc + compare("plan", default_plan())}


STUDY = Study(__doc__, run)
