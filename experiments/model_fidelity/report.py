"""Tables and verdicts of the compared models."""

from __future__ import annotations

from collections.abc import Sequence

from experiments.model_fidelity.compared import LIMIT_M, TOGETHER, Compared, terminal_distances
from experiments.model_fidelity.models import passing, relapses
from experiments.studies import Cell, markdown


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
    return passing(names, terminal_distances(of_flight, effect), LIMIT_M)


def verdicts(entries: Sequence[Compared]) -> list[str]:
    """The rule applied, flight by flight."""
    words = []
    for name in dict.fromkeys(entry.flight for entry in entries):
        of_flight = [entry for entry in entries if entry.flight == name]
        for effect, models in effects_of(of_flight).items():
            terminal = terminal_distances(of_flight, effect)
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
