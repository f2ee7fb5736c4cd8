"""Define models of each effect, from the crudest to the truth, and fly with them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate import solve_ivp

from formulations.arrays import Array
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import HARMONICS_DEGREE
from scp_recon.mission.schedule import Mode
from scp_recon.physics.forces import SPEED_OF_LIGHT_M_S
from scp_recon.physics.frames import unit
from scp_recon.physics.harmonics import HarmonicField
from scp_recon.results.solution import Solution
from scp_recon.simulation.guidance import FlightPlan
from scp_recon.simulation.panels import irradiance
from scp_recon.simulation.vehicle import Vehicle

SRP, GRAVITY, BURNS = "solar radiation pressure", "gravity", "burns"
PLANNER = {SRP: "cannonball", GRAVITY: "J2", BURNS: "impulsive"}
"""The planner's own models."""

ATTITUDE_STEP_S = 60.0
"""Spacing at which the commanded attitude is turned into a force, linear in between."""


@dataclass(frozen=True)
class Flight:
    """A flight by name: its burns, and the attitude commanded."""

    name: str
    plan: FlightPlan

    @classmethod
    def of(cls, name: str, solution: Solution, mission: Mission, vehicle: Vehicle) -> Flight:
        """The flight of a solution; with a burn of zero the panels stay on the Sun."""
        plan = FlightPlan.of(solution, mission, vehicle)
        idle = {f.end_s for f in plan.firings if not f.dv_m_s.any()}
        legs = tuple(
            replace(leg, mode=Mode.SUN_POINTING) if leg.end_s in idle else leg for leg in plan.legs
        )
        return cls(name, replace(plan, legs=legs))

    @property
    def burns_m_s(self) -> Array:
        """Burns, J2000, m/s, shape (m, 3)."""
        return np.array([firing.dv_m_s for firing in self.plan.firings])

    @property
    def breaks_s(self) -> tuple[float, ...]:
        """Times at which the attitude jumps, s."""
        return tuple(leg.start_s for leg in self.plan.legs)


RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 1e-11, 1e-9
"""Of the integrator; together they are worth less than 0.1 mm at the end of the flight."""


@dataclass(frozen=True)
class Firing:
    """Model of a burn.

    Attributes:
        finite: whether thrust lasts from the firing time on; otherwise it is an impulse.
        late: delay of an impulse after the firing time, over the firing's length.
    """

    finite: bool
    late: float = 0.0


@dataclass(frozen=True)
class Model:
    """A model of the flight; `srp` gives the acceleration by sunlight, J2000, m/s^2, at a time in s."""

    gravity: HarmonicField
    srp: Callable[[float], Array]
    firing: Firing


def fly(
    mission: Mission,
    burns_m_s: Array,
    model: Model,
    times_s: Array,
    *,
    thrust_acceleration_m_s2: float,
    breaks_s: tuple[float, ...] = (),
) -> Array:
    """States before any burn at the same time, J2000, m and m/s, shape (n, 6).

    Args:
        mission: initial state, rotation and firing times.
        burns_m_s: planned burns, shape (m, 3); they may be zero.
        model: model of the flight.
        times_s: ascending times of the states, from 0 on.
        thrust_acceleration_m_s2: while firing; it is constant, the propellant being a ten-thousandth.
        breaks_s: times at which `model.srp` may jump.
    """
    lengths = np.linalg.norm(burns_m_s, axis=1) / thrust_acceleration_m_s2
    starts = np.array(mission.scenario.burns.times_s)
    impulses: dict[float, Array] = {}
    thrusts: list[tuple[float, float, Array]] = []
    for start, length, burn in zip(starts.tolist(), lengths.tolist(), burns_m_s, strict=True):
        if model.firing.finite:
            thrusts.append((start, start + length, burn / length if length else burn))
        else:
            impulses[start + model.firing.late * length] = burn
    end = float(times_s[-1])
    edges = {0.0, end, *impulses, *breaks_s}
    edges |= {edge for start, stop, _ in thrusts for edge in (start, stop)}
    stops = sorted(edge for edge in edges if edge <= end)

    state = mission.initial_state.copy()
    seen = [state[None].copy()] if times_s[0] == 0.0 else []
    for before, after in itertools.pairwise(stops):
        state[3:] += impulses.get(before, np.zeros(3))
        middle = 0.5 * (before + after)
        thrust = sum((a for start, stop, a in thrusts if start < middle < stop), np.zeros(3))
        looks = times_s[(times_s > before) & (times_s <= after)]
        states = _arc(mission, model, state, np.union1d(looks, after), before, thrust)
        seen.append(states[: len(looks)])
        state = states[-1].copy()
    return np.concatenate(seen)


def _arc(
    mission: Mission, model: Model, state: Array, looks: Array, start: float, thrust: Array
) -> Array:
    """States at some times of an arc without jumps of forces; the last time is its end."""
    stop = float(looks[-1])
    inside = np.nextafter(stop, start)  # an arc belongs to what holds before its end

    def rate(time: float, y: Array) -> Array:
        to_j2000 = mission.rotation.body_to_j2000(time)
        gravity = np.array(model.gravity.acceleration(*(to_j2000.T @ y[:3])))
        return np.concatenate([y[3:], to_j2000 @ gravity + model.srp(min(time, inside)) + thrust])

    found = solve_ivp(
        rate,
        (start, stop),
        state,
        method="DOP853",
        t_eval=looks,
        rtol=RELATIVE_TOLERANCE,
        atol=ABSOLUTE_TOLERANCE,
    )
    return found.y.T


