"""Models of a flight's forces and burns against the truth, one effect at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from experiments.kept import Kept
from experiments.model_fidelity.arcs import fly
from experiments.model_fidelity.models import PLANNER, Choices, Flight, passing

Array = npt.NDArray[np.float64]

LIMIT_M = 10.0
"""At the end of the flight: Echigo et al., section IV.B."""

TOGETHER = "together"
"""The effect of rows in which all effects are modelled at once."""


@dataclass(frozen=True)
class Compared:
    """A model against the truth.

    Attributes:
        flight: name of the case.
        effect: which is modelled, or `TOGETHER`.
        model: how.
        times_s: shape (n,).
        distance_m: from the truth, shape (n,).
        window_s: observation window.
    """

    flight: str
    effect: str
    model: str
    times_s: Array
    distance_m: Array
    window_s: tuple[float, float]

    @property
    def terminal_m(self) -> float:
        """At the end of the flight."""
        return float(self.distance_m[-1])

    @property
    def window_m(self) -> float:
        """Largest in the observation window."""
        first, last = self.window_s
        return float(self.distance_m[(self.times_s >= first) & (self.times_s <= last)].max())

    @property
    def passes(self) -> bool:
        """Whether the model is good enough."""
        return self.terminal_m < LIMIT_M


def compare(flight: Flight, kept: Kept, tell: Callable[[], None] = lambda: None) -> list[Compared]:
    """Every model of every effect, then the named ones and the planner's together.

    Distances that are kept are not flown again; the truth is.
    """
    mission, choices = flight.plan.mission, Choices.of(flight)
    vehicle = flight.plan.vehicle

    def path(names: dict[str, str]) -> Array:
        states = fly(
            mission,
            flight.burns_m_s,
            choices.model(names),
            mission.times_s,
            thrust_acceleration_m_s2=vehicle.chemical_thruster.thrust_n / vehicle.mass.mass_kg,
            breaks_s=flight.breaks_s,
        )
        return states[:, :3]

    truth = path(choices.truth)
    tell()

    def against_truth(effect: str, model: str, names: dict[str, str]) -> Compared:
        row = kept.row(
            f"{flight.name}, {effect}, {model}",
            lambda: {"distance_m": np.linalg.norm(path(names) - truth, axis=1).tolist()},
        )
        tell()
        distance, window_s = np.array(row["distance_m"]), mission.schedule.window_s
        return Compared(flight.name, effect, model, mission.times_s, distance, window_s)

    found = [against_truth(*single) for single in choices.single()]
    lowest = {effect: _named(found, effect, names) for effect, names in choices.effects.items()}
    found.append(against_truth(TOGETHER, ", ".join(lowest.values()), lowest))
    found.append(against_truth(TOGETHER, ", ".join(PLANNER.values()), PLANNER))
    return found


def flown_models(flight: Flight) -> int:
    """How many flights `compare` makes."""
    return 3 + sum(1 for _ in Choices.of(flight).single())


def _named(found: Sequence[Compared], effect: str, names: list[str]) -> str:
    return passing(names, terminal_distances(found, effect), LIMIT_M)


def terminal_distances(found: Sequence[Compared], effect: str) -> dict[str, float]:
    """Distances from the truth at the end by model, m, of an effect."""
    return {entry.model: entry.terminal_m for entry in found if entry.effect == effect}
