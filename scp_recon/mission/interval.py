"""Hold a quantity of a scenario to two intervals; `intervals` has the rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from scp_recon.display import digits, exact
from scp_recon.errors import InputError
from scp_recon.mission.scene import Scene
from scp_recon.scenario.fields import ScenarioWarning, unit_hint
from scp_recon.scenario.given import shown

Ends = tuple[float, float]
"""Ends of an interval; an infinite one bounds nothing."""
INF = math.inf


@dataclass(frozen=True)
class Interval:
    """A quantity of a scenario, and the intervals that refuse it or warn of it."""

    entries: str
    """Dotted paths, separated by spaces; each has the quantity."""
    quantity: str = ""
    """Bounded quantity in words; the entry itself, or its length, if empty."""
    value: Callable[[Scene, str], float | None] = lambda scene, entry: size(value_at(scene, entry))
    """The quantity of an entry; None where the row does not apply."""
    unit: str = ""
    refuse: Ends | None = None
    warn: Ends | None = None
    hint: str = ""
    """The likely slip, or the reason."""
    or_zero: bool = False
    """Whether zero is meant, and never in question."""
    scale: tuple[Callable[[Scene, str], float | None], str] | None = None
    """Unit of the ends, as a function, and its name; None where the row does not apply."""

    def check(self, scene: Scene) -> Iterator[ScenarioWarning]:
        """Check a scene against the row; yield its warnings.

        Raises:
            InputError: naming the entry, what was given and what is allowed.
        """
        for entry in self.entries.split():
            value = self.value(scene, entry)
            if value is None or (self.or_zero and value == 0.0):
                continue
            scale = self.scale[0](scene, entry) if self.scale else 1.0
            if scale is None:
                continue
            if self.refuse and not self.refuse[0] <= value / scale <= self.refuse[1]:
                allowed = f"must be {self._expected(self.refuse, scale, value)}"
                raise InputError(entry, self._shown(value_at(scene, entry), value), allowed)
            if self.warn and not self.warn[0] <= value / scale <= self.warn[1]:
                expected = f"expected {self._expected(self.warn, scale, value)}"
                given = self._shown(value_at(scene, entry), value)
                yield ScenarioWarning.of(entry, given, expected)

    def _shown(self, given: Any, value: float) -> str:
        """The quantity beside the number or vector it is computed from."""
        if not self.quantity:
            text = exact(value) if isinstance(given, float) else _number(value)
            return f"{text} {self.unit}".rstrip()
        number = f"{self.quantity}: {_number(value, 3)} {self.unit}".rstrip()
        if isinstance(given, tuple) and (len(given) > 3 or isinstance(given[0], tuple)):
            return number
        return f"{shown(given)} ({number})"

    def _expected(self, ends: Ends, scale: float, value: float) -> str:
        hint = self.hint
        if "?" not in hint and self.unit:
            hint += unit_hint(self.unit, value, ends[0] * scale, ends[1] * scale)
        if self.scale is None:
            return f"{self.within(ends)}{hint}"
        absolute = _within((ends[0] * scale, ends[1] * scale), self.unit)
        relative = _within(ends, self.scale[1]).removeprefix("at least ").removeprefix("at most ")
        return f"{self._zero(ends)}{absolute} ({relative}){hint}"

    def within(self, ends: Ends) -> str:
        """An interval in words: "300 to 8000 kg/m^3", "0, or at least 60 s", "at most 2 radii"."""
        words = _within(ends, self.scale[1] if self.scale else self.unit)
        return f"{self._zero(ends)}{words}"

    def _zero(self, ends: Ends) -> str:
        """Words on a zero that is meant where the interval does not hold it."""
        return "0, or " if self.or_zero and ends[0] > 0.0 else ""


VAST = 1e7
"""Numbers from here on have an exponent."""


def _number(value: float, figures: int = 4) -> str:
    return digits(value, figures) if abs(value) < VAST else f"{value:.{figures}g}"


def _within(ends: Ends, unit: str) -> str:
    low, high = ends
    words = f"{_number(low)} to {_number(high)}"
    if high == INF:
        words = f"at least {_number(low)}"
    elif low == -INF:
        words = f"at most {_number(high)}"
    words = f"{words} {unit}".rstrip()
    return words.replace(" 1 times ", " ") if words.startswith("at ") else words


def value_at(scene: Scene, entry: str) -> Any:
    """Value of a scenario at a dotted path; None below a table that it lacks."""
    found: Any = scene.scenario
    for key in entry.split("."):
        found = getattr(found, key, None)
    return found


def size(given: Any) -> float | None:
    """A number, or the length of a vector."""
    if given is None:
        return None
    return math.hypot(*given) if isinstance(given, tuple) else float(given)