@dataclass(frozen=True)
class Choices:
    """Models of each effect by name, in ascending fidelity; the last is the truth."""

    srp: dict[str, Callable[[float], Array]]
    gravity: dict[str, HarmonicField]
    burns: dict[str, Firing]

    @classmethod
    def of(cls, flight: Flight) -> Choices:
        """All models of a flight."""
        mission = flight.plan.mission
        gm = mission.scenario.body.gm_m3_s2
        degrees = {n: HarmonicField.bennu(gm, n) for n in range(HARMONICS_DEGREE + 1)}
        named = {f"degree {n}": field for n, field in degrees.items()}
        gravity = {k: named[k] for k in ("degree 0", "degree 1")} | {"J2": _zonal(degrees[2])}
        nothing = np.zeros(3)
        return cls(
            {
                "none": lambda _: nothing,
                "cannonball": lambda _: mission.forces.srp,
                "N-plate": _plate_srp(flight.plan),
            },
            gravity | named,
            {
                "impulsive": Firing(finite=False),
                "impulsive, mid-firing": Firing(finite=False, late=0.5),
                "finite": Firing(finite=True),
            },
        )

    @property
    def effects(self) -> dict[str, list[str]]:
        """Names of the models of each effect."""
        return {SRP: list(self.srp), GRAVITY: list(self.gravity), BURNS: list(self.burns)}

    @property
    def truth(self) -> dict[str, str]:
        """Name of each effect's truth."""
        return {effect: names[-1] for effect, names in self.effects.items()}

    def model(self, names: dict[str, str]) -> Model:
        """The model with these choices."""
        return Model(self.gravity[names[GRAVITY]], self.srp[names[SRP]], self.burns[names[BURNS]])

    def single(self) -> Iterator[tuple[str, str, dict[str, str]]]:
        """Choices that differ from the truth in one effect: effect, model, all choices."""
        for effect, names in self.effects.items():
            for name in names[:-1]:
                yield effect, name, self.truth | {effect: name}


def _zonal(field: HarmonicField) -> HarmonicField:
    """The planner's gravity: the field's oblateness alone."""
    c = np.zeros_like(field.c)
    c[0, 0], c[2, 0] = field.c[0, 0], field.c[2, 0]
    return HarmonicField(field.gm, field.radius, c, np.zeros_like(field.s))


def _plate_srp(plan: FlightPlan) -> Callable[[float], Array]:
    """Acceleration of the vehicle's plates in its commanded attitude, J2000, m/s^2, of the time."""
    plates, vehicle, mission = Plates.of(plan.vehicle), plan.vehicle, plan.mission
    scale = irradiance(mission.scenario) / SPEED_OF_LIGHT_M_S / vehicle.mass.mass_kg
    times, values = [], []
    for leg in plan.legs:
        count = max(2, int(np.ceil((leg.end_s - leg.start_s) / ATTITUDE_STEP_S)) + 1)
        inside = np.linspace(leg.start_s, np.nextafter(leg.end_s, leg.start_s), count)
        to_j2000 = plan.attitudes(inside).as_matrix()
        sun_body = np.einsum("nji,nj->ni", to_j2000, mission.sun_direction(inside))
        force = plates.force_per_pressure(sun_body)
        times.append(inside)
        values.append(scale * np.einsum("nij,nj->ni", to_j2000, force))
    starts = np.array([leg.start_s for leg in plan.legs])

    def acceleration(time: float) -> Array:
        leg = max(0, int(np.searchsorted(starts, time, side="right")) - 1)
        return np.array([np.interp(time, times[leg], values[leg][:, i]) for i in range(3)])

    return acceleration


@dataclass(frozen=True)
class Plates:
    """The N-plate model of a rigid body; plates do not shade each other.

    Attributes:
        normals: outward unit vectors, body frame, shape (n, 3).
        areas_m2: shape (n,).
        specular, diffuse: fractions of the light that are reflected like that, shape (n,).
    """

    normals: Array
    areas_m2: Array
    specular: Array
    diffuse: Array

    @classmethod
    def of(cls, vehicle: Vehicle) -> Plates:
        """A vehicle's faces and the cells of its panels."""
        plates = vehicle.plates
        return cls(
            unit([plate.normal for plate in plates]),
            np.array([plate.area_m2 for plate in plates]),
            np.array([plate.specular for plate in plates]),
            np.array([plate.diffuse for plate in plates]),
        )

    def force_per_pressure(self, sun_body: Array) -> Array:
        """Force over the pressure of sunlight, body frame, m^2.

        -sum_i A_i cos_i ((1 - rho_s) s + 2 (rho_s cos_i + rho_d / 3) n_i) over the plates with
        cos_i = n_i . s > 0: Montenbruck & Gill, Satellite Orbits, eq. 3.73, with Lambert's law.

        Args:
            sun_body: unit vectors to the Sun, body frame, shape (..., 3).

        Returns:
            Shape (..., 3).
        """
        cosine = np.maximum(0.0, sun_body @ self.normals.T)
        lit = self.areas_m2 * cosine
        along_sun = (lit * (1.0 - self.specular)).sum(axis=-1, keepdims=True) * sun_body
        reflected = 2.0 * lit * (self.specular * cosine + self.diffuse / 3.0)
        return -along_sun - reflected @ self.normals


def passing(names: list[str], displacement: dict[str, float], limit: float) -> str:
    """Lowest fidelity within the limit; the truth if there is no other."""
    return next(name for name in names if displacement.get(name, 0.0) < limit)


def relapses(names: list[str], displacement: dict[str, float], limit: float) -> list[str]:
    """Models of higher fidelity than the one that passes, but beyond the limit."""
    chosen = passing(names, displacement, limit)
    above = itertools.islice(names, names.index(chosen) + 1, None)
    return [name for name in above if displacement.get(name, 0.0) >= limit]
