"""The models that the fidelity study compares: for each effect, from the crudest to the truth."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from experiments.model_fidelity.arcs import Firing, Model
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import Mode
from scp_recon.mission.truth import HARMONICS_DEGREE
from scp_recon.physics.forces import SPEED_OF_LIGHT_M_S
from scp_recon.physics.harmonics import HarmonicField
from scp_recon.solution.file import Solution
from scp_recon.spacecraft.guidance import FlightPlan
from scp_recon.spacecraft.panels import irradiance
from scp_recon.spacecraft.plates import Plates
from scp_recon.spacecraft.vehicle import Vehicle

Array = npt.NDArray[np.float64]

SRP, GRAVITY, BURNS = "solar radiation pressure", "gravity", "burns"
PLANNER = {SRP: "cannonball", GRAVITY: "J2", BURNS: "impulsive"}
"""What the planner flies."""

ATTITUDE_STEP_S = 60.0
"""Spacing at which the commanded attitude is turned into a force, linear in between."""


@dataclass(frozen=True)
class Flight:
    """What is flown.

    Attributes:
        name: of the case.
        plan: burns, and the attitude commanded along them.
    """

    name: str
    plan: FlightPlan

    @classmethod
    def of(cls, name: str, solution: Solution, mission: Mission, vehicle: Vehicle) -> Flight:
        """A solution's burns; where one of them is zero the panels stay on the Sun."""
        plan = FlightPlan.of(solution, mission, vehicle)
        idle = {f.end_s for f in plan.firings if not f.dv_m_s.any()}
        legs = tuple(
            replace(leg, mode=Mode.SUN_POINTING) if leg.end_s in idle else leg for leg in plan.legs
        )
        return cls(name, replace(plan, legs=legs))

    @property
    def burns_m_s(self) -> Array:
        """Shape (m, 3)."""
        return np.array([firing.dv_m_s for firing in self.plan.firings])

    @property
    def breaks_s(self) -> tuple[float, ...]:
        """Where the attitude jumps."""
        return tuple(leg.start_s for leg in self.plan.legs)


@dataclass(frozen=True)
class Choices:
    """For each effect its models by name, in the order of their fidelity; the last is the truth."""

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
        """The truth with one effect modelled otherwise: effect, model, all choices."""
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


def passing(names: list[str], displacement: dict[str, float], limit: float) -> str:
    """The lowest fidelity within the limit, the truth if no other is."""
    return next(name for name in names if displacement.get(name, 0.0) < limit)


def relapses(names: list[str], displacement: dict[str, float], limit: float) -> list[str]:
    """Models above the one that passes which do not: more fidelity need not be better."""
    chosen = passing(names, displacement, limit)
    above = itertools.islice(names, names.index(chosen) + 1, None)
    return [name for name in above if displacement.get(name, 0.0) >= limit]
