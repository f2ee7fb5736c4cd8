"""Make firing times, and phases on a home orbit, controls within spans and the schedule's rules."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from formulations.arrays import Array, Indices
from formulations.problem.controls import Boundary, Feedback, FiringTimes
from scp_recon.mission.feedback import known_from_s, moves_along
from scp_recon.mission.schedule import ROOM_S, Interval, burns_before, timing_rules
from scp_recon.mission.windows import Window
from scp_recon.scenario.schema import Scenario

FREE_SPAN_S = 1e-3
"""Span below which a time counts as given."""
BEFORE_END = "before the end of its span"
"""Words of a rule that more time, not less, makes weaker."""
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
            state = self.ring(phase)
            return state / units, factor(state)

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
    window_s: Window | None,
    nodes: tuple[Array, Indices, Indices],
    spans_s: Sequence[Interval],
    unit_s: float,
    home: tuple[HomePhases, Boundary] | None = None,
    feedback: Feedback | None = None,
) -> FiringTimes | None:
    """Firing times and phases that may move, nondimensional; None if all are given.

    Rules that have an "or", a burn before or after the window, are chosen by where the burn is now. A
    rule keeps some room, or what the present times have of it. Cut-offs move along with their burns,
    in the order that they have with all other burns and with the window. A burn whose cut-off is in the
    window, at the beginning or at another burn stays. Data of contacts and pictures stay where they
    are, and their burns come when these are known.

    Args:
        scenario: with the present times.
        window_s: observation window; None if nothing is observed.
        nodes: their times, shape (n,) in s; those of the burns to be planned; others that stay.
        spans_s: earliest and latest time of each burn to be planned; equal where it is given.
        unit_s: unit of time.
        home: phases on the home orbit, and the boundary states by these; without it the flight's ends
            stay.
        feedback: measurements of the corrected burns, if any.
    """
    times_s, burn_nodes, fixed = nodes
    ends = () if home else (0, len(times_s) - 1)
    wide = [high - low > FREE_SPAN_S for low, high in spans_s]
    cut_offs = {}
    if feedback is not None:
        cut_offs = dict(zip(feedback.burns.tolist(), feedback.cut_offs.tolist(), strict=True))
    along = {burn: node for burn, node in cut_offs.items() if moves_along(scenario, burn)}
    tied = _tied(nodes, cut_offs, along)
    free = np.setdiff1d(np.flatnonzero(wide & ~np.isin(burn_nodes, ends)), tied)
    along = {burn: node for burn, node in along.items() if burn in free}
    phases = home[0].free if home else ()
    if not free.size and not phases:
        return None
    flown, times = scenario.burns_flown, np.array(scenario.burns.times_s)
    before = 0 if window_s is None else burns_before(scenario.burns.times_s, window_s)
    matrix, least, names = timing_rules(len(times), window_s, before, scenario.schedule)
    own, one = matrix[:, flown + free], np.eye(len(free))
    least = least - np.delete(matrix, flown + free, axis=1) @ np.delete(times, flown + free)
    low, high = np.array(spans_s)[free].reshape(-1, 2).T
    number = [f"burn {1 + flown + i}" for i in free]
    order, gaps, ordered = _in_order(nodes, free, cut_offs, along, flown)
    late, known_s, waiting = _after_data(scenario, times_s, free, cut_offs, along)
    now = times[flown + free]
    rows = np.vstack([own, order, late, one, -one])
    bounds = np.concatenate([least + ROOM_S, order @ now - gaps + ROOM_S, known_s, low, -high])
    said = (
        *names,
        *ordered,
        *waiting,
        *(f"{name} after the beginning of its span" for name in number),
        *(f"{name} {BEFORE_END}" for name in number),
    )
    felt = np.flatnonzero(rows.any(axis=1) & np.isfinite(bounds))
    bounds = np.minimum(bounds, rows @ now)[felt] / unit_s
    rows, said = np.pad(rows[felt], ((0, 0), (0, len(phases)))), tuple(said[i] for i in felt)
    if home is not None:
        of_phases, edges, words = home[0].rules(len(free) + len(phases))
        rows, said = np.vstack([rows, of_phases]), (*said, *words)
        bounds = np.r_[bounds, edges]
    boundary = home[1] if home and phases else None
    fixed = np.union1d(fixed, list(cut_offs.values())).astype(np.intp)
    grid, rules = (times_s / unit_s, burn_nodes, fixed), (rows, bounds, said)
    return FiringTimes.on_grid(free, *grid, rules, boundary, along)


def _tied(
    nodes: tuple[Array, Indices, Indices], cut_offs: Mapping[int, int], along: Mapping[int, int]
) -> list[int]:
    """Burns that stay: those whose cut-offs cannot move with them, or that are at another's cut-off."""
    _, burn_nodes, fixed = nodes
    at, tied = {int(node): burn for burn, node in enumerate(burn_nodes)}, list[int]()
    for burn, node in cut_offs.items():
        other = at.get(node, burn)
        if other != burn:
            tied += [burn, other]
        elif node in (0, *fixed) if burn in along else node in at:
            tied.append(burn)
    return tied


Rules = tuple[Array, Array, tuple[str, ...]]
"""Rows of the free times, a number in s for each, and names."""


def _in_order(
    nodes: tuple[Array, Indices, Indices],
    free: Indices,
    cut_offs: Mapping[int, int],
    along: Mapping[int, int],
    flown: int,
) -> Rules:
    """Differences of times that keep cut-offs in order, with the present gaps.

    Each is between neighbours of which at least one is a cut-off apart from its burn. Nodes of
    cut-offs are given by their burns, of all and of those that move along.
    """
    times_s, burn_nodes, fixed = nodes
    owner = {int(burn_nodes[burn]): i for i, burn in enumerate(free)}
    owner |= {node: int(np.searchsorted(free, burn)) for burn, node in along.items()}
    served = {node: burn for burn, node in cut_offs.items() if node != burn_nodes[burn]}
    called = {0: "the beginning", len(times_s) - 1: "the end"}
    called |= dict.fromkeys(fixed.tolist(), "the window")
    called |= {node: f"burn {1 + flown + i}" for i, node in enumerate(burn_nodes.tolist())}
    called |= {node: f"the cut-off of burn {1 + flown + i}" for node, i in served.items()}
    pairs = [pair for pair in itertools.pairwise(sorted(called)) if served.keys() & pair]
    rows, gaps = np.zeros((len(pairs), len(free))), np.zeros(len(pairs))
    for row, (first, second) in enumerate(pairs):
        gaps[row] = times_s[second] - times_s[first]
        for node, sign in ((second, 1.0), (first, -1.0)):
            if node in owner:
                rows[row, owner[node]] += sign
    return rows, gaps, tuple(f"{called[second]} after {called[first]}" for first, second in pairs)


def _after_data(
    scenario: Scenario,
    times_s: Array,
    free: Indices,
    cut_offs: Mapping[int, int],
    along: Mapping[int, int],
) -> Rules:
    """Times of burns whose data do not move along, with those from which on the data are known."""
    waits = [i for i, burn in enumerate(free.tolist()) if burn in cut_offs and burn not in along]
    known_s, names = np.zeros(len(waits)), list[str]()
    for row, burn in enumerate(free[waits].tolist()):
        known_s[row] = known_from_s(scenario, burn, float(times_s[cut_offs[burn]]))
        number = 1 + scenario.burns_flown + burn
        names.append(f"burn {number} at {known_s[row]:g} s or later, with its data")
    return np.eye(len(free))[waits], known_s, tuple(names)
