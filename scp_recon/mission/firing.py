"""Make firing times, and phases on a home orbit, controls within spans and the schedule's rules."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
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

Rule = tuple[str, Array, float]
"""A name, factors of the free times in s (and phases in rad), and the least of the sum."""
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

    def rules(self, columns: int) -> Iterator[Rule]:
        """Edges of spans of less than a turn; phases are the last of so many columns."""
        for row, which in zip(np.eye(columns)[columns - len(self.free) :], self.free, strict=True):
            (low, high), end = self.spans[which], ("departure", "arrival")[which]
            if high - low < TURN - FREE_SPAN:
                yield f"{end} at {np.rad2deg(low):g} deg or more", row, low
                yield f"{end} at {np.rad2deg(high):g} deg or less", -row, -high


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
    own, one, now = matrix[:, flown + free], np.eye(len(free)), times[flown + free]
    least = least - np.delete(matrix, flown + free, axis=1) @ np.delete(times, flown + free)
    low, high = np.array(spans_s)[free].reshape(-1, 2).T
    number = [f"burn {1 + flown + i}" for i in free]
    known_s = {
        burn: (i, known_from_s(scenario, burn, float(times_s[cut_offs[burn]])))
        for i, burn in enumerate(free.tolist())
        if burn in cut_offs and burn not in along
    }
    with_data = "burn {} at {:g} s or later, with its data"
    begin = (f"{name} after the beginning of its span" for name in number)
    rules = [
        *zip(names, own, least + ROOM_S, strict=True),
        *_in_order(scenario, nodes, free, cut_offs, along),
        *(
            (with_data.format(1 + flown + burn, at), one[i], at)
            for burn, (i, at) in known_s.items()
        ),
        *zip(begin, one, low, strict=True),
        *zip((f"{name} {BEFORE_END}" for name in number), -one, -high, strict=True),
    ]
    felt: list[Rule] = [
        (name, np.pad(row, (0, len(phases))), min(bound, float(row @ now)) / unit_s)
        for name, row, bound in rules
        if row.any() and np.isfinite(bound)
    ]
    if home is not None:
        felt += home[0].rules(len(free) + len(phases))
    boundary = home[1] if home and phases else None
    fixed = np.union1d(fixed, list(cut_offs.values())).astype(np.intp)
    limits = (
        np.array([row for _, row, _ in felt]).reshape(len(felt), len(free) + len(phases)),
        np.array([bound for _, _, bound in felt]),
        tuple(name for name, _, _ in felt),
    )
    grid = times_s / unit_s, burn_nodes, fixed
    return FiringTimes.on_grid(free, *grid, limits, boundary, along)


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


def _in_order(
    scenario: Scenario,
    nodes: tuple[Array, Indices, Indices],
    free: Indices,
    cut_offs: Mapping[int, int],
    along: Mapping[int, int],
) -> Iterator[Rule]:
    """Differences of times that keep cut-offs in order, with the present gaps.

    Each is between neighbours of which at least one is a cut-off apart from its burn. Nodes of
    cut-offs are given by their burns, of all and of those that move along.
    """
    (times_s, burn_nodes, fixed), flown = nodes, scenario.burns_flown
    owner = {int(burn_nodes[burn]): i for i, burn in enumerate(free)}
    owner |= {node: int(np.searchsorted(free, burn)) for burn, node in along.items()}
    served = {node: burn for burn, node in cut_offs.items() if node != burn_nodes[burn]}
    called = {0: "the beginning", len(times_s) - 1: "the end"}
    called |= dict.fromkeys(fixed.tolist(), "the window")
    called |= {node: f"burn {1 + flown + i}" for i, node in enumerate(burn_nodes.tolist())}
    called |= {node: f"the cut-off of burn {1 + flown + i}" for node, i in served.items()}
    now = np.array(scenario.burns.times_s)[flown + free]
    for first, second in itertools.pairwise(sorted(called)):
        if served.keys() & {first, second}:
            row = np.zeros(len(free))
            for node, sign in ((second, 1.0), (first, -1.0)):
                if node in owner:
                    row[owner[node]] += sign
            least = row @ now - (times_s[second] - times_s[first]) + ROOM_S
            yield f"{called[second]} after {called[first]}", row, float(least)
