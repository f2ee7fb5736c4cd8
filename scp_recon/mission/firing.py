"""Make the firing times of a mission controls, within their spans and the schedule's rules."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from formulations.arrays import Array, Indices
from formulations.problem.firing_times import FiringTimes
from scp_recon.mission.schedule import ROOM_S, Interval, burns_before, timing_rules
from scp_recon.mission.windows import Window
from scp_recon.scenario.schema import Scenario

FREE_SPAN_S = 1e-3
"""Span below which a time counts as given."""


def firing_times(
    scenario: Scenario,
    window_s: Window,
    nodes: tuple[Array, Indices, Indices],
    spans_s: Sequence[Interval],
    unit_s: float,
) -> FiringTimes | None:
    """Firing times that may move, nondimensional; None if all are given.

    Rules that have an "or", a burn before or after the window, are chosen by where the burn is now. A
    rule keeps some room, or what the present times have of it.

    Args:
        scenario: with the present times.
        window_s: observation window.
        nodes: their times, shape (n,) in s; those of the burns to be planned; others that stay.
        spans_s: earliest and latest time of each burn to be planned; equal where it is given.
        unit_s: unit of time.
    """
    times_s, burn_nodes, fixed = nodes
    last = len(times_s) - 1
    free = np.array(
        [
            i
            for i, (low, high) in enumerate(spans_s)
            if high - low > FREE_SPAN_S and 0 < burn_nodes[i] < last
        ],
        dtype=np.intp,
    )
    if not free.size:
        return None
    flown, times = scenario.burns_flown, np.array(scenario.burns.times_s)
    before = burns_before(scenario.burns.times_s, window_s)
    matrix, least, names = timing_rules(len(times), window_s, before, scenario.schedule)
    own, one = matrix[:, flown + free], np.eye(len(free))
    least = least - np.delete(matrix, flown + free, axis=1) @ np.delete(times, flown + free)
    low, high = np.array(spans_s)[free].T
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
    rules = rows[felt], bounds, tuple(said[i] for i in felt)
    return FiringTimes.on_grid(free, times_s / unit_s, burn_nodes, fixed, rules)
