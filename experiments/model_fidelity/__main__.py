"""How good a model the planner needs: `python -m experiments.model_fidelity`.

A flight under the degree-8 field, light pressure on the vehicle's plates in their commanded attitude
and finite burns is the truth. Each of these is replaced by its cruder models in turn, and the distance
at the end of the flight decides: of every effect the crudest model that stays within 10 m is named.
Written are OUT/model_fidelity.csv, .md and, with the distances over time, model_fidelity_history.csv.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint, parse

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from experiments.kept import Kept
from experiments.model_fidelity.arcs import fly
from experiments.model_fidelity.models import PLANNER, Choices, Flight, passing, relapses
from experiments.observation_table.rows import rows
from experiments.studies import Cell, add_out, markdown, run, to_csv
from scp_recon.files import write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.scenario.load import load_scenario
from scp_recon.solution.file import read_solution
from scp_recon.spacecraft.vehicle import Vehicle, load_vehicle

Array = npt.NDArray[np.float64]

NAME = "model_fidelity"
HISTORY = f"{NAME}_history.csv"
DEFAULT_OUT = Path("runs") / NAME
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
    return passing(names, _terminal(found, effect), LIMIT_M)


def _terminal(found: Sequence[Compared], effect: str) -> dict[str, float]:
    return {entry.model: entry.terminal_m for entry in found if entry.effect == effect}


def flights(mission: Mission, vehicle: Vehicle, solution: Path | None) -> list[Flight]:
    """The departure burn alone, as the paper flies it, and a plan."""
    designs = {row.key: row.design for row in rows(ipopt=False)}
    arc = designs["ballistic"](mission)
    plan = read_solution(solution) if solution else designs["scp_cold"](mission)
    same = Mission.from_scenario(plan.scenario)
    return [
        Flight.of("ballistic arc", arc, mission, vehicle),
        Flight.of("plan", plan, same, vehicle),
    ]


def effects_of(entries: Sequence[Compared]) -> dict[str, list[str]]:
    """Names of the compared models of each effect, in their order."""
    found: dict[str, list[str]] = {}
    for entry in entries:
        if entry.effect != TOGETHER and entry.model not in found.setdefault(entry.effect, []):
            found[entry.effect].append(entry.model)
    return found


def records(entries: Sequence[Compared]) -> list[dict[str, Cell]]:
    """Rows of the CSV."""
    lines: list[dict[str, Cell]] = []
    for entry in entries:
        of_flight = [e for e in entries if e.flight == entry.flight]
        named = (
            entry.effect != TOGETHER
            and _lowest(of_flight, entry.effect) == entry.model
        )  # fmt: skip
        lines.append(
            {
                "flight": entry.flight,
                "effect": entry.effect,
                "model": entry.model,
                "terminal_m": entry.terminal_m,
                "window_max_m": entry.window_m,
                "limit_m": LIMIT_M,
                "passes": entry.passes,
                "lowest_that_passes": named,
            }
        )
    return lines


def _lowest(of_flight: Sequence[Compared], effect: str) -> str:
    """The named model of an effect; the truth, which is not compared with itself, has no name here."""
    names = [*effects_of(of_flight)[effect], "the truth"]
    return passing(names, _terminal(of_flight, effect), LIMIT_M)


def verdicts(entries: Sequence[Compared]) -> list[str]:
    """The rule applied, flight by flight."""
    words = []
    for name in dict.fromkeys(entry.flight for entry in entries):
        of_flight = [entry for entry in entries if entry.flight == name]
        for effect, models in effects_of(of_flight).items():
            terminal = _terminal(of_flight, effect)
            lowest = _lowest(of_flight, effect)
            again = relapses([*models, "the truth"], terminal, LIMIT_M)
            caveat = f"; but not {', '.join(again)}" if again else ""
            value = f" ({terminal[lowest]:.2f} m)" if lowest in terminal else ""
            words.append(
                f"{name}, {effect}: lowest fidelity within {LIMIT_M:g} m is {lowest}{value}{caveat}."
            )
        for entry in of_flight:
            if entry.effect == TOGETHER:
                verdict = "within" if entry.passes else "NOT within"
                words.append(
                    f"{name}, together: {entry.model} end {entry.terminal_m:.2f} m off, "
                    f"{verdict} {LIMIT_M:g} m."
                )
    return words


def to_markdown(entries: Sequence[Compared]) -> str:
    """The tables, flight by flight, and the verdicts."""
    parts = ["# Model fidelity"]
    for name in dict.fromkeys(entry.flight for entry in entries):
        lines = [
            (
                entry.effect,
                entry.model,
                f"{entry.terminal_m:.3g}",
                f"{entry.window_m:.3g}",
                "yes" if entry.passes else "no",
            )
            for entry in entries
            if entry.flight == name
        ]
        header = ("effect", "model", "at the end (m)", "most in the window (m)", "within the limit")
        parts += [f"## {name.capitalize()}", markdown(header, lines)]
    parts += ["## The rule applied", "\n".join(f"- {verdict}" for verdict in verdicts(entries))]
    parts.append(
        "Distances from the truth: degree-8 field turning with the body, light on the vehicle's plates "
        "in the commanded attitude (slews take no time), thrust from the firing time on. J2 is the "
        "oblateness alone, degree 2 has the equator's ellipticity too. The paper's arc has one burn, "
        "at departure; so has the ballistic arc, which stands for it."
    )
    return "\n\n".join(parts) + "\n"


def history(entries: Sequence[Compared]) -> list[dict[str, Cell]]:
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


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog=f"python -m experiments.{NAME}", description=__doc__)
    add_out(p, DEFAULT_OUT)
    p.add_argument(
        "--solution",
        type=Path,
        metavar="DIR",
        help="plan to fly (default: the default scenario's from a cold start)",
    )
    p.add_argument(
        "--vehicle", type=Path, metavar="FILE", help="vehicle file (default: the packaged DARE)"
    )
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 if everything was written, 2 for bad input."""
    return run(_run, parse(parser(), arguments))


def _run(options: argparse.Namespace) -> int:
    mission, vehicle = Mission.from_scenario(load_scenario()), load_vehicle(options.vehicle)
    options.out.mkdir(parents=True, exist_ok=True)
    cases = flights(mission, vehicle, options.solution)
    flown = {case.name: json.dumps(case.burns_m_s.tolist()) for case in cases}
    kept = Kept(
        options.out / f"{NAME}_partial.jsonl", __file__, {**flown, "vehicle": repr(vehicle)}
    )
    columns = (TextColumn("flights"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=sum(map(flown_models, cases)))
        entries = [e for case in cases for e in compare(case, kept, lambda: progress.advance(task))]
    files = {
        f"{NAME}.csv": to_csv(records(entries)),
        f"{NAME}.md": to_markdown(entries),
        HISTORY: to_csv(history(entries)),
    }
    written = [write_atomically(options.out / name, text) for name, text in files.items()]
    kept.forget()
    for line in verdicts(entries):
        print(line)
    for path in written:
        print(f"written: {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
