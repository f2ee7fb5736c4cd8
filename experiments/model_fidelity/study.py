"""Find the crudest model of each effect that is accurate enough for the planner.

The truth is a flight under the degree-8 field, light pressure on the vehicle's plates in their
commanded attitude, and finite burns. Each effect is replaced by its cruder models in turn; the crudest
model whose flight ends within 10 m of the truth is named. Writes OUT/model_fidelity.csv, .md and, with
the distances over time, model_fidelity_history.csv.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.harness import (
    PLAN,
    VEHICLE,
    Claim,
    Findings,
    Record,
    Session,
    Study,
    plan_or_default,
    records,
    view,
)
from experiments.model_fidelity.models import PLANNER, Choices, Flight, fly, passing, relapses
from formulations.arrays import Array
from scp_recon.jobs.job import Job
from scp_recon.jobs.store import Store
from scp_recon.mission.mission import Mission
from scp_recon.results.solution import ballistic_arc
from scp_recon.results.table import Column, Table
from scp_recon.scenario.load import load_scenario
from scp_recon.simulation.vehicle import Vehicle, load_vehicle

TRUTH = "the truth"

LIMIT_M = 10.0
"""At the end of the flight: Echigo et al., section IV.B."""

TOGETHER = "together"
"""The effect of rows in which all effects are modelled at once."""


@dataclass(frozen=True)
class Compared:
    """A model of an effect, or of all `TOGETHER`: its distance from the truth over time, shape (n,)."""

    flight: str
    effect: str
    model: str
    times_s: Array
    distance_m: Array
    window_s: tuple[float, float]

    @property
    def terminal_m(self) -> float:
        """Distance at the end of the flight, m."""
        return float(self.distance_m[-1])

    @property
    def window_m(self) -> float:
        """Largest distance in the observation window, m."""
        first, last = self.window_s
        return float(self.distance_m[(self.times_s >= first) & (self.times_s <= last)].max())

    @property
    def passes(self) -> bool:
        """Whether the model is good enough."""
        return self.terminal_m < LIMIT_M


def compare(flight: Flight, session: Session, store: Store) -> list[Compared]:
    """Fly every model of every effect, then the named ones and the planner's together.

    Kept distances are not computed again; the truth is always flown.
    """
    mission, choices, vehicle = flight.plan.mission, Choices.of(flight), flight.plan.vehicle

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

    def distances(names: dict[str, str]) -> Record:
        return {"distance_m": np.linalg.norm(path(names) - truth, axis=1).tolist()}

    def against_truth(cases: Sequence[tuple[str, str, dict[str, str]]]) -> list[Compared]:
        jobs = [Job(f"{flight.name}, {effect}, {model}", names) for effect, model, names in cases]
        rows = session.rows(flight.name, distances, jobs, store)
        times, window = mission.times_s, mission.schedule.window_s
        return [
            Compared(flight.name, effect, model, times, np.array(row["distance_m"]), window)
            for (effect, model, _), row in zip(cases, rows, strict=True)
        ]

    found = against_truth(list(choices.single()))
    lowest = {
        effect: passing(names, terminal_distances(found, effect), LIMIT_M)
        for effect, names in choices.effects.items()
    }
    together = [(TOGETHER, ", ".join(names.values()), names) for names in (lowest, PLANNER)]
    return [*found, *against_truth(together)]


def terminal_distances(found: Sequence[Compared], effect: str) -> dict[str, float]:
    """Distances from the truth at the end by model, m, of an effect."""
    return {entry.model: entry.terminal_m for entry in found if entry.effect == effect}


def effects_of(entries: Sequence[Compared]) -> dict[str, list[str]]:
    """Names of the compared models of each effect in order, the truth last."""
    found: dict[str, list[str]] = {}
    for entry in entries:
        if entry.effect != TOGETHER and entry.model not in found.setdefault(entry.effect, []):
            found[entry.effect].append(entry.model)
    return {effect: [*models, TRUTH] for effect, models in found.items()}


def by_flight(entries: Sequence[Compared]) -> dict[str, list[Compared]]:
    """Entries of each flight, by its name."""
    names = dict.fromkeys(entry.flight for entry in entries)
    return {name: [entry for entry in entries if entry.flight == name] for name in names}


def table(entries: Sequence[Compared]) -> list[Record]:
    """Rows of the CSV."""
    lines = []
    for own in by_flight(entries).values():
        lowest = {
            (effect, passing(models, terminal_distances(own, effect), LIMIT_M))
            for effect, models in effects_of(own).items()
        }
        lines += [
            {
                "flight": entry.flight,
                "effect": entry.effect,
                "model": entry.model,
                "terminal_m": entry.terminal_m,
                "window_max_m": entry.window_m,
                "limit_m": LIMIT_M,
                "passes": entry.passes,
                "lowest_that_passes": (entry.effect, entry.model) in lowest,
            }
            for entry in own
        ]
    return lines


def claims(entries: Sequence[Compared]) -> list[Claim]:
    """Claims by flight: the crudest sufficient model of each effect, and several together."""
    found, threshold = [], f"within {LIMIT_M:g} m"
    for name, own in by_flight(entries).items():
        for effect, models in effects_of(own).items():
            terminal = terminal_distances(own, effect)
            lowest, again = (rule(models, terminal, LIMIT_M) for rule in (passing, relapses))
            words = f"{name}, {effect}: lowest fidelity is {lowest}"
            words += f", but not {', '.join(again)}" if again else ""
            measured = f"{terminal[lowest]:.2f} m" if lowest in terminal else "no model"
            found.append(Claim(words, threshold, measured, lowest != TRUTH))
        found += [
            Claim(f"{name}, together: {e.model}", threshold, f"{e.terminal_m:.2f} m", e.passes)
            for e in own
            if e.effect == TOGETHER
        ]
    return found


def report(entries: Sequence[Compared]) -> list[str | Table]:
    """The tables, flight by flight."""
    columns: dict[str, Column | str] = {
        "effect": "effect",
        "model": "model",
        "terminal_m": Column("at the end", "m", ".3g"),
        "window_max_m": Column("most in the window", "m", ".3g"),
        "passes": "within the limit",
    }
    tables = [
        view(name.capitalize(), table(own), columns) for name, own in by_flight(entries).items()
    ]
    return [
        *tables,
        "Distances from the truth: degree-8 field turning with the body, light on the vehicle's plates "
        "in the commanded attitude (slews take no time), thrust from the firing time on. J2 is the "
        "oblateness alone, degree 2 has the equator's ellipticity too. The paper's arc has one burn, "
        "at departure; so has the ballistic arc, which stands for it.",
    ]


def history(entries: Sequence[Compared]) -> list[Record]:
    """Distances over time in long form."""
    return [
        {
            "flight": entry.flight,
            "effect": entry.effect,
            "model": entry.model,
            "t_s": time,
            "distance_m": distance,
        }
        for entry in entries
        for time, distance in zip(entry.times_s.tolist(), entry.distance_m.tolist(), strict=True)
    ]


def flights(mission: Mission, vehicle: Vehicle, solution: Path | None) -> list[Flight]:
    """The departure burn alone, as the paper flies it, and a plan."""
    plan = plan_or_default(solution)
    return [
        Flight.of("ballistic arc", ballistic_arc(mission), mission, vehicle),
        Flight.of("plan", plan, plan.mission, vehicle),
    ]


def run(session: Session) -> Findings:
    """Fly every model of every effect on both flights."""
    options = session.options
    mission, vehicle = Mission.from_scenario(load_scenario()), load_vehicle(options.vehicle)
    cases = flights(mission, vehicle, options.solution)
    flown = {case.name: json.dumps(case.burns_m_s.tolist()) for case in cases}
    store = session.store(**flown, vehicle=repr(vehicle))
    entries = [entry for case in cases for entry in compare(case, session, store)]
    return Findings(
        report(entries),
        {
            "model_fidelity.csv": records(table(entries)),
            "model_fidelity_history.csv": records(history(entries)),
        },
        claims(entries),
    )


STUDY = Study("Model fidelity", __doc__, run, (PLAN, VEHICLE))
