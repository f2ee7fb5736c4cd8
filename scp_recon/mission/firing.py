"""Make firing times, and phases on a home orbit, controls within spans and the schedule's rules."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from formulations.arrays import Array, Indices
from formulations.problem.firing_times import Boundary, FiringTimes
from scp_recon.mission.schedule import ROOM_S, Interval, burns_before, timing_rules
from scp_recon.mission.windows import Window
from scp_recon.scenario.schema import Scenario

FREE_SPAN_S = 1e-3
"""Span below which a time counts as given."""
FREE_SPAN = 1e-9
"""Span below which a phase counts as given, rad."""
TURN = 2.0 * np.pi

Ring = Callable[[float], Array]
"""States by phase, rad, of any turn; the waiting spacecraft may be at any of them at any time.

Position and velocity, J2000, body-centred, m and m/s, shape (6,).
"""


@dataclass(frozen=True, eq=False)
class HomePhases:
    """Phases of departure from a home orbit and of arrival there, rad, which may move within spans.

    Attributes:
        ring: states by phase.
        at: present phases.
        spans: least and greatest; equal where a phase is given.
    """

    ring: Ring
    at: tuple[float, float]
    spans: tuple[Interval, Interval]

    @property
    def free(self) -> tuple[int, ...]:
        """Numbers of the phases that may move."""
        return tuple(i for i, (low, high) in enumerate(self.spans) if high - low > FREE_SPAN)

    def boundary(self, units: Array, factor: Callable[[Array], Array]) -> Boundary:
        """Nondimensional boundary states by phase, with the initial factor by the initial state, SI."""

        def first(phase: float) -> tuple[Array, Array]:
            return self.ring(phase) / units, factor(self.ring(phase))

        return Boundary(first, lambda phase: self.ring(phase) / units, self.at, self.free)

    def rules(self, columns: int) -> tuple[Array, Array, tuple[str, ...]]:
        """Edges of spans of less than a turn, as matrix t >= least; phases are t's last columns."""
        rows, least, names = np.zeros((0, columns)), [], []
        for number, which in enumerate(self.free):
            (low, high), end = self.spans[which], ("departure", "arrival")[which]
            if high - low >= TURN - FREE_SPAN:
                continue
            one = np.eye(columns)[[columns - len(self.free) + number]]
            rows = np.vstack([rows, one, -one])
            least += [low, -high]
            names += [
                f"{end} at {np.rad2deg(low):g} deg or more",
                f"{end} at {np.rad2deg(high):g} deg or less",
            ]
        return rows, np.array(least), tuple(names)


def firing_times(
    scenario: Scenario,
    window_s: Window,
    nodes: tuple[Array, Indices, Indices],
    spans_s: Sequence[Interval],
    unit_s: float,
    home: tuple[HomePhases, Boundary] | None = None,
) -> FiringTimes | None:
    """Firing times and phases that may move, nondimensional; None if all are given.

    Rules that have an "or", a burn before or after the window, are chosen by where the burn is now. A
    rule keeps some room, or what the present times have of it.

    Args:
        scenario: with the present times.
        window_s: observation window.
        nodes: their times, shape (n,) in s; those of the burns to be planned; others that stay.
        spans_s: earliest and latest time of each burn to be planned; equal where it is given.
        unit_s: unit of time.
        home: phases on the home orbit, and the boundary states by these; without it the flight's ends
            stay.
    """
    times_s, burn_nodes, fixed = nodes
    ends = () if home else (0, len(times_s) - 1)
    wide = [high - low > FREE_SPAN_S for low, high in spans_s]
    free = np.flatnonzero(wide & ~np.isin(burn_nodes, ends))
    phases = home[0].free if home else ()
    if not free.size and not phases:
        return None
    flown, times = scenario.burns_flown, np.array(scenario.burns.times_s)
    before = burns_before(scenario.burns.times_s, window_s)
    matrix, least, names = timing_rules(len(times), window_s, before, scenario.schedule)
    own, one = matrix[:, flown + free], np.eye(len(free))
    least = least - np.delete(matrix, flown + free, axis=1) @ np.delete(times, flown + free)
    low, high = np.array(spans_s)[free].reshape(-1, 2).T
    number = [f"burn {1 + flown + i}" for i in free]
    rows = np.vstack([own, one, -one])
    bounds = np.concatenate([least + ROOM_S, low, -high])
    said = (
        *names,
        *(f"{name} at {time:g} s or later" for name, time in zip(number, low, strict=True)),
        *(f"{name} at {time:g} s or before" for name, time in zip(number, high, strict=True)),
    )
    felt = np.flatnonzero(rows.any(axis=1) & np.isfinite(bounds))
    now = times[flown + free]
    bounds = np.minimum(bounds, rows @ now)[felt] / unit_s
    rows, said = np.pad(rows[felt], ((0, 0), (0, len(phases)))), tuple(said[i] for i in felt)
    if home is not None:
        of_phases, edges, words = home[0].rules(len(free) + len(phases))
        rows, said = np.vstack([rows, of_phases]), (*said, *words)
        bounds = np.r_[bounds, edges]
    rules = rows, bounds, said
    boundary = home[1] if home and phases else None
    return FiringTimes.on_grid(free, times_s / unit_s, burn_nodes, fixed, rules, boundary)
