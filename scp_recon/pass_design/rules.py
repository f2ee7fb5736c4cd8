"""The schedule's rules as linear inequalities on burn times, and legal times near given ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.optimize import linprog

from scp_recon.mission.legal_burns import before_burn_s, sun_leg_s
from scp_recon.mission.windows import Window
from scp_recon.scenario.sections import ScheduleRules

Array = npt.NDArray[np.float64]
Span = tuple[float, float]


ROOM_S = 1.0
"""By which times that are free keep the rules, so that they may be rounded."""


def timing_rules(
    n_burns: int, window_s: Window, before: int, rules: ScheduleRules
) -> tuple[Array, Array]:
    """A and b of A t >= b, shapes (m, m) and (m,), for the times t of m burns in s.

    A burn comes a cycle after the burn or the window before it: slew and recharge, then slew and
    heating. Slew, recharge and another slew part a burn from the window after it. Echigo et al.,
    section V.A.

    Args:
        n_burns: m.
        window_s: observation window, in the burns' time.
        before: burns between the first one and the window, at most m - 2.
        rules: durations.
    """
    sun_leg = sun_leg_s(rules)
    cycle = sun_leg + before_burn_s(rules)
    rows = np.eye(n_burns - 1, n_burns, 1) - np.eye(n_burns - 1, n_burns)
    least = np.full(n_burns - 1, cycle)
    rows[before, before] = 0.0  # the window lies between these two
    least[before] += window_s[1]
    rows = np.vstack([rows, -np.eye(n_burns)[before]])
    return rows, np.r_[least, rules.attitude_s + sun_leg - window_s[0]]


def nearest_legal(
    times_s: Sequence[float],
    spans_s: Sequence[Span],
    window_s: Window,
    before: int,
    rules: ScheduleRules,
) -> tuple[float, ...] | None:
    """Times within spans and rules, the sum of their differences from given ones the least.

    Returns:
        None if there are none.
    """
    n, wanted = len(times_s), np.array(times_s)
    matrix, least = timing_rules(n, window_s, before, rules)
    apart = np.vstack([np.hstack([s * np.eye(n), -np.eye(n)]) for s in (1.0, -1.0)])
    found = linprog(
        np.r_[np.zeros(n), np.ones(n)],
        A_ub=np.vstack([apart, np.hstack([-matrix, np.zeros((n, n))])]),
        b_ub=np.r_[wanted, -wanted, -least],
        bounds=[*spans_s, *[(0.0, None)] * n],
    )
    return None if found.x is None else tuple(map(float, found.x[:n]))
